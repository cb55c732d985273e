//! The table at the end: a row per frame.

use comfy_table::{Cell, CellAlignment, Table, presets};
use splat::frame::{ViewMetrics, mean};

use crate::outcome::Outcome;

const HEADER: [&str; 6] = ["frame", "state", "PSNR dB", "SSIM", "moving PSNR dB", "seconds"];

/// Frames with held-out metrics before → after refinement, and their mean.
pub(crate) fn frames(outcome: &Outcome) -> String {
    let mut table = empty(&HEADER);
    for (number, frame) in &outcome.frames {
        let (before, after) = frame.means();
        let [psnr, ssim, moving] = columns(before, after);
        let seconds = if frame.seconds > 0.0 { format!("{:.1}", frame.seconds) } else { String::new() };
        table.add_row([number.to_string(), frame.state.to_owned(), psnr, ssim, moving, seconds]);
    }
    let all: Vec<_> = outcome.frames.values().map(|frame| frame.means()).collect();
    let before = mean(all.iter().filter_map(|(before, _)| *before));
    let after = mean(all.iter().filter_map(|(_, after)| *after));
    if outcome.frames.len() > 1 && after.is_some() {
        let [psnr, ssim, moving] = columns(before.as_ref(), after.as_ref());
        table.add_row(["mean".to_owned(), String::new(), psnr, ssim, moving, String::new()]);
    }
    align(&mut table);
    table.to_string()
}

/// A table with the given header, for any command.
pub(crate) fn empty(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(header.iter().map(Cell::new));
    table
}

/// Figures to the right.
pub(crate) fn align(table: &mut Table) {
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
}

fn columns(before: Option<&ViewMetrics>, after: Option<&ViewMetrics>) -> [String; 3] {
    let pair = |value: fn(&ViewMetrics) -> Option<f64>, digits| {
        change(before.and_then(value), after.and_then(value), digits)
    };
    [pair(|m| Some(m.psnr), 2), pair(|m| Some(m.ssim), 3), pair(|m| m.moving_psnr, 2)]
}

fn change(before: Option<f64>, after: Option<f64>, digits: usize) -> String {
    match (before, after) {
        (Some(before), Some(after)) => format!("{before:.digits$} → {after:.digits$}"),
        (None, Some(after)) => format!("{after:.digits$}"),
        (_, None) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use trackersplat_proto::v1::TaskState;

    use super::*;
    use crate::outcome::tests::frame_event;

    #[test]
    fn a_row_per_frame_and_their_mean() {
        let mut outcome = Outcome::default();
        outcome.observe(&frame_event(1, 1, TaskState::Done));
        outcome.observe(&frame_event(2, 2, TaskState::Done));
        outcome.observe(&frame_event(3, 3, TaskState::Failed));
        let text = frames(&outcome);
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(rows.len(), 5, "{text}");
        assert!(rows[1].contains("done") && rows[1].contains("30.00") && rows[1].contains("2.5"), "{text}");
        assert!(rows[3].contains("failed") && !rows[3].contains("30.00"), "{text}");
        assert!(rows[4].contains("mean") && rows[4].contains("28.00"), "{text}");
    }

    #[test]
    fn a_change_is_shown_only_where_both_sides_are_known() {
        assert_eq!(change(Some(1.0), Some(2.0), 1), "1.0 → 2.0");
        assert_eq!(change(None, Some(2.0), 1), "2.0");
        assert_eq!(change(Some(1.0), None, 1), "");
    }
}
