//! Chaining of pair flows and choice between chains of different gaps: each pixel takes the candidate with the
//! smallest standard deviation among those that see it (after Neoral et al., "MFT: long-term tracking of every
//! pixel", 2024, with the uncertainties measured instead of learned).

use super::{
    consistency::{Judged, is_inside},
    flow::Flow,
};

/// Continues tracks from the key frame to an earlier frame by the flow from there.
pub(super) fn chain(to_earlier: &Judged, onward: &Judged) -> Judged {
    let (width, height) = (to_earlier.flow.width, to_earlier.flow.height);
    let mut flow = Flow::zeros(width, height);
    let mut visible = Vec::with_capacity(width * height);
    let mut sigma = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let [u, v] = to_earlier.flow.at(x, y);
            let (at_x, at_y) = (x as f32 + u, y as f32 + v);
            let corners = onward.flow.corners(at_x, at_y);
            let step = onward.flow.sample(at_x, at_y);
            flow.u[i] = u + step[0];
            flow.v[i] = v + step[1];
            let step_seen = corners.iter().all(|&(corner, weight)| weight < 0.05 || onward.visible[corner]);
            let inside = is_inside(x as f32 + flow.u[i], y as f32 + flow.v[i], width, height);
            visible.push(to_earlier.visible[i] && step_seen && inside);
            let step_sigma: f32 = corners.iter().map(|&(corner, weight)| weight * onward.sigma[corner]).sum();
            sigma.push(to_earlier.sigma[i].hypot(step_sigma));
        }
    }
    Judged { flow, visible, sigma }
}

/// Per pixel the candidate with the smallest standard deviation among the visible ones, the first of equals; where
/// none is visible, the one with the smallest of all.
pub(super) fn choose(candidates: &[Judged]) -> Judged {
    let mut chosen = candidates[0].clone();
    for candidate in &candidates[1..] {
        for i in 0..chosen.sigma.len() {
            let better = match (candidate.visible[i], chosen.visible[i]) {
                (true, false) => true,
                (false, true) => false,
                _ => candidate.sigma[i] < chosen.sigma[i],
            };
            if better {
                chosen.flow.u[i] = candidate.flow.u[i];
                chosen.flow.v[i] = candidate.flow.v[i];
                chosen.visible[i] = candidate.visible[i];
                chosen.sigma[i] = candidate.sigma[i];
            }
        }
    }
    chosen
}

/// The way back along visible tracks, zero where none arrives; of several the most certain counts.
pub(super) fn inverted(judged: &Judged) -> Flow {
    let (width, height) = (judged.flow.width, judged.flow.height);
    let mut back = Flow::zeros(width, height);
    let mut certainty = vec![f32::INFINITY; width * height];
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let [u, v] = judged.flow.at(x, y);
            let (to_x, to_y) = ((x as f32 + u).round(), (y as f32 + v).round());
            let inside = to_x >= 0.0 && to_y >= 0.0 && to_x < width as f32 && to_y < height as f32;
            if !judged.visible[i] || !inside {
                continue;
            }
            let at = to_y as usize * width + to_x as usize;
            if judged.sigma[i] < certainty[at] {
                certainty[at] = judged.sigma[i];
                back.u[at] = -u;
                back.v[at] = -v;
            }
        }
    }
    back
}
