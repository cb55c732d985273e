//! The table of sightings.

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::{
    machine::MachineLine,
    sightings::{Judged, Record, WAYS},
};

/// Errors from which a sighting is called wrong, pixels.
const WRONG: [f64; 3] = [1.0, 2.0, 4.0];
/// Errors from which it is, standard deviations.
const BEYOND_CLAIM: f64 = 3.0;
/// Error up to which a sighting is called right, pixels.
const RIGHT: f64 = 1.0;
/// Error of a place from which it is called wrong, pixels.
const WRONG_PLACE: f64 = 2.0;
/// Least and largest number of views of a line.
const VIEWS: [(usize, usize); 5] = [(1, usize::MAX), (1, 1), (2, 2), (3, 3), (4, usize::MAX)];

/// Everything that a run found out about sightings.
#[derive(Debug, Serialize)]
pub(crate) struct SightingsReport {
    pub(crate) machine: MachineLine,
    pub(crate) frames: Vec<u32>,
    pub(crate) lines: Vec<Line>,
}

/// Sightings that are wrong by one measure.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Wrong {
    /// Of all sightings.
    pub(crate) share: Option<f64>,
    /// The share of them that the lift leaves out.
    pub(crate) left_out: Option<f64>,
}

/// Errors of one way to a position, pixels.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Places {
    pub(crate) way: &'static str,
    pub(crate) mean: f64,
    pub(crate) ninth_decile: f64,
    /// Share off by more than two pixels.
    pub(crate) wrong: f64,
}

/// Gaussians of one clip that move, or rest, and are seen by so many views.
#[derive(Debug, Serialize)]
pub(crate) struct Line {
    pub(crate) clip: String,
    pub(crate) is_moving: bool,
    /// Least and largest number of views.
    pub(crate) views: (usize, usize),
    /// Over all frames.
    pub(crate) gaussians: usize,
    /// Share of them whose position the lift finds without their neighbours.
    pub(crate) decided: Option<f64>,
    pub(crate) sightings: usize,
    /// Off by more than 1, 2, 4 pixels, and by more than three deviations.
    pub(crate) wrong: Vec<Wrong>,
    /// Share left out of the sightings that are off by at most a pixel.
    pub(crate) false_alarms: Option<f64>,
    /// The same of those of which the lift believes the exact one.
    pub(crate) false_alarms_of_own_surface: Option<f64>,
    /// Gaussians whose places are compared.
    pub(crate) placed: usize,
    pub(crate) places: Vec<Places>,
}

impl Line {
    /// The lines of one clip.
    pub(crate) fn all(clip: &str, records: &[Record]) -> Vec<Self> {
        let of = |is_moving: bool| VIEWS.map(|views| Self::new(clip, records, is_moving, views));
        [of(true), of(false)].into_iter().flatten().collect()
    }

    fn new(clip: &str, records: &[Record], is_moving: bool, views: (usize, usize)) -> Self {
        let is_here = |record: &&Record| {
            record.is_moving == is_moving && (views.0..=views.1).contains(&record.views)
        };
        let records: Vec<&Record> = records.iter().filter(is_here).collect();
        let judged: Vec<&Judged> = records.iter().flat_map(|record| &record.judged).collect();
        let left_out = |of: &[&Judged]| share(of, |judged| !judged.is_believed);
        let wrong = |is_wrong: &dyn Fn(&Judged) -> bool| {
            let wrong: Vec<&Judged> = judged.iter().copied().filter(|judged| is_wrong(judged)).collect();
            Wrong { share: share(&judged, |judged| is_wrong(judged)), left_out: left_out(&wrong) }
        };
        let mut all_wrong: Vec<Wrong> = WRONG.iter().map(|&px| wrong(&|judged| judged.error > px)).collect();
        all_wrong.push(wrong(&|judged| judged.error > BEYOND_CLAIM * judged.deviation));
        let right: Vec<&Judged> = judged.iter().copied().filter(|judged| judged.error <= RIGHT).collect();
        let own: Vec<&Judged> = right.iter().copied().filter(|judged| judged.is_own_surface).collect();
        let errors: Vec<_> = records.iter().filter_map(|record| record.errors).collect();
        let alone: Vec<_> = errors.iter().filter(|errors| errors[..3].iter().all(Option::is_some)).collect();
        let places = WAYS.iter().enumerate().filter_map(|(way, name)| {
            let found: Vec<f64> = if way < 3 { alone.iter().filter_map(|errors| errors[way]).collect() } else { errors.iter().filter_map(|errors| errors[way]).collect() };
            places(name, found)
        });
        let missed: Vec<&Judged> = judged.iter().copied().filter(|j| j.error > 2.0 && j.error > 3.0 * j.deviation && j.is_believed).collect();
        let confident = judged.iter().filter(|j| j.error > 2.0 && j.error > 3.0 * j.deviation).count();
        let pct = |n: usize| 100.0 * n as f64 / missed.len().max(1) as f64;
        let count = |f: &dyn Fn(&Judged) -> bool| missed.iter().filter(|j| f(j)).count();
        eprintln!("{clip} {is_moving} {views:?}: confidently wrong {confident} of {}, missed {} ; of missed: other surface {:.1} %, own surface and place wrong {:.1} %, own surface and place right {:.1} %",
            judged.len(), missed.len(), pct(count(&|j| !j.is_own_surface)),
            pct(count(&|j| j.is_own_surface && j.place_error.is_none_or(|e| e > 2.0))), pct(count(&|j| j.is_own_surface && j.place_error.is_some_and(|e| e <= 2.0))));
        Self {
            clip: clip.to_owned(),
            is_moving,
            views,
            gaussians: records.len(),
            decided: share(&records, |record| record.is_decided),
            sightings: judged.len(),
            wrong: all_wrong,
            false_alarms: left_out(&right),
            false_alarms_of_own_surface: left_out(&own),
            placed: errors.len(),
            places: places.collect(),
        }
    }

    fn name(&self) -> [String; 3] {
        let views = match self.views {
            (1, usize::MAX) => "all".to_owned(),
            (least, usize::MAX) => format!("{least}+"),
            (least, _) => least.to_string(),
        };
        [self.clip.clone(), if self.is_moving { "move" } else { "rest" }.to_owned(), views]
    }
}

fn share<T>(of: &[&T], is: impl Fn(&T) -> bool) -> Option<f64> {
    let count = of.iter().filter(|one| is(one)).count();
    (!of.is_empty()).then(|| count as f64 / of.len() as f64)
}

fn places(way: &'static str, mut errors: Vec<f64>) -> Option<Places> {
    errors.sort_by(f64::total_cmp);
    let count = errors.len() as f64;
    Some(Places {
        way,
        mean: errors.iter().sum::<f64>() / count,
        ninth_decile: *errors.get(errors.len() * 9 / 10)?,
        wrong: errors.iter().filter(|&&error| error > WRONG_PLACE).count() as f64 / count,
    })
}

impl SightingsReport {
    /// Two tables: of sightings, of places.
    pub(crate) fn tables(&self) -> String {
        let percent = |share: Option<f64>| share.map_or("-".into(), |share| format!("{:.2} %", 100.0 * share));
        let names = ["clip", "Gaussians that", "views"];
        let sightings = [
            "number", "decided", "sightings", "> 1 px", "left out", "> 2 px", "left out", "> 4 px", "left out", "> 3 σ",
            "left out", "right, left out", "of own surface",
        ];
        let of_sightings = self.lines.iter().map(|line| {
            let mut row =
                vec![line.gaussians.to_string(), percent(line.decided), line.sightings.to_string()];
            for wrong in &line.wrong {
                row.extend([percent(wrong.share), percent(wrong.left_out)]);
            }
            row.extend([percent(line.false_alarms), percent(line.false_alarms_of_own_surface)]);
            (line, row)
        });
        let mut header = vec!["placed".to_owned()];
        for way in WAYS {
            header.extend([format!("{way}: mean px"), "90 %".into(), "> 2 px".into()]);
        }
        let of_places = self.lines.iter().map(|line| {
            let mut row = vec![line.placed.to_string()];
            for places in &line.places {
                row.extend([format!("{:.3}", places.mean), format!("{:.3}", places.ninth_decile)]);
                row.push(percent(Some(places.wrong)));
            }
            (line, row)
        });
        format!(
            "{}\nFrames {:?}. Sightings by own tracks against those by exact ones; left out by the lift.\n\n{}\n\nPlaces, \
             projected to the views.\n\n{}",
            self.machine,
            self.frames,
            table(&names, &sightings.map(String::from), of_sightings),
            table(&names, &header, of_places),
        )
    }
}

fn table<'a>(
    names: &[&str],
    header: &[String],
    rows: impl Iterator<Item = (&'a Line, Vec<String>)>,
) -> Table {
    let mut table = Table::new();
    table.load_style(ASCII_MARKDOWN);
    table.set_header(names.iter().copied().map(String::from).chain(header.iter().cloned()));
    for (line, mut row) in rows {
        row.resize(header.len(), "-".into());
        table.add_row(line.name().into_iter().chain(row));
    }
    for column in table.column_iter_mut().skip(names.len()) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
