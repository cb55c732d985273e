//! A fixed list of dispatches, recorded again for every step.

use wgpu::{BindGroup, CommandEncoder, ComputePassDescriptor, ComputePassTimestampWrites};

use crate::{buffers::Buffer, kernels::Kernel};

/// How many workgroups a dispatch has.
#[derive(Clone, Debug)]
pub(crate) enum Groups {
    /// Columns and rows.
    Fixed(u32, u32),
    /// As the device has written at this offset.
    Planned(Buffer, u64),
}

impl Groups {
    /// `count` workgroups, laid out in rows as `group_number` in the shaders expects; at least one.
    pub(crate) fn of(count: u64) -> Self {
        Self::in_rows(count, 65_535)
    }

    /// The same in rows of at most `row`.
    pub(crate) fn in_rows(count: u64, row: u32) -> Self {
        let (count, row) = (count.max(1), u64::from(row));
        Self::Fixed(count.min(row) as u32, count.div_ceil(row) as u32)
    }

    /// Workgroups of 256 threads for so many items.
    pub(crate) fn threads(items: u64) -> Self {
        Self::of(items.div_ceil(256))
    }
}

/// One kernel on its resources.
#[derive(Clone, Debug)]
pub(crate) struct Dispatch {
    pub kernel: Kernel,
    pub resources: BindGroup,
    pub groups: Groups,
}

/// Records the dispatches as one pass; the device orders those that share buffers.
pub(crate) fn record<'a>(
    encoder: &mut CommandEncoder,
    label: &'static str,
    dispatches: impl IntoIterator<Item = &'a Dispatch>,
) {
    record_timed(encoder, label, None, dispatches);
}

/// The same, with the times at which the pass begins and ends.
pub(crate) fn record_timed<'a>(
    encoder: &mut CommandEncoder,
    label: &'static str,
    timestamp_writes: Option<ComputePassTimestampWrites<'_>>,
    dispatches: impl IntoIterator<Item = &'a Dispatch>,
) {
    let mut pass =
        encoder.begin_compute_pass(&ComputePassDescriptor { label: Some(label), timestamp_writes });
    for dispatch in dispatches {
        pass.set_pipeline(&dispatch.kernel.pipeline);
        pass.set_bind_group(0, &dispatch.resources, &[]);
        match &dispatch.groups {
            Groups::Fixed(columns, rows) => pass.dispatch_workgroups(*columns, *rows, 1),
            Groups::Planned(buffer, offset) => pass.dispatch_workgroups_indirect(buffer, *offset),
        }
    }
}
