//! Dense flow between two frames of a view, both ways.

use std::sync::Arc;

use super::{
    TrackingSettings,
    coarse::{self, CoarseMatches},
    consistency::texture,
    densify::densify,
    flow::Flow,
    patches::{self, Guess, PatchField},
    planes::{Planes, pyramid},
    refine::{SHADING_RADIUS, Smoothing, refine},
    texels::Texels,
};
use crate::{image::Image, simd::Instructions};

/// Colour difference between neighbours that halves their smoothness, 0 to 255 scale.
const EDGE_SCALE: f32 = 40.0;

/// One level of a frame's pyramid.
pub(super) struct Level<const C: usize> {
    pub(super) planes: Arc<Planes<C>>,
    /// Its colours, and gradients without what shading may explain.
    pub(super) texels: Texels<C>,
    /// How alike each pixel is to its left and to its upper neighbour, 1 where equal; 0 where there is none.
    pub(super) similarity: [Vec<f32>; 2],
}

impl<const C: usize> Level<C> {
    pub(super) fn pyramid(finest: Planes<C>, settings: &TrackingSettings) -> Vec<Self> {
        let level = |planes: Planes<C>| {
            // What shading takes from differences it takes from their derivatives.
            let shaded = planes.high_passed(SHADING_RADIUS);
            let texels = Texels::new(&planes, &Planes::from_interiors(planes.width, planes.height, shaded));
            let similarity = similarity(&planes);
            Self { planes: Arc::new(planes), texels, similarity }
        };
        pyramid(finest, settings.search_side as usize).into_iter().map(level).collect()
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

/// What of a frame is matched.
pub(super) struct Pyramid {
    levels: Levels,
    /// The image of the exhaustive search, in colour.
    searched: Arc<Planes>,
}

/// Finest level first.
pub(super) enum Levels {
    Luma(Vec<Level<1>>),
    Colour(Vec<Level<3>>),
}

impl Pyramid {
    /// The pyramid of an image that has pixels.
    pub(super) fn new(image: &Image, settings: &TrackingSettings) -> Self {
        let halvings = settings.halvings(image.width, image.height);
        let levels = if settings.colour {
            Levels::Colour(Level::pyramid(Planes::from_image(image, halvings), settings))
        } else {
            Levels::Luma(Level::pyramid(Planes::luma_of(image, halvings), settings))
        };
        let searched = match &levels {
            Levels::Luma(levels) => Arc::new(Planes::from_image(image, halvings + levels.len() as u32 - 1)),
            Levels::Colour(levels) => Arc::clone(&levels[levels.len() - 1].planes),
        };
        Self { levels, searched }
    }

    /// Columns and rows of the finest level.
    pub(super) fn size(&self) -> [usize; 2] {
        match &self.levels {
            Levels::Luma(levels) => levels[0].planes.size(),
            Levels::Colour(levels) => levels[0].planes.size(),
        }
    }
}

impl TrackingSettings {
    /// Columns and rows at which the built-in tracker matches images of this size: the size of its states.
    pub fn matched_size(&self, width: u32, height: u32) -> (u32, u32) {
        let side = 1 << self.halvings(width, height);
        (width.div_ceil(side), height.div_ceil(side))
    }

    /// How often images of this size are halved before they are matched.
    fn halvings(&self, width: u32, height: u32) -> u32 {
        let longer = width.max(height);
        let at_least = if longer > self.quarter_side { 2 } else { u32::from(longer > self.full_side) };
        let fits = |&halvings: &u32| longer.div_ceil(1 << halvings) <= self.max_side.max(2);
        (at_least..31).find(fits).unwrap_or(31)
    }
}

/// A frame, prepared for comparison and, by `P`, for its matcher.
pub(super) struct Frame<P> {
    /// How well a displacement of each pixel of the finest level can be told: the smaller eigenvalue of the structure
    /// tensor.
    pub(super) texture: Vec<f32>,
    /// The finest level, in colour.
    pub(super) colours: Arc<Planes>,
    prepared: P,
}

impl Frame<()> {
    /// A frame for a matcher that takes its colours.
    pub(super) fn plain(image: &Image, settings: &TrackingSettings) -> Self {
        let colours = Arc::new(Planes::from_image(image, settings.halvings(image.width, image.height)));
        Self { texture: texture(&colours), colours, prepared: () }
    }
}

impl<P> Frame<P> {
    /// Columns of the finest level.
    pub(super) fn width(&self) -> usize {
        self.colours.width
    }

    /// Rows of the finest level.
    pub(super) fn height(&self) -> usize {
        self.colours.height
    }
}

impl Frame<Pyramid> {
    pub(super) fn new(image: &Image, settings: &TrackingSettings) -> Self {
        let pyramid = Pyramid::new(image, settings);
        let colours = match &pyramid.levels {
            Levels::Colour(levels) => Arc::clone(&levels[0].planes),
            Levels::Luma(_) => {
                Arc::new(Planes::from_image(image, settings.halvings(image.width, image.height)))
            }
        };
        Self { texture: texture(&colours), colours, prepared: pyramid }
    }

    /// `flow` to another frame, refined at the finest level where `trust` says that colour counts.
    pub(super) fn refined(
        &self,
        other: &Self,
        flow: Flow,
        trust: &[bool],
        settings: &TrackingSettings,
    ) -> Flow {
        let (instructions, trust, smoothing) = (Instructions::detect(), Some(trust), Smoothing::of(settings));
        match (&self.prepared.levels, &other.prepared.levels) {
            (Levels::Luma(a), Levels::Luma(b)) => refine(instructions, &a[0], &b[0], flow, trust, smoothing),
            (Levels::Colour(a), Levels::Colour(b)) => {
                refine(instructions, &a[0], &b[0], flow, trust, smoothing)
            }
            // Frames of one view have one setting.
            _ => flow,
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
    first: &Frame<Pyramid>,
    second: &Frame<Pyramid>,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    match_pyramids(Instructions::detect(), &first.prepared, &second.prepared, guides, settings)
}

/// [`match_frames`] of frames that are only matched, with certain instructions.
pub(super) fn match_pyramids(
    instructions: Instructions,
    first: &Pyramid,
    second: &Pyramid,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    let radius = (settings.search_radius.clamp(0.0, 1.0) * first.searched.width as f32).round() as usize;
    let seeds = coarse::search(instructions, &first.searched, &second.searched, radius);
    match (&first.levels, &second.levels) {
        (Levels::Luma(a), Levels::Luma(b)) => match_levels(instructions, a, b, &seeds, guides, settings),
        (Levels::Colour(a), Levels::Colour(b)) => match_levels(instructions, a, b, &seeds, guides, settings),
        // Frames of one view have one setting.
        _ => {
            let [width, height] = first.size();
            (Flow::zeros(width, height), Flow::zeros(width, height))
        }
    }
}

fn match_levels<const C: usize>(
    instructions: Instructions,
    first: &[Level<C>],
    second: &[Level<C>],
    seeds: &CoarseMatches,
    guides: Option<Guides<'_>>,
    settings: &TrackingSettings,
) -> (Flow, Flow) {
    let (forward, backward) = (guides.map(|guides| guides.forward()), guides.map(|guides| guides.backward()));
    rayon::join(
        || descend_pyramid(instructions, first, second, &seeds.forward, forward, settings),
        || descend_pyramid(instructions, second, first, &seeds.backward, backward, settings),
    )
}

fn descend_pyramid<const C: usize>(
    instructions: Instructions,
    from: &[Level<C>],
    to: &[Level<C>],
    seeds: &Flow,
    guide: Option<Guess<'_>>,
    settings: &TrackingSettings,
) -> Flow {
    let coarsest = from.len() - 1;
    let smoothing = Smoothing::of(settings);
    let match_level = |level: usize, coarser: Option<&Flow>| {
        let (reference, target) = (&from[level], &to[level]);
        let planes = &reference.planes;
        let mut guesses = Vec::new();
        guesses.extend(coarser.map(|flow| Guess { flow, scale: 2.0 }));
        let scale = 1.0 / (1u32 << level) as f32;
        guesses.extend(guide.map(|guide| Guess { scale: guide.scale * scale, ..guide }));
        let seeds = (level == coarsest).then_some(Guess { flow: seeds, scale: 1.0 });
        let stride = if level == 0 { settings.patch_stride } else { settings.patch_stride.div_ceil(2) };
        let mut field = PatchField::new(planes.width, planes.height, stride as usize);
        patches::search(
            instructions,
            planes,
            &target.planes,
            &guesses,
            seeds,
            settings.patch_iterations,
            &mut field,
        );
        let dense = densify(instructions, planes, &target.planes, &field);
        refine(instructions, reference, target, dense, None, smoothing)
    };
    let mut flow = match_level(coarsest, None);
    for level in (0..coarsest).rev() {
        let (reference, target) = (&from[level], &to[level]);
        let [width, height] = reference.planes.size();
        flow = if width.max(height) > settings.patch_side as usize {
            refine(instructions, reference, target, flow.doubled(width, height), None, smoothing)
        } else {
            match_level(level, Some(&flow))
        };
    }
    flow
}
