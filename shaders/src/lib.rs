//! The GPU engine: the stages of `splat::raster`, the loss and the optimiser in WGSL, on any Vulkan, Metal or DirectX 12
//! device.
//!
//! `wgsl/<stage>.wgsl` is the twin of `splat/src/raster/<stage>.rs`; `wgsl/shared` holds what several stages share. `build.rs`
//! composes and validates them. The stages and their contracts are those of the CPU engine, the loops are not: the unit of
//! work is a tile of 16 × 16 pixels.
//!
//! Every sum has a fixed order, so the same input gives the same bytes on the same device. Kernels ask for nothing beyond
//! WebGPU's default limits. Where a device has subgroups, of whatever size, some stages run in a faster form that gives the
//! same bytes.

// Tests of the crate and of its public side share their support.
#[cfg(test)]
extern crate self as splat_shaders;

mod buffers;
mod device;
mod engine;
mod kernels;
mod layout;
mod moments;
mod optimise;
mod probe;
mod program;
mod session;
mod stages;
#[cfg(test)]
mod tests;
mod transfer;
mod wanted;

pub use device::{
    DeviceChoice, DeviceDescription, DeviceError, DeviceKind, GpuDevice, choose, devices, real_gpus,
};
pub use engine::GpuEngine;
pub use probe::{Probe, Stage};
