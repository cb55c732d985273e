//! Which instructions the kernels use.

use std::{fmt, str::FromStr};

/// A compilation of the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// AVX-512 F, VL, DQ and BW, and POPCNT.
    Avx512,
    /// AVX2 and FMA.
    Avx2,
    /// What every machine of the architecture has: SSE2, NEON.
    Baseline,
}

impl InstructionSet {
    /// Every set, widest first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Baseline];

    fn is_available(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        let (avx512, avx2) = (
            is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("popcnt"),
            is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
        );
        #[cfg(not(target_arch = "x86_64"))]
        let (avx512, avx2) = (false, false);
        match self {
            Self::Avx512 => avx512,
            Self::Avx2 => avx2,
            Self::Baseline => true,
        }
    }
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Avx512 => "avx512",
            Self::Avx2 => "avx2",
            Self::Baseline => "baseline",
        })
    }
}

impl FromStr for InstructionSet {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|set| set.to_string() == text)
            .ok_or_else(|| format!("no instruction set `{text}`; choose avx512, avx2 or baseline"))
    }
}

/// The machine lacks an instruction set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this machine has no {0}; leave the instruction set to be detected")]
pub struct Unavailable(pub InstructionSet);

/// An instruction set that this machine has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Instructions(InstructionSet);

impl Instructions {
    /// The widest.
    pub fn detect() -> Self {
        let widest = InstructionSet::ALL.into_iter().find(|set| set.is_available());
        Self(widest.unwrap_or(InstructionSet::Baseline))
    }

    /// A certain one.
    pub fn require(set: InstructionSet) -> Result<Self, Unavailable> {
        if set.is_available() { Ok(Self(set)) } else { Err(Unavailable(set)) }
    }

    /// All that this machine has, widest first.
    pub fn available() -> impl Iterator<Item = Self> {
        InstructionSet::ALL.into_iter().filter(|set| set.is_available()).map(Self)
    }

    /// The same, or AVX2 in place of AVX-512: for code that streams through unaligned rows, which gains nothing from wider
    /// registers.
    pub(crate) fn at_most_avx2(self) -> Self {
        // `is_available` asks for AVX2 and FMA with AVX-512.
        if self.0 == InstructionSet::Avx512 { Self(InstructionSet::Avx2) } else { self }
    }

    /// Which it is.
    pub fn set(self) -> InstructionSet {
        self.0
    }
}

impl Default for Instructions {
    fn default() -> Self {
        Self::detect()
    }
}
