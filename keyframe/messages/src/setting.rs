//! Names of settings in messages. Users set options in different ways, for example with flags. A
//! program therefore defines how messages spell the names.

use std::fmt::{Display, Formatter, Result};
use std::sync::OnceLock;

/// Defines the settings with the names that the options have in the libraries.
macro_rules! settings {
    ($($(#[$doc:meta])* $name:ident = $option:literal,)*) => {
        /// An option that users can set and that messages name.
        ///
        /// ```
        /// use messages::Setting;
        ///
        /// // A program may spell the settings in another way: see `Setting::spell_as`.
        /// assert_eq!(format!("{}: must be above 0", Setting::MaxSplats), "max_splats: must be above 0");
        /// ```
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Setting {
            $($(#[$doc])* $name,)*
        }

        impl Setting {
            /// All settings.
            pub const ALL: &[Self] = &[$(Self::$name,)*];

            /// Name of the option in the libraries.
            const fn option(self) -> &'static str {
                match self {
                    $(Self::$name => $option,)*
                }
            }
        }
    };
}

settings! {
    /// Base link of a robot description.
    BaseLink = "base_link",
    /// Distances by which joints move from their positions.
    By = "by",
    /// Camera of a rig file to calibrate, or place of a camera.
    Camera = "camera",
    /// Camera path of rendered images.
    CameraPath = "camera_path",
    /// Width of the cells of a simplified mesh.
    CellM = "cell_m",
    /// Rule for the number of splats.
    Count = "count",
    /// Box outside of which a rendered scene is invisible.
    Crop = "crop",
    /// Model from which missing depth is rendered.
    DepthFrom = "depth_from",
    /// Kinds of disturbance that a bench measures.
    Disturb = "disturbances",
    /// Drift of the clock of a camera.
    DriftPpm = "drift_ppm",
    /// Confirmation that an arm may move.
    EnableMotion = "is_confirmed",
    /// Whether rendered images are panoramas.
    Equirect = "is_equirectangular",
    /// Horizontal field of view of a camera.
    FieldOfView = "field_of_view_deg",
    /// Constant latency of a camera.
    FixedMillis = "fixed_millis",
    /// Whether an existing file is replaced.
    Force = "can_replace",
    /// Address at which Foxglove gets the data of the page.
    Foxglove = "foxglove",
    /// Recording that replaces the devices.
    From = "recording",
    /// Selection of test images.
    Holdout = "holdout",
    /// Random latency of a camera.
    JitterMillis = "jitter_millis",
    /// List of the keyframes to use.
    Keyframes = "keyframes",
    /// Sizes of a disturbance.
    Levels = "levels",
    /// Address of the server.
    Listen = "listen",
    /// Whether a simulation waits for the trainer.
    Lockstep = "is_lockstep",
    /// Maximum GPU memory of a model.
    MaxBytes = "max_bytes",
    /// Maximum number of poses to which an arm moves.
    MaxPoses = "max_poses",
    /// Maximum number of splats.
    MaxSplats = "max_splats",
    /// How an arm moves during its calibration.
    Move = "motion",
    /// Variants that a bench trains.
    Only = "only",
    /// Folder of the results.
    Out = "out",
    /// Calibration parameters to estimate from a scene.
    Params = "params",
    /// Curves of other trainers.
    Peer = "peers",
    /// Picture of a rig.
    Picture = "picture",
    /// Viewpoint of a rendered image.
    Pose = "pose",
    /// Target positions of joints.
    Positions = "to",
    /// Images per second of a dataset.
    RateHz = "rate_hz",
    /// Images per second of simulated cameras.
    Rates = "rates_hz",
    /// Playback of a recording at the speed of its devices.
    RealTime = "real_time",
    /// File to which the data of the devices are recorded.
    Record = "record",
    /// Recovery of an arm that has stopped.
    Recover = "recover",
    /// Calibration parameters that training refines.
    Refine = "refine",
    /// Playback of a recording again and again.
    Repeat = "repeat",
    /// File of a calibration report.
    Report = "report",
    /// Folder of the run that training continues.
    Resume = "resume",
    /// Rig file that replaces the rig file stored in a recording.
    Rig = "rig",
    /// Known robot.
    Robot = "robot",
    /// Numbers of samples of a neural field.
    Samples = "n_samples",
    /// Fraction to which images are scaled.
    Scale = "scale",
    /// Folder for the photographs of a calibration.
    SaveImages = "save_images",
    /// Duration.
    Seconds = "seconds",
    /// Time at the start of a run that is not evaluated.
    SettleSeconds = "settle_seconds",
    /// Whether other machines may open the page.
    Share = "share",
    /// Simulation of the devices of a rig.
    Sim = "sim",
    /// Image sizes.
    Size = "sizes_px",
    /// Numbers of splats.
    Splats = "n_splats",
    /// Number of optimizer steps.
    Steps = "steps",
    /// Optimizer steps between two keyframes.
    StepsPerKeyframe = "steps_per_keyframe",
    /// Printed calibration target.
    Target = "target",
    /// Link of a robot description that is the flange.
    Tip = "tip",
    /// Format of an exported file.
    To = "format",
    /// Robot description.
    Urdf = "urdf",
    /// Whether a hand-eye calibration also estimates the lens.
    WithIntrinsics = "with_intrinsics",
    /// Whether a hand-eye calibration also estimates joint offsets.
    WithJoints = "with_joints",
    /// Rig file into which a result is written.
    WriteRig = "write_rig",
}

/// How the program spells a setting.
static SPELLER: OnceLock<fn(Setting) -> &'static str> = OnceLock::new();

impl Setting {
    /// Sets how [`Display`] writes settings in this program, for example as flags. Before the first
    /// call, [`Display`] writes the names that the options have in the libraries. Only the first
    /// call has an effect.
    pub fn spell_as(speller: fn(Self) -> &'static str) {
        let _ = SPELLER.set(speller);
    }
}

impl Display for Setting {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let spelled = SPELLER
            .get()
            .map_or(self.option(), |speller| speller(*self));
        f.write_str(spelled)
    }
}

#[cfg(test)]
mod tests {
    use super::Setting;

    #[test]
    fn a_program_spells_the_settings_once() {
        assert_eq!(Setting::MaxSplats.to_string(), "max_splats");
        Setting::spell_as(|setting| match setting {
            Setting::MaxSplats => "--max-splats",
            _ => "another flag",
        });
        Setting::spell_as(|_| "a later speller");
        assert_eq!(Setting::MaxSplats.to_string(), "--max-splats");
        assert_eq!(Setting::Out.to_string(), "another flag");
    }
}
