//! Which kind of tracker a network is, by the names, types and shapes of its inputs and outputs.

use rten::{DataType, Dimension, Model, NodeId, ValueType};

/// What a network gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signature {
    /// The flow between two frames.
    PairFlow,
    /// The flow from the key frame to a frame, with visibility.
    KeyToFrame,
}

/// How an output states visibility.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Visibility {
    Probability,
    Logits,
}

/// How an output states doubt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Doubt {
    Sigma,
    LogVariance,
}

/// Inputs and outputs of a network.
#[derive(Debug)]
pub(super) struct Ports {
    pub(super) images: [NodeId; 2],
    pub(super) flow: NodeId,
    pub(super) visibility: Option<(NodeId, Visibility)>,
    pub(super) doubt: Option<(NodeId, Doubt)>,
    /// Width and height, if the network was exported for one size only.
    pub(super) size: Option<(usize, usize)>,
}

impl Ports {
    /// The ports of a network; in the error what does not fit.
    pub(super) fn of(model: &Model) -> Result<Self, String> {
        let [first, second] = ["image1", "image2"].map(|name| image(model, name));
        let ((first, size), (second, other_size)) = (first?, second?);
        if model.input_ids().len() != 2 {
            return Err(format!("it has {} inputs instead of two", model.input_ids().len()));
        }
        if size != other_size {
            return Err("its images differ in size".to_owned());
        }
        let flow = output(model, "flow").ok_or("it has no output flow")?;
        let either = |names: [&str; 2]| match names.map(|name| output(model, name)) {
            [Some(_), Some(_)] => Err(format!("it has both {} and {}", names[0], names[1])),
            [first, second] => Ok((first, second)),
        };
        let visibility = match either(["visibility", "visibility_logits"])? {
            (Some(id), _) => Some((id, Visibility::Probability)),
            (_, Some(id)) => Some((id, Visibility::Logits)),
            _ => None,
        };
        let doubt = match either(["sigma", "log_variance"])? {
            (Some(id), _) => Some((id, Doubt::Sigma)),
            (_, Some(id)) => Some((id, Doubt::LogVariance)),
            _ => None,
        };
        if doubt.is_some() && visibility.is_none() {
            return Err("it states doubt but no visibility".to_owned());
        }
        Ok(Self { images: [first, second], flow, visibility, doubt, size })
    }
}

/// An input image, and width and height if they are fixed.
fn image(model: &Model, name: &str) -> Result<(NodeId, Option<(usize, usize)>), String> {
    let id = named(model, model.input_ids(), name).ok_or_else(|| format!("it has no input {name}"))?;
    let Some(info) = model.node_info(id) else { return Err(format!("it has no input {name}")) };
    if info.dtype().is_some_and(|kind| kind != ValueType::Tensor(DataType::Float)) {
        return Err(format!("its input {name} is not f32"));
    }
    let Some(shape) = info.shape() else { return Ok((id, None)) };
    let is = |dimension: &Dimension, size| match dimension {
        Dimension::Fixed(fixed) => *fixed == size,
        Dimension::Symbolic(_) => true,
    };
    let [batch, channels, height, width] = &shape[..] else {
        return Err(format!("its input {name} has {} dimensions", shape.len()));
    };
    if !is(batch, 1) || !is(channels, 3) {
        return Err(format!("its input {name} is not one image of three channels"));
    }
    match (width, height) {
        (Dimension::Fixed(width), Dimension::Fixed(height)) => Ok((id, Some((*width, *height)))),
        (Dimension::Symbolic(_), Dimension::Symbolic(_)) => Ok((id, None)),
        _ => Err(format!("its input {name} has one fixed side; fix both or none")),
    }
}

fn output(model: &Model, name: &str) -> Option<NodeId> {
    named(model, model.output_ids(), name)
}

fn named(model: &Model, ids: &[NodeId], name: &str) -> Option<NodeId> {
    ids.iter().copied().find(|&id| model.node_info(id).and_then(|info| info.name()) == Some(name))
}

/// Inputs and outputs in words.
pub(super) fn found(model: &Model) -> String {
    let list = |ids: &[NodeId]| -> String {
        let described: Vec<String> = ids.iter().map(|&id| port(model, id)).collect();
        if described.is_empty() { "none".to_owned() } else { described.join(", ") }
    };
    format!("inputs {}; outputs {}", list(model.input_ids()), list(model.output_ids()))
}

fn port(model: &Model, id: NodeId) -> String {
    let Some(info) = model.node_info(id) else { return "?".to_owned() };
    let name = info.name().unwrap_or("(unnamed)");
    let shape = info.shape().map_or_else(
        || "of unknown shape".to_owned(),
        |shape| {
            let sizes: Vec<String> = shape
                .iter()
                .map(|dimension| match dimension {
                    Dimension::Fixed(size) => size.to_string(),
                    Dimension::Symbolic(name) => name.clone(),
                })
                .collect();
            format!("[{}]", sizes.join(", "))
        },
    );
    format!("{name} {shape}")
}
