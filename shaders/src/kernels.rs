//! The compiled kernels.

use std::borrow::Cow;

use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindingResource, ComputePipeline,
    ComputePipelineDescriptor, Device, PipelineCompilationOptions, ShaderModule, ShaderModuleDescriptor,
    ShaderSource,
};

/// A stage's WGSL as `build.rs` composed it.
macro_rules! composed {
    ($name:literal) => {
        include_str!(concat!(env!("OUT_DIR"), "/", $name, ".wgsl"))
    };
}

/// Every stage's name and source.
pub(crate) const SOURCES: &[(&str, &str)] = &[
    ("project", composed!("project")),
    ("bin", composed!("bin")),
    ("scan", composed!("scan")),
    ("sort", composed!("sort")),
    ("blend", composed!("blend")),
    ("blend_backward", composed!("blend_backward")),
    ("project_backward", composed!("project_backward")),
    ("footprint_moments", composed!("footprint_moments")),
    ("quantize", composed!("quantize")),
    ("loss", composed!("loss")),
    ("adam", composed!("adam")),
    ("replace", composed!("replace")),
];

/// The stages that are faster with subgroups, in that form: the same bindings, the same results to the byte.
pub(crate) const SUBGROUP_SOURCES: &[(&str, &str)] =
    &[("scan", composed!("scan_subgroups")), ("sort", composed!("sort_subgroups"))];

/// An entry point of a stage.
#[derive(Clone, Debug)]
pub(crate) struct Kernel {
    pub pipeline: ComputePipeline,
    name: &'static str,
}

impl Kernel {
    fn new(device: &Device, module: &ShaderModule, name: &'static str) -> Self {
        let pipeline = device.create_compute_pipeline(&ComputePipelineDescriptor {
            label: Some(name),
            layout: None,
            module,
            entry_point: Some(name),
            // Every kernel writes its shared memory before it reads it.
            compilation_options: PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        Self { pipeline, name }
    }

    /// The resources of one dispatch by the number of their binding.
    pub(crate) fn bind(&self, device: &Device, resources: &[(u32, BindingResource<'_>)]) -> BindGroup {
        let entries: Vec<_> = resources
            .iter()
            .map(|(binding, resource)| BindGroupEntry { binding: *binding, resource: resource.clone() })
            .collect();
        device.create_bind_group(&BindGroupDescriptor {
            label: Some(self.name),
            layout: &self.pipeline.get_bind_group_layout(0),
            entries: &entries,
        })
    }
}

/// One field per entry point, in the order of a step.
macro_rules! kernels {
    ($($module:literal: $($kernel:ident),+;)+) => {
        /// Every entry point.
        #[derive(Clone, Debug)]
        pub(crate) struct Kernels {
            $($(pub $kernel: Kernel,)+)+
        }

        impl Kernels {
            /// In the form for subgroups where there is one, if `has_subgroups`.
            pub(crate) fn new(device: &Device, has_subgroups: bool) -> Self {
                $(
                    let module = compile(device, $module, has_subgroups);
                    $(let $kernel = Kernel::new(device, &module, stringify!($kernel));)+
                )+
                Self { $($($kernel,)+)+ }
            }
        }
    };
}

kernels! {
    "project": project;
    "bin": count, plan, emit, bound;
    "scan": reduce, spine, add;
    "sort": histogram, scatter;
    "blend": blend;
    "blend_backward": blend_backward;
    "project_backward": project_backward;
    "footprint_moments": footprint_moments, join_moments;
    "quantize": quantize;
    "loss": similarity, loss_gradient, total;
    "adam": adam_geometry, adam_sh;
    "replace": replace;
}

fn compile(device: &Device, name: &'static str, has_subgroups: bool) -> ShaderModule {
    let faster = if has_subgroups { SUBGROUP_SOURCES } else { &[] };
    let mut forms = faster.iter().chain(SOURCES);
    let source = forms.find(|(stage, _)| *stage == name).map_or("", |(_, source)| source);
    device.create_shader_module(ShaderModuleDescriptor {
        label: Some(name),
        source: ShaderSource::Wgsl(Cow::Borrowed(source)),
    })
}
