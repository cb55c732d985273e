//! Exposure: a frame is brought to the key frame's before anything is compared. Patches are compared up to an offset, not
//! up to a gain.

use std::borrow::Cow;

use crate::image::Image;

/// Shares of the pixels whose luma is compared: neither the darkest, which are noise, nor the brightest, which are clipped.
const QUANTILES: usize = 16;
const FROM: f32 = 0.1;
const TO: f32 = 0.85;
/// Pixels that are looked at, at most.
const PIXELS: usize = 1 << 12;
/// Gains within this factor are left as they are: contents change too.
const NOTHING: f32 = 1.1;
/// Gains beyond this factor are not believed: two stops.
const MOST: f32 = 4.0;
/// Share of the squared difference that a gain may leave unexplained.
const UNEXPLAINED: f32 = 0.1;
/// Quantiles that a gain may make worse: what comes and goes in a scene changes some of them, exposure all alike.
const WORSE: usize = 3;
/// What 8 bits do not tell apart.
const STEP: f32 = 1.0 / 255.0;
/// Luma from which a quantile may be clipped.
const CLIPPED: f32 = 0.98;
/// Quantiles that must be left for a gain to be believed.
const LEAST: usize = QUANTILES / 2;

/// How bright an image is.
pub(super) struct Exposure {
    quantiles: [f32; QUANTILES],
}

impl Exposure {
    /// That of an image; values that are not finite count as 0.
    pub(super) fn of(image: &Image) -> Self {
        let step = (image.pixel_count() / PIXELS) | 1;
        let luma = |&[red, green, blue]: &[f32; 3]| {
            let luma = 0.299 * red + 0.587 * green + 0.114 * blue;
            if luma.is_finite() { luma } else { 0.0 }
        };
        let mut values: Vec<f32> = image.pixels.as_chunks().0.iter().step_by(step).map(luma).collect();
        values.sort_unstable_by(f32::total_cmp);
        let last = values.len().saturating_sub(1) as f32;
        let quantile = |n: usize| {
            let share = FROM + (TO - FROM) * n as f32 / (QUANTILES - 1) as f32;
            values.get((share * last) as usize).copied().unwrap_or(0.0)
        };
        Self { quantiles: std::array::from_fn(quantile) }
    }

    /// `image` times the gain that gives it this exposure; as it is if no gain explains the difference.
    pub(super) fn equalised<'a>(&self, image: &'a Image) -> Cow<'a, Image> {
        let Some(gain) = self.gain_of(&Self::of(image)) else { return Cow::Borrowed(image) };
        // What a gain makes brighter than white was clipped in the key frame. What is not finite is left for its readers.
        let equal = |&value: &f32| if value.is_finite() { (gain * value).min(value.max(1.0)) } else { value };
        let pixels = image.pixels.iter().map(equal).collect();
        Cow::Owned(Image { pixels, ..*image })
    }

    fn gain_of(&self, other: &Self) -> Option<f32> {
        let pairs = self.quantiles.into_iter().zip(other.quantiles);
        let unclipped: Vec<(f32, f32)> = pairs.filter(|&(a, b)| a < CLIPPED && b < CLIPPED).collect();
        let energy = |of: fn(&(f32, f32)) -> f32| unclipped.iter().map(|pair| of(pair).powi(2)).sum::<f32>();
        let gain = (energy(|pair| pair.0) / energy(|pair| pair.1)).sqrt();
        let is_credible = unclipped.len() >= LEAST && (NOTHING..=MOST).contains(&gain.max(1.0 / gain));
        let off = |&(ours, theirs): &(f32, f32), gain: f32| (ours - gain * theirs).abs();
        let left = |gain: f32| unclipped.iter().map(|pair| off(pair, gain).powi(2)).sum::<f32>();
        let worse = unclipped.iter().filter(|pair| off(pair, gain) > off(pair, 1.0) + STEP).count();
        (is_credible && left(gain) < UNEXPLAINED * left(1.0) && worse <= WORSE).then_some(gain)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ramp from black to white, of which `dark` columns of a hundred are black.
    fn ramp(gain: f32, dark: usize) -> Image {
        let value = |i: usize| if i % 100 < dark { 0.0 } else { gain * (i % 100) as f32 / 100.0 };
        let pixels = (0..100 * 20).flat_map(|i| [value(i); 3]).collect();
        Image { width: 100, height: 20, pixels }
    }

    #[test]
    fn a_stop_more_or_less_is_taken_back() {
        let key = ramp(0.5, 0);
        let exposure = Exposure::of(&key);
        for gain in [0.25f32, 0.4, 0.97] {
            let equal = exposure.equalised(&ramp(gain, 0)).into_owned();
            let off = equal.pixels.iter().zip(&key.pixels).map(|(a, b)| (a - b).abs());
            // Both gains are rounded.
            assert!(off.fold(0.0, f32::max) < 1e-6, "{gain}");
        }
    }

    /// Someone bright in the dark, in so many columns of a hundred.
    fn stage(columns: usize) -> Image {
        let value = |i: usize| if i % 100 < columns { 0.45 + 0.003 * (i % 100) as f32 } else { 0.08 };
        let pixels = (0..100 * 20).flat_map(|i| [value(i); 3]).collect();
        Image { width: 100, height: 20, pixels }
    }

    #[test]
    fn clipped_highlights_do_not_count() {
        let key = ramp(0.6, 0);
        let bright = Image {
            pixels: ramp(1.2, 0).pixels.iter().map(|value| value.min(1.0)).collect(),
            ..ramp(1.2, 0)
        };
        let equal = Exposure::of(&key).equalised(&bright).into_owned();
        let darker = key.pixels.iter().zip(&equal.pixels).filter(|(key, _)| **key < 0.45);
        assert!(darker.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) < 1e-3);
    }

    #[test]
    fn someone_who_comes_near_in_the_dark_is_no_exposure() {
        let exposure = Exposure::of(&stage(10));
        for columns in [15, 25, 30, 35, 50, 70, 90] {
            assert!(matches!(exposure.equalised(&stage(columns)), Cow::Borrowed(_)), "{columns}");
        }
    }

    #[test]
    fn what_comes_and_goes_is_no_exposure() {
        let exposure = Exposure::of(&ramp(0.5, 0));
        for other in [ramp(0.5, 30), ramp(0.5, 60), ramp(0.53, 0), Image::filled(100, 20, [0.3; 3])] {
            assert!(matches!(exposure.equalised(&other), Cow::Borrowed(_)));
        }
    }

    #[test]
    fn what_is_not_finite_stays_so() {
        let exposure = Exposure::of(&ramp(0.5, 0));
        let mut darker = ramp(0.25, 0);
        darker.pixels[7] = f32::NAN;
        darker.pixels[8] = f32::INFINITY;
        let Cow::Owned(equal) = exposure.equalised(&darker) else { panic!("a gain explains it") };
        assert!(equal.pixels[7].is_nan() && equal.pixels[8] == f32::INFINITY && equal.pixels[9].is_finite());
    }

    #[test]
    fn nothing_is_made_of_nothing() {
        let black = Image::filled(4, 3, [0.0; 3]);
        let broken = Image::filled(4, 3, [f32::NAN, f32::INFINITY, 1.0]);
        for first in [&black, &broken, &ramp(0.5, 0), &Image::filled(0, 0, [0.0; 3])] {
            for second in [&black, &broken, &Image::filled(4, 3, [f32::MAX; 3])] {
                assert!(matches!(Exposure::of(first).equalised(second), Cow::Borrowed(_)));
            }
        }
    }
}
