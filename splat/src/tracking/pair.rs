//! Dense flow between two frames of a view, both ways.

use super::{
    TrackingSettings, coarse,
    flow::Flow,
    patches::{self, Reference},
    planes::{Planes, pyramid},
    refine::{self, Smoothing},
};
use crate::image::Image;

/// A frame, prepared for matching: a pyramid with its gradients, finest first.
pub(super) struct Frame {
    pub(super) levels: Vec<Planes>,
    pub(super) gradients: Vec<[Planes; 2]>,
}

impl Frame {
    pub(super) fn new(image: &Image, settings: &TrackingSettings) -> Self {
        let finest = Planes::from_image(image);
        // The pyramid down to the tracking resolution, of which only the end is kept.
        let mut reduced = pyramid(finest, settings.max_side as usize);
        let finest = reduced.swap_remove(reduced.len() - 1);
        let levels = pyramid(finest, settings.search_side as usize);
        let gradients = levels.iter().map(Planes::gradients).collect();
        Self { levels, gradients }
    }

    pub(super) fn width(&self) -> usize {
        self.levels[0].width
    }

    pub(super) fn height(&self) -> usize {
        self.levels[0].height
    }

    pub(super) fn reference(&self, level: usize) -> Reference<'_> {
        Reference { planes: &self.levels[level], gradients: &self.gradients[level] }
    }
}

/// What is known beforehand of the flow from the first frame to the second, and back.
#[derive(Clone, Copy)]
pub(super) struct Guides<'a> {
    pub(super) forward: &'a Flow,
    pub(super) backward: &'a Flow,
}

/// The flow from `first` to `second` and the flow back, at the finest level. Frames must have the same size.
pub(super) fn match_frames(
    first: &Frame,
    second: &Frame,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    let coarsest = first.levels.len() - 1;
    let radius =
        (settings.search_radius.clamp(0.0, 1.0) * first.levels[coarsest].width as f32).round() as usize;
    let seeds = coarse::search(&first.levels[coarsest], &second.levels[coarsest], radius);
    rayon::join(
        || descend_pyramid(first, second, &seeds.forward, guides.map(|guides| guides.forward), settings),
        || descend_pyramid(second, first, &seeds.backward, guides.map(|guides| guides.backward), settings),
    )
}

fn descend_pyramid(
    from: &Frame,
    to: &Frame,
    seeds: &Flow,
    guide: Option<&Flow>,
    settings: &TrackingSettings,
) -> Flow {
    let coarsest = from.levels.len() - 1;
    let smoothing = Smoothing::of(settings);
    let mut flow = seeds.clone();
    for level in (0..=coarsest).rev() {
        let planes = &from.levels[level];
        let (width, height) = (planes.width, planes.height);
        let scale = 0.5f32.powi(level as i32);
        let seeds = seeds.resampled_nearest(width, height, (1 << (coarsest - level)) as f32);
        let guide = guide.map(|guide| guide.resampled_nearest(width, height, scale));
        let mut guesses = vec![&flow, &seeds];
        guesses.extend(&guide);
        let stride = if level == 0 { settings.patch_stride } else { settings.patch_stride.div_ceil(2) };
        let field = patches::search(
            &from.reference(level),
            &to.levels[level],
            &guesses,
            stride as usize,
            settings.patch_iterations,
        );
        let dense = patches::densify(planes, &to.levels[level], &field);
        flow = refine::refine(&from.reference(level), &to.reference(level), &dense, None, smoothing);
        if level > 0 {
            let finer = &from.levels[level - 1];
            flow = flow.resampled_nearest(finer.width, finer.height, 2.0);
        }
    }
    flow
}
