//! Every setting of a reconstruction, in one place: the same structs are the settings file, the command line's
//! `--set KEY=VALUE`, and the JSON on the wire.

use serde::{Deserialize, Serialize};

use crate::{
    motion::MotionSettings, refine::RefineSettings, static_model::StaticModelSettings,
    tracking::TrackingSettings,
};

/// How much time to trade for accuracy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quality {
    /// A look at the result.
    Draft,
    /// The default.
    #[default]
    Balanced,
    /// The paper's budget.
    Best,
}

/// What the masks of a clip are for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskUse {
    /// They mark the moving region that is reported apart.
    #[default]
    Evaluate,
    /// They mark the pixels that count in training; everything else is ignored.
    Train,
}

/// Whether frames start from tracked motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionSource {
    /// From the tracks, by motion compensation.
    #[default]
    Tracks,
    /// From the static model as it is: the baseline.
    None,
}

/// Everything that, with the clip, decides the result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Seed of every random choice.
    pub seed: u64,
    /// Colour behind everything, sRGB in `[0, 1]`.
    pub background: [f32; 3],
    /// What the clip's masks are for.
    pub masks: MaskUse,
    /// Where frames start from.
    pub motion_source: MotionSource,
    /// Reconstruction of the key frame.
    pub static_model: StaticModelSettings,
    /// Dense tracks.
    pub tracking: TrackingSettings,
    /// Motion compensation.
    pub motion: MotionSettings,
    /// Photometric refinement of a frame.
    pub refine: RefineSettings,
}

impl Default for Settings {
    fn default() -> Self {
        Self::preset(Quality::default())
    }
}

impl Settings {
    /// The settings of a quality level.
    pub fn preset(quality: Quality) -> Self {
        Self {
            seed: 0,
            background: [0.0; 3],
            masks: MaskUse::default(),
            motion_source: MotionSource::default(),
            static_model: StaticModelSettings::preset(quality),
            tracking: TrackingSettings::preset(quality),
            motion: MotionSettings::preset(quality),
            refine: RefineSettings::preset(quality),
        }
    }
}

/// Ranges of settings, checked wherever settings are read.
pub(crate) mod range {
    use std::{collections::BTreeSet, fmt::Display};

    use serde::{Deserialize, Deserializer, de::Error};

    fn between<T: PartialOrd + Display, E: Error>(value: T, least: T, most: T) -> Result<T, E> {
        // False for what is not a number.
        if least <= value && value <= most {
            return Ok(value);
        }
        Err(E::custom(format!("{value} is not between {least} and {most}")))
    }

    /// A share or a rate: 0 to 1.
    pub(crate) fn unit<'de, D: Deserializer<'de>>(from: D) -> Result<f32, D::Error> {
        between(f32::deserialize(from)?, 0.0, 1.0)
    }

    /// A whole number within bounds.
    pub(crate) fn whole<'de, const LEAST: u32, const MOST: u32, D: Deserializer<'de>>(
        from: D,
    ) -> Result<u32, D::Error> {
        between(u32::deserialize(from)?, LEAST, MOST)
    }

    /// A correlation: -1 to 1.
    pub(crate) fn correlation<'de, D: Deserializer<'de>>(from: D) -> Result<f32, D::Error> {
        between(f32::deserialize(from)?, -1.0, 1.0)
    }

    /// A distance in pixels: above 0, to a million.
    pub(crate) fn distance<'de, D: Deserializer<'de>>(from: D) -> Result<f32, D::Error> {
        let value = f32::deserialize(from)?;
        if value > 0.0 && value <= 1e6 {
            return Ok(value);
        }
        Err(D::Error::custom(format!("{value} is not above 0 and at most 1000000")))
    }

    /// A weight against another: 0 to a million.
    pub(crate) fn weight<'de, D: Deserializer<'de>>(from: D) -> Result<f32, D::Error> {
        between(f32::deserialize(from)?, 0.0, 1e6)
    }

    /// Distances between frames: up to 16, each 1 to 1000, none twice. A chain given twice would vote twice.
    pub(crate) fn gaps<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u32>, D::Error> {
        let gaps = Vec::<u32>::deserialize(from)?;
        let distinct: BTreeSet<u32> = gaps.iter().copied().collect();
        if gaps.len() <= 16 && distinct.len() == gaps.len() && gaps.iter().all(|gap| (1..=1000).contains(gap))
        {
            return Ok(gaps);
        }
        Err(D::Error::custom(format!(
            "{gaps:?} are not up to 16 different distances between 1 and 1000 frames"
        )))
    }

    /// A share in double precision: 0 to 1.
    pub(crate) fn share<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
        between(f64::deserialize(from)?, 0.0, 1.0)
    }

    /// A size, a deviation or a significance: 0 to 1e30.
    pub(crate) fn magnitude<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
        let value = f64::deserialize(from)?;
        if (0.0..=1e30).contains(&value) {
            return Ok(value);
        }
        Err(D::Error::custom(format!("{value:?} is not between 0 and 1e30")))
    }

    /// A number of views, neighbours or rounds: at most a thousand.
    pub(crate) fn few<'de, D: Deserializer<'de>>(from: D) -> Result<usize, D::Error> {
        let value = usize::deserialize(from)?;
        if value <= 1000 {
            return Ok(value);
        }
        Err(D::Error::custom(format!("{value} is more than 1000")))
    }

    /// A number of steps: at most a million.
    pub(crate) fn steps<'de, D: Deserializer<'de>>(from: D) -> Result<u32, D::Error> {
        let value = u32::deserialize(from)?;
        if value <= 1_000_000 {
            return Ok(value);
        }
        Err(D::Error::custom(format!("{value} is more than 1000000 steps")))
    }

    /// A number of Gaussians: 1 to a hundred million.
    pub(crate) fn gaussians<'de, D: Deserializer<'de>>(from: D) -> Result<usize, D::Error> {
        let value = usize::deserialize(from)?;
        if (1..=100_000_000).contains(&value) {
            return Ok(value);
        }
        Err(D::Error::custom(format!("{value} is not between 1 and 100000000 Gaussians")))
    }

    /// A spherical-harmonic degree: 0 to 3.
    pub(crate) fn degree<'de, D: Deserializer<'de>>(from: D) -> Result<u32, D::Error> {
        let value = u32::deserialize(from)?;
        if value <= crate::gaussians::sh::MAX_DEGREE {
            return Ok(value);
        }
        Err(D::Error::custom(format!("degree {value} is not between 0 and 3")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_survives_the_wire() {
        for quality in [Quality::Draft, Quality::Balanced, Quality::Best] {
            let settings = Settings::preset(quality);
            let json = serde_json::to_string(&settings).expect("settings are plain numbers");
            assert_eq!(serde_json::from_str::<Settings>(&json).expect("own settings are in range"), settings);
        }
    }

    #[test]
    fn unknown_keys_and_values_out_of_range_are_refused() {
        for (json, said) in [
            (r#"{"refine":{"iterationss":1}}"#, "iterationss"),
            (r#"{"refine":{"iterations":4000000000}}"#, "4000000000"),
            (r#"{"refine":{"dssim_weight":1.5}}"#, "1.5"),
            (r#"{"refine":{"mean_rate":-0.1}}"#, "-0.1"),
            (r#"{"static_model":{"max_gaussians":0}}"#, "0 is not"),
            (r#"{"motion":{"static_share":-0.5}}"#, "-0.5"),
            (r#"{"motion":{"max_log_strain":-0.2}}"#, "-0.2"),
            (r#"{"motion":{"expected_strain":1e300}}"#, "1e300"),
            (r#"{"motion":{"neighbours":100000}}"#, "100000"),
            (r#"{"static_model":{"random_points":1000000000000}}"#, "1000000000000"),
            (r#"{"static_model":{"sh_degree":4}}"#, "degree 4"),
        ] {
            let error = serde_json::from_str::<Settings>(json).expect_err(json).to_string();
            assert!(error.contains(said), "{json}: {error}");
        }
    }
}
