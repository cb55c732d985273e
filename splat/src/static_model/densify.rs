//! Adaptive density control: clone what is too small, split what is too large, remove what shows nothing.

use glam::DVec3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::StaticModelSettings;
use crate::{engine::DensityStatistics, gaussians::Gaussians};

/// Each half of a split Gaussian is smaller by this factor (3D Gaussian Splatting, section 5.2).
const SPLIT_SHRINK: f32 = 1.6;

/// A new set and, per Gaussian, the old one whose optimiser state it keeps.
pub(super) struct Densified {
    pub(super) gaussians: Gaussians,
    pub(super) source: Vec<Option<usize>>,
}

/// Grows and prunes `gaussians`; grows only if `grow`, and never beyond `settings.max_gaussians`.
pub(super) fn densify(
    gaussians: &Gaussians,
    statistics: &DensityStatistics,
    settings: &StaticModelSettings,
    extent: f64,
    grow: bool,
    random: &mut ChaCha8Rng,
) -> Densified {
    let keep: Vec<usize> = (0..gaussians.len()).filter(|&i| keeps(gaussians, i, settings, extent)).collect();
    let room = settings.max_gaussians.saturating_sub(keep.len());
    let chosen = if grow { strongest(&keep, statistics, settings, room) } else { Vec::new() };
    let mut result = Densified { gaussians: Gaussians::empty(gaussians.sh_degree), source: Vec::new() };
    let split_size = f64::from(settings.split_extent) * extent;
    for &index in &keep {
        let selected = chosen.binary_search(&index).is_ok();
        if !selected {
            push(&mut result, gaussians, index, Some(index));
        } else if largest_scale(gaussians, index) <= split_size {
            push(&mut result, gaussians, index, Some(index));
            push(&mut result, gaussians, index, None);
        } else {
            for _ in 0..2 {
                push(&mut result, gaussians, index, None);
                displace_and_shrink(&mut result.gaussians, gaussians, index, random);
            }
        }
    }
    result
}

fn keeps(gaussians: &Gaussians, index: usize, settings: &StaticModelSettings, extent: f64) -> bool {
    gaussians.is_finite(index)
        && gaussians.opacity(index) >= f64::from(settings.prune_opacity)
        && largest_scale(gaussians, index) <= f64::from(settings.prune_extent) * extent
}

fn largest_scale(gaussians: &Gaussians, index: usize) -> f64 {
    gaussians.log_scales[index].iter().map(|&value| f64::from(value).exp()).fold(0.0, f64::max)
}

/// Indices above the gradient threshold, ascending; the strongest `room` of them if there are more.
fn strongest(
    keep: &[usize],
    statistics: &DensityStatistics,
    settings: &StaticModelSettings,
    room: usize,
) -> Vec<usize> {
    let mut candidates: Vec<(f32, usize)> = keep
        .iter()
        .map(|&i| (statistics.gradient_norm[i] / statistics.visible_steps[i].max(1) as f32, i))
        .filter(|&(gradient, _)| gradient > settings.densify_gradient)
        .collect();
    candidates.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    candidates.truncate(room);
    let mut indices: Vec<usize> = candidates.into_iter().map(|(_, index)| index).collect();
    indices.sort_unstable();
    indices
}

fn push(result: &mut Densified, from: &Gaussians, index: usize, source: Option<usize>) {
    let set = &mut result.gaussians;
    set.means.push(from.means[index]);
    set.rotations.push(from.rotations[index]);
    set.log_scales.push(from.log_scales[index]);
    set.logit_opacities.push(from.logit_opacities[index]);
    set.sh.extend_from_slice(from.sh_of(index));
    result.source.push(source);
}

/// Moves the last Gaussian of `set` to a sample of the one it was split from, and shrinks it.
fn displace_and_shrink(set: &mut Gaussians, from: &Gaussians, index: usize, random: &mut ChaCha8Rng) {
    let scales = from.log_scales[index].map(|value| f64::from(value).exp());
    let sample: [f64; 3] = std::array::from_fn(|axis| scales[axis] * standard_normal(random));
    let moved = from.mean(index) + from.rotation(index) * DVec3::from(sample);
    let last = set.len() - 1;
    set.means[last] = moved.as_vec3().to_array();
    set.log_scales[last] = from.log_scales[index].map(|value| value - SPLIT_SHRINK.ln());
}

/// Box–Muller.
fn standard_normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}
