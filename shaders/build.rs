//! Composes every stage with the shared modules that it imports, validates it against WebGPU's base capabilities, and
//! writes plain WGSL for `src/kernels.rs` to include; stages that are faster with subgroups a second time, as
//! `NAME_subgroups.wgsl`. A shader that is wrong fails the build with its file and line.

use std::{collections::HashMap, env, error::Error, fs, path::Path};

use naga::{
    back::wgsl::WriterFlags,
    valid::{Capabilities, ValidationFlags, Validator},
};
use naga_oil::compose::{ComposableModuleDescriptor, Composer, NagaModuleDescriptor, ShaderDefValue};

/// Modules that stages import; each after those that it imports itself.
const SHARED: [&str; 6] = ["types", "projection", "harmonics", "tiles", "footprint", "group_scan"];

/// Stages that have a form for devices with subgroups.
const WITH_SUBGROUPS: [&str; 2] = ["scan", "sort"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=wgsl");
    let out = env::var("OUT_DIR")?;
    let mut composer = Composer::default().with_capabilities(Capabilities::SUBGROUP);
    for name in SHARED {
        let path = format!("wgsl/shared/{name}.wgsl");
        let source = fs::read_to_string(&path)?;
        let descriptor =
            ComposableModuleDescriptor { source: &source, file_path: &path, ..Default::default() };
        if let Err(error) = composer.add_composable_module(descriptor) {
            return Err(error.emit_to_string(&composer).into());
        }
    }
    for entry in fs::read_dir("wgsl")? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "wgsl") {
            let name = path.file_stem().and_then(|stem| stem.to_str()).ok_or("a file without a name")?;
            let mut write = |form: &str, capabilities| -> Result<(), Box<dyn Error>> {
                let plain = compose(&mut composer, &path, capabilities)?;
                Ok(fs::write(Path::new(&out).join(format!("{name}{form}.wgsl")), plain)?)
            };
            write("", Capabilities::empty())?;
            if WITH_SUBGROUPS.contains(&name) {
                write("_subgroups", Capabilities::SUBGROUP)?;
            }
        }
    }
    Ok(())
}

/// The stage in plain WGSL, in the form for devices with these capabilities.
fn compose(
    composer: &mut Composer,
    path: &Path,
    capabilities: Capabilities,
) -> Result<String, Box<dyn Error>> {
    let source = fs::read_to_string(path)?;
    let file_path = path.to_str().ok_or("a path that is not Unicode")?;
    let mut shader_defs = HashMap::new();
    if capabilities.contains(Capabilities::SUBGROUP) {
        shader_defs.insert("SUBGROUPS".to_owned(), ShaderDefValue::Bool(true));
    }
    let descriptor = NagaModuleDescriptor { source: &source, file_path, shader_defs, ..Default::default() };
    let module = match composer.make_naga_module(descriptor) {
        Ok(module) => module,
        Err(error) => return Err(error.emit_to_string(composer).into()),
    };
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    let info = validator
        .validate(&module)
        .map_err(|error| format!("{file_path}: {}", error.emit_to_string_with_path(&source, file_path)))?;
    Ok(naga::back::wgsl::write_string(&module, &info, WriterFlags::empty())?)
}
