//! The simulated scenes, each with an arm and a depth camera on its flange.

use anyhow::{Context, Result};
use capture::config::Rig;
use capture::known_robots::KnownRobot;
use serde::Serialize;

/// The URDF of the robot in front of the cabinet.
const CABINET_URDF: &str = include_str!("../../../../rigs/robots/mobile-arm.urdf");
/// Lens and sensor of the camera. Small images are enough for a map of free space.
const CAMERA: &str = "driver = \"sim\"\nsize_px = [320, 240]\nrate_hz = 10\n\
                      exposure_micros = 1000\nreadout_micros = 15000\nparent = \"flange\"\n";
const INTRINSICS: &str = "intrinsics = { focal_px = [307.3, 307.1], principal_px = [161.9, 118.2], \
                          lens = \"pinhole\" }\n";
const DEPTH: &str = "[camera.wrist.depth]\nmin_m = 0.1\nmax_m = 6.0\n";

/// A simulated scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum GoalScene {
    /// A Panda at a table with objects.
    Table,
    /// A Panda on a base that stands in front of an open cabinet.
    Cabinet,
    /// A UR5e at the table with objects.
    OtherArm,
}

impl GoalScene {
    /// All scenes.
    pub const ALL: [Self; 3] = [Self::Table, Self::Cabinet, Self::OtherArm];

    /// Description for tables.
    #[must_use]
    pub fn title(self) -> &'static str {
        match self {
            Self::Table => "Panda at a table",
            Self::Cabinet => "Panda at a cabinet",
            Self::OtherArm => "UR5e at a table",
        }
    }

    /// Time at which the base stands still, seconds. Before, it walks to its station.
    pub(super) fn rests_from_secs(self) -> f64 {
        match self {
            Self::Table | Self::OtherArm => 0.0,
            Self::Cabinet => 19.5,
        }
    }

    /// Duration of the tour from which the first map is made, seconds.
    pub(super) fn tour_secs(self) -> f64 {
        self.rests_from_secs() + 40.0
    }

    /// The rig, without noise.
    ///
    /// # Errors
    ///
    /// If its text is invalid.
    pub(super) fn rig(self) -> Result<Rig> {
        let (arm, urdf) = match self {
            Self::Table => of_known("panda")?,
            Self::OtherArm => of_known("ur5e")?,
            Self::Cabinet => (
                "urdf = \"mobile-arm\"\nbase_link = \"base\"\nflange_link = \"panda_link8\"\n"
                    .to_owned(),
                CABINET_URDF,
            ),
        };
        let (base, scene) = match self {
            Self::Table | Self::OtherArm => ("", "static-arm"),
            Self::Cabinet => ("[base]\ndriver = \"sim\"\nrate_hz = 100\n", "mobile-arm"),
        };
        let pose = match self {
            // The cameras of the scenes, 50 and 80 degrees from the axis of the flange.
            Self::Table => {
                "xyz_m = [0.06, 0.0, 0.045], quat_xyzw = [0.29883623873011983, \
                 0.29883623873011983, 0.6408563820557885, 0.6408563820557885]"
            }
            Self::Cabinet => {
                "xyz_m = [0.06, 0.0, 0.045], quat_xyzw = [0.45451947767204365, \
                 0.45451947767204365, 0.5416752204197018, 0.5416752204197018]"
            }
            Self::OtherArm => "xyz_m = [0.0, 0.06, 0.04], quat_xyzw = [0.0, 0.0, 0.0, 1.0]",
        };
        let text = format!(
            "[arm]\ndriver = \"sim\"\n{arm}{base}[camera.wrist]\n{CAMERA}\
             parent_from_camera = {{ {pose} }}\n{INTRINSICS}{DEPTH}\
             [sim]\nscene = {scene:?}\nseed = 1\nideal = true\ntruth = false\nlockstep = true\n"
        );
        Rig::parse("rig.toml", &text, urdf, &[]).context("the rig of the bench")
    }
}

/// The keys and the URDF of a robot of the program.
fn of_known(name: &str) -> Result<(String, &'static str)> {
    let robot = KnownRobot::find(name).context("a robot of the program is missing")?;
    let keys = format!(
        "urdf = {:?}\nbase_link = {:?}\nflange_link = {:?}\n",
        robot.name, robot.base_link, robot.flange_link
    );
    Ok((keys, robot.urdf))
}
