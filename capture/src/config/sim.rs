//! The keys in `[sim]`.

use super::key::{Keys, entry, keys, table_of};
use super::section::Section;
use super::table_schema::{PLAIN_NAME, TableSchema};
use super::train::{DEFAULT_SEED, SEED_RANGE};
use kinematics::Transform;
use std::collections::BTreeMap;
use toml::{Table, Value};

keys! {
    /// Settings of the simulator, which is used with `--sim` and by drivers named `sim`.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Sim {
        /// Name of the scene. Without this key, a scene for the robot and its cameras.
        pub scene: Option<String>;
        /// Random seed of the simulation.
        pub seed: u64 = DEFAULT_SEED, in SEED_RANGE;
        /// Whether sensor imperfections and the drift of the base are off.
        pub ideal: bool = false;
        /// Whether the simulation waits for its consumer and always gives the same samples.
        pub lockstep: bool = false;
        /// Whether an arm that is moved with `--sim` keeps its driver. The driver then moves
        /// emulated motors in real time.
        pub emulate_arm: bool = false;
        /// Speed factor of the scanning motion.
        pub speed: f64 = 1.0, in 0.01..=2.0;
        /// Whether the camera rotates only about the vertical axis.
        pub azimuth_only: bool = false;
        /// Simulated time after which the samples end, seconds. Without this key, unlimited.
        pub duration_secs: Option<f64>, in 0.001..=1e6;
        /// Number of color images of the first camera after which the samples end. Without this key,
        /// unlimited.
        pub n_images: Option<u64>, in 1..=1_000_000_000;
        /// Whether ground truth is delivered with the images.
        pub truth: bool = true;
        /// Whether the ground truth includes depth without noise.
        pub truth_depth: bool = false;
        /// Brightness of the lights while a camera on the flange is inside the cabinet, relative to
        /// the brightness outside the cabinet.
        pub light_inside_frac: f64 = 1.0, in 0.0..=4.0;
        /// Printed calibration targets in the scene, by name.
        pub targets: BTreeMap<String, SimTarget> => BTreeMap::new();
    }

    /// The keys in `[sim.target.NAME]`.
    #[derive(Clone, Debug, PartialEq)]
    pub struct SimTarget {
        /// Specification of the target, such as `charuco:5x7:34mm:26mm:5X5_100`.
        pub spec: String, required "the target, such as \"charuco:5x7:34mm:26mm:5X5_100\"";
        /// Pose of the board frame: x points right on the print, y down, z into the board. Without
        /// this key, the target is on the flange.
        pub world_from_board: Option<Transform>;
        /// Pose of the board frame relative to the flange, for a board that the arm carries.
        pub flange_from_board: Option<Transform>;
        /// Camera in front of which a hand moves the board, as a person does who calibrates a lens.
        pub moved_before: Option<String>;
    }
}

/// Schema of the table.
pub(super) fn schema() -> TableSchema {
    let mut sim = table_of::<Sim>();
    let about = "Printed calibration targets in the scene. Each table has a name.";
    sim.named("target", about, PLAIN_NAME, table_of::<SimTarget>());
    sim
}

pub(super) fn read(mut keys: Section<'_>) -> Option<Sim> {
    let mut sim = Sim::read_keys(&mut keys)?;
    let named = keys
        .named_sections("target")
        .into_iter()
        .map(|(name, keys)| {
            keys.check_name(&name);
            Some((name, keys.read()?))
        });
    let targets = named.collect::<Vec<_>>();
    keys.end();
    sim.targets = targets.into_iter().collect::<Option<_>>()?;
    Some(sim)
}

pub(super) fn write(sim: &Sim) -> Table {
    let mut table = sim.write_keys();
    if !sim.targets.is_empty() {
        let targets = sim
            .targets
            .iter()
            .filter_map(|(name, target)| entry(name, target));
        table.insert("target".to_owned(), Value::Table(targets.collect()));
    }
    table
}
