//! What can go wrong with a simulated rig.

/// Errors of simulated rigs.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A number of the configuration makes no sense.
    #[error("{of}: {key} is {got}, allowed are {lower} to {upper}")]
    OutOfRange {
        /// Camera or part of the rig.
        of: String,
        /// Name of the number.
        key: &'static str,
        /// What it is.
        got: f64,
        /// Smallest allowed.
        lower: f64,
        /// Largest allowed.
        upper: f64,
    },
    /// The arm has another number of joints.
    #[error("the simulated arm has {expected} joints, {got} names were given")]
    NJoints {
        /// Names given.
        got: usize,
        /// Joints of the arm.
        expected: usize,
    },
    /// A joint is to be read that the arm does not have.
    #[error("the simulated arm has no joint {joint:?}, its joints are: {}", .known.join(", "))]
    UnknownJoint {
        /// Name given.
        joint: String,
        /// Names of the arm's joints.
        known: Vec<String>,
    },
    /// Nothing to render.
    #[error("a simulated rig needs at least one camera")]
    NoCamera,
    /// There is no flange to fix a camera to.
    #[error("camera {camera:?} has the parent flange, but the robot of this scene has no arm")]
    NoFlange {
        /// Name of the camera.
        camera: String,
    },
    /// Two cameras cannot be told apart.
    #[error("two cameras are named {camera:?}")]
    DuplicateName {
        /// The name.
        camera: String,
    },
    /// MuJoCo does not accept the scene that was built.
    #[error("mujoco refuses the scene: {reason}")]
    Scene {
        /// What MuJoCo says.
        reason: String,
    },
    /// MuJoCo casts no rays.
    #[error("mujoco casts no rays: {reason}")]
    Rays {
        /// What MuJoCo says.
        reason: String,
    },
    /// A generated texture or mesh cannot be encoded.
    #[error("cannot encode the texture {name:?}")]
    Texture {
        /// Name of the texture.
        name: &'static str,
        /// Why.
        source: image::ImageError,
    },
    /// The lens shows nothing at a pixel.
    #[error("camera {camera:?}: the lens shows nothing at pixel {pixel:?}")]
    Lens {
        /// Name of the camera.
        camera: String,
        /// The pixel.
        pixel: [f64; 2],
    },
    /// The arm's past does not reach back far enough.
    #[error("no joint reading around {nanos} ns of simulated time")]
    NoHistory {
        /// Simulated time.
        nanos: i64,
    },
    /// The EGL library is missing.
    #[error("cannot load libEGL.so.1 (Debian: libegl1 libegl-mesa0 libgl1-mesa-dri): {reason}")]
    NoEgl {
        /// What the loader says.
        reason: String,
    },
    /// No EGL platform gives an OpenGL context without a display.
    #[error("no headless OpenGL context: {reason}")]
    NoContext {
        /// What each platform answered.
        reason: String,
    },
    /// The render thread ended early.
    #[error("the render thread stopped: {reason}")]
    Stopped {
        /// Why, as far as it is known.
        reason: String,
    },
    /// A thread cannot be started.
    #[error("cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The scan asks for a pose that the arm cannot take.
    #[error("the arm cannot look at the scene from the scan's position at {at_secs:.1} s")]
    Unreachable {
        /// Time in the scan, seconds.
        at_secs: f64,
    },
}
