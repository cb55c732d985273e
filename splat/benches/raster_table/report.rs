//! The table, and the same figures as JSON.

use std::collections::BTreeMap;

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;
use splat::raster::PairCounts;

use super::{
    floor::{Floor, Machine},
    machine::MachineLine,
    measure::Row,
    peers,
    step::STAGES,
};

/// Median and minimum of repeats.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Figure {
    median: f64,
    min: f64,
}

impl Figure {
    /// Of at least one value.
    fn of(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let middle = sorted.len() / 2;
        let median =
            if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) };
        Self { median, min: sorted[0] }
    }

    fn show(self, verbose: bool) -> String {
        if verbose { format!("{:.2} ({:.2})", self.median, self.min) } else { format!("{:.2}", self.median) }
    }
}

/// Everything that a run found out; times in milliseconds where the name says nothing else.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    machine: MachineLine,
    floor: FloorReport,
    rows: Vec<RowReport>,
}

#[derive(Debug, Serialize)]
struct FloorReport {
    instruction_set: &'static str,
    forward_ns_per_pair: Figure,
    backward_ns_per_pair: Figure,
}

#[derive(Debug, Serialize)]
struct RowReport {
    scene: String,
    gaussians: usize,
    width: u32,
    height: u32,
    sh_degree: u32,
    threads: usize,
    counts: Counts,
    stages: BTreeMap<&'static str, Figure>,
    step: Figure,
    /// Blended pairs per second of blending and its replay.
    pairs_per_second: f64,
    /// Blended pairs per evaluated lane.
    lane_occupancy: f64,
    /// Live groups at the floor's cost per pair, spread over the threads.
    pairs_floor: f64,
    /// The same if no lane were idle: blended pairs at the floor's cost.
    blended_pairs_floor: f64,
    /// Adam at the floor, spread over the threads.
    adam_floor: f64,
    /// `pairs_floor` by the time of blending and its replay.
    raster_share_of_floor: f64,
    /// `pairs_floor + adam_floor` by the time of the whole step.
    step_share_of_floor: f64,
    opensplat_step: Option<f64>,
    brush_step: Option<f64>,
}

/// [`PairCounts`] with the names of JSON.
#[derive(Debug, Serialize)]
struct Counts {
    footprints: u64,
    band_entries: u64,
    spans: u64,
    span_pairs: u64,
    groups: u64,
    live_groups: u64,
    blended_pairs: u64,
}

impl From<PairCounts> for Counts {
    fn from(counts: PairCounts) -> Self {
        let PairCounts { footprints, entries, spans, span_pairs, groups, live_groups, blended_pairs } =
            counts;
        Self { footprints, band_entries: entries, spans, span_pairs, groups, live_groups, blended_pairs }
    }
}

impl Report {
    /// Puts the rows against the floor.
    pub(crate) fn new(machine: MachineLine, best: Machine, floor: &Floor, rows: &[Row]) -> Self {
        let floor = FloorReport {
            instruction_set: best.name(),
            forward_ns_per_pair: Figure::of(&floor.forward),
            backward_ns_per_pair: Figure::of(&floor.backward),
        };
        let per_pair = floor.forward_ns_per_pair.median + floor.backward_ns_per_pair.median;
        Self { machine, rows: rows.iter().map(|row| row_report(row, per_pair)).collect(), floor }
    }

    /// One line per row.
    pub(crate) fn table(&self, verbose: bool) -> String {
        let has_peers = self.rows.iter().any(|row| row.opensplat_step.is_some() || row.brush_step.is_some());
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        let mut header = vec!["N", "image", "SH", "thr"];
        header.extend(STAGES.map(|(name, _)| name));
        header.extend(["step", "Mpairs/s", "lanes", "floor", "raster", "step at"]);
        if has_peers {
            header.extend(["OpenSplat", "x", "Brush", "x"]);
        }
        table.set_header(header);
        for row in &self.rows {
            table.add_row(row.cells(verbose, has_peers));
        }
        for column in table.column_iter_mut() {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!("{}\n\n{table}\n\n{}", self.head(), self.legend(has_peers))
    }

    fn head(&self) -> String {
        let FloorReport { instruction_set, forward_ns_per_pair, backward_ns_per_pair } = &self.floor;
        format!(
            "{}\nfloor per pair ({instruction_set}, one core): forward {} ns, backward {} ns",
            self.machine,
            forward_ns_per_pair.show(true),
            backward_ns_per_pair.show(true)
        )
    }

    fn legend(&self, has_peers: bool) -> String {
        let mut lines = vec![
            "Milliseconds, medians (in brackets: fastest). step: one step of a session, timed apart from the stages.",
            "Mpairs/s: blended pairs by the time of blend + blend_backward. lanes: blended pairs per evaluated lane.",
            "floor: live groups at the floor's cost per pair, plus Adam's memory traffic, over the threads.",
            "raster: share of the floor that blend + blend_backward reach; step at: that of the whole step.",
        ];
        if has_peers {
            lines.push(peers::MEASURED_ON);
        }
        lines.join("\n")
    }
}

fn row_report(row: &Row, floor_per_pair: f64) -> RowReport {
    let mut stages = BTreeMap::new();
    for ((name, _), times) in STAGES.iter().zip(&row.stages) {
        stages.insert(*name, Figure::of(times));
    }
    let step = Figure::of(&row.step);
    let raster = stages["blend"].median + stages["blend_backward"].median;
    let at_floor = |pairs: u64| pairs as f64 * floor_per_pair * 1e-6 / row.threads as f64;
    let pairs_floor = at_floor(row.counts.live_groups * PairCounts::lanes_per_group());
    let adam_floor = Figure::of(&row.adam_floor).median / row.threads as f64;
    let (opensplat_step, brush_step) = match row.file {
        Some(_) => peers::steps(row.size, row.threads),
        None => (None, None),
    };
    RowReport {
        scene: row.file.clone().unwrap_or_else(|| "generated".into()),
        gaussians: row.size.gaussians,
        width: row.size.width,
        height: row.size.height,
        sh_degree: row.size.sh_degree,
        threads: row.threads,
        counts: row.counts.into(),
        stages,
        step,
        pairs_per_second: row.counts.blended_pairs as f64 / (raster * 1e-3),
        lane_occupancy: row.counts.lane_occupancy(),
        pairs_floor,
        blended_pairs_floor: at_floor(row.counts.blended_pairs),
        adam_floor,
        raster_share_of_floor: pairs_floor / raster,
        step_share_of_floor: (pairs_floor + adam_floor) / step.median,
        opensplat_step,
        brush_step,
    }
}

impl RowReport {
    fn cells(&self, verbose: bool, has_peers: bool) -> Vec<String> {
        let mut cells = vec![
            self.gaussians.to_string(),
            format!("{}x{}", self.width, self.height),
            self.sh_degree.to_string(),
            self.threads.to_string(),
        ];
        cells.extend(STAGES.map(|(name, _)| self.stages[name].show(verbose)));
        cells.extend([
            self.step.show(verbose),
            format!("{:.0}", self.pairs_per_second * 1e-6),
            format!("{:.0}%", 100.0 * self.lane_occupancy),
            format!("{:.2}", self.pairs_floor + self.adam_floor),
            format!("{:.0}%", 100.0 * self.raster_share_of_floor),
            format!("{:.0}%", 100.0 * self.step_share_of_floor),
        ]);
        if has_peers {
            for peer in [self.opensplat_step, self.brush_step] {
                cells.push(peer.map_or("-".into(), |time| format!("{time:.0}")));
                cells.push(peer.map_or("-".into(), |time| format!("{:.1}", time / self.step.median)));
            }
        }
        cells
    }
}
