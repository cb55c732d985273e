//! The tables of `docs/numerics.md`, from the rows of the test target `stability`.

use std::{
    fmt::Write,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;

use crate::cargo;

/// Where the tests write their rows, one file per sweep.
const ROWS_VARIABLE: &str = "TRACKERSPLAT_STABILITY_ROWS";

const START: &str = "<!-- rows of ";
const END: &str = "<!-- end of rows -->";

/// One line of a table, as the tests write it.
#[derive(Debug, Deserialize)]
struct Row {
    stage: String,
    extreme: String,
    cases: u64,
    /// None if it is no number.
    error: Option<f64>,
    unit: String,
    bound: Option<f64>,
    factor: f64,
    why: String,
    remark: String,
    holds: bool,
}

/// Runs the suite and puts its rows into the document, those that do not hold as well.
///
/// # Errors
/// If a row does not hold, after the document is written; if a sweep has no table or a table no sweep.
pub(crate) fn run() -> Result<()> {
    let folder = tempfile::tempdir().context("a temporary folder")?;
    let arguments = ["test", "--package", "trackersplat-tests", "--test", "stability"];
    let status = cargo::cargo()
        .args(arguments)
        .env(ROWS_VARIABLE, folder.path())
        .status()
        .context("cannot start cargo")?;
    let path = document();
    let before = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let after = filled(&before, |sweep| rows(folder.path(), sweep))?;
    fs::write(&path, after).with_context(|| path.display().to_string())?;
    if !status.success() {
        bail!("the suite fails ({status}); docs/numerics.md has what it wrote");
    }
    Ok(())
}

fn document() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/numerics.md")
}

fn rows(folder: &Path, sweep: &str) -> Result<Vec<Row>> {
    let path = folder.join(format!("{sweep}.jsonl"));
    let text = fs::read_to_string(&path)
        .with_context(|| format!("the suite wrote no rows of `{sweep}`; did that test panic?"))?;
    text.lines()
        .map(|line| serde_json::from_str(line).with_context(|| format!("a row of `{sweep}`")))
        .collect()
}

/// The document with its tables renewed; everything outside of the markers stays.
fn filled(document: &str, rows: impl Fn(&str) -> Result<Vec<Row>>) -> Result<String> {
    let mut text = String::new();
    let mut lines = document.lines();
    while let Some(line) = lines.next() {
        text += line;
        text.push('\n');
        let Some(sweep) = line.strip_prefix(START).and_then(|rest| rest.strip_suffix(" -->")) else {
            continue;
        };
        text += &table(&rows(sweep)?)?;
        let has_end = lines.by_ref().any(|line| line == END);
        ensure!(has_end, "the table of `{sweep}` has no `{END}`");
        text += END;
        text.push('\n');
    }
    Ok(text)
}

fn table(rows: &[Row]) -> Result<String> {
    let mut table = String::from(
        "\n| stage | extreme | cases | worst error | bound | factor × prediction | remark |\n\
         |---|---|---:|---:|---:|---|---|\n",
    );
    for row in rows {
        let Row { stage, extreme, cases, unit, factor, why, remark, .. } = row;
        let (error, bound) = (number(row.error), number(row.bound));
        let remark = if row.holds { remark.clone() } else { format!("**does not hold** {remark}") };
        let cells = format!("{stage}{extreme}{unit}{why}{remark}");
        ensure!(!cells.contains(['|', '\n']), "{stage}, {extreme}: a cell holds `|` or ends its line");
        let error = if row.bound == Some(0.0) && row.error == Some(0.0) { "none".into() } else { error };
        let (error, bound) =
            (format!("{error} {unit}"), if bound == "0.0e0" { "exact".into() } else { bound });
        writeln!(
            table,
            "| {stage} | {extreme} | {cases} | {error} | {bound} | {factor} × {why} | {remark} |"
        )?;
    }
    table.push('\n');
    Ok(table)
}

fn number(value: Option<f64>) -> String {
    value.map_or("no number".into(), |value| format!("{value:.1e}"))
}
