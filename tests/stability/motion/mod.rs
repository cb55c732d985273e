//! Motion compensation against dense least squares in double precision, and what noise propagation predicts.

pub(crate) mod footprints;
mod judge;
pub(crate) mod lift;
pub(crate) mod moments;
pub(crate) mod partial;
pub(crate) mod population;
pub(crate) mod poses;
mod prescribed;
mod properties;
mod reference;
pub(crate) mod regularisation;
pub(crate) mod rotation;
mod scene;
mod wall;
