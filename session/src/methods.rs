//! Names and kinds of models, as given on the command line and in rig files.

use crate::run_folder::{expect_model, expect_one_model};
use capture::Rig;
use gpu::Gpu;
use messages::listed;
use std::path::Path;
use std::sync::Arc;
use trainer::{LoadedModel, ModelKind};

/// Lists kinds in prose: `splat`, `tsdf and splat`, `tsdf, nerf and splat`.
pub fn describe(kinds: &[ModelKind]) -> String {
    listed(
        &kinds.iter().map(|kind| kind.name()).collect::<Vec<_>>(),
        "and",
    )
}

/// The kind of the model at a path; `None` if there is no model.
///
/// # Errors
///
/// If the folder contains several models, or its `model.json` is invalid.
pub fn kind_of(path: &Path) -> anyhow::Result<Option<ModelKind>> {
    expect_one_model(path)?;
    Ok(ModelKind::of_saved(path)?)
}

/// Loads a saved model of any kind from its folder, or splats from a file. An empty model causes a
/// warning.
pub fn load(gpu: Arc<Gpu>, model: &Path) -> anyhow::Result<LoadedModel> {
    expect_model(model)?;
    let loaded = trainer::load(gpu, model)?;
    if let Some(note) = note_if_empty(model, &loaded) {
        log::warn!("{note}");
    }
    Ok(loaded)
}

/// A note about a model that contains nothing to render; `None` for other models.
///
/// * `path`: path of the model.
#[must_use]
pub fn note_if_empty(path: &Path, model: &LoadedModel) -> Option<String> {
    let is_empty = model.method.model().progress().primitives == 0;
    is_empty.then(|| empty_note(path, model.kind))
}

fn empty_note(path: &Path, kind: ModelKind) -> String {
    let primitives = kind.entry().primitives_label.to_lowercase();
    format!(
        "{} contains no {primitives}: its pictures show only the background",
        path.display()
    )
}

/// The methods listed in a rig file.
///
/// # Errors
///
/// If a method is unknown.
pub fn methods_of(rig: &Rig) -> anyhow::Result<Vec<ModelKind>> {
    let known: Vec<_> = ModelKind::ALL
        .iter()
        .map(|kind| (kind.name(), *kind))
        .collect();
    Ok(rig.train.methods.resolve(&known)?)
}

/// The methods in a list of names, separated by commas.
///
/// # Errors
///
/// A message, if a name is unknown or listed twice.
pub fn methods_in(text: &str) -> Result<Vec<ModelKind>, String> {
    let mut kinds = Vec::new();
    for name in text.split(',') {
        let kind = ModelKind::from_name(name).ok_or_else(|| {
            let known: Vec<&str> = ModelKind::ALL.iter().map(|kind| kind.name()).collect();
            format!("unknown method {name:?}, expected {}", listed(&known, "or"))
        })?;
        // Two models of one method would share a folder.
        if kinds.contains(&kind) {
            return Err(format!("{name} is listed twice"));
        }
        kinds.push(kind);
    }
    Ok(kinds)
}

/// Why there is no model of the requested method among these.
pub(crate) fn unknown(kinds: impl Iterator<Item = ModelKind>, requested: Option<&str>) -> String {
    let names = kinds.map(ModelKind::name).collect::<Vec<_>>().join(" or ");
    format!(
        "no model with the method {:?}; use {names}",
        requested.unwrap_or_default()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn note_names_the_empty_model() {
        let note = empty_note(Path::new("splats.ply"), ModelKind::default());
        assert_eq!(
            note,
            "splats.ply contains no splats: its pictures show only the background"
        );
    }

    #[test]
    fn listed_methods_are_known_and_distinct() {
        let kind = |name| ModelKind::from_name(name).expect("registered");
        assert_eq!(
            methods_in("tsdf,splat"),
            Ok(vec![kind("tsdf"), kind("splat")])
        );
        for (text, message) in [
            ("mesh", "\"mesh\""),
            ("splat,splat", "listed twice"),
            ("splat,", "\"\""),
            ("", "\"\""),
        ] {
            assert!(
                methods_in(text).is_err_and(|error| error.contains(message)),
                "{text}"
            );
        }
    }

    #[test]
    fn names_are_listed_in_prose() {
        assert_eq!(describe(&ModelKind::ALL[..1]), "splat");
        assert_eq!(describe(ModelKind::ALL), "splat, tsdf and nerf");
    }
}
