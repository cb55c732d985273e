//! Moments of every footprint under a track field, see `wgsl/footprint_moments.wgsl`.

use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::cast_slice;
use splat::{
    cameras::Camera,
    engine::EngineError,
    gaussians::Gaussians,
    motion::{
        moments::FootprintMoments,
        reweighting::{ExpectedMotion, Reweighting},
    },
    tracking::TrackField,
};

use crate::{
    buffers::{
        Buffers, MomentBuffers, ParameterBuffers, Size, admit, admit_instead, parameters::check_lengths,
        total,
    },
    device::GpuDevice,
    engine::{Context, GpuEngine},
    layout::{Expectation, Moments, View},
    program::record,
    stages::{Binder, ViewBuffer},
    transfer::read,
};

/// What all passes over a view share.
struct Measurement<'a> {
    context: &'a Context,
    view: ViewBuffer,
    buffers: Buffers,
    tracks: MomentBuffers,
}

/// See `Engine::footprint_moments`; the tracks are of the camera's size.
pub(crate) fn footprint_moments(
    engine: &GpuEngine,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
    reweighting: Option<&Reweighting>,
) -> Result<Vec<FootprintMoments>, EngineError> {
    let device = &engine.context.device;
    let view = ViewBuffer::new(device, View::new(camera, [0.0; 3]))?;
    let (measured, size) = taken_over(engine, gaussians, &view.data)?;
    let buffers = Buffers::new(device, measured.parameters.clone(), &size)?;
    let (buffers, intersections) =
        engine
            .run(&measured.colourless, &view, buffers, |binder, buffers, view| binder.lists(buffers, view))?;
    // Sums are the largest buffer by far, and by now it is known how many there are.
    let of_lists = Size { capacity: intersections.into(), ..buffers.size };
    admit(device, &MomentBuffers::requests(&of_lists))?;
    let tracks = MomentBuffers::new(device, &of_lists, tracks)?;
    let measurement = Measurement { context: &engine.context, view, buffers, tracks };
    let (expectations, all) = every(gaussians.len());
    let mut moments = measurement.pass(&expectations, &all)?;
    if let Some(reweighting) = reweighting {
        reweighting.apply(&mut moments, |expected| measurement.reweighted(gaussians.len(), expected))?;
    }
    Ok(moments)
}

/// A set on the device, and what a view of it takes, for which there is room.
pub(crate) fn taken_over(
    engine: &GpuEngine,
    gaussians: &Gaussians,
    view: &View,
) -> Result<(Arc<Measured>, Size), EngineError> {
    let device = &engine.context.device;
    let size = engine.size(gaussians.len(), 1, view, false)?;
    let measured = engine.context.measured.take_over(device, gaussians)?;
    // By now its parameters are held.
    let parameters = total(&ParameterBuffers::requests(size.count, size.coefficients));
    admit_instead(device, &Buffers::requests(&size), parameters)?;
    Ok((measured, size))
}

/// The first pass: every footprint, as it is.
pub(crate) fn every(count: usize) -> (Vec<Expectation>, Vec<u32>) {
    let wanted = Expectation { is_wanted: 1.0, ..Expectation::default() };
    (vec![wanted; count], (0..count as u32).collect())
}

/// What a footprint needs of its Gaussian, here and on the device.
#[derive(Debug)]
pub(crate) struct Measured {
    /// All but the higher harmonics, most of what there is to upload.
    colourless: Gaussians,
    parameters: ParameterBuffers,
}

/// The set that was measured last. Views of one moment see the same Gaussians, and comparing a set takes a fifth of the time
/// that uploading it takes, or less.
#[derive(Debug, Default)]
pub(crate) struct LastMeasured(Mutex<Option<Arc<Measured>>>);

impl LastMeasured {
    /// Frees what is kept, unless it is in use.
    pub(crate) fn forget(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Uploads a set unless it is there already.
    pub(crate) fn take_over(
        &self,
        device: &GpuDevice,
        gaussians: &Gaussians,
    ) -> Result<Arc<Measured>, EngineError> {
        check_lengths(gaussians)?;
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(measured) = last.as_ref().filter(|measured| measured.is_of(gaussians)) {
            return Ok(Arc::clone(measured));
        }
        // Before there are two of them.
        *last = None;
        let colourless = without_directions(gaussians);
        let parameters = ParameterBuffers::new(device, &colourless)?;
        Ok(Arc::clone(last.insert(Arc::new(Measured { colourless, parameters }))))
    }
}

impl Measured {
    /// Whether it is the same bit by bit, of a set whose arrays belong together.
    fn is_of(&self, gaussians: &Gaussians) -> bool {
        let Gaussians { means, rotations, log_scales, logit_opacities, sh, .. } = &self.colourless;
        let stride = 3 * gaussians.sh_coefficients();
        let is_same = |kept: &[f32], given: &[f32]| cast_slice::<_, u8>(kept) == cast_slice::<_, u8>(given);
        is_same(means.as_flattened(), gaussians.means.as_flattened())
            && is_same(rotations.as_flattened(), gaussians.rotations.as_flattened())
            && is_same(log_scales.as_flattened(), gaussians.log_scales.as_flattened())
            && is_same(logit_opacities, &gaussians.logit_opacities)
            && sh.chunks_exact(3).zip(gaussians.sh.chunks_exact(stride)).all(|(a, b)| is_same(a, &b[..3]))
    }
}

fn without_directions(gaussians: &Gaussians) -> Gaussians {
    let stride = 3 * gaussians.sh_coefficients();
    Gaussians {
        means: gaussians.means.clone(),
        rotations: gaussians.rotations.clone(),
        log_scales: gaussians.log_scales.clone(),
        logit_opacities: gaussians.logit_opacities.clone(),
        sh: gaussians.sh.chunks_exact(stride).flat_map(|sh| [sh[0], sh[1], sh[2]]).collect(),
        sh_degree: 0,
    }
}

impl Measurement<'_> {
    fn reweighted(
        &self,
        count: usize,
        expected: &[(u32, ExpectedMotion)],
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let mut expectations = vec![Expectation::default(); count];
        for &(index, ExpectedMotion { displacement, inverse_scale_squared }) in expected {
            expectations[index as usize] = Expectation {
                displacement: displacement.map(|value| value as f32),
                fall: (inverse_scale_squared * std::f64::consts::LOG2_E) as f32,
                is_wanted: 1.0,
            };
        }
        let wanted: Vec<u32> = expected.iter().map(|&(index, _)| index).collect();
        self.pass(&expectations, &wanted)
    }

    /// Moments of the wanted Gaussians' footprints, in their order.
    fn pass(
        &self,
        expectations: &[Expectation],
        wanted: &[u32],
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let Self { context: Context { device, kernels, .. }, view, buffers, tracks } = self;
        tracks.ask(device, expectations, wanted)?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        // Tiles whose pixels are covered leave the rest of their list alone.
        encoder.clear_buffer(&tracks.sums, 0, None);
        let program =
            Binder { device, kernels }.footprint_moments(buffers, tracks, view, wanted.len() as u64);
        record(&mut encoder, "moments", &program);
        device.queue.submit([encoder.finish()]);
        let found: Vec<Moments> = read(device, &tracks.moments, wanted.len())?;
        Ok(found.iter().map(|moments| absolute(moments, view.data.size[0])).collect())
    }
}

/// In the image's coordinates.
fn absolute(of: &Moments, width: u32) -> FootprintMoments {
    let [weight, weight_squared, blend_weight, visible] = of.weights.map(f64::from);
    if !(weight > 0.0) {
        return FootprintMoments { blend_weight, ..Default::default() };
    }
    let [u, v, a, b] = of.first.map(f64::from);
    let [uu, uv, vv, power] = of.second.map(f64::from);
    let [au, av, bu, bv] = of.cross.map(f64::from);
    let centroid = [f64::from(of.anchor % width) + 0.5 + u, f64::from(of.anchor / width) + 0.5 + v];
    let displacement = [f64::from(of.reference[0]) + a, f64::from(of.reference[1]) + b];
    FootprintMoments {
        blend_weight,
        visible,
        weight,
        weight_squared,
        pixels: of.pixels as u32,
        centroid,
        tracked_centroid: [centroid[0] + displacement[0], centroid[1] + displacement[1]],
        source: [uu, uv, vv],
        // The tracked position is the pixel plus its displacement.
        cross: [uu + au, uv + av, uv + bu, vv + bv],
        target: uu + vv + 2.0 * (au + bv) + power,
        variance: visible,
        contest: 0.0,
    }
}
