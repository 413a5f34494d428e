//! Training settings of rig files.

use capture::Rig;
use crate::Error;
use trainer::ModelKind;
use trainer::splat::SplatOptions;

/// The scene models that a rig file names.
///
/// # Errors
///
/// If it names an unknown one.
pub fn methods_of(rig: &Rig) -> crate::Result<Vec<ModelKind>> {
    Ok(rig.train.methods.resolve(&ModelKind::ALL.map(|kind| (kind.name(), kind)))?)
}

/// Trainer options from the settings in a rig file. `steps` is the number of steps if it is fixed in advance.
pub fn options_of(train: &capture::config::Train, steps: Option<u64>) -> Result<SplatOptions, Error> {
    let defaults = SplatOptions::default();
    let max_splats = train.max_splats.unwrap_or(defaults.max_splats.into());
    Ok(SplatOptions {
        seed: train.seed,
        max_splats: u32::try_from(max_splats)
            .map_err(|_| Error::BadInput(format!("max_splats = {max_splats}: must be at most {}", u32::MAX)))?,
        max_bytes: train.max_bytes,
        sh_degree: train.sh_degree,
        n_planned_steps: steps.unwrap_or(defaults.n_planned_steps),
        ..defaults
    })
}
