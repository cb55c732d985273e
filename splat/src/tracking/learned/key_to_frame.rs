//! Networks that see the key frame and a later one, and say where everything is and what is visible.

use std::{ops::Range, sync::Arc};

use super::{
    DEFAULT_SIGMA, LearnedError, LearnedTracker,
    network::{Input, Maps},
    pair_flow::{OUTSIDE, flow_of},
};
use crate::{
    image::Image,
    tracking::{TrackField, TrackingSettings, consistency::is_inside, planes::Planes, view::unknown},
};

/// Probability from which a pixel counts as visible.
const VISIBLE: f32 = 0.5;

pub(super) fn track<E: From<LearnedError>>(
    tracker: &LearnedTracker,
    frames: Range<usize>,
    is_wanted: &dyn Fn(usize) -> bool,
    load: &mut dyn FnMut(usize) -> Result<Arc<Image>, E>,
    settings: &TrackingSettings,
    emit: &mut dyn FnMut(usize, TrackField) -> Result<(), E>,
) -> Result<(), E> {
    let mut wanted = frames.filter(|&index| is_wanted(index)).peekable();
    if wanted.peek().is_none() {
        return Ok(());
    }
    let key_image = load(0)?;
    let size = (key_image.width, key_image.height);
    let key = if key_image.pixel_count() == 0 { None } else { Some(tracker.input(&key_image)?) };
    drop(key_image);
    for index in wanted {
        let image = load(index)?;
        let field = match &key {
            Some(key) if (image.width, image.height) == size => {
                let maps = tracker.network.run(key, &tracker.input(&image)?)?;
                field(key, &maps, settings)
            }
            _ => unknown(size),
        };
        emit(index, field)?;
    }
    Ok(())
}

impl LearnedTracker {
    fn input(&self, image: &Image) -> Result<Input, LearnedError> {
        let channels = Planes::from_image(image, 0).interiors();
        self.network.input(image.width as usize, image.height as usize, &channels)
    }
}

fn field(key: &Input, maps: &Maps, settings: &TrackingSettings) -> TrackField {
    let (width, height) = key.fit.image;
    let flow = flow_of(key, maps);
    let visible = key.fit.enlarged(&maps.visible);
    let [scale_x, scale_y] = key.fit.scale();
    let scale = scale_x.max(scale_y);
    let sigma = match maps.sigma.is_empty() {
        true => vec![DEFAULT_SIGMA; width * height],
        false => key.fit.enlarged(&maps.sigma),
    };
    let widest = width.max(height) as f32;
    let mut field = unknown((width as u32, height as u32));
    for index in 0..width * height {
        let (x, y) = ((index % width) as f32 + flow.u[index], (index / width) as f32 + flow.v[index]);
        let stated = scale * sigma[index];
        // Also false for what is not a number.
        let known = stated >= 0.0
            && stated.is_finite()
            && visible[index].is_finite()
            && x.abs().max(y.abs()) < OUTSIDE * widest;
        if !known {
            continue;
        }
        let seen = is_inside(x, y, width, height) && visible[index] > VISIBLE;
        field.positions[index] = [x + 0.5, y + 0.5];
        field.visible[index] = seen;
        let doubt = if seen { 0.0 } else { settings.hidden_sigma };
        field.sigma[index] = (stated.max(settings.sigma_floor) + doubt).min(widest);
    }
    field
}
