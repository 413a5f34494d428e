//! Names and options of models, as given on the command line and in rig files.

use crate::run_folder::{expect_model, expect_one_model};
use capture::Rig;
use capture::config::Train;
use gpu::Gpu;
use messages::{BadInput, listed};
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;
use trainer::{CommonOptions, LoadedModel, ModelKind, ModelSpec};

/// Names and values of options that only some methods have.
pub type Settings = Vec<(&'static str, Value)>;

/// Maximum number of splats.
pub const MAX_SPLATS: &str = "max_splats";
/// How the number of splats is chosen.
pub const COUNT: &str = "count";
/// Degree of the spherical harmonics.
pub const SH_DEGREE: &str = "sh_degree";

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

/// Options from a rig file. `steps` is the number of training steps, if known in advance.
pub fn options(train: &Train, steps: Option<u64>) -> (CommonOptions, Settings) {
    let defaults = CommonOptions::default();
    let common = CommonOptions {
        seed: train.seed,
        max_bytes: train.max_bytes,
        n_planned_steps: steps.unwrap_or(defaults.n_planned_steps),
        ..defaults
    };
    let max_splats = train.max_splats.map(|n| (MAX_SPLATS, n.into()));
    (
        common,
        max_splats
            .into_iter()
            .chain([(SH_DEGREE, train.sh_degree.into())])
            .collect(),
    )
}

/// One model spec per kind. Each gets the common options and those `settings` that its method has.
pub fn specs(
    kinds: &[ModelKind],
    common: &CommonOptions,
    settings: &Settings,
) -> anyhow::Result<Vec<ModelSpec>> {
    // Options that a method does not have are skipped, so that one list serves a run of several
    // methods. Flags that no method has were rejected before.
    let spec = |kind: &ModelKind| ModelSpec::new(*kind, common.clone(), settings);
    kinds
        .iter()
        .map(spec)
        .collect::<Result<_, _>>()
        .map_err(|error| BadInput(error.to_string()).into())
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
    fn every_setting_belongs_to_a_method() {
        for name in [MAX_SPLATS, COUNT, SH_DEGREE] {
            assert!(
                ModelKind::ALL.iter().any(|kind| kind.has_option(name)),
                "{name}"
            );
        }
        assert!(
            !ModelKind::ALL
                .iter()
                .any(|kind| kind.has_option("max-splats"))
        );
    }

    #[test]
    fn note_names_the_empty_model() {
        let note = empty_note(Path::new("splats.ply"), ModelKind::default());
        assert_eq!(
            note,
            "splats.ply contains no splats: its pictures show only the background"
        );
    }

    #[test]
    fn names_are_listed_in_prose() {
        assert_eq!(describe(&ModelKind::ALL[..1]), "splat");
        assert_eq!(describe(ModelKind::ALL), "splat, tsdf and nerf");
    }
}
