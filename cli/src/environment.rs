//! What the environment says; the libraries do not read it.

use trackersplat_coordinator::StoreOptions;

/// How object stores are reached. Variables that are no text are none of theirs.
pub(crate) fn stores() -> StoreOptions {
    let text = |(name, value): (std::ffi::OsString, std::ffi::OsString)| {
        Some((name.into_string().ok()?, value.into_string().ok()?))
    };
    StoreOptions::from_variables(std::env::vars_os().filter_map(text))
}
