//! Options that several commands share.

use std::{
    path::{Path, PathBuf},
    str::FromStr,
    sync::Arc,
};

use clap::{Args, ValueEnum};
use splat::{
    engine::Engine,
    motion::LiftMethod,
    raster::CpuEngine,
    settings::{MotionSource, Quality},
    simd::{InstructionSet, Instructions},
};
use trackersplat_proto::v1::{ExactTracks, SubmitRequest, TrackFiles, submit_request::Tracks};

use crate::{
    device::{DeviceArg, Placement, gpu_engine, memories, share_of_memory},
    error::CliError,
    frame_range::FrameRange,
    layers::SettingsLayers,
};

/// Where the pieces that run by hand find each other by default.
pub(crate) const DEFAULT_COORDINATOR: &str = "http://127.0.0.1:7700";

/// A coordinator to talk to.
#[derive(Args, Clone, Debug)]
pub(crate) struct CoordinatorArgs {
    /// Address of the coordinator.
    #[arg(long, value_name = "URL", default_value = DEFAULT_COORDINATOR, env = "TRACKERSPLAT_COORDINATOR")]
    pub(crate) coordinator: String,
}

/// What to reconstruct and how.
#[derive(Args, Clone, Debug)]
pub(crate) struct JobArgs {
    /// Folder of the clip (COLMAP, nerfstudio transforms, or LLFF/N3DV), or its URL: s3://, gs://, az://, abfss://, or
    /// https:// of a WebDAV server, with credentials in the coordinator's environment.
    pub(crate) clip: String,

    /// Frames to reconstruct, first and last; the first is the key frame [default: all].
    #[arg(long, value_name = "1..10", help_heading = "Input")]
    pub(crate) frames: Option<FrameRange>,

    /// Views to hold out for evaluation [default: the data set's test views].
    #[arg(long, value_name = "NAMES", value_delimiter = ',', help_heading = "Input")]
    pub(crate) test_views: Vec<String>,

    /// Gaussian PLY that replaces the reconstruction of the key frame.
    #[arg(long, value_name = "FILE", help_heading = "Input")]
    pub(crate) static_model: Option<PathBuf>,

    /// Where tracks come from: `exact` reads the clip's flow/<view>.npz, files are npz per training view,
    /// named after the views or in their order [default: the built-in tracker].
    #[arg(long, value_name = "exact|FILE", num_args = 1.., help_heading = "Input")]
    pub(crate) tracks: Vec<String>,

    /// A neural network in place of the built-in tracker: an ONNX file, as docs/trackers.md describes it.
    #[arg(long, value_name = "onnx:FILE", conflicts_with = "tracks", help_heading = "Input")]
    pub(crate) tracker: Option<TrackerArg>,

    #[command(flatten)]
    pub(crate) settings: SettingsArgs,
}

/// A tracker that is not the built-in one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct TrackerArg {
    /// ONNX file of the network.
    pub(crate) file: String,
}

impl FromStr for TrackerArg {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.strip_prefix("onnx:") {
            Some(file) if !file.is_empty() => Ok(Self { file: file.to_owned() }),
            _ => {
                Err("write onnx:FILE, as in --tracker onnx:raft.onnx; leave it out for the built-in tracker")
            }
        }
    }
}

/// How to reconstruct.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct SettingsArgs {
    /// How much time to trade for accuracy.
    #[arg(long, value_enum, default_value_t, help_heading = "Reconstruction")]
    pub(crate) quality: QualityArg,

    /// Where frames start from [default: tracks].
    #[arg(long, value_enum, help_heading = "Reconstruction")]
    pub(crate) motion: Option<MotionArg>,

    /// How tracks become motion [default: robust]; `reference` is an ablation, to compare with.
    #[arg(long, value_enum, help_heading = "Reconstruction")]
    pub(crate) lift: Option<LiftArg>,

    /// Seed of every random choice [default: 0].
    #[arg(long, help_heading = "Reconstruction")]
    pub(crate) seed: Option<u64>,

    /// TOML file of settings, over the preset of --quality.
    #[arg(long, value_name = "FILE", help_heading = "Reconstruction")]
    pub(crate) settings: Option<PathBuf>,

    /// One setting by its dotted key, over --settings; may be repeated.
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Reconstruction")]
    pub(crate) set: Vec<String>,
}

/// [`Quality`] on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum QualityArg {
    /// A look at the result.
    Draft,
    /// The default.
    #[default]
    Balanced,
    /// The paper's budget.
    Best,
}

/// [`MotionSource`] on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum MotionArg {
    /// From the tracks, by motion compensation.
    Tracks,
    /// From the static model as it is: the baseline.
    None,
}

/// [`LiftMethod`] on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum LiftArg {
    /// The project's own motion compensation.
    Robust,
    /// Ablation: the path of TrackerSplat's released code, with its thresholds and its defects.
    Reference,
}

impl From<QualityArg> for Quality {
    fn from(quality: QualityArg) -> Self {
        match quality {
            QualityArg::Draft => Self::Draft,
            QualityArg::Balanced => Self::Balanced,
            QualityArg::Best => Self::Best,
        }
    }
}

impl From<MotionArg> for MotionSource {
    fn from(motion: MotionArg) -> Self {
        match motion {
            MotionArg::Tracks => Self::Tracks,
            MotionArg::None => Self::None,
        }
    }
}

impl From<LiftArg> for LiftMethod {
    fn from(lift: LiftArg) -> Self {
        match lift {
            LiftArg::Robust => Self::Robust,
            LiftArg::Reference => Self::Reference,
        }
    }
}

impl JobArgs {
    /// The submission for a coordinator; paths become absolute, because it runs in another folder.
    pub(crate) fn request(&self, output: Option<&Path>) -> Result<SubmitRequest, CliError> {
        let layers = SettingsLayers {
            quality: self.settings.quality.into(),
            file: self.settings.settings.as_deref(),
            assignments: &self.settings.set,
            motion: self.settings.motion.map(Into::into),
            lift: self.settings.lift.map(Into::into),
            seed: self.settings.seed,
        };
        let settings_json = serde_json::to_string(&layers.resolve()?)
            .map_err(|error| CliError::failed("the settings as JSON", error))?;
        let frames = self.frames.unwrap_or(FrameRange { first: 0, last: 0 });
        Ok(SubmitRequest {
            clip: absolute(&self.clip)?,
            output: output.map(|output| absolute(&output.to_string_lossy())).transpose()?.unwrap_or_default(),
            first_frame: frames.first,
            last_frame: frames.last,
            test_views: self.test_views.clone(),
            settings_json,
            static_model: match &self.static_model {
                Some(file) => absolute(&file.to_string_lossy())?,
                None => String::new(),
            },
            tracks: self.tracks()?,
        })
    }

    fn tracks(&self) -> Result<Option<Tracks>, CliError> {
        if let Some(tracker) = &self.tracker {
            return Ok(Some(Tracks::TrackerModel(absolute(&tracker.file)?)));
        }
        match self.tracks.as_slice() {
            [] => Ok(None),
            [one] if one == "exact" => Ok(Some(Tracks::ExactTracks(ExactTracks {}))),
            files if files.iter().any(|file| file == "exact") => {
                let why = "'exact' stands alone; give it without files, or only files (./exact for a file of that name)";
                Err(CliError::bad_input("--tracks", why))
            }
            files => {
                let paths = files.iter().map(|file| absolute(file)).collect::<Result<_, _>>()?;
                Ok(Some(Tracks::TrackFiles(TrackFiles { paths })))
            }
        }
    }
}

/// How this machine computes.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct EngineArgs {
    /// What computes: a GPU by its number or by a part of its name, as `trackersplat devices` lists them, or the processor.
    ///
    /// `auto` is the best GPU, or the processor where there is none; `gpu` is the best GPU or an error. Neither takes software
    /// that behaves like a GPU, which must be named. Results of different devices differ by rounding.
    #[arg(long, value_name = "auto|cpu|gpu|gpu:N|NAME", default_value_t, help_heading = "Execution")]
    pub(crate) device: DeviceArg,

    /// Instruction set of the processor [default: the widest; possible values: avx512, avx2, baseline].
    ///
    /// avx512 and avx2 give the same bytes, baseline others, by rounding. Asks for the processor: with it, `--device auto` is
    /// `--device cpu`.
    #[arg(long, value_name = "SET", help_heading = "Execution")]
    pub(crate) instructions: Option<InstructionSet>,

    /// MiB of the GPU's memory that a process takes at most [default: all; workers that this program starts on one GPU divide nine tenths].
    ///
    /// Never more than the GPU has. Where this program starts workers, each of them takes so much: it is not divided. A job that needs more fails as out of resources. For workers of several programs on one GPU whose driver does not say what
    /// the others have.
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u32).range(1..), help_heading = "Execution")]
    pub(crate) device_memory: Option<u32>,
}

/// One worker process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct WorkerSetup {
    /// Threads for what runs on the processor.
    pub(crate) threads: usize,
    /// Its device, as the arguments of `worker` that say so.
    pub(crate) arguments: Vec<String>,
}

impl EngineArgs {
    /// The engine, if this machine can run it.
    pub(crate) fn engine(&self) -> Result<Arc<dyn Engine>, CliError> {
        self.engine_on(&self.placement()?)
    }

    /// The engine on one of these devices, the best.
    pub(crate) fn engine_on(&self, placement: &Placement) -> Result<Arc<dyn Engine>, CliError> {
        match placement {
            // The best comes first.
            Placement::Gpus(gpus) => {
                gpu_engine(gpus, self.device_memory.map(|mebibytes| u64::from(mebibytes) << 20))
            }
            Placement::Cpu => Ok(Arc::new(self.cpu_engine()?)),
        }
    }

    /// Worker processes for this machine: `asked` of them, else one per GPU, else `on_cpu` of one thread each. Each owns one
    /// device; the `cores` are divided among those that own a GPU.
    pub(crate) fn workers(
        &self,
        placement: &Placement,
        asked: Option<usize>,
        on_cpu: usize,
        cores: usize,
    ) -> Vec<WorkerSetup> {
        let instructions = self.instructions.map(|set| format!("--instructions={set}"));
        match placement {
            Placement::Cpu => {
                let arguments = ["--device=cpu".to_owned()].into_iter().chain(instructions).collect();
                vec![WorkerSetup { threads: 1, arguments }; asked.unwrap_or(on_cpu)]
            }
            Placement::Gpus(gpus) => {
                let count = asked.unwrap_or(gpus.len());
                // In turn: some may have one more than others.
                let assigned: Vec<usize> = gpus.iter().copied().cycle().take(count).collect();
                let is_divided = self.device_memory.is_none() && count > gpus.len();
                let memories = if is_divided { memories() } else { Vec::new() };
                let one = |&gpu: &usize| WorkerSetup {
                    threads: (cores / count).max(1),
                    arguments: [
                        Some(format!("--device=gpu:{gpu}")),
                        self.memory_of_a_worker(gpu, &assigned, &memories),
                    ]
                    .into_iter()
                    .flatten()
                    .collect(),
                };
                assigned.iter().map(one).collect()
            }
        }
    }

    /// What a worker is told of its GPU's memory; `assigned` are the GPUs of all of them, `memories` those of all devices.
    fn memory_of_a_worker(&self, gpu: usize, assigned: &[usize], memories: &[Option<u64>]) -> Option<String> {
        let workers = assigned.iter().filter(|&&other| other == gpu).count();
        let memory = memories.get(gpu).copied().flatten().filter(|_| workers > 1);
        let share = memory.map(|bytes| share_of_memory(bytes, workers));
        let mebibytes = self.device_memory.map(u64::from).or(share)?;
        Some(format!("--device-memory={mebibytes}"))
    }

    /// The devices that are meant, on this machine.
    pub(crate) fn placement(&self) -> Result<Placement, CliError> {
        match (&self.instructions, &self.device) {
            (Some(_), DeviceArg::Auto) => Ok(Placement::Cpu),
            (Some(set), DeviceArg::Gpu | DeviceArg::One(_)) => Err(CliError::bad_input(
                format!("--instructions {set}"),
                format!("a GPU has no such instructions; leave it out, or --device {}", self.device),
            )),
            (_, device) => device.placement(),
        }
    }

    fn cpu_engine(&self) -> Result<CpuEngine, CliError> {
        let Some(set) = self.instructions else { return Ok(CpuEngine::default()) };
        let instructions = Instructions::require(set)
            .map_err(|error| CliError::bad_input(format!("--instructions {set}"), error))?;
        Ok(CpuEngine::new(instructions))
    }
}

/// An absolute path; URLs stay as they are.
fn absolute(path: &str) -> Result<String, CliError> {
    if path.contains("://") {
        return Ok(path.to_owned());
    }
    let absolute =
        std::path::absolute(path).map_err(|error| CliError::bad_input(format!("path '{path}'"), error))?;
    Ok(absolute.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        job: JobArgs,
    }

    fn request(line: &[&str]) -> Result<SubmitRequest, CliError> {
        Line::try_parse_from(std::iter::once("x").chain(line.iter().copied())).unwrap().job.request(None)
    }

    #[test]
    fn a_plain_line_asks_for_everything_the_clip_has() {
        let request = request(&["clip"]).unwrap();
        assert!(Path::new(&request.clip).is_absolute() && request.clip.ends_with("/clip"));
        assert_eq!((request.first_frame, request.last_frame), (0, 0));
        assert_eq!(request.tracks, None);
        assert!(
            request.output.is_empty() && request.static_model.is_empty() && request.test_views.is_empty()
        );
    }

    #[test]
    fn every_flag_reaches_the_submission() {
        let line = [
            "file:///clip",
            "--frames",
            "2..5",
            "--test-views",
            "a,b",
            "--static-model",
            "/m.ply",
            "--tracks",
            "exact",
            "--seed",
            "9",
            "--motion",
            "none",
            "--lift",
            "reference",
        ];
        let request = request(&line).unwrap();
        assert_eq!(request.clip, "file:///clip");
        assert_eq!((request.first_frame, request.last_frame), (2, 5));
        assert_eq!(request.test_views, ["a", "b"]);
        assert_eq!(request.static_model, "/m.ply");
        assert!(matches!(request.tracks, Some(Tracks::ExactTracks(_))));
        let settings: splat::settings::Settings = serde_json::from_str(&request.settings_json).unwrap();
        assert_eq!((settings.seed, settings.motion_source), (9, MotionSource::None));
        assert_eq!(settings.motion.lift, LiftMethod::Reference);
    }

    fn arguments(setups: &[WorkerSetup]) -> Vec<&str> {
        setups.iter().map(|setup| setup.arguments[0].as_str()).collect()
    }

    #[test]
    fn a_host_has_a_worker_per_gpu_or_as_many_as_asked_for() {
        let args = EngineArgs::default();
        let gpus = Placement::Gpus(vec![2, 0]);
        let by_default = args.workers(&gpus, None, 16, 16);
        assert_eq!(arguments(&by_default), ["--device=gpu:2", "--device=gpu:0"]);
        assert_eq!(by_default[0].threads, 8);
        let three = args.workers(&gpus, Some(3), 16, 2);
        assert_eq!(arguments(&three), ["--device=gpu:2", "--device=gpu:0", "--device=gpu:2"]);
        assert_eq!(three[0].threads, 1);
        assert!(args.workers(&gpus, Some(0), 16, 16).is_empty());
        let limited = EngineArgs { device_memory: Some(512), ..EngineArgs::default() };
        let second = limited.workers(&gpus, None, 16, 16).swap_remove(1);
        assert_eq!(second.arguments, ["--device=gpu:0", "--device-memory=512"]);
        let cpu = args.workers(&Placement::Cpu, None, 3, 16);
        assert_eq!(arguments(&cpu), ["--device=cpu"; 3]);
        assert_eq!(cpu[0].threads, 1);
        assert_eq!(args.workers(&Placement::Cpu, Some(5), 3, 16).len(), 5);
    }

    #[test]
    fn workers_divide_the_gpu_that_they_are_on() {
        let memories = [Some(10 << 30), Some(20 << 30), None];
        let args = EngineArgs::default();
        let told = |gpu, assigned: &[usize]| args.memory_of_a_worker(gpu, assigned, &memories);
        // Three workers on two GPUs: one has its GPU for itself.
        assert_eq!(told(1, &[1, 0, 1]).as_deref(), Some("--device-memory=9216"));
        assert_eq!(told(0, &[1, 0, 1]), None);
        assert_eq!(told(2, &[2, 2]), None, "nobody knows how much there is");
        let explicit = EngineArgs { device_memory: Some(512), ..EngineArgs::default() };
        let told = explicit.memory_of_a_worker(1, &[1, 1], &memories);
        assert_eq!(told.as_deref(), Some("--device-memory=512"), "for each of them");
    }

    #[test]
    fn instructions_are_the_processors() {
        let baseline = |device: DeviceArg| EngineArgs {
            device,
            instructions: Some(InstructionSet::Baseline),
            device_memory: None,
        };
        for device in [DeviceArg::Auto, DeviceArg::Cpu] {
            let args = baseline(device);
            assert_eq!(args.engine().unwrap().name(), "cpu");
            let workers = args.workers(&args.placement().unwrap(), Some(1), 1, 1);
            assert_eq!(workers[0].arguments, ["--device=cpu", "--instructions=baseline"]);
        }
        let refused = baseline(DeviceArg::Gpu).engine().err().unwrap();
        assert_eq!(refused.exit_code(), 3);
        assert!(refused.to_string().contains("--instructions baseline"), "{refused}");
    }

    #[test]
    fn a_tracker_is_an_onnx_file_and_excludes_tracks() {
        let Some(Tracks::TrackerModel(file)) =
            request(&["clip", "--tracker", "onnx:nets/raft.onnx"]).unwrap().tracks
        else {
            panic!("a tracker");
        };
        assert!(Path::new(&file).is_absolute() && file.ends_with("/nets/raft.onnx"));
        for line in [
            ["x", "clip", "--tracker", "raft.onnx"].as_slice(),
            &["x", "clip", "--tracker", "onnx:"],
            &["x", "clip", "--tracker", "onnx:a.onnx", "--tracks", "exact"],
        ] {
            let error = Line::try_parse_from(line).err().unwrap().to_string();
            assert!(error.contains("--tracker"), "{error}");
        }
    }

    #[test]
    fn track_files_are_absolute_and_exact_stands_alone() {
        let Some(Tracks::TrackFiles(files)) =
            request(&["clip", "--tracks", "a.npz", "/b.npz"]).unwrap().tracks
        else {
            panic!("track files");
        };
        assert!(files.paths[0].ends_with("/a.npz") && Path::new(&files.paths[0]).is_absolute());
        assert_eq!(files.paths[1], "/b.npz");
        let error = request(&["clip", "--tracks", "exact", "a.npz"]).unwrap_err();
        assert_eq!(error.exit_code(), 3);
    }
}
