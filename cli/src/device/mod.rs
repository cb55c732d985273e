//! `--device`: which device computes, and how a host is divided among worker processes.

mod reopening;

use std::{fmt, str::FromStr, sync::Arc};

use splat::engine::{Engine, EngineError};
use splat_shaders::{DeviceChoice, DeviceError, GpuDevice, GpuEngine, choose, devices, real_gpus};

use self::reopening::{Candidate, ReopeningEngine};
use crate::error::CliError;

/// `--device` on the command line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) enum DeviceArg {
    /// The best GPU, else the processor.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// The best GPU; an error if there is none.
    Gpu,
    /// One of the list of `devices`, software too.
    One(DeviceChoice),
}

/// Where work goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Placement {
    /// To the processor.
    Cpu,
    /// To these GPUs, by their numbers; at least one.
    Gpus(Vec<usize>),
}

impl FromStr for DeviceArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim().to_lowercase().as_str() {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            _ => match text.parse() {
                Ok(choice) => Ok(Self::One(choice)),
                Err(error) => Err(format!("{error}; `trackersplat devices` lists them")),
            },
        }
    }
}

impl fmt::Display for DeviceArg {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu => f.write_str("gpu"),
            Self::One(choice) => choice.fmt(f),
        }
    }
}

impl DeviceArg {
    /// The devices that are meant, on this machine.
    pub(crate) fn placement(&self) -> Result<Placement, CliError> {
        let real = || real_gpus(&devices()).iter().map(|device| device.index).collect::<Vec<_>>();
        match self {
            Self::Cpu => Ok(Placement::Cpu),
            Self::Auto => match real() {
                none if none.is_empty() => Ok(Placement::Cpu),
                gpus => Ok(Placement::Gpus(gpus)),
            },
            Self::Gpu => match real() {
                none if none.is_empty() => Err(self.refused(choose(&DeviceChoice::Auto, &devices()).err())),
                gpus => Ok(Placement::Gpus(gpus)),
            },
            Self::One(choice) => match choose(choice, &devices()) {
                Ok(device) => Ok(Placement::Gpus(vec![device.index])),
                Err(error) => Err(self.refused(Some(error))),
            },
        }
    }

    fn refused(&self, error: Option<DeviceError>) -> CliError {
        let why = error.map(|error| error.to_string()).unwrap_or_default();
        CliError::bad_input(
            format!("--device {self}"),
            format!("{why}; `trackersplat devices` says more, --device cpu always computes"),
        )
    }
}

/// An engine on the first of these GPUs that opens, by their numbers, best first, at least one. It is opened when it is needed, and it and no other
/// again after it was lost. `memory` is the most bytes that it takes, all there are if `None`.
pub(crate) fn gpu_engine(gpus: &[usize], memory: Option<u64>) -> Result<Arc<dyn Engine>, CliError> {
    let all = devices();
    let candidate = |&index: &usize| {
        let device = choose(&DeviceChoice::Index(index), &all)
            .map_err(|error| CliError::failed(format!("device gpu:{index}"), error))?;
        let itself = device.itself();
        let open = move || open(&itself, memory);
        Ok(Candidate { name: device.label(), open: Box::new(open) })
    };
    let candidates = gpus.iter().map(candidate).collect::<Result<Vec<_>, CliError>>()?;
    Ok(Arc::new(ReopeningEngine::new(candidates)))
}

fn open(choice: &DeviceChoice, memory: Option<u64>) -> Result<Arc<dyn Engine>, EngineError> {
    let device = GpuDevice::open(choice).map_err(|error| EngineError::DeviceLost(error.to_string()))?;
    let device = match memory {
        Some(bytes) => device.with_memory_limit(bytes),
        None => device,
    };
    Ok(Arc::new(GpuEngine::new(device)?))
}

/// Memory of every device of this machine, bytes, by their numbers; `None` where nobody knows.
pub(crate) fn memories() -> Vec<Option<u64>> {
    devices().iter().map(|device| device.memory).collect()
}

/// What each of so many processes may take of a GPU's memory, MiB: nine tenths of it are divided, the rest is for what drivers take for
/// each process.
pub(crate) fn share_of_memory(bytes: u64, processes: usize) -> u64 {
    (bytes / 10 * 9 / processes.max(1) as u64) >> 20
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_device_reads_back_as_it_was_written() {
        for text in ["auto", "cpu", "gpu", "gpu:3", "NVIDIA H100"] {
            assert_eq!(text.parse::<DeviceArg>().unwrap().to_string(), text);
        }
        assert_eq!("GPU:3".parse(), Ok(DeviceArg::One(DeviceChoice::Index(3))));
        assert_eq!(" Cpu ".parse(), Ok(DeviceArg::Cpu));
    }

    #[test]
    fn what_is_no_device_is_refused_with_the_remedy() {
        for text in ["", " ", "gpu:", "gpu:-1", "gpu:x"] {
            let error = text.parse::<DeviceArg>().unwrap_err();
            assert!(error.contains("trackersplat devices"), "{text}: {error}");
        }
        let unknown = DeviceArg::One(DeviceChoice::Name("no card has this name".to_owned()));
        let error = unknown.placement().unwrap_err();
        assert_eq!(error.exit_code(), 3);
        assert!(error.to_string().contains("this machine has"), "{error}");
    }

    #[test]
    fn processes_on_one_gpu_leave_a_tenth_of_it() {
        let gibibytes = |number: u64| number << 30;
        assert_eq!(share_of_memory(gibibytes(80), 1), 73_728);
        assert_eq!(share_of_memory(gibibytes(80), 3), 24_576);
        assert_eq!(share_of_memory(gibibytes(10), 0), 9216);
        assert_eq!(share_of_memory(u64::MAX, 1), (u64::MAX / 10 * 9) >> 20);
    }

    #[test]
    fn the_processor_is_always_there() {
        assert_eq!(DeviceArg::Cpu.placement().unwrap(), Placement::Cpu);
        assert!(DeviceArg::Auto.placement().is_ok());
    }
}
