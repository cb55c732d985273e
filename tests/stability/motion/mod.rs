//! Motion compensation against dense least squares in double precision, and what noise propagation predicts.

pub(crate) mod footprints;
mod judge;
pub(crate) mod lift;
pub(crate) mod partial;
pub(crate) mod population;
mod prescribed;
#[cfg(test)]
mod properties;
mod reference;
mod scene;
mod wall;
