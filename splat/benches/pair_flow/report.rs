//! The table, and the same figures as JSON.

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::{
    machine::MachineLine,
    measure::{Preset, Summary},
};

/// Everything that a run found out.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    pub(crate) machine: MachineLine,
    pub(crate) presets: Vec<Preset>,
}

impl Report {
    /// One line per preset.
    pub(crate) fn table(&self) -> String {
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        let mut header = vec!["preset".to_owned()];
        if let Some(preset) = self.presets.first() {
            header.extend(preset.times.iter().map(|time| format!("ms {}x{}", time.width, time.height)));
            for errors in &preset.errors {
                header.extend(["all", "moving"].map(|pixels| format!("{} {pixels}", errors.clip)));
            }
        }
        table.set_header(header);
        for preset in &self.presets {
            let mut cells = vec![preset.name.clone()];
            cells.extend(preset.times.iter().map(|time| format!("{:.1}", time.milliseconds)));
            let summary = |of: &Summary| format!("{:.3} / {:.3}", of.mean, of.median);
            cells.extend(preset.errors.iter().flat_map(|errors| [&errors.all, &errors.moving]).map(summary));
            table.add_row(cells);
        }
        for column in table.column_iter_mut() {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!(
            "{}\n\n{table}\n\nMilliseconds of processor time (where the system tells) of one thread per one-way flow: \
             half of what both ways take, pyramids included. Errors: mean / median of the distance from the exact \
             position, pixels, over the visible pixels of frame 1 at every later frame.",
            self.machine
        )
    }
}
