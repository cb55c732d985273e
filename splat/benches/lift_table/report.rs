//! The table, and what it was meant to show.

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::measure::{Cell, Errors, Spread};

/// Rotations are to be better by this.
const ROTATION_GAIN: f64 = 3.0;

/// Everything that a run found out.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    pub(crate) gaussians: usize,
    pub(crate) seed: u64,
    pub(crate) cells: Vec<Cell>,
}

impl Report {
    /// One line per cell.
    pub(crate) fn table(&self, verbose: bool) -> String {
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        let mut header = vec!["motion", "views", "noise"];
        header.extend(["position: none", "reference", "robust", "gain"]);
        header.extend(["rotation: none", "reference", "robust", "gain"]);
        if verbose {
            header.extend(["of shape: reference", "robust"]);
        }
        header.extend(["solved: reference", "its rotations", "robust"]);
        table.set_header(header);
        for cell in &self.cells {
            table.add_row(row(cell, verbose));
        }
        for column in table.column_iter_mut().skip(2) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!("{}\n\n{table}\n\n{}", self.head(verbose), self.verdict())
    }

    fn head(&self, verbose: bool) -> String {
        let brackets = if verbose { " (in brackets: nine tenths)" } else { "" };
        format!(
            "{} Gaussians, seed {}; noise: standard deviation of each entry of every view's affine fit.\n\
             Medians over all Gaussians{brackets}. Positions: 1/10 000 of the scene's diagonal; rotations: degrees.\n\
             Solved: from their own footprints; the released path solves positions and rotations apart.",
            self.gaussians, self.seed
        )
    }

    fn verdict(&self) -> String {
        let falls_short = |cell: &&Cell| {
            let is_better =
                cell.position_gain() > 1.0 && cell.robust.solved > cell.reference_rotations_solved;
            !(is_better && cell.rotation_gain() >= ROTATION_GAIN)
        };
        let short: Vec<String> = self
            .cells
            .iter()
            .filter(falls_short)
            .map(|cell| format!("{}, {}, {} %", cell.motion, cell.rig, 100.0 * cell.noise))
            .collect();
        if short.is_empty() {
            return format!(
                "Robust is better in every cell, in rotation by {ROTATION_GAIN} times at least; solved is compared with the \
                 released path's rotations."
            );
        }
        format!("Not better, or in rotation by less than {ROTATION_GAIN} times: {}.", short.join("; "))
    }
}

fn row(cell: &Cell, verbose: bool) -> Vec<String> {
    let show = |spread: Spread, scale: f64| {
        let median = figure(scale * spread.median);
        if verbose { format!("{median} ({})", figure(scale * spread.ninth)) } else { median }
    };
    let position = |errors: &Errors| show(errors.position, 1e4);
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut cells = vec![cell.motion.into(), cell.rig.into(), format!("{} %", 100.0 * cell.noise)];
    cells.extend([&cell.none, &cell.reference, &cell.robust].map(position));
    cells.push(format!("{:.1}", cell.position_gain()));
    cells.extend([&cell.none, &cell.reference, &cell.robust].map(|errors| show(errors.rotation, 1.0)));
    cells.push(format!("{:.1}", cell.rotation_gain()));
    if verbose {
        cells.extend([&cell.reference, &cell.robust].map(|errors| show(errors.shape_rotation, 1.0)));
    }
    cells.extend([cell.reference.solved, cell.reference_rotations_solved, cell.robust.solved].map(percent));
    cells
}

/// Three significant digits.
fn figure(value: f64) -> String {
    if !value.is_finite() || value == 0.0 {
        return value.to_string();
    }
    let decimals = (2 - value.abs().log10().floor() as i32).clamp(0, 9) as usize;
    format!("{value:.decimals$}")
}
