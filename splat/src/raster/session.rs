//! placeholder
use crate::engine::*;
use crate::gaussians::Gaussians;
use crate::optim::LearningRates;
pub(super) struct CpuSession;
impl CpuSession {
    pub(super) fn new(_: SessionInput) -> Result<Self, EngineError> {
        Ok(Self)
    }
}
impl Session for CpuSession {
    fn step(&mut self, _: usize, _: &LearningRates) -> Result<StepReport, EngineError> {
        todo!()
    }
    fn gaussians(&self) -> Result<Gaussians, EngineError> {
        todo!()
    }
    fn take_density_statistics(&mut self) -> Result<DensityStatistics, EngineError> {
        todo!()
    }
    fn replace(&mut self, _: Gaussians, _: &[Option<usize>]) -> Result<(), EngineError> {
        todo!()
    }
}
