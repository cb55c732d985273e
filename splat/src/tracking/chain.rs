//! Chaining of pair flows and choice between chains of different gaps: each pixel takes the candidate that most of those
//! that see it agree with, of those the one with the smallest standard deviation (after Neoral et al., "MFT: long-term
//! tracking of every pixel", 2024, with the uncertainties measured instead of learned).

use super::{
    consistency::{Judged, is_inside},
    flow::{self, Flow},
};

/// Continues tracks from the key frame to an earlier frame by the flow from there.
pub(super) fn chain(to_earlier: &Judged, onward: &Judged) -> Judged {
    let (width, height) = (to_earlier.flow.width, to_earlier.flow.height);
    let mut flow = Flow::zeros(width, height);
    let mut visible = Vec::with_capacity(width * height);
    let mut sigma = Vec::with_capacity(width * height);
    let mut links = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let [u, v] = to_earlier.flow.at(x, y);
            let (at_x, at_y) = (x as f32 + u, y as f32 + v);
            let corners = onward.flow.corners(at_x, at_y);
            let step = onward.flow.between(&corners);
            flow.u[i] = u + step[0];
            flow.v[i] = v + step[1];
            let step_seen = flow::sees(&corners, &onward.visible);
            let inside = is_inside(x as f32 + flow.u[i], y as f32 + flow.v[i], width, height);
            visible.push(to_earlier.visible[i] && step_seen && inside);
            let fetched = |values: &[f32]| -> f32 {
                corners.iter().map(|&(corner, weight)| weight * values[corner]).sum()
            };
            sigma.push(to_earlier.sigma[i].hypot(fetched(&onward.sigma)));
            links.push(to_earlier.links[i] + fetched(&onward.links));
        }
    }
    Judged { links, ..Judged::of(flow, visible, sigma) }
}

/// Share of the distance to the nearest candidate that disagrees in the standard deviation.
const DOUBT: f32 = 0.164;
/// Candidates closer than this support each other, pixels.
const AGREE: f32 = 2.0;

/// Per pixel the visible candidate that most others agree with, of those the one with the smallest standard
/// deviation, of equals the first. Without a majority the doubt is added to its standard deviation: repetitive or
/// plain texture matches well in wrong places too. Where no candidate is visible, the same among the hidden ones.
pub(super) fn choose(candidates: &[Judged]) -> Judged {
    let mut chosen = candidates[0].clone();
    for i in 0..chosen.sigma.len() {
        let (candidate, doubt) = choose_at(candidates, i);
        let candidate = &candidates[candidate];
        chosen.flow.u[i] = candidate.flow.u[i];
        chosen.flow.v[i] = candidate.flow.v[i];
        chosen.visible[i] = candidate.visible[i];
        chosen.sigma[i] = candidate.sigma[i].hypot(doubt);
        chosen.links[i] = candidate.links[i];
    }
    chosen
}

/// The chosen candidate for pixel `i`, and how far away the truth may be because of those that disagree.
fn choose_at(candidates: &[Judged], i: usize) -> (usize, f32) {
    let distance = |a: &Judged, b: &Judged| (a.flow.u[i] - b.flow.u[i]).hypot(a.flow.v[i] - b.flow.v[i]);
    let any_visible = candidates.iter().any(|candidate| candidate.visible[i]);
    let eligible =
        || candidates.iter().enumerate().filter(|(_, candidate)| candidate.visible[i] == any_visible);
    let mut best = (0, 0, f32::INFINITY);
    for (index, candidate) in eligible() {
        let support = eligible().filter(|(_, other)| distance(candidate, other) < AGREE).count();
        if support > best.1 || (support == best.1 && candidate.sigma[i] < best.2) {
            best = (index, support, candidate.sigma[i]);
        }
    }
    let (index, support, _) = best;
    if 2 * support > eligible().count() {
        return (index, 0.0);
    }
    let disagreeing =
        eligible().map(|(_, other)| distance(&candidates[index], other)).filter(|&d| d >= AGREE);
    let nearest = disagreeing.fold(f32::INFINITY, f32::min);
    (index, if nearest.is_finite() { DOUBT * nearest } else { 0.0 })
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

#[cfg(test)]
mod tests {
    use super::*;

    fn constant(u: f32, v: f32, visible: bool, sigma: f32) -> Judged {
        let (width, height) = (8, 6);
        let mut flow = Flow::zeros(width, height);
        flow.u.fill(u);
        flow.v.fill(v);
        Judged::of(flow, vec![visible; width * height], vec![sigma; width * height])
    }

    #[test]
    fn chaining_adds_displacements_and_variances() {
        let chained = chain(&constant(1.5, -1.0, true, 3.0), &constant(0.25, 2.0, true, 4.0));
        assert!(chained.flow.u.iter().all(|&u| u == 1.75) && chained.flow.v.iter().all(|&v| v == 1.0));
        assert!(chained.sigma.iter().all(|&sigma| sigma == 5.0));
        assert!(chained.links.iter().all(|&links| links == 2.0));
        // Column 7 ends at 8.75, outside.
        assert!(chained.visible[0] && !chained.visible[7]);
        assert!(!chain(&constant(0.0, 0.0, false, 1.0), &constant(0.0, 0.0, true, 1.0)).visible[0]);
        assert!(!chain(&constant(0.0, 0.0, true, 1.0), &constant(0.0, 0.0, false, 1.0)).visible[0]);
    }

    #[test]
    fn the_majority_wins_then_certainty_and_disagreement_is_doubt() {
        let pick = |candidates: &[Judged]| {
            let chosen = choose(candidates);
            (chosen.flow.u[0], chosen.visible[0], chosen.sigma[0])
        };
        let near = constant(1.0, 0.0, true, 2.0);
        let also_near = constant(1.5, 0.0, true, 1.0);
        let far = constant(31.0, 0.0, true, 0.1);
        let hidden = constant(5.0, 0.0, false, 0.01);
        assert_eq!(pick(&[far.clone(), near.clone(), also_near.clone()]), (1.5, true, 1.0));
        assert_eq!(pick(&[hidden.clone(), near.clone()]), (1.0, true, 2.0));
        assert_eq!(pick(&[hidden.clone(), hidden.clone()]), (5.0, false, 0.01));
        // Agreement comes first among the hidden ones too.
        let [one, another] = [20.0, 21.0].map(|u| constant(u, 0.0, false, 3.0));
        assert_eq!(pick(&[hidden, one, another]), (20.0, false, 3.0));
        assert_eq!(pick(&[near, far]), (31.0, true, 0.1f32.hypot(30.0 * DOUBT)));
    }

    #[test]
    fn the_way_back_is_the_negative_where_something_arrives() {
        let back = inverted(&constant(2.0, 1.0, true, 1.0));
        assert_eq!((back.at(2, 1), back.at(7, 5)), ([-2.0, -1.0], [-2.0, -1.0]));
        assert_eq!((back.at(1, 1), back.at(2, 0)), ([0.0, 0.0], [0.0, 0.0]));
        assert_eq!(inverted(&constant(2.0, 1.0, false, 1.0)), Flow::zeros(8, 6));
        assert_eq!(inverted(&constant(f32::MAX, f32::NAN, true, 1.0)), Flow::zeros(8, 6));
    }
}
