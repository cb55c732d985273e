//! Dense flow between two frames of a view, both ways.

use super::{
    TrackingSettings, coarse,
    densify::densify,
    flow::Flow,
    patches::{self, Guess, PatchField},
    planes::{Planes, pyramid},
    refine::{Smoothing, refine},
    texels::Texels,
};
use crate::{image::Image, simd::Instructions};

/// Colour difference between neighbours that halves their smoothness, 0 to 255 scale.
const EDGE_SCALE: f32 = 40.0;

/// One level of a frame's pyramid.
pub(super) struct Level<const P: usize, const C: usize> {
    pub(super) planes: Planes<P>,
    pub(super) shown: Planes<C>,
    pub(super) texels: Texels<C>,
    /// How alike each pixel is to its left and to its upper neighbour, 1 where equal; 0 where there is none.
    pub(super) similarity: [Vec<f32>; 2],
}

impl<const P: usize, const C: usize> Level<P, C> {
    fn new(planes: Planes<P>, shown: Planes<C>) -> Self {
        let texels = Texels::new(&shown);
        let similarity = similarity(&shown);
        Self { planes, shown, texels, similarity }
    }
}

fn similarity<const C: usize>(planes: &Planes<C>) -> [Vec<f32>; 2] {
    let (width, height) = (planes.width, planes.height);
    let mut similarity = [(); 2].map(|()| vec![0.0f32; width * height]);
    for y in 0..height {
        for (axis, step) in [1, planes.stride].into_iter().enumerate() {
            if axis == 1 && y == 0 {
                continue;
            }
            let line = &mut similarity[axis][y * width..(y + 1) * width];
            for channel in &planes.channels {
                let first = planes.index(0, y);
                let (here, there) = (&channel[first..][..width], &channel[first - step..][..width]);
                for i in 0..width {
                    line[i] += (here[i] - there[i]) * (here[i] - there[i]);
                }
            }
            let scale = 1.0 / (C as f32 * EDGE_SCALE * EDGE_SCALE);
            for value in line.iter_mut() {
                *value = 1.0 / (1.0 + *value * scale);
            }
            if axis == 0 {
                line[0] = 0.0;
            }
        }
    }
    similarity
}

enum Matched {
    A(Vec<Level<1, 1>>),
    B(Vec<Level<3, 1>>),
    C(Vec<Level<1, 3>>),
    D(Vec<Level<3, 3>>),
}

/// A frame, prepared for matching.
pub(super) struct Frame {
    /// Pyramid in colour, finest first.
    pub(super) levels: Vec<Planes>,
    /// Gradients along x and y of the finest level.
    pub(super) gradients: [[Planes; 2]; 1],
    matched: Matched,
}

impl Frame {
    pub(super) fn new(image: &Image, settings: &TrackingSettings) -> Self {
        let finest = Planes::from_image(image);
        // The pyramid down to the tracking resolution, of which only the end is kept.
        let mut reduced = pyramid(finest, settings.max_side as usize);
        let finest = reduced.swap_remove(reduced.len() - 1);
        let levels = pyramid(finest, settings.search_side as usize);
        let gradients = [levels[0].gradients()];
        let matched = match settings.colour {
            0 => Matched::A(levels.iter().map(|planes| Level::new(planes.luma(), planes.luma())).collect()),
            1 => Matched::B(levels.iter().map(|planes| Level::new(planes.clone(), planes.luma())).collect()),
            2 => Matched::C(levels.iter().map(|planes| Level::new(planes.luma(), planes.clone())).collect()),
            _ => Matched::D(levels.iter().map(|planes| Level::new(planes.clone(), planes.clone())).collect()),
        };
        Self { levels, gradients, matched }
    }

    pub(super) fn width(&self) -> usize {
        self.levels[0].width
    }

    pub(super) fn height(&self) -> usize {
        self.levels[0].height
    }

    /// `flow` to another frame, refined at the finest level where `trust` says that colour counts.
    pub(super) fn refined(
        &self,
        other: &Self,
        flow: Flow,
        trust: &[bool],
        settings: &TrackingSettings,
    ) -> Flow {
        let smoothing = Smoothing::of(settings);
        let i = Instructions::detect();
        match (&self.matched, &other.matched) {
            (Matched::A(a), Matched::A(b)) => refine(i, &a[0], &b[0], flow, Some(trust), smoothing),
            (Matched::B(a), Matched::B(b)) => refine(i, &a[0], &b[0], flow, Some(trust), smoothing),
            (Matched::C(a), Matched::C(b)) => refine(i, &a[0], &b[0], flow, Some(trust), smoothing),
            (Matched::D(a), Matched::D(b)) => refine(i, &a[0], &b[0], flow, Some(trust), smoothing),
            _ => flow,
        }
    }

    fn descend(
        &self,
        to: &Self,
        i: Instructions,
        seeds: &Flow,
        guide: Option<Guess<'_>>,
        s: &TrackingSettings,
    ) -> Flow {
        match (&self.matched, &to.matched) {
            (Matched::A(a), Matched::A(b)) => descend_pyramid(i, a, b, seeds, guide, s),
            (Matched::B(a), Matched::B(b)) => descend_pyramid(i, a, b, seeds, guide, s),
            (Matched::C(a), Matched::C(b)) => descend_pyramid(i, a, b, seeds, guide, s),
            (Matched::D(a), Matched::D(b)) => descend_pyramid(i, a, b, seeds, guide, s),
            _ => seeds.clone(),
        }
    }
}

/// What is known beforehand of the flow from the first frame to the second, and back.
#[derive(Clone, Copy)]
pub(super) struct Guides<'a> {
    pub(super) forward: &'a Flow,
    pub(super) backward: &'a Flow,
    /// Resolution of the finest level over that of these fields.
    pub(super) scale: f32,
}

impl<'a> Guides<'a> {
    fn forward(&self) -> Guess<'a> {
        Guess { flow: self.forward, scale: self.scale }
    }

    fn backward(&self) -> Guess<'a> {
        Guess { flow: self.backward, scale: self.scale }
    }
}

/// The flow from `first` to `second` and the flow back, at the finest level. Frames must have the same size.
pub(super) fn match_frames(
    first: &Frame,
    second: &Frame,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    match_frames_with(Instructions::detect(), first, second, guides, settings)
}

pub(super) fn match_frames_with(
    instructions: Instructions,
    first: &Frame,
    second: &Frame,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    let coarsest = first.levels.len() - 1;
    let radius =
        (settings.search_radius.clamp(0.0, 1.0) * first.levels[coarsest].width as f32).round() as usize;
    let seeds = coarse::search(instructions, &first.levels[coarsest], &second.levels[coarsest], radius);
    rayon::join(
        || {
            first.descend(
                second,
                instructions,
                &seeds.forward,
                guides.map(|guides| guides.forward()),
                settings,
            )
        },
        || {
            second.descend(
                first,
                instructions,
                &seeds.backward,
                guides.map(|guides| guides.backward()),
                settings,
            )
        },
    )
}

fn descend_pyramid<const P: usize, const C: usize>(
    instructions: Instructions,
    from: &[Level<P, C>],
    to: &[Level<P, C>],
    seeds: &Flow,
    guide: Option<Guess<'_>>,
    settings: &TrackingSettings,
) -> Flow {
    let coarsest = from.len() - 1;
    let smoothing = Smoothing::of(settings);
    let mut flow: Option<Flow> = None;
    for level in (0..=coarsest).rev() {
        let (reference, target) = (&from[level], &to[level]);
        let mut guesses = vec![Guess { flow: seeds, scale: (1u32 << (coarsest - level)) as f32 }];
        guesses.extend(flow.as_ref().map(|flow| Guess { flow, scale: 2.0 }));
        let scale = 1.0 / (1u32 << level) as f32;
        guesses.extend(guide.map(|guide| Guess { scale: guide.scale * scale, ..guide }));
        let stride = if level == 0 { settings.patch_stride } else { settings.patch_stride.div_ceil(2) };
        let planes = &reference.planes;
        let mut field = PatchField::new(planes.width, planes.height, stride as usize);
        patches::search(
            instructions,
            planes,
            &target.planes,
            &guesses,
            settings.patch_iterations,
            &mut field,
        );
        let dense = densify(instructions, planes, &target.planes, &field);
        flow = Some(refine(instructions, reference, target, dense, None, smoothing));
    }
    flow.unwrap_or_else(|| seeds.clone())
}
