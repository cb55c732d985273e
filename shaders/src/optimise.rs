//! The stages of a step beyond a view: loss, optimiser, and the optimiser's part in a change of the set.

use bytemuck::bytes_of;
use splat::engine::EngineError;

use crate::{
    buffers::{Buffer, Buffers, GradientBuffers, LossBuffers, OptimiserBuffers, allocate, uniform},
    kernels::Kernel,
    layout::{GEOMETRY, ReplaceSettings},
    program::{Dispatch, Groups},
    stages::{Binder, ViewBuffer, whole},
};

impl Binder<'_> {
    /// The loss of what is rendered against `wanted`, and its gradient by the image.
    pub(crate) fn loss(
        &self,
        buffers: &Buffers,
        gradients: &GradientBuffers,
        loss: &LossBuffers,
        view: &ViewBuffer,
        wanted: &Buffer,
    ) -> [Dispatch; 3] {
        let Buffers { common, images, .. } = buffers;
        let tiles = || Groups::of(view.data.tile_count().into());
        let seen = || {
            [
                (0, whole(&view.buffer)),
                (2, whole(&common.state)),
                (3, whole(&images.rendered)),
                (4, whole(wanted)),
                (5, whole(&loss.derivatives)),
                (7, whole(&loss.shares)),
            ]
        };
        let with_gradient = [&seen()[..], &[(6, whole(&gradients.image))]].concat();
        let summed = [
            (0, whole(&view.buffer)),
            (1, whole(&common.step)),
            (2, whole(&common.state)),
            (7, whole(&loss.shares)),
            (8, whole(&loss.losses)),
        ];
        [
            self.dispatch(&self.kernels.similarity, tiles(), &seen()),
            self.dispatch(&self.kernels.loss_gradient, tiles(), &with_gradient),
            self.dispatch(&self.kernels.total, Groups::of(1), &summed),
        ]
    }

    /// One descent step of every parameter.
    pub(crate) fn adam(
        &self,
        buffers: &Buffers,
        gradients: &GradientBuffers,
        optimiser: &OptimiserBuffers,
        coefficients: u64,
    ) -> [Dispatch; 2] {
        let Buffers { common, parameters, footprints, .. } = buffers;
        let [geometry_first, geometry_second, sh_first, sh_second] = &optimiser.moments;
        let update = |kernel: &Kernel, width: u64, buffers: [&Buffer; 4]| {
            let [values, gradient, first, second] = buffers;
            let resources = [
                (0, whole(&common.step)),
                (1, whole(&common.state)),
                (2, whole(values)),
                (3, whole(gradient)),
                (4, whole(first)),
                (5, whole(second)),
                (6, whole(&optimiser.active)),
            ];
            self.dispatch(kernel, Groups::threads(width * footprints.count), &resources)
        };
        let geometry = [&parameters.geometry, &gradients.geometry, geometry_first, geometry_second];
        let sh = [&parameters.sh, &gradients.sh, sh_first, sh_second];
        [
            update(&self.kernels.adam_geometry, GEOMETRY as u64, geometry),
            update(&self.kernels.adam_sh, 3 * coefficients, sh),
        ]
    }

    /// Takes `width` values per Gaussian over from an old set to one of `count`.
    pub(crate) fn replace(
        &self,
        sources: &Buffer,
        old: &Buffer,
        new: &Buffer,
        count: u64,
        width: u64,
    ) -> Result<Dispatch, EngineError> {
        let [settings] = allocate(self.device, [uniform("replace", size_of::<ReplaceSettings>() as u64)])?;
        let data = ReplaceSettings { count: count as u32, width: width as u32 };
        self.device.queue.write_buffer(&settings, 0, bytes_of(&data));
        let resources = [(0, whole(&settings)), (1, whole(sources)), (2, whole(old)), (3, whole(new))];
        Ok(self.dispatch(&self.kernels.replace, Groups::threads(count * width), &resources))
    }
}
