//! Instructions of one fixed optimisation step, which no other load on the machine can change.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail, ensure};
use comfy_table::{CellAlignment, Table, presets};
use serde::{Deserialize, Serialize};

use crate::bench::build;

/// Growth of a stage that counts as a regression.
const TOLERANCE: f64 = 0.03;

/// What the functions of the benchmark that are counted are called.
const PREFIX: &str = "one_step::counted_";

/// The counts in the repository.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Record {
    /// Of the machine; counts of another say nothing.
    architecture: String,
    /// The compiler, which changes counts as well.
    rustc: String,
    stages: Vec<Stage>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Stage {
    stage: String,
    instructions: u64,
}

/// Counts, and compares with the record or renews it.
pub(crate) fn run(record: bool) -> Result<()> {
    require_avx2()?;
    require_valgrind()?;
    let now = Record {
        architecture: std::env::consts::ARCH.into(),
        rustc: rustc()?,
        stages: count(&build("one_step")?)?,
    };
    let path = path();
    if record {
        let text = serde_json::to_string_pretty(&now)? + "\n";
        fs::write(&path, text).with_context(|| path.display().to_string())?;
        println!("{}", table(&now.stages, &now.stages));
        return Ok(());
    }
    let text = fs::read_to_string(&path)
        .with_context(|| format!("{}: no record; write one with --record", path.display()))?;
    let recorded: Record = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    ensure!(
        recorded.architecture == now.architecture,
        "the record is of {}, this machine is {}; compare on a machine like that of the record",
        recorded.architecture,
        now.architecture
    );
    println!("{}", table(&recorded.stages, &now.stages));
    if recorded.rustc != now.rustc {
        println!("the record was made with {}, this is {}", recorded.rustc, now.rustc);
    }
    judge(&recorded.stages, &now.stages)
}

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../splat/benches/instructions.json")
}

/// Valgrind has no AVX-512, so all machines with AVX2 run the same kernels in it; others run the baseline.
fn require_avx2() -> Result<()> {
    #[cfg(target_arch = "x86_64")]
    if !(is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")) {
        bail!(
            "the counts on record are of the AVX2 kernels, which this machine cannot run; count on one that has AVX2"
        );
    }
    Ok(())
}

fn require_valgrind() -> Result<()> {
    let is_there = Command::new("valgrind").arg("--version").output().is_ok_and(|run| run.status.success());
    ensure!(
        is_there,
        "valgrind counts the instructions and is missing; install it: apt-get install valgrind"
    );
    Ok(())
}

fn rustc() -> Result<String> {
    let program = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(program).arg("--version").output().context("cannot start rustc")?;
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Runs the benchmark in valgrind, which writes one file per counted function.
fn count(program: &Path) -> Result<Vec<Stage>> {
    let folder = tempfile::tempdir().context("a temporary folder")?;
    let output = Command::new("valgrind")
        .args(["--quiet", "--tool=callgrind", &format!("--dump-after={PREFIX}*")])
        .arg(format!("--callgrind-out-file={}", folder.path().join("counts").display()))
        .arg(program)
        .output()
        .context("cannot start valgrind")?;
    ensure!(output.status.success(), "valgrind failed:\n{}", String::from_utf8_lossy(&output.stderr));
    let mut stages = Vec::new();
    // Files are numbered from 1 in the order of the calls.
    for number in 1.. {
        let Ok(text) = fs::read_to_string(folder.path().join(format!("counts.{number}"))) else { break };
        let stage = parse(&text).with_context(|| format!("part {number} of valgrind's output"))?;
        if stage.stage != "nothing" {
            stages.push(stage);
        }
    }
    ensure!(
        !stages.is_empty(),
        "valgrind saw no function `{PREFIX}*`; was the benchmark built without symbols?"
    );
    Ok(stages)
}

/// Name and count of one part.
fn parse(text: &str) -> Result<Stage> {
    let after = |start: &str| text.lines().find_map(|line| line.strip_prefix(start));
    let function = after("desc: Trigger: --dump-after=").context("no trigger")?;
    let total = after("totals:").context("no totals")?;
    Ok(Stage {
        stage: function.strip_prefix(PREFIX).context("another function")?.to_owned(),
        instructions: total.trim().parse().with_context(|| format!("totals {total}"))?,
    })
}

fn count_of(stages: &[Stage], name: &str) -> Option<u64> {
    stages.iter().find(|stage| stage.stage == name).map(|stage| stage.instructions)
}

fn ratio(before: u64, now: u64) -> f64 {
    now as f64 / before.max(1) as f64
}

fn table(recorded: &[Stage], now: &[Stage]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    table.set_header(["stage", "recorded", "now", "ratio"]);
    for Stage { stage, instructions } in now {
        let before = count_of(recorded, stage);
        table.add_row([
            stage.clone(),
            before.map_or("-".into(), |before| before.to_string()),
            instructions.to_string(),
            before.map_or("-".into(), |before| format!("{:.3}", ratio(before, *instructions))),
        ]);
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// # Errors
/// If a stage grew beyond the tolerance, or the stages are not those on record.
fn judge(recorded: &[Stage], now: &[Stage]) -> Result<()> {
    let names = |stages: &[Stage]| stages.iter().map(|stage| stage.stage.clone()).collect::<Vec<_>>();
    ensure!(
        names(recorded) == names(now),
        "the stages on record are {:?}, now they are {:?}; renew the record with --record",
        names(recorded),
        names(now)
    );
    let grown: Vec<String> = recorded
        .iter()
        .zip(now)
        .filter(|(before, now)| ratio(before.instructions, now.instructions) > 1.0 + TOLERANCE)
        .map(|(before, now)| {
            format!("{} {:+.1} %", now.stage, 100.0 * (ratio(before.instructions, now.instructions) - 1.0))
        })
        .collect();
    ensure!(
        grown.is_empty(),
        "more instructions than on record: {}; if that is meant, renew the record with --record",
        grown.join(", ")
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stages(counts: &[(&str, u64)]) -> Vec<Stage> {
        counts.iter().map(|&(stage, instructions)| Stage { stage: stage.into(), instructions }).collect()
    }

    #[test]
    fn name_and_count_of_a_part_are_read() {
        let text = "version: 1\npart: 3\n\ndesc: Trigger: --dump-after=one_step::counted_blend\n\nevents: Ir\n\
                    fn=(1) x\n16 3\ntotals: 18107527\n";
        assert_eq!(parse(text).expect("a part"), stages(&[("blend", 18_107_527)])[0]);
        assert!(parse("desc: Trigger: Program termination\ntotals: 5\n").is_err(), "the end of the program");
        assert!(parse("desc: Trigger: --dump-after=one_step::counted_bin\n").is_err(), "no totals");
    }

    #[test]
    fn growth_beyond_the_tolerance_fails_and_names_the_stage() {
        let recorded = stages(&[("blend", 1000), ("loss", 1000)]);
        assert!(judge(&recorded, &stages(&[("blend", 1030), ("loss", 400)])).is_ok());
        let error = judge(&recorded, &stages(&[("blend", 1031), ("loss", 1000)])).expect_err("3.1 % more");
        assert!(error.to_string().contains("blend +3.1 %"), "{error}");
    }

    #[test]
    fn other_stages_than_on_record_fail() {
        let recorded = stages(&[("blend", 1000), ("loss", 1000)]);
        assert!(judge(&recorded, &stages(&[("blend", 1000)])).is_err());
        assert!(judge(&recorded, &stages(&[("blend", 1000), ("bin", 1000)])).is_err());
    }
}
