//! The stages of one view as dispatches, each bound to its buffers.

use wgpu::{BindingResource, Buffer};

use crate::{
    buffers::{
        BLOCK, CommonBuffers, DEPTH_PASSES, FootprintBuffers, ImageBuffers, IntersectionBuffers,
        ParameterBuffers, SortBuffers,
    },
    device::GpuDevice,
    kernels::{Kernel, Kernels},
    layout::View,
    program::{Dispatch, Groups},
};

/// Offset of the number of workgroups that the sort of the intersections has, and of those that its scan has.
const SORT_GROUPS: u64 = 0;
const SCAN_GROUPS: u64 = 16;

/// The buffers of the forward stages of one view.
pub(crate) struct Forward<'a> {
    pub parameters: &'a ParameterBuffers,
    pub common: &'a CommonBuffers,
    pub footprints: &'a FootprintBuffers,
    pub intersections: &'a IntersectionBuffers,
    pub images: &'a ImageBuffers,
    pub view: &'a Buffer,
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
    pub(crate) fn forward(&self, buffers: &Forward<'_>, view: &View) -> Vec<Dispatch> {
        let mut program = vec![self.project(buffers)];
        self.bin(buffers, view, &mut program);
        program.push(self.blend(buffers, view));
        program
    }

    fn project(&self, buffers: &Forward<'_>) -> Dispatch {
        let Forward { parameters, common, footprints, .. } = buffers;
        let resources = [
            (0, whole(buffers.view)),
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

    fn bin(&self, buffers: &Forward<'_>, view: &View, program: &mut Vec<Dispatch>) {
        let Forward { common, footprints, intersections, images, .. } = buffers;
        let blocks = Groups::of(footprints.count.div_ceil(BLOCK));
        let scans = Groups::of((16 * footprints.count.div_ceil(BLOCK)).div_ceil(BLOCK));
        let (depths, order) = self.sort(common, &footprints.depth, 0, DEPTH_PASSES, &blocks, &scans, program);
        program.push(self.dispatch(
            &self.kernels.count,
            Groups::threads(footprints.count + 1),
            &[
                (0, whole(buffers.view)),
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
        program.push(self.dispatch(
            &self.kernels.plan,
            Groups::of(1),
            &[
                (1, whole(&common.step)),
                (11, whole(&footprints.counts)),
                (12, whole(&common.state)),
                (13, whole(&common.dispatches)),
            ],
        ));
        let tiles = &intersections.tiles;
        program.push(self.dispatch(
            &self.kernels.emit,
            Groups::threads(footprints.count),
            &[
                (0, whole(buffers.view)),
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
        let (keys, _) = self.sort(common, tiles, 1, tile_passes(view), &blocks, &scans, program);
        program.push(self.dispatch(
            &self.kernels.bound,
            Groups::threads(view.tile_count().into()),
            &[
                (0, whole(buffers.view)),
                (2, whole(&common.state)),
                (14, whole(keys)),
                (15, whole(&images.bounds)),
            ],
        ));
    }

    /// Sorts by the lowest `4 · passes` bits and says where the result is.
    fn sort<'b>(
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
            self.scan(common, list + 1, &buffers.histogram, &buffers.sums, scans, program);
            let scattered = [
                (0, common.sort_setting(list, pass)),
                (1, whole(&common.state)),
                (2, whole(&buffers.keys[from])),
                (3, whole(&buffers.values[from])),
                (4, whole(&buffers.histogram)),
                (5, whole(&buffers.keys[to])),
                (6, whole(&buffers.values[to])),
            ];
            program.push(self.dispatch(&self.kernels.scatter, blocks.clone(), &scattered));
        }
        let at = passes as usize % 2;
        (&buffers.keys[at], &buffers.values[at])
    }

    fn scan(
        &self,
        common: &CommonBuffers,
        list: u32,
        values: &Buffer,
        sums: &Buffer,
        groups: &Groups,
        program: &mut Vec<Dispatch>,
    ) {
        let settings = || [(0, common.scan_setting(list)), (1, whole(&common.state))];
        let all = [&settings()[..], &[(2, whole(values)), (3, whole(sums))]].concat();
        let spine = [&settings()[..], &[(3, whole(sums))]].concat();
        program.push(self.dispatch(&self.kernels.reduce, groups.clone(), &all));
        program.push(self.dispatch(&self.kernels.spine, Groups::of(1), &spine));
        program.push(self.dispatch(&self.kernels.add, groups.clone(), &all));
    }

    fn blend(&self, buffers: &Forward<'_>, view: &View) -> Dispatch {
        let Forward { common, footprints, intersections, images, .. } = buffers;
        let resources = [
            (0, whole(buffers.view)),
            (1, whole(&common.state)),
            (2, whole(&images.bounds)),
            (3, whole(sorted_slots(intersections, view))),
            (4, whole(&intersections.owners)),
            (5, whole(&footprints.footprints)),
            (6, whole(&images.rendered)),
            (7, whole(&images.last)),
        ];
        self.dispatch(&self.kernels.blend, Groups::of(view.tile_count().into()), &resources)
    }
}

/// The whole buffer.
pub(crate) fn whole(buffer: &Buffer) -> BindingResource<'_> {
    buffer.as_entire_binding()
}

/// Passes of the sort by tile. One key more than there are tiles: that of no tile.
fn tile_passes(view: &View) -> u32 {
    (u32::BITS - view.tile_count().leading_zeros()).div_ceil(4)
}

/// Where the sort leaves the slots of a view.
pub(crate) fn sorted_slots<'a>(intersections: &'a IntersectionBuffers, view: &View) -> &'a Buffer {
    &intersections.tiles.values[tile_passes(view) as usize % 2]
}
