//! Bringing values to the device and back to the host, a bounded part at a time: what is in transit takes memory of its own.

use std::{
    sync::{PoisonError, mpsc::RecvTimeoutError},
    time::Duration,
};

use bytemuck::{Pod, cast_slice};
use splat::engine::EngineError;
use wgpu::{BufferDescriptor, BufferUsages, ErrorFilter, MapMode};

use crate::{buffers::Buffer, device::GpuDevice};

/// Bytes in transit at a time.
const PART: usize = 1 << 25;
/// Up to this size the queue takes them along, in memory of its own that a device is lost without.
const SMALL: usize = 1 << 16;

/// Writes values to the start of a buffer.
pub(crate) fn write<T: Pod>(device: &GpuDevice, target: &Buffer, values: &[T]) -> Result<(), EngineError> {
    write_in_parts(device, target, cast_slice(values), PART)
}

fn write_in_parts(device: &GpuDevice, target: &Buffer, bytes: &[u8], part: usize) -> Result<(), EngineError> {
    if bytes.len() <= SMALL.min(part) {
        device.queue.write_buffer(target, 0, bytes);
        return Ok(());
    }
    for (number, bytes) in bytes.chunks(part).enumerate() {
        let size = bytes.len() as u64;
        let staging = in_transit(device, size, BufferUsages::MAP_WRITE | BufferUsages::COPY_SRC, true)?;
        let failed = |reason: String| EngineError::Internal(format!("writing {size} bytes: {reason}"));
        staging
            .get_mapped_range_mut(..size)
            .map_err(|error| failed(error.to_string()))?
            .copy_from_slice(bytes);
        staging.unmap();
        // While this part was copied here, the device may have been at work on the one before: two at a time.
        let earlier = device.uploading.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(earlier) = earlier {
            device.wait(Some(earlier))?;
        }
        let mut encoder = device.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&staging, 0, target, (number * part) as u64, size);
        let submission = device.queue.submit([encoder.finish()]);
        *device.uploading.lock().unwrap_or_else(PoisonError::into_inner) = Some(submission);
    }
    Ok(())
}

/// The first `length` values of a buffer, once everything submitted so far is done.
pub(crate) fn read<T: Pod>(
    device: &GpuDevice,
    source: &wgpu::Buffer,
    length: usize,
) -> Result<Vec<T>, EngineError> {
    read_in_parts(device, source, length, PART)
}

fn read_in_parts<T: Pod>(
    device: &GpuDevice,
    source: &wgpu::Buffer,
    length: usize,
    part: usize,
) -> Result<Vec<T>, EngineError> {
    let mut values = Vec::with_capacity(length);
    // A whole number of values and of the words that copies are made of.
    let part = (part / size_of::<T>()).next_multiple_of(4);
    while values.len() < length {
        read_part(device, source, (length - values.len()).min(part), &mut values)?;
    }
    Ok(values)
}

/// Reads the next `count` values after those that are there.
fn read_part<T: Pod>(
    device: &GpuDevice,
    source: &wgpu::Buffer,
    count: usize,
    values: &mut Vec<T>,
) -> Result<(), EngineError> {
    let [offset, size] = [values.len(), count].map(|count| (count * size_of::<T>()) as u64);
    let staging = in_transit(device, size, BufferUsages::MAP_READ | BufferUsages::COPY_DST, false)?;
    let mut encoder = device.device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(source, offset, &staging, 0, size);
    let submission = device.queue.submit([encoder.finish()]);
    let lost = |reason: String| EngineError::DeviceLost(format!("reading back {size} bytes: {reason}"));
    let (sender, receiver) = std::sync::mpsc::channel();
    staging.map_async(MapMode::Read, ..size, move |result| {
        // Nobody listens only where the reading was given up.
        let _ = sender.send(result);
    });
    // Another thread's poll may have taken the callback up and not yet called it when ours returns.
    let outcome = loop {
        device.wait(Some(submission.clone()))?;
        match receiver.recv_timeout(Duration::from_millis(10)) {
            Err(RecvTimeoutError::Timeout) => continue,
            other => break other,
        }
    };
    outcome.map_err(|error| lost(error.to_string()))?.map_err(|error| lost(error.to_string()))?;
    let mapped = staging.get_mapped_range(..size).map_err(|error| lost(error.to_string()))?;
    // Mapped memory has no alignment to promise.
    values.extend(mapped.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned::<T>));
    Ok(())
}

/// Memory of the host that the device sees. It is not of the account: it is little, and on a card not of the card.
fn in_transit(
    device: &GpuDevice,
    size: u64,
    usage: BufferUsages,
    mapped_at_creation: bool,
) -> Result<wgpu::Buffer, EngineError> {
    let scope = device.device.push_error_scope(ErrorFilter::OutOfMemory);
    let descriptor = BufferDescriptor { label: Some("in transit"), size, usage, mapped_at_creation };
    let buffer = device.device.create_buffer(&descriptor);
    match pollster::block_on(scope.pop()) {
        Some(_) => Err(EngineError::OutOfResources { needed: size, available: 0 }),
        None => Ok(buffer),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::{
        buffers::{allocate, storage},
        tests::support,
    };

    #[test]
    fn only_a_second_upload_waits_for_the_first() {
        if support::engine().is_none() {
            return;
        }
        let device = support::open().with_poll(|_, _| Err(wgpu::PollError::Timeout));
        let values = vec![7_u32; SMALL];
        let [buffer] = allocate(&device, [storage("values", 4 * SMALL as u64)]).unwrap();
        write(&device, &buffer, &values).unwrap();
        let outcome = write(&device, &buffer, &values);
        assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    }

    #[test]
    fn values_in_parts_come_back_as_they_went() {
        let Some(engine) = support::engine() else { return };
        let device = &engine.context.device;
        let values: Vec<[u32; 3]> = (0..40_000).map(|place| [place, place ^ 0x5555, !place]).collect();
        let [buffer] = allocate(device, [storage("values", 12 * values.len() as u64)]).unwrap();
        for part in [PART, 4096, 100_000] {
            device.queue.write_buffer(&buffer, 0, &vec![0; 12 * values.len()]);
            write_in_parts(device, &buffer, cast_slice(&values), part).unwrap();
            for part in [PART, 4096, 100_000] {
                assert!(read_in_parts::<[u32; 3]>(device, &buffer, values.len(), part).unwrap() == values);
                assert!(read_in_parts::<[u32; 3]>(device, &buffer, 0, part).unwrap().is_empty());
                assert_eq!(read_in_parts::<[u32; 3]>(device, &buffer, 1, part).unwrap(), values[..1]);
            }
        }
    }
}
