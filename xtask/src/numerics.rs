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
    largest: Option<f64>,
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
        "\n| stage | extreme | cases | largest error | nearest to its bound | bound = factor × prediction | remark |\n\
         |---|---|---:|---:|---:|---|---|\n",
    );
    for row in rows {
        let Row { stage, extreme, cases, unit, factor, why, remark, .. } = row;
        let remark = if row.holds { remark.clone() } else { format!("**does not hold** {remark}") };
        let cells = format!("{stage}{extreme}{unit}{why}{remark}");
        ensure!(!cells.contains(['|', '\n']), "{stage}, {extreme}: a cell holds `|` or ends its line");
        let nearest = format!("{} of {}", number(row.error), number(row.bound));
        let (largest, nearest) = match row.largest {
            Some(0.0) => ("none".into(), "exact".into()),
            largest => (format!("{} {unit}", number(largest)), nearest),
        };
        let bound = if unit.is_empty() { why.clone() } else { format!("{factor} × {why}") };
        writeln!(table, "| {stage} | {extreme} | {cases} | {largest} | {nearest} | {bound} | {remark} |")?;
    }
    table.push('\n');
    Ok(table)
}

fn number(value: Option<f64>) -> String {
    value.map_or("no number".into(), |value| format!("{value:.1e}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOCUMENT: &str = "before\n<!-- rows of one -->\nOLD\n<!-- end of rows -->\nafter\n";

    fn row(error: f64, holds: bool) -> Row {
        Row {
            stage: "stage".into(),
            extreme: "extreme".into(),
            cases: 3,
            largest: Some(2.0 * error),
            error: Some(error),
            unit: "pixel".into(),
            bound: Some(1e-3),
            factor: 2.0,
            why: "rounding".into(),
            remark: String::new(),
            holds,
        }
    }

    #[test]
    fn tables_are_renewed_and_the_rest_stays() {
        let text = filled(DOCUMENT, |_| Ok(vec![row(2e-4, true), row(5e-2, false)])).expect("a document");
        assert!(text.starts_with("before\n<!-- rows of one -->\n\n| stage |"), "{text}");
        assert!(text.ends_with("\n<!-- end of rows -->\nafter\n"), "{text}");
        assert!(!text.contains("OLD"), "{text}");
        assert!(
            text.contains("| stage | extreme | 3 | 4.0e-4 pixel | 2.0e-4 of 1.0e-3 | 2 × rounding |  |"),
            "{text}"
        );
        assert_eq!(text.matches("**does not hold**").count(), 1, "{text}");
        assert_eq!(filled(&text, |_| Ok(vec![row(2e-4, true), row(5e-2, false)])).expect("again"), text);
    }

    #[test]
    fn documents_and_rows_that_make_no_table_are_refused() {
        assert!(filled("<!-- rows of one -->\nOLD\n", |_| Ok(Vec::new())).is_err(), "no end");
        assert!(filled(DOCUMENT, |_| bail!("no rows")).is_err(), "no rows");
        let broken = || Row { remark: "a | b".into(), ..row(0.0, true) };
        assert!(filled(DOCUMENT, |_| Ok(vec![broken()])).is_err(), "a cell in two");
    }

    #[test]
    fn what_is_no_number_says_so() {
        let broken = Row { error: None, largest: None, ..row(0.0, false) };
        assert!(table(&[broken]).expect("a table").contains("no number of 1.0e-3"));
    }
}
