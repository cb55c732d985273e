//! Why a network cannot track.

use thiserror::Error;

/// Why a network cannot track.
#[derive(Debug, Error)]
pub enum LearnedError {
    /// The file is larger than a model may be.
    #[error("{model}: {bytes} bytes, a model may have at most {most}; export a smaller one")]
    TooLarge {
        /// The file.
        model: String,
        /// Its size.
        bytes: usize,
        /// The largest size.
        most: usize,
    },
    /// Not an ONNX file, a broken one, or one with operators that the runtime lacks.
    #[error(
        "{model}: cannot load the network: {problem}; export it to a single ONNX file as docs/trackers.md describes"
    )]
    Unloadable {
        /// The file.
        model: String,
        /// What is wrong with it.
        problem: String,
    },
    /// Neither of the signatures.
    #[error(
        "{model}: {problem}; it has {found}; a tracker has the inputs image1 and image2, f32 [1, 3, H, W], and the output flow \
         [1, 2, H, W], and may have visibility or visibility_logits and sigma or log_variance: see docs/trackers.md"
    )]
    Signature {
        /// The file.
        model: String,
        /// What does not fit.
        problem: String,
        /// Inputs and outputs.
        found: String,
    },
    /// The file describes its preprocessing wrongly.
    #[error(
        "{model}: the metadata {key} is '{value}', expected {expected}; export it again, or set tracking.onnx"
    )]
    Metadata {
        /// The file.
        model: String,
        /// Key of the entry.
        key: &'static str,
        /// Its value.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// The network failed on images.
    #[error(
        "{model}: the network fails on images of {width} x {height}: {problem}; export it for such sizes, or set \
         tracking.onnx.max_side or tracking.onnx.multiple"
    )]
    Run {
        /// The file.
        model: String,
        /// Columns of the input.
        width: usize,
        /// Rows of the input.
        height: usize,
        /// What the runtime says.
        problem: String,
    },
    /// An output is not what the signature says.
    #[error(
        "{model}: output {output} is {found}, expected {expected}; export it again as docs/trackers.md describes"
    )]
    Output {
        /// The file.
        model: String,
        /// Name of the output.
        output: &'static str,
        /// What it is.
        found: String,
        /// What it should be.
        expected: String,
    },
}
