//! The stages of one view as dispatches, each bound to its buffers.

use bytemuck::bytes_of;
use splat::engine::EngineError;
use wgpu::BindingResource;

use crate::{
    buffers::{
        BLOCK, Buffer, Buffers, CommonBuffers, DEPTH_PASSES, DIGITS, GradientBuffers, IntersectionBuffers,
        MomentBuffers, SortBuffers, allocate, uniform,
    },
    device::GpuDevice,
    kernels::{Kernel, Kernels},
    layout::View,
    program::{Dispatch, Groups},
};

/// Offset of the number of workgroups that the sort of the intersections has, and of those that its scan has.
const SORT_GROUPS: u64 = 0;
const SCAN_GROUPS: u64 = 16;

/// A view's uniform, here and on the device.
#[derive(Clone, Debug)]
pub(crate) struct ViewBuffer {
    pub data: View,
    pub buffer: Buffer,
}

impl ViewBuffer {
    pub(crate) fn new(device: &GpuDevice, data: View) -> Result<Self, EngineError> {
        let [buffer] = allocate(device, [uniform("view", size_of::<View>() as u64)])?;
        device.queue.write_buffer(&buffer, 0, bytes_of(&data));
        Ok(Self { data, buffer })
    }
}

/// Binds kernels to resources.
pub(crate) struct Binder<'a> {
    pub device: &'a GpuDevice,
    pub kernels: &'a Kernels,
}

impl Binder<'_> {
    pub(crate) fn dispatch(
        &self,
        kernel: &Kernel,
        groups: Groups,
        resources: &[(u32, BindingResource<'_>)],
    ) -> Dispatch {
        let resources = kernel.bind(&self.device.device, resources);
        Dispatch { kernel: kernel.clone(), resources, groups }
    }

    /// Stages 1 to 3.
    pub(crate) fn forward(&self, buffers: &Buffers, view: &ViewBuffer) -> Vec<Dispatch> {
        let mut program = self.lists(buffers, view);
        program.push(self.blend(buffers, view));
        program
    }

    /// Stages 1 and 2.
    pub(crate) fn lists(&self, buffers: &Buffers, view: &ViewBuffer) -> Vec<Dispatch> {
        let mut program = vec![self.project(buffers, view)];
        self.bin(buffers, view, &mut program);
        program
    }

    /// Moments of `wanted` footprints, after the lists of a view.
    pub(crate) fn footprint_moments(
        &self,
        buffers: &Buffers,
        tracks: &MomentBuffers,
        view: &ViewBuffer,
        wanted: u64,
    ) -> [Dispatch; 2] {
        let Buffers { footprints, intersections, images, .. } = buffers;
        let of_tiles = [
            (0, whole(&view.buffer)),
            (1, whole(&images.bounds)),
            (2, whole(sorted_slots(intersections, &view.data))),
            (3, whole(&intersections.owners)),
            (4, whole(&footprints.footprints)),
            (5, whole(&tracks.expectations)),
            (6, whole(&tracks.positions)),
            (7, whole(&tracks.sigmas)),
            (8, whole(&tracks.sums)),
        ];
        let joined = [
            (0, whole(&view.buffer)),
            (9, whole(&footprints.ranges)),
            (10, whole(&tracks.wanted)),
            (11, whole(&tracks.sums)),
            (12, whole(&tracks.moments)),
        ];
        let tiles = Groups::of(view.data.tile_count().into());
        [
            self.dispatch(&self.kernels.footprint_moments, tiles, &of_tiles),
            self.dispatch(&self.kernels.join_moments, Groups::threads(wanted), &joined),
        ]
    }

    /// What is rendered as 8-bit RGB.
    pub(crate) fn quantize(&self, buffers: &Buffers, bytes: &Buffer, view: &ViewBuffer) -> Dispatch {
        let resources = [(0, whole(&view.buffer)), (1, whole(&buffers.images.rendered)), (2, whole(bytes))];
        let groups = Groups::threads(view.data.pixels().div_ceil(4));
        self.dispatch(&self.kernels.quantize, groups, &resources)
    }

    /// Stages 4 and 5.
    pub(crate) fn backward(
        &self,
        buffers: &Buffers,
        gradients: &GradientBuffers,
        view: &ViewBuffer,
    ) -> [Dispatch; 2] {
        [self.blend_backward(buffers, gradients, view), self.project_backward(buffers, gradients, view)]
    }

    fn project(&self, buffers: &Buffers, view: &ViewBuffer) -> Dispatch {
        let Buffers { parameters, common, footprints, .. } = buffers;
        let resources = [
            (0, whole(&view.buffer)),
            (1, whole(&common.step)),
            (2, whole(&common.state)),
            (3, whole(&parameters.geometry)),
            (4, whole(&parameters.sh)),
            (5, whole(&footprints.footprints)),
            (6, whole(&footprints.reaches)),
            (7, whole(&footprints.depth.keys[0])),
            (8, whole(&footprints.depth.values[0])),
            (9, whole(&footprints.ranges)),
        ];
        self.dispatch(&self.kernels.project, Groups::threads(footprints.count), &resources)
    }

    fn bin(&self, buffers: &Buffers, view: &ViewBuffer, program: &mut Vec<Dispatch>) {
        let Buffers { common, footprints, intersections, images, .. } = buffers;
        let blocks = Groups::of(footprints.count.div_ceil(BLOCK));
        let scans = Groups::of((DIGITS * footprints.count.div_ceil(BLOCK)).div_ceil(BLOCK));
        let (depths, order) = self.sort(common, &footprints.depth, 0, DEPTH_PASSES, &blocks, &scans, program);
        program.push(self.dispatch(
            &self.kernels.count,
            Groups::threads(footprints.count + 1),
            &[
                (0, whole(&view.buffer)),
                (1, whole(&common.step)),
                (2, whole(&common.state)),
                (3, whole(depths)),
                (4, whole(order)),
                (5, whole(&footprints.reaches)),
                (6, whole(&footprints.counts)),
            ],
        ));
        let scans = Groups::of((footprints.count + 1).div_ceil(BLOCK));
        self.scan(common, 0, &footprints.counts, &footprints.sums, &scans, program);
        program.push(self.plan(common, &footprints.counts));
        let tiles = &intersections.tiles;
        program.push(self.dispatch(
            &self.kernels.emit,
            Groups::threads(footprints.count),
            &[
                (0, whole(&view.buffer)),
                (1, whole(&common.step)),
                (2, whole(&common.state)),
                (4, whole(order)),
                (5, whole(&footprints.reaches)),
                (6, whole(&footprints.counts)),
                (7, whole(&tiles.keys[0])),
                (8, whole(&tiles.values[0])),
                (9, whole(&intersections.owners)),
                (10, whole(&footprints.ranges)),
            ],
        ));
        let blocks = Groups::Planned(common.dispatches.clone(), SORT_GROUPS);
        let scans = Groups::Planned(common.dispatches.clone(), SCAN_GROUPS);
        let (keys, _) = self.sort(common, tiles, 1, tile_passes(&view.data), &blocks, &scans, program);
        program.push(self.dispatch(
            &self.kernels.bound,
            Groups::threads(view.data.tile_count().into()),
            &[
                (0, whole(&view.buffer)),
                (2, whole(&common.state)),
                (14, whole(keys)),
                (15, whole(&images.bounds)),
            ],
        ));
    }

    /// Decides how many workgroups the intersections take, whose number is the last of the scanned `counts`.
    pub(crate) fn plan(&self, common: &CommonBuffers, counts: &Buffer) -> Dispatch {
        let resources = [
            (1, whole(&common.step)),
            (11, whole(counts)),
            (12, whole(&common.state)),
            (13, whole(&common.dispatches)),
        ];
        self.dispatch(&self.kernels.plan, Groups::of(1), &resources)
    }

    /// Sorts by the lowest `8 · passes` bits and says where the result is.
    pub(crate) fn sort<'b>(
        &self,
        common: &CommonBuffers,
        buffers: &'b SortBuffers,
        list: u32,
        passes: u32,
        blocks: &Groups,
        scans: &Groups,
        program: &mut Vec<Dispatch>,
    ) -> (&'b Buffer, &'b Buffer) {
        for pass in 0..passes {
            let (from, to) = (pass as usize % 2, (pass as usize + 1) % 2);
            let counted = [
                (0, common.sort_setting(list, pass)),
                (1, whole(&common.state)),
                (2, whole(&buffers.keys[from])),
                (4, whole(&buffers.histogram)),
            ];
            program.push(self.dispatch(&self.kernels.histogram, blocks.clone(), &counted));
            self.scan_blocks(common, list + 1, &buffers.histogram, &buffers.sums, scans, program);
            let scattered = [
                (0, common.sort_setting(list, pass)),
                (1, whole(&common.state)),
                (2, whole(&buffers.keys[from])),
                (3, whole(&buffers.values[from])),
                (4, whole(&buffers.histogram)),
                (5, whole(&buffers.sums)),
                (6, whole(&buffers.keys[to])),
                (7, whole(&buffers.values[to])),
            ];
            program.push(self.dispatch(&self.kernels.scatter, blocks.clone(), &scattered));
        }
        let at = passes as usize % 2;
        (&buffers.keys[at], &buffers.values[at])
    }

    pub(crate) fn scan(
        &self,
        common: &CommonBuffers,
        list: u32,
        values: &Buffer,
        sums: &Buffer,
        groups: &Groups,
        program: &mut Vec<Dispatch>,
    ) {
        self.scan_blocks(common, list, values, sums, groups, program);
        let resources = scan_resources(common, list, values, sums);
        program.push(self.dispatch(&self.kernels.add, groups.clone(), &resources));
    }

    /// Sums within blocks, and over the blocks before.
    fn scan_blocks(
        &self,
        common: &CommonBuffers,
        list: u32,
        values: &Buffer,
        sums: &Buffer,
        groups: &Groups,
        program: &mut Vec<Dispatch>,
    ) {
        let [settings, state, values, sums] = scan_resources(common, list, values, sums);
        let spine = [settings.clone(), state.clone(), sums.clone()];
        program.push(self.dispatch(&self.kernels.reduce, groups.clone(), &[settings, state, values, sums]));
        program.push(self.dispatch(&self.kernels.spine, Groups::of(1), &spine));
    }

    fn blend(&self, buffers: &Buffers, view: &ViewBuffer) -> Dispatch {
        let Buffers { common, footprints, intersections, images, .. } = buffers;
        let resources = [
            (0, whole(&view.buffer)),
            (1, whole(&common.state)),
            (2, whole(&images.bounds)),
            (3, whole(sorted_slots(intersections, &view.data))),
            (4, whole(&intersections.owners)),
            (5, whole(&footprints.footprints)),
            (6, whole(&images.rendered)),
            (7, whole(&images.last)),
        ];
        self.dispatch(&self.kernels.blend, Groups::of(view.data.tile_count().into()), &resources)
    }

    fn blend_backward(&self, buffers: &Buffers, gradients: &GradientBuffers, view: &ViewBuffer) -> Dispatch {
        let Buffers { footprints, intersections, images, .. } = buffers;
        let resources = [
            (0, whole(&view.buffer)),
            (2, whole(&images.bounds)),
            (3, whole(sorted_slots(intersections, &view.data))),
            (4, whole(&intersections.owners)),
            (5, whole(&footprints.footprints)),
            (6, whole(&images.rendered)),
            (7, whole(&images.last)),
            (8, whole(&gradients.image)),
            (9, whole(&intersections.sums)),
        ];
        self.dispatch(&self.kernels.blend_backward, Groups::of(view.data.tile_count().into()), &resources)
    }

    fn project_backward(
        &self,
        buffers: &Buffers,
        gradients: &GradientBuffers,
        view: &ViewBuffer,
    ) -> Dispatch {
        let Buffers { common, parameters, footprints, intersections, .. } = buffers;
        let resources = [
            (0, whole(&view.buffer)),
            (1, whole(&common.step)),
            (2, whole(&common.state)),
            (3, whole(&parameters.geometry)),
            (4, whole(&parameters.sh)),
            (5, whole(&footprints.ranges)),
            (6, whole(&intersections.sums)),
            (7, whole(&gradients.geometry)),
            (8, whole(&gradients.sh)),
            (9, whole(&gradients.density)),
        ];
        self.dispatch(&self.kernels.project_backward, Groups::threads(footprints.count), &resources)
    }
}

fn scan_resources<'b>(
    common: &'b CommonBuffers,
    list: u32,
    values: &'b Buffer,
    sums: &'b Buffer,
) -> [(u32, BindingResource<'b>); 4] {
    [(0, common.scan_setting(list)), (1, whole(&common.state)), (2, whole(values)), (3, whole(sums))]
}

/// The whole buffer.
pub(crate) fn whole(buffer: &Buffer) -> BindingResource<'_> {
    buffer.as_entire_binding()
}

/// Passes of the sort by tile. One key more than there are tiles: that of no tile.
pub(crate) fn tile_passes(view: &View) -> u32 {
    (u32::BITS - view.tile_count().leading_zeros()).div_ceil(8)
}

/// Where the sort leaves the slots of a view.
pub(crate) fn sorted_slots<'a>(intersections: &'a IntersectionBuffers, view: &View) -> &'a Buffer {
    &intersections.tiles.values[tile_passes(view) as usize % 2]
}
