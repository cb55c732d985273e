//! A loaded network: what goes in, what comes out, and every way in which that can fail.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
};

use rten::{Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value};

use super::{
    LearnedError,
    images::Fit,
    settings::{OnnxSettings, ValueRange},
    signature::{self, Doubt, Ports, Signature, Visibility},
    wire,
};

/// Most bytes of a model.
pub const MAX_MODEL_BYTES: usize = 1 << 30;

/// Longest side of the images that a network sees, pixels.
pub const MAX_SIDE: usize = 4096;

/// Largest multiple that sides are padded to.
pub(super) const MAX_MULTIPLE: usize = 256;

/// An image as a network takes it.
pub(super) struct Input {
    pub(super) fit: Fit,
    value: Value,
}

/// What a network says about a pair of images, at its own resolution, `padded` of the [`Fit`].
pub(super) struct Maps {
    pub(super) flow: [Vec<f32>; 2],
    /// Probability per pixel; empty where the network gives none.
    pub(super) visible: Vec<f32>,
    /// Standard deviation per axis, pixels of the network; empty where the network gives none.
    pub(super) sigma: Vec<f32>,
}

/// A network with the preprocessing that it wants.
#[derive(Debug)]
pub(super) struct Network {
    name: String,
    model: Model,
    ports: Ports,
    range: ValueRange,
    multiple: usize,
    max_side: usize,
}

impl Network {
    pub(super) fn load(bytes: Vec<u8>, name: &str, settings: &OnnxSettings) -> Result<Self, LearnedError> {
        if bytes.len() > MAX_MODEL_BYTES {
            return Err(LearnedError::TooLarge {
                model: name.into(),
                bytes: bytes.len(),
                most: MAX_MODEL_BYTES,
            });
        }
        let unloadable = |problem: String| LearnedError::Unloadable { model: name.into(), problem };
        wire::check(&bytes).map_err(|problem| unloadable(problem.into()))?;
        let model = guarded(|| ModelOptions::with_all_ops().load(bytes))
            .and_then(|model| model.map_err(|error| error.to_string()))
            .map_err(unloadable)?;
        let not_a_tracker = |problem| {
            let found = signature::found(&model);
            LearnedError::Signature { model: name.into(), problem, found }
        };
        let ports = Ports::of(&model).map_err(not_a_tracker)?;
        if let Some((width, height)) =
            ports.size.filter(|&(w, h)| !(1..=MAX_SIDE).contains(&w) || !(1..=MAX_SIDE).contains(&h))
        {
            return Err(not_a_tracker(format!(
                "its images are {width} x {height}, sides may have 1 to {MAX_SIDE}"
            )));
        }
        let range = match settings.range {
            Some(range) => range,
            None => {
                metadata(&model, name, "trackersplat.range", ValueRange::EXPECTED, ValueRange::from_name)?
                    .unwrap_or(ValueRange::Bytes)
            }
        };
        let multiple = match settings.multiple {
            Some(multiple) => (multiple as usize).clamp(1, MAX_MULTIPLE),
            None => metadata(&model, name, "trackersplat.multiple", "1 to 256", |text| {
                text.parse().ok().filter(|multiple| (1..=MAX_MULTIPLE).contains(multiple))
            })?
            .unwrap_or(8),
        };
        let max_side = (settings.max_side as usize).clamp(1, MAX_SIDE);
        Ok(Self { name: name.into(), model, ports, range, multiple, max_side })
    }

    pub(super) fn signature(&self) -> Signature {
        match self.ports.visibility {
            Some(_) => Signature::KeyToFrame,
            None => Signature::PairFlow,
        }
    }

    /// Longer side of the largest images that the network sees; at least 1.
    pub(super) fn longest_side(&self) -> usize {
        self.ports.size.map_or(self.max_side, |(width, height)| width.max(height))
    }

    /// An image, three channels of `height * width` values from 0 to 255, as the network takes it; sides of at least 1.
    pub(super) fn input(
        &self,
        width: usize,
        height: usize,
        channels: &[Vec<f32>; 3],
    ) -> Result<Input, LearnedError> {
        let fit = match self.ports.size {
            Some(size) => Fit::stretched((width, height), size),
            None => Fit::within((width, height), self.max_side, self.multiple),
        };
        let values = fit.input(channels, self.range);
        let value = Value::from_shape([1, 3, fit.padded.1, fit.padded.0], values)
            .map_err(|error| self.failed(&fit, error.to_string()))?;
        Ok(Input { fit, value })
    }

    /// What the network says about two images of the same size.
    pub(super) fn run(&self, first: &Input, second: &Input) -> Result<Maps, LearnedError> {
        let fit = &first.fit;
        let mut wanted = vec![self.ports.flow];
        wanted.extend(self.ports.visibility.map(|(id, _)| id));
        wanted.extend(self.ports.doubt.map(|(id, _)| id));
        let inputs = vec![
            (self.ports.images[0], (&first.value).into()),
            (self.ports.images[1], (&second.value).into()),
        ];
        // A thread of its own for each run: the runtime divides some products by the number of threads, which would
        // show in the last bits. What runs at the same time is pairs and views.
        let options = RunOptions::default().with_thread_pool(Some(Arc::new(ThreadPool::with_num_threads(1))));
        let values = guarded(|| self.model.run(inputs, &wanted, Some(options)))
            .and_then(|values| values.map_err(|error| error.to_string()))
            .map_err(|problem| self.failed(fit, problem))?;

        let mut values = values.into_iter();
        let mut next = |id: NodeId, name, channels| -> Result<Vec<f32>, LearnedError> {
            let value =
                values.next().ok_or_else(|| self.failed(fit, format!("no value for output {id:?}")))?;
            self.map(value, name, channels, fit)
        };
        let mut flow = next(self.ports.flow, "flow", 2)?;
        let v = flow.split_off(flow.len() / 2);
        let visible = match self.ports.visibility {
            None => Vec::new(),
            Some((id, Visibility::Probability)) => next(id, "visibility", 1)?,
            Some((id, Visibility::Logits)) => {
                let logits = next(id, "visibility_logits", 1)?;
                logits.into_iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect()
            }
        };
        let sigma = match self.ports.doubt {
            None => Vec::new(),
            Some((id, Doubt::Sigma)) => next(id, "sigma", 1)?,
            Some((id, Doubt::LogVariance)) => {
                next(id, "log_variance", 1)?.into_iter().map(|log| (0.5 * log).exp()).collect()
            }
        };
        let finite = flow.iter().zip(&v).filter(|(u, v)| u.is_finite() && v.is_finite()).count();
        if 2 * finite < flow.len() {
            let found = format!("not finite in {} of {} pixels", flow.len() - finite, flow.len());
            let expected = "numbers; check the range of its images (tracking.onnx.range)".to_owned();
            return Err(LearnedError::Output { model: self.name.clone(), output: "flow", found, expected });
        }
        Ok(Maps { flow: [flow, v], visible, sigma })
    }

    /// The values of an output of `channels` maps.
    fn map(
        &self,
        value: Value,
        output: &'static str,
        channels: usize,
        fit: &Fit,
    ) -> Result<Vec<f32>, LearnedError> {
        let (width, height) = fit.padded;
        let wrong = |found: String| {
            let expected = format!("f32 [1, {channels}, {height}, {width}], the size of the images");
            LearnedError::Output { model: self.name.clone(), output, found, expected }
        };
        let flat = (channels == 1).then(|| value.clone().into_shape_vec::<f32, 3>().ok()).flatten();
        if let Some((_, values)) = flat.filter(|(shape, _)| *shape == [1, height, width]) {
            return Ok(values);
        }
        let (shape, values) = value.into_shape_vec::<f32, 4>().map_err(|error| wrong(error.to_string()))?;
        if shape != [1, channels, height, width] {
            return Err(wrong(format!("{shape:?}")));
        }
        Ok(values)
    }

    fn failed(&self, fit: &Fit, problem: String) -> LearnedError {
        let (width, height) = fit.padded;
        LearnedError::Run { model: self.name.clone(), width, height, problem }
    }
}

/// An entry of the model's metadata, if it is there.
fn metadata<T>(
    model: &Model,
    name: &str,
    key: &'static str,
    expected: &'static str,
    parse: impl Fn(&str) -> Option<T>,
) -> Result<Option<T>, LearnedError> {
    let Some(value) = model.metadata().get(key) else { return Ok(None) };
    let wrong = || LearnedError::Metadata { model: name.into(), key, value: value.into(), expected };
    parse(value.trim()).map(Some).ok_or_else(wrong)
}

/// Runs the runtime; a file that it did not foresee must not end the process.
fn guarded<T>(run: impl FnOnce() -> T) -> Result<T, String> {
    // Nothing that the closures borrow is used after a panic, except the model, whose caches are behind locks.
    catch_unwind(AssertUnwindSafe(run)).map_err(|panic| {
        let text =
            panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        format!("the runtime gave up ({})", text.unwrap_or("without a reason"))
    })
}
