//! Motion compensation against dense least squares in double precision, and what noise propagation predicts.

pub(crate) mod footprints;
mod judge;
pub(crate) mod lift;
mod prescribed;
mod reference;
mod scene;
mod wall;
