//! How images reach a network.

use serde::{Deserialize, Deserializer, Serialize, de::Error};

use super::network::{MAX_MULTIPLE, MAX_SIDE};

/// How images reach a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OnnxSettings {
    /// Longer side of the images that the network sees, pixels; larger images are reduced, smaller ones are not
    /// enlarged; 16 to 4096, default 768. Without effect on a network that was exported for one size.
    #[serde(deserialize_with = "side")]
    pub max_side: u32,
    /// Values that black and white become; default: as the model's metadata `trackersplat.range` says, else `0..255`.
    pub range: Option<ValueRange>,
    /// Sides are padded to a multiple of this, pixels; 1 to 256, default: as the model's metadata
    /// `trackersplat.multiple` says, else 8.
    #[serde(deserialize_with = "multiple")]
    pub multiple: Option<u32>,
}

impl Default for OnnxSettings {
    fn default() -> Self {
        Self { max_side: 768, range: None, multiple: None }
    }
}

/// Values of the images that a network sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ValueRange {
    /// Black 0, white 255.
    #[serde(rename = "0..255")]
    Bytes,
    /// Black 0, white 1.
    #[serde(rename = "0..1")]
    Unit,
    /// Black -1, white 1.
    #[serde(rename = "-1..1")]
    Symmetric,
    /// 0 to 1, less the mean and over the standard deviation of ImageNet's channels.
    #[serde(rename = "imagenet")]
    ImageNet,
}

impl ValueRange {
    /// The values in words, for errors.
    pub(super) const EXPECTED: &'static str = "0..255, 0..1, -1..1 or imagenet";

    pub(super) fn from_name(name: &str) -> Option<Self> {
        serde_json::from_value(name.into()).ok()
    }

    /// Offset and factor that turn a channel's 0 to 255 into this range: `(value + offset) * factor`.
    pub(super) fn scale(self, channel: usize) -> (f32, f32) {
        const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
        const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
        match self {
            Self::Bytes => (0.0, 1.0),
            Self::Unit => (0.0, 1.0 / 255.0),
            Self::Symmetric => (-127.5, 1.0 / 127.5),
            Self::ImageNet => (-255.0 * MEAN[channel], 1.0 / (255.0 * DEVIATION[channel])),
        }
    }
}

fn side<'de, D: Deserializer<'de>>(from: D) -> Result<u32, D::Error> {
    let value = u32::deserialize(from)?;
    if (16..=MAX_SIDE as u32).contains(&value) {
        return Ok(value);
    }
    Err(D::Error::custom(format!("{value} is not between 16 and {MAX_SIDE} pixels")))
}

fn multiple<'de, D: Deserializer<'de>>(from: D) -> Result<Option<u32>, D::Error> {
    let value = Option::<u32>::deserialize(from)?;
    if value.is_none_or(|value| (1..=MAX_MULTIPLE as u32).contains(&value)) {
        return Ok(value);
    }
    Err(D::Error::custom(format!("{} is not between 1 and {MAX_MULTIPLE} pixels", value.unwrap_or_default())))
}
