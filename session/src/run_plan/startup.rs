//! Shows viewers what a run prepares before its models are trained.

use capture::config::{ArmDriver, Rig};
use messages::counted;
use trainer::ModelKind;
use viz::{Hub, ModelStatus, StateProgress, Status};

/// Publishes the first status of a run, with the models that it will train.
pub(super) fn publish(hub: &Hub, kinds: &[ModelKind]) {
    let mut models = kinds.iter().map(|kind| ModelStatus {
        method: kind.name().to_owned(),
        primitives_label: kind.entry().primitives_label.to_owned(),
        has_chunks: kind.entry().has_chunks,
        ..ModelStatus::default()
    });
    hub.set_status(Status {
        state: "starting".to_owned(),
        model: models.next().unwrap_or_default(),
        others: models.collect(),
        ..Status::default()
    });
}

/// Publishes what is being prepared.
pub(super) fn show(hub: &Hub, state: &str, text: String) {
    let progress = StateProgress {
        text,
        ..StateProgress::default()
    };
    hub.set_state_and_progress(state, Some(progress.at_startup()));
}

/// The devices of a rig in a few words.
pub(super) fn devices(rig: &Rig) -> String {
    let mut devices = Vec::new();
    if rig.arm.driver != ArmDriver::None {
        devices.push("the arm".to_owned());
    }
    if rig.has_moving_base() {
        devices.push("the moving base".to_owned());
    }
    for (n, item) in [
        (rig.cameras.len(), "camera"),
        (rig.scanners.len(), "range scanner"),
    ] {
        if n > 0 {
            devices.push(counted(n as u64, item));
        }
    }
    devices.join(", ")
}
