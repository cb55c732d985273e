//! What host and kernels have in common is read from the compiled shaders.

use std::{collections::BTreeMap, mem::offset_of};

use naga::{
    AddressSpace, Expression, Literal, Module, TypeInner,
    valid::{Capabilities, ValidationFlags, Validator},
};
use splat::raster;

use crate::{
    kernels::{SOURCES, SUBGROUP_SOURCES},
    layout::{
        Density, Expectation, GEOMETRY, Moments, ReplaceSettings, SUMS, ScanSettings, SortSettings, State,
        Step, TILE, View,
    },
};

fn modules() -> Vec<(&'static str, Module)> {
    let parse = |source| naga::front::wgsl::parse_str(source).expect("the build has validated it");
    SOURCES.iter().chain(SUBGROUP_SOURCES).map(|&(name, source)| (name, parse(source))).collect()
}

/// A name without what composing appended.
fn plain(name: &str) -> &str {
    name.split("X_naga_oil_mod_").next().unwrap_or(name).trim_end_matches('_')
}

/// Size, and name and offset of every member.
type Layout = (usize, Vec<(String, usize)>);

/// Every struct of every stage.
fn structs() -> Vec<(String, Layout)> {
    let mut found = Vec::new();
    for (_, module) in modules() {
        for (_, kind) in module.types.iter() {
            if let (Some(name), TypeInner::Struct { members, span }) = (&kind.name, &kind.inner) {
                let members = members
                    .iter()
                    .map(|member| (member.name.clone().unwrap_or_default(), member.offset as usize))
                    .collect();
                found.push((plain(name).to_owned(), (*span as usize, members)));
            }
        }
    }
    found
}

macro_rules! layout_of {
    ($type:ident { $($field:ident),+ $(,)? }) => {
        (
            stringify!($type),
            (
                size_of::<$type>(),
                vec![$((stringify!($field).to_owned(), offset_of!($type, $field))),+],
            ),
        )
    };
}

#[test]
fn host_structs_lie_in_memory_as_the_shaders_read_them() {
    let expected: BTreeMap<&str, Layout> = BTreeMap::from([
        layout_of!(View {
            right,
            down,
            forward,
            centre_rest,
            background,
            focal,
            principal,
            slope_low,
            slope_high,
            size,
            tiles,
            absolute,
            structural,
            is_packed,
            padding,
        }),
        layout_of!(Step {
            count,
            coefficients,
            degree,
            capacity,
            rates,
            sh_rates,
            first_correction,
            second_correction,
            number,
            loss_place,
            has_active,
            padding,
        }),
        layout_of!(State { gaussians, intersections, needed, failed, failed_step }),
        layout_of!(SortSettings { list, shift }),
        layout_of!(ScanSettings { list }),
        layout_of!(ReplaceSettings { count, width }),
        layout_of!(Density { gradient_norm, visible_steps }),
        layout_of!(Moments { weights, first, second, cross, reference, anchor, pixels }),
        layout_of!(Expectation { displacement, fall, is_wanted }),
    ]);
    let found = structs();
    for (name, layout) in &expected {
        let twins: Vec<_> = found.iter().filter(|(twin, _)| twin == name).collect();
        assert!(!twins.is_empty(), "no shader has {name}");
        assert!(
            twins.iter().all(|(_, twin)| twin == layout),
            "{name}: {layout:?}, the shaders have {twins:?}"
        );
    }
}

#[test]
fn constants_are_those_of_the_cpu_engine() {
    let expected = BTreeMap::from([
        ("NEAR_PLANE", raster::NEAR_PLANE),
        ("LOW_PASS", raster::LOW_PASS),
        ("ALPHA_MIN", raster::ALPHA_MIN.into()),
        ("ALPHA_MAX", raster::ALPHA_MAX.into()),
        ("TRANSMITTANCE_MIN", raster::TRANSMITTANCE_MIN.into()),
        ("TILE", TILE.into()),
        ("GEOMETRY", GEOMETRY as f64),
        ("SUMS", SUMS as f64),
        ("SIGMA_MIN", raster::SIGMA_MIN.into()),
        ("SIGMA_MAX", raster::SIGMA_MAX.into()),
        ("FARTHEST", raster::FARTHEST),
        ("LN_OF_255", -f64::from(raster::ALPHA_MIN).ln()),
    ]);
    let mut seen = BTreeMap::new();
    for (stage, module) in modules() {
        for (_, constant) in module.constants.iter() {
            let value = match module.global_expressions[constant.init] {
                Expression::Literal(Literal::F32(value)) => f64::from(value),
                Expression::Literal(Literal::U32(value)) => value.into(),
                _ => continue,
            };
            let name = plain(constant.name.as_deref().unwrap_or_default()).to_owned();
            if let Some(&wanted) = expected.get(name.as_str()) {
                assert!((value - wanted).abs() <= 1e-7 * wanted, "{stage}: {name} is {value}, not {wanted}");
                seen.insert(name, value);
            }
        }
    }
    assert_eq!(seen.len(), expected.len(), "{seen:?}");
}

#[test]
fn kernels_keep_to_the_base_limits() {
    for (stage, module) in modules() {
        // The build has validated the base forms without it.
        let info = Validator::new(ValidationFlags::all(), Capabilities::SUBGROUP)
            .validate(&module)
            .expect("the build has validated it");
        for (number, entry) in module.entry_points.iter().enumerate() {
            let threads: u32 = entry.workgroup_size.iter().product();
            assert!(threads <= 256, "{stage}.{}: {threads} threads", entry.name);
            let used = |space: &dyn Fn(AddressSpace) -> bool| {
                let all = module.global_variables.iter();
                all.filter(|&(handle, variable)| {
                    space(variable.space) && !info.get_entry_point(number)[handle].is_empty()
                })
                .map(|(_, variable)| module.types[variable.ty].inner.size(module.to_ctx()))
                .collect::<Vec<u32>>()
            };
            let shared: u32 = used(&|space| space == AddressSpace::WorkGroup).iter().sum();
            assert!(shared <= 16_384, "{stage}.{}: {shared} bytes of workgroup memory", entry.name);
            let buffers = used(&|space| matches!(space, AddressSpace::Storage { .. })).len();
            assert!(buffers <= 8, "{stage}.{}: {buffers} storage buffers", entry.name);
        }
    }
}
