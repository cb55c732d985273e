//! Bringing values back to the host.

use std::{sync::mpsc::RecvTimeoutError, time::Duration};

use bytemuck::Pod;
use splat::engine::EngineError;
use wgpu::{Buffer, BufferUsages, MapMode, PollType};

use crate::{
    buffers::{Request, allocate},
    device::GpuDevice,
};

/// The first `length` values of a buffer, once everything submitted so far is done.
pub(crate) fn read<T: Pod>(
    device: &GpuDevice,
    source: &Buffer,
    length: usize,
) -> Result<Vec<T>, EngineError> {
    if length == 0 {
        return Ok(Vec::new());
    }
    let bytes = (length * size_of::<T>()) as u64;
    let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
    let [staging] = allocate(device, [Request { label: "readback", bytes, usage }])?;
    let mut encoder = device.device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(source, 0, &staging, 0, bytes);
    device.queue.submit([encoder.finish()]);
    let lost = |reason: String| EngineError::DeviceLost(format!("reading back {bytes} bytes: {reason}"));
    let (sender, receiver) = std::sync::mpsc::channel();
    staging.map_async(MapMode::Read, ..bytes, move |result| {
        // Nobody listens only where the reading was given up.
        let _ = sender.send(result);
    });
    // Another thread's poll may have taken the callback up and not yet called it when ours returns.
    let outcome = loop {
        device.device.poll(PollType::wait_indefinitely()).map_err(|error| lost(error.to_string()))?;
        device.check()?;
        match receiver.recv_timeout(Duration::from_millis(10)) {
            Err(RecvTimeoutError::Timeout) => continue,
            other => break other,
        }
    };
    outcome.map_err(|error| lost(error.to_string()))?.map_err(|error| lost(error.to_string()))?;
    let mapped = staging.get_mapped_range(..bytes).map_err(|error| lost(error.to_string()))?;
    // Mapped memory has no alignment to promise.
    Ok(mapped.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect())
}
