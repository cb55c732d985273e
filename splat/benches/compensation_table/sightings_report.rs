//! The tables of sightings.

use comfy_table::{CellAlignment, Table, presets::ASCII_MARKDOWN};
use serde::Serialize;

use super::{
    machine::MachineLine,
    sightings::{ALONE, Judged, Record, WHOLE},
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
    /// PSNR of the moving region before refinement, mean over the frames, dB, by the whole of compensation without and with the
    /// oracle; by clip.
    pub(crate) psnr: Vec<(String, [f64; WHOLE.len()])>,
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

/// Sightings that the lift believes although they are off by more than two pixels and three deviations.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Missed {
    /// Of all sightings.
    pub(crate) share: Option<f64>,
    /// Share of those missed that are wrong by exact tracks too: their footprint shows another surface.
    pub(crate) other_surface: Option<f64>,
    /// Share of those missed in whose view the lift's place is wrong.
    pub(crate) wrong_place: Option<f64>,
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
    /// Off by more than two pixels and three deviations, while most of the Gaussian's sightings are right.
    pub(crate) outvoted: Wrong,
    /// Share left out of the sightings that are off by at most a pixel.
    pub(crate) false_alarms: Option<f64>,
    pub(crate) missed: Missed,
    /// Gaussians that all ways of the views alone place.
    pub(crate) placed_alone: usize,
    /// Gaussians whose exact place is known.
    pub(crate) placed: usize,
    pub(crate) alone: Vec<Option<Places>>,
    pub(crate) whole: Vec<Option<Places>>,
}

impl Line {
    /// The lines of one clip.
    pub(crate) fn all(clip: &str, records: &[Record]) -> Vec<Self> {
        let of = |is_moving: bool| VIEWS.map(|views| Self::new(clip, records, is_moving, views));
        [of(true), of(false)].into_iter().flatten().collect()
    }

    fn new(clip: &str, records: &[Record], is_moving: bool, views: (usize, usize)) -> Self {
        let is_here =
            |record: &&Record| record.is_moving == is_moving && (views.0..=views.1).contains(&record.views);
        let records: Vec<&Record> = records.iter().filter(is_here).collect();
        let judged: Vec<&Judged> = records.iter().flat_map(|record| &record.judged).collect();
        let that = |is: &dyn Fn(&Judged) -> bool| -> Vec<&Judged> {
            judged.iter().copied().filter(|judged| is(judged)).collect()
        };
        let left_out = |of: &[&Judged]| share(of, |judged| !judged.is_believed);
        let wrong = |is_wrong: &dyn Fn(&Judged) -> bool| Wrong {
            share: share(&judged, |judged| is_wrong(judged)),
            left_out: left_out(&that(is_wrong)),
        };
        let is_beyond_claim = |judged: &Judged| judged.error > BEYOND_CLAIM * judged.deviation;
        let mut all_wrong: Vec<Wrong> = WRONG.iter().map(|&px| wrong(&|judged| judged.error > px)).collect();
        all_wrong.push(wrong(&is_beyond_claim));
        let is_surely_wrong = |judged: &Judged| judged.error > WRONG_PLACE && is_beyond_claim(judged);
        let is_missed = |judged: &Judged| judged.is_believed && is_surely_wrong(judged);
        let missed = that(&is_missed);
        let alone: Vec<_> = records.iter().filter_map(|record| record.alone).collect();
        let whole: Vec<_> = records.iter().filter_map(|record| record.whole).collect();
        Self {
            clip: clip.to_owned(),
            is_moving,
            views,
            gaussians: records.len(),
            decided: share(&records, |record| record.is_decided),
            sightings: judged.len(),
            wrong: all_wrong,
            outvoted: wrong(&|judged| is_surely_wrong(judged) && judged.are_most_right),
            false_alarms: left_out(&that(&|judged| judged.error <= RIGHT)),
            missed: Missed {
                share: share(&judged, |judged| is_missed(judged)),
                other_surface: share(&missed, |judged| judged.is_of_other_surface),
                wrong_place: share(&missed, |judged| judged.is_misplaced),
            },
            placed_alone: alone.len(),
            placed: whole.len(),
            alone: by_way(ALONE, &alone),
            whole: by_way(WHOLE, &whole),
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

    fn sightings_row(&self) -> Vec<String> {
        let mut row = vec![self.gaussians.to_string(), percent(self.decided), self.sightings.to_string()];
        let wrong = self.wrong.iter().chain([&self.outvoted]);
        row.extend(wrong.flat_map(|wrong| [wrong.share, wrong.left_out]).map(percent));
        let Missed { share, other_surface, wrong_place } = self.missed;
        row.extend([self.false_alarms, share, other_surface, wrong_place].map(percent));
        row
    }

    fn places_row(&self) -> Vec<String> {
        let cells = |places: &Option<Places>| {
            let pixels = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.3}"));
            let [mean, ninth] = [places.map(|p| p.mean), places.map(|p| p.ninth_decile)].map(pixels);
            [mean, ninth, percent(places.map(|p| p.wrong))]
        };
        let mut row = vec![self.placed_alone.to_string()];
        row.extend(self.alone.iter().flat_map(cells));
        row.push(self.placed.to_string());
        row.extend(self.whole.iter().flat_map(cells));
        row
    }
}

fn share<T>(of: &[&T], is: impl Fn(&T) -> bool) -> Option<f64> {
    let count = of.iter().filter(|one| is(one)).count();
    (!of.is_empty()).then(|| count as f64 / of.len() as f64)
}

fn by_way<const N: usize>(ways: [&'static str; N], errors: &[[f64; N]]) -> Vec<Option<Places>> {
    let of = |(index, way)| places(way, errors.iter().map(|errors| errors[index]).collect());
    ways.into_iter().enumerate().map(of).collect()
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
    /// Two tables, of sightings and of places, and what they come to.
    pub(crate) fn tables(&self) -> String {
        let sightings = [
            "number",
            "decided",
            "sightings",
            "> 1 px",
            "left out",
            "> 2 px",
            "left out",
            "> 4 px",
            "left out",
            "> 3 σ",
            "left out",
            "> 2 px and 3 σ, most right",
            "left out",
            "right, left out",
            "missed",
            "other surface",
            "place wrong",
        ];
        let errors = |way: &str| [format!("{way}: mean px"), "90 %".into(), "> 2 px".into()];
        let mut places = vec!["placed alone".to_owned()];
        places.extend(ALONE.into_iter().flat_map(errors));
        places.push("placed".into());
        places.extend(WHOLE.into_iter().flat_map(errors));
        let psnr = self.psnr.iter().map(|(clip, [own, oracle])| {
            format!("{clip}: PSNR of the moving region before refinement {own:.2} dB, with the oracle {oracle:.2} dB")
        });
        format!(
            "{}\nFrames {:?}. Sightings by own tracks against those by exact ones; left out by the lift.\n\n{}\n\nPlaces, \
             projected to the views, against those that exact tracks lead to.\n\n{}\n\n{}",
            self.machine,
            self.frames,
            self.table(sightings.map(String::from).to_vec(), Line::sightings_row),
            self.table(places, Line::places_row),
            psnr.collect::<Vec<_>>().join("\n"),
        )
    }

    fn table(&self, header: Vec<String>, row: fn(&Line) -> Vec<String>) -> Table {
        let names = ["clip", "Gaussians that", "views"].map(String::from);
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN);
        table.set_header(names.iter().cloned().chain(header));
        for line in &self.lines {
            table.add_row(line.name().into_iter().chain(row(line)));
        }
        for column in table.column_iter_mut().skip(names.len()) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        table
    }
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |share| format!("{:.2} %", 100.0 * share))
}
