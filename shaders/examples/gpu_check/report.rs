//! What was found, for people and as JSON.

use std::fmt;

use serde::Serialize;
use splat_shaders::GpuDevice;

use crate::benchmark::{Refinement, Row};

/// Everything.
#[derive(Serialize)]
pub(crate) struct Report {
    pub version: &'static str,
    pub adapter: Adapter,
    /// Whether the program came to its end; it writes what it has as it goes.
    pub is_complete: bool,
    pub checks: Vec<Check>,
    pub rows: Vec<Row>,
    pub refinement: Option<Refinement>,
}

/// The device.
#[derive(Serialize)]
pub(crate) struct Adapter {
    name: String,
    kind: String,
    backend: String,
    driver: String,
    features: Vec<&'static str>,
    /// Of the kernels that have several forms.
    kernels: &'static str,
    max_binding_bytes: u64,
}

impl Adapter {
    pub(crate) fn new(device: &GpuDevice) -> Self {
        let of = device.description();
        Self {
            name: of.name.clone(),
            kind: format!("{:?}", of.kind).to_lowercase(),
            backend: of.backend.clone(),
            driver: of.driver.clone(),
            features: of.features.clone(),
            kernels: if device.uses_subgroups() { "subgroups" } else { "base" },
            max_binding_bytes: of.max_binding,
        }
    }
}

impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, kind, backend, driver, features, kernels, max_binding_bytes } = self;
        write!(
            f,
            "{name} ({kind}, {backend}, {driver})\nfeatures: {}; kernels: {kernels}\n",
            features.join(", ")
        )?;
        write!(f, "largest binding: {} MiB", max_binding_bytes >> 20)
    }
}

/// One comparison.
#[derive(Serialize)]
pub(crate) struct Check {
    scene: String,
    what: String,
    error: f64,
    limit: f64,
}

impl Check {
    pub(crate) fn new(scene: &str, what: &str, error: f64, limit: f64) -> Self {
        Self { scene: scene.to_owned(), what: what.to_owned(), error, limit }
    }

    /// Not for NaN either.
    pub(crate) fn passed(&self) -> bool {
        self.error < self.limit
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scene, what, error, limit } = self;
        let verdict = if self.passed() { "ok    " } else { "FAILED" };
        write!(f, "{verdict} {scene}: {what} {error:.1e} (limit {limit:.0e})")
    }
}
