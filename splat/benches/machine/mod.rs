//! What the figures were taken on.

use std::process::Command;

use serde::Serialize;

/// The machine, as far as it tells.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct MachineLine {
    cpu: String,
    cores: usize,
    instruction_sets: Vec<&'static str>,
    rustc: String,
    /// Load average over the last minute, before the run: others' work makes the figures noisy.
    load: Option<f64>,
}

impl MachineLine {
    /// Asks the system.
    pub(crate) fn read() -> Self {
        Self {
            cpu: cpu().unwrap_or_else(|| std::env::consts::ARCH.into()),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            instruction_sets: instruction_sets(),
            rustc: rustc().unwrap_or_else(|| "rustc of unknown version".into()),
            load: load(),
        }
    }
}

impl std::fmt::Display for MachineLine {
    fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { cpu, cores, instruction_sets, rustc, load } = self;
        write!(to, "{cpu}, {cores} cores, {}; {rustc}", instruction_sets.join(" "))?;
        match load {
            Some(load) => write!(to, "; load before the run {load:.2}"),
            None => Ok(()),
        }
    }
}

fn cpu() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let value = |key: &str| {
        let line =
            text.lines().find(|line| line.split(':').next().is_some_and(|found| found.trim() == key))?;
        line.split_once(':').map(|(_, value)| value.trim().to_owned())
    };
    let name = value("model name")?;
    // Virtual machines often tell no more than the make.
    Some(match (value("cpu family"), value("model")) {
        (Some(family), Some(model)) => format!("{name} (family {family}, model {model})"),
        _ => name,
    })
}

fn instruction_sets() -> Vec<&'static str> {
    let mut sets = Vec::new();
    #[cfg(target_arch = "x86_64")]
    {
        let known = [
            ("SSE2", true),
            ("AVX2", is_x86_feature_detected!("avx2")),
            ("FMA", is_x86_feature_detected!("fma")),
            ("AVX-512F", is_x86_feature_detected!("avx512f")),
            ("AVX-512VL", is_x86_feature_detected!("avx512vl")),
            ("AVX-512DQ", is_x86_feature_detected!("avx512dq")),
            ("AVX-512BW", is_x86_feature_detected!("avx512bw")),
        ];
        sets.extend(known.iter().filter(|(_, is_there)| *is_there).map(|(name, _)| *name));
    }
    if cfg!(target_arch = "aarch64") {
        sets.push("NEON");
    }
    sets
}

fn rustc() -> Option<String> {
    let program = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(program).arg("--version").output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}
