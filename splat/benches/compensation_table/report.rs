//! The table, and what it was meant to show.

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::{
    machine::MachineLine,
    measure::{Method, Run},
};

/// Everything that a run found out.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    pub(crate) machine: MachineLine,
    pub(crate) frames: Vec<u32>,
    pub(crate) iterations: Vec<u32>,
    pub(crate) runs: Vec<Run>,
}

/// Runs of one clip, method and source of tracks: one line of the table.
type Line<'a> = Vec<&'a Run>;

impl Report {
    /// One line per clip, source of tracks and method: means over the frames.
    pub(crate) fn table(&self) -> String {
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        let mut header =
            ["clip", "tracks", "start", "solved", "propagated", "static"].map(String::from).to_vec();
        header.extend(self.iterations.iter().map(u32::to_string));
        table.set_header(header);
        for line in self.lines() {
            table.add_row(self.row(&line));
        }
        for column in table.column_iter_mut().skip(3) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!(
            "{}\nPSNR of the moving region in held-out views, dB, mean over frames {:?}, after so many steps of \
             refinement.\n\n{table}\n\n{}",
            self.machine,
            self.frames,
            self.comparisons().join("\n")
        )
    }

    fn lines(&self) -> Vec<Line<'_>> {
        let mut lines: Vec<Line<'_>> = Vec::new();
        for run in &self.runs {
            let key = |run: &Run| (run.clip.clone(), run.tracks, run.method);
            match lines.iter_mut().find(|line| key(line[0]) == key(run)) {
                Some(line) => line.push(run),
                None => lines.push(vec![run]),
            }
        }
        lines
    }

    fn row(&self, line: &Line<'_>) -> Vec<String> {
        let tracks = line[0].tracks.map_or("-", |tracks| tracks.name());
        let mut cells = [line[0].clip.as_str(), tracks, line[0].method.name()].map(String::from).to_vec();
        for origin in 0..3 {
            let share = line.iter().map(|run| run.origins[origin]).sum::<f64>() / line.len() as f64;
            let is_none = line[0].method == Method::None;
            cells.push(if is_none { "-".into() } else { format!("{:.0} %", 100.0 * share) });
        }
        let psnr =
            |&iterations| moving_psnr(line, iterations).map_or("-".into(), |psnr| format!("{psnr:.2}"));
        cells.extend(self.iterations.iter().map(psnr));
        cells
    }

    /// Robust against the others, where both were measured.
    fn comparisons(&self) -> Vec<String> {
        let lines = self.lines();
        let mut said = Vec::new();
        for robust in lines.iter().filter(|line| line[0].method == Method::Robust) {
            let Run { clip, tracks, .. } = robust[0];
            let other = |method: Method| {
                let is_it = |line: &&Line<'_>| {
                    let same_tracks = method == Method::None || line[0].tracks == *tracks;
                    line[0].clip == *clip && line[0].method == method && same_tracks
                };
                lines.iter().find(is_it)
            };
            let mut compare = |what: &str, method: Method, own: u32, others: u32| {
                let theirs = other(method).and_then(|line| moving_psnr(line, others));
                if let (Some(ours), Some(theirs)) = (moving_psnr(robust, own), theirs) {
                    let tracks = tracks.map_or("-", |tracks| tracks.name());
                    said.push(format!("{clip}, {tracks} tracks: {what}: {:+.2} dB", ours - theirs));
                }
            };
            compare("robust over reference before refinement", Method::Reference, 0, 0);
            compare("robust after 100 over none after 1000", Method::None, 100, 1000);
        }
        said
    }
}

/// Mean over the frames in which something moves.
fn moving_psnr(line: &Line<'_>, iterations: u32) -> Option<f64> {
    let all = line.iter().flat_map(|run| &run.quality).filter(|quality| quality.iterations == iterations);
    let values: Vec<f64> = all.filter_map(|quality| quality.moving_psnr).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}
