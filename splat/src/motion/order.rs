//! How much of a footprint's motion its tracks support: the order of the 2D model, from one set of moments.

use glam::DMat2;
use serde::{Deserialize, Serialize};

use super::{
    MotionSettings,
    moments::{Displacements, trace},
};

/// What a parameter must explain, in squared standard deviations (Akaike's criterion).
///
/// Of the criteria in `docs/motion.md` the one that finds the order of simulated motions most often and predicts them
/// best; heavier penalties lose strains that a footprint shows.
const PENALTY: f64 = 2.0;

/// The order of a footprint's motion model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Order {
    /// It does not move; no parameters.
    Static,
    /// Two parameters.
    Translation,
    /// Four: it also turns and grows.
    Similarity,
    /// Six.
    Affine,
}

/// How many footprints, over all Gaussians and views that see them, got which model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct OrderCounts {
    /// No motion beyond the track noise.
    pub r#static: usize,
    /// A translation, two parameters.
    pub translation: usize,
    /// A similarity, four parameters.
    pub similarity: usize,
    /// An affine map, six parameters.
    pub affine: usize,
}

impl OrderCounts {
    pub(super) fn of(orders: impl Iterator<Item = Order>) -> Self {
        let mut counts = Self::default();
        for order in orders {
            *match order {
                Order::Static => &mut counts.r#static,
                Order::Translation => &mut counts.translation,
                Order::Similarity => &mut counts.similarity,
                Order::Affine => &mut counts.affine,
            } += 1;
        }
        counts
    }
}

/// The gradients of displacement of the moving orders, and the power that each leaves, px² over both axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidates {
    similarity: DMat2,
    affine: DMat2,
    residual_power: [f64; 3],
}

impl Candidates {
    /// Least squares, regularised by `ridge` px² on the footprint's covariance.
    pub(super) fn new(displacements: &Displacements, ridge: f64) -> Self {
        let Displacements { source, strain, power, .. } = *displacements;
        let regularised = source + DMat2::from_diagonal(glam::DVec2::splat(ridge));
        let extent = trace(regularised).max(f64::MIN_POSITIVE);
        let (growth, turn) = (trace(strain) / extent, (strain.x_axis.y - strain.y_axis.x) / extent);
        let similarity = DMat2::from_cols_array(&[growth, turn, -turn, growth]);
        let affine = strain * regularised.inverse();
        // `|a − G d|²` averaged: whatever `G`, regularised or not.
        let left = |gradient: DMat2| {
            let explained = 2.0 * trace(gradient * strain.transpose());
            let model = trace(gradient * source * gradient.transpose());
            (power - explained + model).max(0.0)
        };
        Self { similarity, affine, residual_power: [power, left(similarity), left(affine)] }
    }

    /// Power that the affine model leaves, px² over both axes.
    pub(super) fn affine_residual_power(&self) -> f64 {
        self.residual_power[2]
    }

    /// Power that a model leaves beside the mean displacement, px² over both axes.
    pub(super) fn residual_power(&self, order: Order) -> f64 {
        match order {
            Order::Static | Order::Translation => self.residual_power[0],
            Order::Similarity => self.residual_power[1],
            Order::Affine => self.residual_power[2],
        }
    }

    /// Derivative of the displacement by the pixel.
    pub(super) fn gradient(&self, order: Order) -> DMat2 {
        match order {
            Order::Static | Order::Translation => DMat2::ZERO,
            Order::Similarity => self.similarity,
            Order::Affine => self.affine,
        }
    }

    /// The moving order with the least `independent pixels · residual power / noise + 2 · parameters`; `noise` is the
    /// variance per axis.
    pub(super) fn select(&self, noise: f64, independent_pixels: f64) -> Order {
        let orders = [(Order::Translation, 2.0), (Order::Similarity, 4.0), (Order::Affine, 6.0)];
        let cost = |&(order, parameters): &(Order, f64)| {
            independent_pixels * self.residual_power(order) / noise.max(f64::MIN_POSITIVE)
                + PENALTY * parameters
        };
        // Of equals the first, which has fewer parameters.
        orders
            .into_iter()
            .min_by(|a, b| cost(a).total_cmp(&cost(b)))
            .map_or(Order::Translation, |best| best.0)
    }

    /// Whether the footprint does not change its shape beyond `noise`, the variance per axis.
    pub(super) fn is_rigid(&self, noise: f64, independent_pixels: f64, settings: &MotionSettings) -> bool {
        let explained = self.residual_power[0] - self.residual_power[2];
        // Four parameters instead of the two of a displacement, hence twice the square: at a significance of 3 noise
        // alone exceeds it in 0.1 % of footprints, that of the displacement in 1 %.
        let by_noise = 2.0 * settings.static_significance.powi(2) * noise / independent_pixels;
        explained <= by_noise.max(settings.static_floor.powi(2))
    }
}
