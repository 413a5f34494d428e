//! Errors of simulated rigs.

/// Errors of simulated rigs.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A number in the configuration is out of range.
    #[error("{of}: {key} is {got}, must be {lower} to {upper}")]
    OutOfRange {
        /// Camera or part of the rig.
        of: String,
        /// Key of the number.
        key: &'static str,
        /// Value found.
        got: f64,
        /// Minimum.
        lower: f64,
        /// Maximum.
        upper: f64,
    },
    /// The configuration names a different number of joints than the arm has.
    #[error("the simulated arm has {expected} joints, but {got} names were given")]
    NJoints {
        /// Number of names given.
        got: usize,
        /// Number of joints of the arm.
        expected: usize,
    },
    /// The reading order contains a joint that the arm does not have.
    #[error("the simulated arm has no joint {joint:?}, its joints are: {}", .known.join(", "))]
    UnknownJoint {
        /// Name given.
        joint: String,
        /// Names of the arm's joints.
        known: Vec<String>,
    },
    /// The configuration has no cameras.
    #[error("a simulated rig needs at least one camera")]
    NoCamera,
    /// A camera is attached to the flange of a robot without an arm.
    #[error(
        "camera {camera:?} has the parent flange, but the simulated robot has no moving joints: set its parent to base \
         or world, or check arm.flange_link"
    )]
    NoFlange {
        /// Name of the camera.
        camera: String,
    },
    /// A target that is moved by hand has no camera, or the rig has range scanners.
    #[error(
        "{target}.moved_before: a target that is moved by hand needs a simulated camera, and a rig without range \
         scanners"
    )]
    TargetInHand {
        /// Name of the target.
        target: String,
    },
    /// The robot of the scene has no arm to move.
    #[error("the robot of this scene has no arm")]
    NoArm,
    /// The emulated motors no longer report their positions.
    #[error("the emulated motors of the simulated arm have stopped")]
    MotorsStopped,
    /// The arm cannot be moved within the given limits.
    #[error("the simulated arm cannot be moved: {reason}")]
    Motion {
        /// Cause.
        reason: String,
    },
    /// Two devices of the same kind have the same name.
    #[error("two {devices} are named {name:?}")]
    DuplicateName {
        /// Kind of the devices, in the plural.
        devices: &'static str,
        /// The name.
        name: String,
    },
    /// A target is attached to the flange of a robot without an arm.
    #[error(
        "{target} is on the flange, but the robot of this scene has no arm: give world_from_board"
    )]
    TargetWithoutFlange {
        /// Name of the target in the rig file.
        target: String,
    },
    /// The specification of a printed target is invalid.
    #[error("sim.target.{target}.spec: {source}; correct this key in the rig file")]
    Target {
        /// Name of the target in the rig file.
        target: String,
        /// Cause.
        source: targets::SpecError,
    },
    /// A printed target cannot be drawn.
    #[error(
        "sim.target.{target}.spec: the target cannot be drawn: {source}; change the number or size of its squares or tags"
    )]
    DrawTarget {
        /// Name of the target in the rig file.
        target: String,
        /// Cause.
        source: targets::PrintError,
    },
    /// MuJoCo rejected the generated scene.
    #[error("MuJoCo rejected the scene: {reason}")]
    Scene {
        /// Message from MuJoCo.
        reason: String,
    },
    /// MuJoCo could not cast rays.
    #[error("MuJoCo could not cast rays: {reason}")]
    Rays {
        /// Message from MuJoCo.
        reason: String,
    },
    /// A generated texture or mesh cannot be encoded.
    #[error("cannot encode the texture {name:?}")]
    Texture {
        /// Name of the texture.
        name: String,
        /// Cause.
        source: image::ImageError,
    },
    /// The lens model has no ray for a pixel.
    #[error("camera {camera:?}: the lens model has no ray for pixel {pixel:?}")]
    Lens {
        /// Name of the camera.
        camera: String,
        /// The pixel.
        pixel: [f64; 2],
    },
    /// The arm's history does not reach back far enough.
    #[error("no joint reading around {nanos} ns of simulated time")]
    NoHistory {
        /// Simulated time.
        nanos: i64,
    },
    /// The EGL library is missing.
    #[error("cannot load libEGL.so.1 (Debian: libegl1 libegl-mesa0 libgl1-mesa-dri): {reason}")]
    NoEgl {
        /// Message from the loader.
        reason: String,
    },
    /// No EGL platform provides an OpenGL context without a display.
    #[error("no headless OpenGL context: {reason}")]
    NoContext {
        /// Result of each platform.
        reason: String,
    },
    /// The render thread stopped early.
    #[error("the render thread stopped: {reason}")]
    Stopped {
        /// Cause, if known.
        reason: String,
    },
    /// A thread cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The robot description of a rig file cannot be simulated.
    #[error("the robot description cannot be simulated: {0}")]
    Robot(#[source] kinematics::Error),
    /// The scene is made for another robot.
    #[error(
        "the scene {scene:?} is made for the arm in rigs/robots/mobile-arm.urdf, which differs from this robot: remove \
         sim.scene from the rig file, or set it to \"mobile-base\""
    )]
    SceneOfAnotherRobot {
        /// Name of the scene.
        scene: &'static str,
    },
    /// A camera cannot see the scene.
    #[error("camera {camera:?} cannot be simulated: {reason}; {remedy}")]
    CannotScan {
        /// Name of the camera.
        camera: String,
        /// Cause.
        reason: String,
        /// What to do.
        remedy: String,
    },
    /// The scan requires a pose that the arm cannot reach.
    #[error("the arm cannot reach the camera pose of the scan at {at_secs:.1} s")]
    Unreachable {
        /// Time in the scan, seconds.
        at_secs: f64,
    },
}
