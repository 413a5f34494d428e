//! Describes what a run opens. Opening the devices can take ten seconds, and the terminal would
//! otherwise show nothing until then.

use super::RunInput;
use capture::config::{ArmDriver, Rig};
use messages::{counted, listed};

/// The rig and the source of its samples in one line.
pub(super) fn describe(rig_name: &str, rig: &Rig, input: &RunInput) -> String {
    let cameras: Vec<&str> = rig.cameras.iter().map(|camera| &*camera.name).collect();
    let mut parts = vec![format!(
        "{} ({})",
        counted(cameras.len() as u64, "camera"),
        listed(&cameras, "and")
    )];
    if !rig.scanners.is_empty() {
        parts.push(counted(rig.scanners.len() as u64, "range scanner"));
    }
    if rig.arm.driver != ArmDriver::None {
        parts.push("an arm".to_owned());
    }
    if rig.has_moving_base() {
        parts.push("a moving base".to_owned());
    }
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    let source = match input {
        RunInput::Recording { path, .. } => format!(", played from {}", path.display()),
        RunInput::Devices {
            is_simulated: true, ..
        } => ", simulated".to_owned(),
        RunInput::Devices { .. } => String::new(),
    };
    format!("rig {rig_name}: {}{source}", listed(&parts, "and"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rig_and_source_are_named() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs");
        let devices = |is_simulated| RunInput::Devices {
            is_simulated,
            is_lockstep: false,
        };
        let recording = RunInput::Recording {
            path: "scan.mcap".into(),
            is_real_time: false,
            is_repeated: false,
        };
        for (name, input, words) in [
            (
                "static-arm",
                devices(true),
                "1 camera (wrist) and an arm, simulated",
            ),
            ("static-arm", devices(false), "1 camera (wrist) and an arm"),
            (
                "static-arm",
                recording,
                "1 camera (wrist) and an arm, played from scan.mcap",
            ),
        ] {
            let file = folder.join(format!("{name}.toml"));
            let rig = Rig::load(&file, &[]).expect("a rig of this repository");
            assert_eq!(describe(name, &rig, &input), format!("rig {name}: {words}"));
        }
    }
}
