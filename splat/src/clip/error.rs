//! Why a clip could not be opened or read.

use std::{io, path::PathBuf};

use thiserror::Error;

use crate::image::DecodeError;

/// What is wrong with a pose.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum PoseProblem {
    /// NaN or infinity.
    #[error("is not finite")]
    NotFinite,
    /// A quaternion of zeros.
    #[error("has the quaternion 0, which is no rotation")]
    ZeroQuaternion,
    /// Reflects the world.
    #[error("is mirrored (its determinant is {determinant:.6}, a rotation has 1)")]
    Mirrored {
        /// Determinant of the rotation block.
        determinant: f64,
    },
    /// Shears or scales the world.
    #[error("is not a rotation (RᵀR differs from the identity by {deviation:.6}, {tolerance} is tolerated)")]
    NotOrthonormal {
        /// Largest absolute entry of `RᵀR - I`.
        deviation: f64,
        /// What is tolerated.
        tolerance: f64,
    },
}

/// Why a clip could not be opened or read. Each names the file, the value and the remedy.
#[derive(Debug, Error)]
pub enum ClipError {
    /// The path is not a folder.
    #[error("{path} is not a folder; give the folder that holds the data set")]
    NoFolder {
        /// What was given.
        path: PathBuf,
    },
    /// The folder holds no known layout.
    #[error(
        "{root}: no known data-set layout; looked for transforms/*.json, transforms_train.json, transforms.json, \
         cameras and images as .bin or .txt in sparse/0 or sparse, and poses_bounds.npy; give the folder that holds one of these"
    )]
    UnknownLayout {
        /// The folder.
        root: PathBuf,
    },
    /// A file cannot be read or written.
    #[error("{path}: {source}; check that it exists and may be accessed")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system says.
        source: io::Error,
    },
    /// A file's content breaks its format.
    #[error("{path}: {place}: found {found}, expected {expected}; mend or re-export the file")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, field or record.
        place: String,
        /// The offending value.
        found: String,
        /// What belongs there.
        expected: String,
    },
    /// The lens model is not supported.
    #[error(
        "{path}: camera {camera} has the lens model {model}; supported are PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL and \
         OPENCV; undistort the images first (colmap image_undistorter) or calibrate with one of these"
    )]
    UnsupportedLens {
        /// The file.
        path: PathBuf,
        /// Camera id or view.
        camera: String,
        /// Name of the model.
        model: String,
    },
    /// The distortion maps two directions to one pixel.
    #[error(
        "{path}: the distortion of view {view} folds the image over itself near pixel ({x:.0}, {y:.0}); its coefficients are \
         wrong or extrapolated: calibrate again or undistort the images first"
    )]
    FoldingLens {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Column.
        x: f64,
        /// Row.
        y: f64,
    },
    /// A focal length, principal point or image size that no camera has.
    #[error("{path}: view {view} has {name} {value}; give {expected}")]
    Intrinsics {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Which parameter.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is valid.
        expected: &'static str,
    },
    /// A pose that is not a rigid motion.
    #[error(
        "{path}: the pose of view {view} {problem}; export the camera again as a rigid world-to-camera motion"
    )]
    Pose {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// What is wrong.
        problem: PoseProblem,
    },
    /// A camera that is not the same in all frames.
    #[error(
        "{path}: view {view} differs at frame {frame} from frame {first}: {what} changes by {change:.3e} ({tolerance:.0e} is \
         tolerated); cameras must be static: fix the rig, or name each camera apart"
    )]
    MovingCamera {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Frame that differs.
        frame: u32,
        /// Frame it is compared with.
        first: u32,
        /// Which part of the camera.
        what: &'static str,
        /// By how much.
        change: f64,
        /// What is tolerated.
        tolerance: f64,
    },
    /// A model without cameras or images.
    #[error(
        "{path}: the model is empty: it has {cameras} cameras and {images} images; run the calibration again"
    )]
    EmptyModel {
        /// The file or folder.
        path: PathBuf,
        /// Number of cameras.
        cameras: usize,
        /// Number of images.
        images: usize,
    },
    /// A name that files cannot have.
    #[error(
        "{path}: view '{view}' has a name that no file can be given; use letters, digits and the like, folders apart by '/'"
    )]
    ViewName {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
    },
    /// Two views whose files would have one name.
    #[error("{path}: files of the views {first} and {second} would both be named {file}; rename one of them")]
    SameFiles {
        /// The file that names the second view.
        path: PathBuf,
        /// One view.
        first: String,
        /// The other.
        second: String,
        /// Name of the files, without an ending.
        file: String,
    },
    /// Two cameras of one name.
    #[error("{path}: view {view} is given twice; give every camera its own name")]
    DuplicateView {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
    },
    /// One camera is both training and test.
    #[error("{path}: view {view} is a training view in one frame and held out in another; choose one")]
    MixedSplit {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
    },
    /// A camera without any image.
    #[error("view {view} has no images (looked for {looked_for}); add its images or remove the camera")]
    NoImages {
        /// The view.
        view: String,
        /// File or folder.
        looked_for: PathBuf,
    },
    /// A frame that one view lacks and others have.
    #[error(
        "view {view} lacks frame {frame} (looked for {looked_for}); add the image, or choose frames that every view has"
    )]
    MissingFrame {
        /// The view.
        view: String,
        /// The frame number.
        frame: u32,
        /// File or folder.
        looked_for: PathBuf,
    },
    /// Two images of one frame.
    #[error("{first} and {second} are both frame {frame}; keep one")]
    DuplicateFrame {
        /// The frame number.
        frame: u32,
        /// One file.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
    /// An image whose name holds no frame number.
    #[error("{path}: its name holds no frame number below 4294967296; name frames like frame_0001.png")]
    UnnumberedFrame {
        /// The file.
        path: PathBuf,
    },
    /// Frames were asked for that the clip lacks.
    #[error(
        "frames {first} to {last} were asked for, {root} has frames {available_first} to {available_last}; choose among these"
    )]
    FrameRange {
        /// The data set.
        root: PathBuf,
        /// First asked for.
        first: u32,
        /// Last asked for.
        last: u32,
        /// First there.
        available_first: u32,
        /// Last there.
        available_last: u32,
    },
    /// Held-out views were asked for that the clip lacks.
    #[error("there is no view {unknown} to hold out; known views: {known}")]
    UnknownTestViews {
        /// Comma-separated names.
        unknown: String,
        /// Comma-separated names.
        known: String,
    },
    /// Nothing to triangulate from.
    #[error(
        "{root}: {training} of {views} views are for training, at least two are needed; hold out fewer views or add cameras"
    )]
    TooFewTrainingViews {
        /// The data set.
        root: PathBuf,
        /// Number of training views.
        training: usize,
        /// Number of all views.
        views: usize,
    },
    /// An image or mask that cannot be decoded.
    #[error("{path}: {source}")]
    Undecodable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: DecodeError,
    },
    /// A JPEG that ends before its image does; decoders would fill the rest with grey.
    #[error("{path}: the JPEG is cut short (no end-of-image marker); copy the complete file again")]
    Truncated {
        /// The file.
        path: PathBuf,
    },
    /// An image or mask of another size than its camera.
    #[error(
        "{path} is {width}x{height} pixels, its camera {view} is {camera_width}x{camera_height}; resize the image or give the \
         camera of this size"
    )]
    ImageSize {
        /// The file.
        path: PathBuf,
        /// Columns of the file.
        width: u32,
        /// Rows of the file.
        height: u32,
        /// The view.
        view: String,
        /// Columns of the camera.
        camera_width: u32,
        /// Rows of the camera.
        camera_height: u32,
    },
    /// Rows of `poses_bounds.npy` and cameras do not match.
    #[error(
        "{path} has {rows} rows for {cameras} cameras in {folder}; give one row per video or image folder, in the order of their names"
    )]
    RowCount {
        /// The poses.
        path: PathBuf,
        /// Rows.
        rows: usize,
        /// Videos or image folders.
        cameras: usize,
        /// Where they are.
        folder: PathBuf,
    },
    /// The clip's videos cannot be decoded without ffmpeg.
    #[error(
        "decoding {video} needs ffmpeg, and `{program}` is not on the PATH; install it (Debian, Ubuntu: apt install ffmpeg; macOS: \
         brew install ffmpeg; Windows: winget install ffmpeg), or extract the frames to images/<camera>/frame_0001.png yourself"
    )]
    NoFfmpeg {
        /// The video.
        video: PathBuf,
        /// What was looked for.
        program: String,
    },
    /// ffmpeg failed.
    #[error("ffmpeg could not decode {video}: {message}; check that the file is a complete video")]
    Ffmpeg {
        /// The video.
        video: PathBuf,
        /// What ffmpeg said.
        message: String,
    },
    /// No folder for decoded videos was given.
    #[error(
        "{video} must be decoded to images, and no scratch folder was given; set `scratch` in the clip's options"
    )]
    NoScratch {
        /// The video.
        video: PathBuf,
    },
    /// A view or frame index past the end.
    #[error(
        "there is no view {view} with frame index {frame}: the clip has {views} views and {frames} frames"
    )]
    OutOfRange {
        /// View index.
        view: usize,
        /// Frame index.
        frame: usize,
        /// Number of views.
        views: usize,
        /// Number of frames.
        frames: usize,
    },
}

impl ClipError {
    /// Wraps an I/O error on `path`.
    pub(super) fn io(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, source }
    }

    /// A value that breaks the format of `path`.
    pub(super) fn malformed(
        path: impl Into<PathBuf>,
        place: impl ToString,
        found: impl ToString,
        expected: impl ToString,
    ) -> Self {
        Self::Malformed {
            path: path.into(),
            place: place.to_string(),
            found: found.to_string(),
            expected: expected.to_string(),
        }
    }
}
