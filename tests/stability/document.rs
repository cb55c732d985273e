//! The rows against their bounds and against the tables of `docs/numerics.md`.

use std::path::{Path, PathBuf};

use serde_json::json;

use crate::row::Row;

/// Folder for the rows; `cargo xtask numerics` sets it.
const ROWS_VARIABLE: &str = "TRACKERSPLAT_STABILITY_ROWS";

/// Asserts that every row of a sweep holds, and that the document lists exactly these rows.
///
/// Figures are not compared: they differ between instruction sets. With the variable set, the rows are written for the
/// document instead of compared with it.
pub(crate) fn prove(sweep: &str, rows: &[Row]) {
    for row in rows {
        let mark = if row.holds() { "holds" } else { "FAILS" };
        println!("{mark}: {}", line(row));
    }
    match std::env::var_os(ROWS_VARIABLE) {
        Some(folder) => write(Path::new(&folder), sweep, rows),
        None => compare(sweep, rows),
    }
    let failing: Vec<String> = rows.iter().filter(|row| !row.holds()).map(line).collect();
    assert!(failing.is_empty(), "rows of {sweep} that do not hold:\n{}", failing.join("\n"));
}

fn line(row: &Row) -> String {
    let Row { stage, extreme, cases, largest, error, predicted, bar, .. } = row;
    format!(
        "{stage}, {extreme}: {cases} cases, largest {largest:.2e} {}, worst {error:.2e} of {:.2e} = {} × {predicted:.2e}",
        bar.unit,
        row.bound(),
        bar.factor
    )
}

/// One JSON object per line, in the order of the sweep; what is no number becomes null.
fn write(folder: &Path, sweep: &str, rows: &[Row]) {
    let lines = rows.iter().map(|row| {
        let object = json!({
            "stage": row.stage,
            "extreme": row.extreme,
            "cases": row.cases,
            "largest": row.largest,
            "error": row.error,
            "unit": row.bar.unit,
            "bound": row.bound(),
            "factor": row.bar.factor,
            "why": row.bar.why,
            "remark": row.remark,
            "holds": row.holds(),
        });
        format!("{object}\n")
    });
    let path = folder.join(format!("{sweep}.jsonl"));
    std::fs::write(&path, lines.collect::<String>())
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/numerics.md")
}

fn text() -> String {
    std::fs::read_to_string(path()).unwrap_or_else(|error| panic!("{}: {error}", path().display()))
}

fn compare(sweep: &str, rows: &[Row]) {
    let text = text();
    let listed = listed(&text, sweep).unwrap_or_else(|| panic!("docs/numerics.md has no table of {sweep}"));
    let found: Vec<(&str, &str)> = rows.iter().map(|row| (row.stage, row.extreme)).collect();
    assert_eq!(listed, found, "docs/numerics.md lists other rows of {sweep}; run `cargo xtask numerics`");
}

/// Stage and extreme of every row between the markers of a sweep.
fn listed<'a>(text: &'a str, sweep: &str) -> Option<Vec<(&'a str, &'a str)>> {
    let (_, rest) = text.split_once(&format!("<!-- rows of {sweep} -->"))?;
    let (table, _) = rest.split_once("<!-- end of rows -->")?;
    let cells = |line: &'a str| {
        let mut cells = line.strip_prefix('|')?.split('|').map(str::trim);
        Some((cells.next()?, cells.next()?))
    };
    // Two lines of heading.
    Some(table.lines().filter_map(cells).skip(2).collect())
}

/// Asserts that the document has the tables of these sweeps, in this order, and no other.
pub(crate) fn require_tables(sweeps: &[&str]) {
    let text = text();
    let marked: Vec<&str> =
        text.lines().filter_map(|line| line.strip_prefix("<!-- rows of ")?.strip_suffix(" -->")).collect();
    assert_eq!(
        marked, sweeps,
        "docs/numerics.md needs a pair of markers for every sweep, in the suite's order"
    );
}

#[test]
fn listed_rows_are_read_without_their_figures() {
    let text = "<!-- rows of one -->\n\n| stage | extreme | cases |\n|---|---|---:|\n| a | b, c | 1 |\n| d | e | 2 |\n\n\
                <!-- end of rows -->\n| other | table |\n";
    assert_eq!(listed(text, "one"), Some(vec![("a", "b, c"), ("d", "e")]));
    assert_eq!(listed(text, "two"), None);
}
