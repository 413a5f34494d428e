//! Photographs of saved models for viewers, from the keyframes in the folder of a run.

use crate::stored_keyframes::StoredKeyframes;
use keyframe::Keyframe;
use kinematics::{Stamp, Transform};
use std::path::Path;
use std::sync::Arc;
use viz::Hub;

/// Lets clients see the stored keyframes of models, if there are any.
///
/// * `models`: folders or files of the models.
/// * `model_from_page`: pose of the page's world in the world of the models.
pub(crate) fn serve_stored<'a>(
    hub: &Hub,
    models: impl Iterator<Item = &'a Path>,
    model_from_page: &Transform,
) {
    // If several models were trained at once, each model has its own subfolder in the folder of the
    // run.
    let folders = models.flat_map(|model| std::iter::once(model).chain(model.parent()));
    let mut stored = folders.map(StoredKeyframes::of_run);
    let Some(stored) = stored.find(StoredKeyframes::exist) else {
        return;
    };
    let page_from_model = model_from_page.inverse();
    hub.keyframes()
        .set_reader(Arc::new(move |camera: &str, stamp: Stamp| {
            let keyframe = stored.read_one(camera, stamp);
            let in_page = |keyframe: Keyframe| Keyframe {
                world_from_camera: page_from_model * keyframe.world_from_camera,
                ..keyframe
            };
            keyframe
                .map(|keyframe| keyframe.map(in_page))
                .map_err(|error| format!("{error:#}"))
        }));
}
