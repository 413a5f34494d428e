//! Shows the incidents of a steered run beside its saved models: the robot, and a list that the page
//! loads.

use crate::robot_meshes;
use crate::steering::steering_log;
use anyhow::Context;
use capture::config::Rig;
use drivers::recording::RIG_FILE;
use kinematics::{Transform, transform};
use std::fs::File;
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use viz::{Hub, ServedFile};

/// Name in the URL. The page shows a list of incidents if the server offers a file of this name.
const NAME: &str = "steering-incidents.json";

/// Publishes the robot of a steered run, and returns the file with its incidents; `None` if the
/// models are not those of a steered run.
///
/// * `models`: folders or files of the models.
/// * `model_from_page`: pose of the page's world in the world of the models.
pub(crate) fn publish(
    hub: &Hub,
    models: &[PathBuf],
    model_from_page: &Transform,
) -> Option<ServedFile> {
    let model = models.first().filter(|model| model.is_dir())?;
    let logs = steering_log::files_of(model).ok()?;
    if let Err(error) = publish_robot(hub, model) {
        log::warn!("incidents are shown without the robot: {error:#}");
    }
    let page_from_model = model_from_page.inverse();
    Some(ServedFile {
        name: NAME.to_owned(),
        label: "Steering incidents (JSON)".to_owned(),
        save_as: Some(NAME.to_owned()),
        open: Arc::new(move || {
            write(&logs, &page_from_model).map_err(|error| format!("{error:#}"))
        }),
    })
}

fn publish_robot(hub: &Hub, model: &Path) -> anyhow::Result<()> {
    let file = model.join(RIG_FILE);
    let rig = Rig::load(&file, &[])?;
    if let Some(robot) = robot_meshes::description(&rig)? {
        hub.set_robot(robot);
    }
    Ok(())
}

/// Writes the incidents to a temporary file, and opens it. A log may be long, so this is done when
/// a client asks for it.
fn write(logs: &[PathBuf], page_from_model: &Transform) -> anyhow::Result<File> {
    let mut incidents = steering_log::incidents(logs)?;
    incidents.world_from_base = in_page(page_from_model, incidents.world_from_base);
    for incident in &mut incidents.incidents {
        incident.view = incident.view.map(|view| in_page(page_from_model, view));
    }
    let mut file = tempfile::tempfile().context("cannot create a temporary file")?;
    file.write_all(&serde_json::to_vec(&incidents)?)?;
    file.rewind()?;
    Ok(file)
}

/// A pose in the world of the page.
fn in_page(page_from_model: &Transform, pose: [f64; 7]) -> [f64; 7] {
    transform::to_xyz_xyzw(&(page_from_model * transform::from_xyz_xyzw(pose)))
}
