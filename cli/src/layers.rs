//! Settings in layers: the quality's preset, then the settings file, then `--set`, then flags. Later ones win, and
//! every error names the key.

use std::path::Path;

use serde_json::Value;
use splat::{
    motion::LiftMethod,
    settings::{MotionSource, Quality, Settings},
};

use crate::error::CliError;

/// What the command line says about settings.
#[derive(Clone, Debug, Default)]
pub(crate) struct SettingsLayers<'a> {
    pub(crate) quality: Quality,
    pub(crate) file: Option<&'a Path>,
    /// `KEY=VALUE`, in order.
    pub(crate) assignments: &'a [String],
    pub(crate) motion: Option<MotionSource>,
    pub(crate) lift: Option<LiftMethod>,
    pub(crate) seed: Option<u64>,
}

impl SettingsLayers<'_> {
    /// The settings that all layers together make.
    pub(crate) fn resolve(&self) -> Result<Settings, CliError> {
        let preset = serde_json::to_value(Settings::preset(self.quality))
            .map_err(|error| CliError::failed("the preset's settings", error))?;
        let mut layered = Layered { tree: preset };
        if let Some(file) = self.file {
            layered.add_file(file)?;
        }
        for assignment in self.assignments {
            layered.assign(assignment)?;
        }
        let mut settings = layered.settings().map_err(|error| CliError::failed("the settings", error))?;
        settings.motion_source = self.motion.unwrap_or(settings.motion_source);
        settings.motion.lift = self.lift.unwrap_or(settings.motion.lift);
        settings.seed = self.seed.unwrap_or(settings.seed);
        Ok(settings)
    }
}

/// Complete settings as a tree of tables.
struct Layered {
    tree: Value,
}

impl Layered {
    fn settings(&self) -> Result<Settings, serde_json::Error> {
        serde_json::from_value(self.tree.clone())
    }

    fn add_file(&mut self, file: &Path) -> Result<(), CliError> {
        let name = file.display();
        let text = std::fs::read_to_string(file).map_err(|error| CliError::bad_input(&name, error))?;
        let table: toml::Table = toml::from_str(&text).map_err(|error| CliError::bad_input(&name, error))?;
        let table = serde_json::to_value(table).map_err(|error| CliError::bad_input(&name, error))?;
        self.overlay(&mut Vec::new(), table).map_err(|error| CliError::bad_input(&name, error))
    }

    fn assign(&mut self, assignment: &str) -> Result<(), CliError> {
        let failed = |why: String| CliError::bad_input(format!("--set {assignment}"), why);
        let (key, value) =
            assignment.split_once('=').ok_or_else(|| failed("write KEY=VALUE, as in --set seed=7".into()))?;
        let path: Vec<String> = key.trim().split('.').map(str::to_owned).collect();
        self.put(&path, parse_value(value.trim())).map_err(failed)
    }

    /// Puts every leaf of a table at its place.
    fn overlay(&mut self, path: &mut Vec<String>, value: Value) -> Result<(), String> {
        let is_section = path.is_empty() || self.find(path)?.is_object();
        match value {
            Value::Object(table) if is_section => {
                for (key, value) in table {
                    path.push(key);
                    self.overlay(path, value)?;
                    path.pop();
                }
                Ok(())
            }
            value => self.put(path, value),
        }
    }

    /// Replaces one setting and checks it at once, so that the error can name it.
    fn put(&mut self, path: &[String], value: Value) -> Result<(), String> {
        let place = self.find(path)?;
        if place.is_object() && !value.is_object() {
            return Err(format!("'{}' is a section; set one of: {}", path.join("."), keys(place)));
        }
        let shown = value.to_string();
        *place = value;
        self.settings().map(|_| ()).map_err(|error| format!("'{}' = {shown}: {error}", path.join(".")))
    }

    fn find(&mut self, path: &[String]) -> Result<&mut Value, String> {
        let mut place = &mut self.tree;
        for (depth, key) in path.iter().enumerate() {
            let known = keys(place);
            place = place.as_object_mut().and_then(|table| table.get_mut(key)).ok_or_else(|| {
                format!("unknown setting '{}'; known there: {known}", path[..=depth].join("."))
            })?;
        }
        Ok(place)
    }
}

fn keys(value: &Value) -> String {
    let Some(table) = value.as_object() else { return "no further keys".to_owned() };
    table.keys().map(String::as_str).collect::<Vec<_>>().join(", ")
}

/// A value as TOML has it (`7`, `0.5`, `true`, `[0, 0, 0]`, `"text"`); everything else is text.
fn parse_value(text: &str) -> Value {
    let document = format!("value = {text}");
    let parsed = toml::from_str::<toml::Table>(&document).ok().filter(|table| table.len() == 1);
    let value =
        parsed.and_then(|mut table| table.remove("value")).and_then(|value| serde_json::to_value(value).ok());
    value.unwrap_or_else(|| Value::String(text.to_owned()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn resolve(file: Option<&str>, assignments: &[&str]) -> Result<Settings, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("settings.toml");
        if let Some(text) = file {
            std::fs::write(&path, text).unwrap();
        }
        let assignments: Vec<String> = assignments.iter().map(|&text| text.to_owned()).collect();
        let layers = SettingsLayers {
            file: file.is_some().then_some(path.as_path()),
            assignments: &assignments,
            ..SettingsLayers::default()
        };
        layers.resolve().map_err(|error| {
            assert_eq!(error.exit_code(), 3, "{error}");
            error.to_string()
        })
    }

    #[test]
    fn without_layers_the_preset_stands() {
        for quality in [Quality::Draft, Quality::Balanced, Quality::Best] {
            let layers = SettingsLayers { quality, ..SettingsLayers::default() };
            assert_eq!(layers.resolve().unwrap(), Settings::preset(quality));
        }
    }

    #[test]
    fn later_layers_win() {
        let file = "seed = 3\nbackground = [1.0, 1.0, 1.0]\nmasks = \"train\"";
        let settings = resolve(Some(file), &["seed=4", "motion_source=none", "seed=5"]).unwrap();
        assert_eq!(settings.seed, 5);
        assert_eq!(settings.background, [1.0; 3]);
        assert_eq!(settings.masks, splat::settings::MaskUse::Train);
        assert_eq!(settings.motion_source, MotionSource::None);

        let assignments = ["seed=5", "motion_source=none", "motion.lift=reference"].map(str::to_owned);
        let flags = SettingsLayers {
            assignments: &assignments,
            motion: Some(MotionSource::Tracks),
            lift: Some(LiftMethod::Robust),
            seed: Some(6),
            ..SettingsLayers::default()
        };
        let settings = flags.resolve().unwrap();
        assert_eq!((settings.seed, settings.motion_source), (6, MotionSource::Tracks));
        assert_eq!(settings.motion.lift, LiftMethod::Robust);
    }

    #[test]
    fn an_unknown_key_is_named_with_its_neighbours() {
        let error = resolve(None, &["sede=3"]).unwrap_err();
        assert!(error.contains("'sede'") && error.contains("seed"), "{error}");
        let error = resolve(Some("[refine]\nno_such_key = 3"), &[]).unwrap_err();
        assert!(error.contains("'refine.no_such_key'") && error.contains("settings.toml"), "{error}");
        let error = resolve(None, &["seed.deeper=3"]).unwrap_err();
        assert!(error.contains("'seed.deeper'"), "{error}");
    }

    #[test]
    fn a_value_of_the_wrong_kind_names_its_key() {
        let error = resolve(None, &["seed=many"]).unwrap_err();
        assert!(error.contains("'seed'") && error.contains("many"), "{error}");
        let error = resolve(Some("background = [0.0, 0.0]"), &[]).unwrap_err();
        assert!(error.contains("'background'"), "{error}");
        let error = resolve(None, &["refine=3"]).unwrap_err();
        assert!(error.contains("'refine' is a section"), "{error}");
        let error = resolve(None, &["seed"]).unwrap_err();
        assert!(error.contains("KEY=VALUE"), "{error}");
    }

    #[test]
    fn a_file_that_is_no_toml_is_named() {
        let error = resolve(Some("seed = = 3"), &[]).unwrap_err();
        assert!(error.contains("settings.toml"), "{error}");
        let layers =
            SettingsLayers { file: Some(Path::new("/no/such/file.toml")), ..SettingsLayers::default() };
        assert!(layers.resolve().unwrap_err().to_string().contains("/no/such/file.toml"));
    }

    #[test]
    fn values_are_read_as_toml_and_else_as_text() {
        assert_eq!(parse_value("7"), serde_json::json!(7));
        assert_eq!(parse_value("0.5"), serde_json::json!(0.5));
        assert_eq!(parse_value("[0.0, 1.0]"), serde_json::json!([0.0, 1.0]));
        assert_eq!(parse_value("true"), serde_json::json!(true));
        assert_eq!(parse_value("\"7\""), serde_json::json!("7"));
        assert_eq!(parse_value("tracks"), serde_json::json!("tracks"));
        assert_eq!(parse_value("1\nother = 2"), serde_json::json!("1\nother = 2"));
    }
}
