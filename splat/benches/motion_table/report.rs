//! The table, and the same figures as JSON.

use std::collections::BTreeMap;

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::{
    machine::MachineLine,
    measure::{Row, STAGES},
};

/// Milliseconds that the clock may be off by twice; shorter stages have no growth.
const LEAST_TIME: f64 = 8.0;

/// Everything that a run found out; times in milliseconds.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    machine: MachineLine,
    stages: [&'static str; STAGES.len()],
    rows: Vec<Row>,
    /// `log t` by `log N` from the smallest to the largest scene, by stage and for the whole: one is linear.
    growth: BTreeMap<&'static str, f64>,
}

impl Report {
    /// Compares the smallest with the largest scene.
    pub(crate) fn new(machine: MachineLine, rows: Vec<Row>) -> Self {
        Self { machine, stages: STAGES, growth: growth(&rows), rows }
    }

    /// One line per scene.
    pub(crate) fn table(&self) -> String {
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        let mut header = vec!["N", "views"];
        header.extend(STAGES);
        header.extend(["whole", "at rest", "solved"]);
        table.set_header(header);
        for row in &self.rows {
            let mut cells = vec![row.gaussians.to_string(), row.views.to_string()];
            cells.extend(row.stages.map(|time| format!("{time:.1}")));
            cells.push(format!("{:.0}", row.whole));
            cells.extend([row.at_rest, row.solved].map(|share| format!("{:.0} %", 100.0 * share)));
            table.add_row(cells);
        }
        if !self.growth.is_empty() {
            let mut cells = vec!["growth".to_owned(), String::new()];
            let names = STAGES.iter().chain(&["whole"]);
            let growth = |name| self.growth.get(name).map_or("-".into(), |growth| format!("{growth:.2}"));
            cells.extend(names.map(growth));
            cells.extend([String::new(), String::new()]);
            table.add_row(cells);
        }
        for column in table.column_iter_mut() {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!(
            "{}\n\n{table}\n\nMilliseconds of processor time (where the system tells) of one thread, the fastest of the repeats by stage; tracks \
             of 640x360.\n\
             growth: exponent of N from the smallest to the largest scene; 1 is linear.",
            self.machine
        )
    }
}

fn growth(rows: &[Row]) -> BTreeMap<&'static str, f64> {
    let smallest = rows.iter().min_by_key(|row| row.gaussians);
    let largest = rows.iter().max_by_key(|row| row.gaussians);
    let (Some(small), Some(large)) = (smallest, largest) else { return BTreeMap::new() };
    if small.gaussians == large.gaussians {
        return BTreeMap::new();
    }
    let exponent =
        |from: f64, to: f64| (to / from).ln() / (large.gaussians as f64 / small.gaussians as f64).ln();
    let by_stage = STAGES.into_iter().zip(small.stages.into_iter().zip(large.stages));
    by_stage
        .chain([("whole", (small.whole, large.whole))])
        .filter(|(_, (from, _))| *from >= LEAST_TIME)
        .map(|(stage, (from, to))| (stage, exponent(from, to)))
        .collect()
}
