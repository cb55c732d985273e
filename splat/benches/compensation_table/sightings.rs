//! How often a view's tracks mislead it about a Gaussian, and what the lift, which sees all views, makes of it.

use std::sync::Arc;

use anyhow::Result;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use splat::{
    cameras::Camera,
    clip::Split,
    formats::track_npz,
    gaussians::Gaussians,
    motion::{
        self, MotionField, MotionOrigin, MotionView,
        sightings::{Seen, Sightings, Verdict},
    },
    raster::CpuEngine,
    settings::Settings,
};

use super::{Tracks, clip::ClipInput};

/// A sighting off by more than this is what the oracle drops, pixels.
const WRONG: f64 = 2.0;
/// Mean displacement in the views from which a Gaussian moves, pixels.
const MOVING: f64 = 1.0;
/// Views that must agree on the exact place of a Gaussian for it to be known.
const SURE: usize = 3;
/// Most Gauss-Newton steps of the plain fit.
const STEPS: usize = 20;

/// Ways to a position from a Gaussian's own views.
pub(crate) const ALONE: [&str; 3] = ["least squares", "lift", "lift, oracle"];
/// Ways to a position by the whole of compensation.
pub(crate) const WHOLE: [&str; 2] = ["whole", "whole, oracle"];

/// One view's sighting by own tracks, of a Gaussian whose place is known from exact ones.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Judged {
    /// Distance from the place, projected, pixels.
    pub(crate) error: f64,
    /// What it claims to err by, standard deviation per axis, pixels.
    pub(crate) deviation: f64,
    pub(crate) is_believed: bool,
    /// Whether most of the Gaussian's sightings are right, so that a vote of the views can tell.
    pub(crate) are_most_right: bool,
    /// Whether the sighting by exact tracks is wrong too: its footprint shows another surface.
    pub(crate) is_of_other_surface: bool,
    /// Whether the place that the lift finds is wrong in this view.
    pub(crate) is_misplaced: bool,
}

/// One Gaussian at one frame whose place is known.
#[derive(Clone, Debug)]
pub(crate) struct Record {
    pub(crate) is_moving: bool,
    /// Views that see it, by own tracks.
    pub(crate) views: usize,
    /// What these see.
    pub(crate) judged: Vec<Judged>,
    /// Whether the lift found a position without help of neighbours.
    pub(crate) is_decided: bool,
    /// Mean distance of the position, projected to the views, from the place, pixels, by [`ALONE`]; absent where one of the
    /// ways needs the neighbours.
    pub(crate) alone: Option<[f64; ALONE.len()]>,
    /// The same by [`WHOLE`].
    pub(crate) whole: Option<[f64; WHOLE.len()]>,
}

/// One frame.
pub(crate) struct Frame {
    /// Every Gaussian that some view sees by own tracks, and whose place is known.
    pub(crate) records: Vec<Record>,
    /// PSNR of the moving region before refinement by [`WHOLE`], dB.
    pub(crate) psnr: Option<[f64; WHOLE.len()]>,
}

impl ClipInput {
    /// What the views see at frame number `frame`.
    pub(crate) fn sightings(&self, frame: u32, settings: &Settings) -> Result<Frame> {
        let index = frame as usize - 1;
        let engine = CpuEngine::default();
        let scene = &self.static_model;
        let least = settings.motion.least_track_sigma;
        let (mut own_views, mut exact_views) =
            (self.motion_views(Tracks::Own, index)?, self.whole_exact_views(index)?);
        for view in own_views.iter_mut().chain(&mut exact_views) {
            view.tracks = Arc::new(motion::no_surer_than(&view.tracks, least));
        }
        let own = Sightings::gather(&engine, scene, &own_views, &settings.motion)?;
        let exact = Sightings::gather(&engine, scene, &exact_views, &settings.motion)?;
        let cameras = own_views.iter().map(|view| &view.camera).collect();
        let trial = Trial { scene, own, exact, cameras };

        let with_all = trial.own.field(|_, _| true)?;
        let places: Vec<Option<DVec3>> =
            (0..scene.len()).into_par_iter().map(|gaussian| trial.place(gaussian)).collect();
        let with_right =
            trial.own.field(|gaussian, view| trial.is_right(gaussian, view, places[gaussian]))?;
        let psnr = |field: &MotionField| -> Result<Option<f64>> {
            let moved = motion::apply(scene, field);
            Ok(self.quality(&engine, &moved, index, 0, settings)?.moving_psnr)
        };
        Ok(Frame {
            psnr: psnr(&with_all)?.zip(psnr(&with_right)?).map(<[f64; 2]>::from),
            records: (0..scene.len())
                .into_par_iter()
                .filter_map(|gaussian| {
                    let moved = [&with_all, &with_right].map(|field| field.translation[gaussian]);
                    trial.record(gaussian, places[gaussian]?, moved)
                })
                .collect(),
        })
    }

    /// Exact tracks that are known where they are hidden too: what a sighting is held against is where the surface goes.
    fn whole_exact_views(&self, frame: usize) -> Result<Vec<MotionView>> {
        let mut views = self.motion_views(Tracks::Exact, frame)?;
        for (view, index) in views.iter_mut().zip(self.views(Split::Train)) {
            let tracks = Arc::make_mut(&mut view.tracks);
            let file = self.clip.exact_flow_path(index);
            tracks.visible = track_npz::read_exact_validity(&file, tracks.width, tracks.height)?;
        }
        Ok(views)
    }
}

struct Trial<'a> {
    scene: &'a Gaussians,
    own: Sightings<'a>,
    exact: Sightings<'a>,
    cameras: Vec<&'a Camera>,
}

impl Trial<'_> {
    /// Where exact tracks take a Gaussian, if enough views agree.
    fn place(&self, gaussian: usize) -> Option<DVec3> {
        let verdict = self.exact.verdict(gaussian, |_| true)?;
        let is_sure = is_decided(&verdict) && verdict.believed.len() >= SURE;
        is_sure.then_some(self.scene.mean(gaussian) + verdict.translation)
    }

    /// How far a view's sighting of a Gaussian is from its place, pixels.
    fn error(&self, seen: &Seen, place: DVec3) -> Option<f64> {
        Some(self.cameras[seen.view].project_world(place)?.distance(seen.pixel))
    }

    /// What the oracle keeps: of what is not known, everything.
    fn is_right(&self, gaussian: usize, view: usize, place: Option<DVec3>) -> bool {
        let Some(place) = place else { return true };
        let seen = self.own.of(gaussian).find(|seen| seen.view == view);
        seen.and_then(|seen| self.error(&seen, place)).is_some_and(|error| error <= WRONG)
    }

    /// `None` where no view sees the Gaussian. `moved` are its motions by the whole of compensation, without and with the oracle.
    fn record(&self, gaussian: usize, place: DVec3, moved: [DVec3; 2]) -> Option<Record> {
        let mean = self.scene.mean(gaussian);
        let seen: Vec<Seen> = self.own.of(gaussian).collect();
        if seen.is_empty() {
            return None;
        }
        let own = self.own.verdict(gaussian, |_| true);
        let decided = own.as_ref().filter(|verdict| is_decided(verdict));
        let error = |found: DVec3| distance(found, place, &seen, &self.cameras);
        let alone = || {
            let oracle = self.own.verdict(gaussian, |view| self.is_right(gaussian, view, Some(place)));
            let oracle = oracle.filter(is_decided)?;
            let plain = least_squares(mean, &seen, &self.cameras);
            Some([error(plain)?, error(mean + decided?.translation)?, error(mean + oracle.translation)?])
        };
        Some(Record {
            is_moving: error(mean)? > MOVING,
            views: seen.len(),
            judged: self.judged(gaussian, &seen, own.as_ref(), place),
            is_decided: decided.is_some(),
            alone: alone(),
            whole: error(mean + moved[0]).zip(error(mean + moved[1])).map(<[f64; 2]>::from),
        })
    }

    fn judged(&self, gaussian: usize, seen: &[Seen], own: Option<&Verdict>, place: DVec3) -> Vec<Judged> {
        let exact_seen: Vec<Seen> = self.exact.of(gaussian).collect();
        let errors: Vec<Option<f64>> = seen.iter().map(|seen| self.error(seen, place)).collect();
        let right = errors.iter().flatten().filter(|&&error| error <= WRONG).count();
        let are_most_right = 2 * right > seen.len();
        let found = own.map(|own| self.scene.mean(gaussian) + own.translation);
        let judge = |(seen, error): (&Seen, &Option<f64>)| {
            let exactly = exact_seen.iter().find(|exact| exact.view == seen.view);
            let in_view = |place: DVec3| self.cameras[seen.view].project_world(place);
            let misplaced = found.and_then(in_view).zip(in_view(place)).map(|(a, b)| a.distance(b));
            Some(Judged {
                error: (*error)?,
                deviation: seen.deviation,
                is_believed: own.is_some_and(|own| own.believed.contains(&seen.view)),
                are_most_right,
                is_of_other_surface: exactly.and_then(|exact| self.error(exact, place)) > Some(WRONG),
                is_misplaced: misplaced > Some(WRONG),
            })
        };
        seen.iter().zip(&errors).filter_map(judge).collect()
    }
}

fn is_decided(verdict: &Verdict) -> bool {
    verdict.origin != MotionOrigin::Unsolved
}

/// Mean distance of two places in the views that see the Gaussian, pixels.
fn distance(place: DVec3, truth: DVec3, seen: &[Seen], cameras: &[&Camera]) -> Option<f64> {
    let in_view = |seen: &Seen| {
        let camera = cameras[seen.view];
        Some(camera.project_world(place)?.distance(camera.project_world(truth)?))
    };
    let distances: Vec<f64> = seen.iter().filter_map(in_view).collect();
    (!distances.is_empty()).then(|| distances.iter().sum::<f64>() / distances.len() as f64)
}

/// The place that all sightings together are closest to, each by its claim: what a lift that trusts every view finds. The
/// prior of the lift decides what no view sees.
fn least_squares(mean: DVec3, seen: &[Seen], cameras: &[&Camera]) -> DVec3 {
    let depth = seen.iter().map(|seen| cameras[seen.view].to_camera(mean).z).fold(0.0, f64::max);
    let ridge = DMat3::from_diagonal(DVec3::splat(1e-2 / depth.powi(2)));
    let cost = |place: DVec3| -> f64 {
        let square = |seen: &Seen| {
            let residual = cameras[seen.view].project_world(place).map(|at| seen.pixel - at);
            residual.map_or(f64::INFINITY, |r| r.length_squared() / seen.deviation.powi(2))
        };
        seen.iter().map(square).sum()
    };
    let mut place = mean;
    for _ in 0..STEPS {
        let (mut normal, mut gradient) = (ridge, DVec3::ZERO);
        for seen in seen {
            let camera = cameras[seen.view];
            let Some(at) = camera.project_world(place) else { return place };
            let (residual, weight) = (seen.pixel - at, seen.deviation.powi(-2));
            let [u, v] = camera.world_jacobian(camera.to_camera(place));
            normal += (outer(u) + outer(v)) * weight;
            gradient += (u * residual.x + v * residual.y) * weight;
        }
        let step = normal.inverse() * gradient;
        let before = cost(place);
        let shorter = (0..6).map(|halvings| place + step * 0.5f64.powi(halvings));
        let Some(better) = shorter.into_iter().find(|&candidate| cost(candidate) < before) else { break };
        place = better;
    }
    place
}

fn outer(a: DVec3) -> DMat3 {
    DMat3::from_cols(a * a.x, a * a.y, a * a.z)
}
