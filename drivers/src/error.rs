//! Errors of devices, recordings and datasets.

use kinematics::Stamp;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

/// Part of a recording that was written to the file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RecordedSpan {
    /// Number of readable samples.
    pub n_samples: u64,
    /// Time from the first to the last stamp, seconds.
    pub seconds: f64,
}

impl std::fmt::Display for RecordedSpan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.n_samples {
            0 => f.write_str("no samples were saved"),
            n_samples => write!(
                f,
                "the first {:.1} s ({n_samples} samples) are saved",
                self.seconds
            ),
        }
    }
}

/// An error of a device, recording or dataset.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A camera did not deliver an image in time.
    #[error("camera {camera:?}: no image within {waited:?}")]
    NoImage {
        /// Name in the rig file.
        camera: String,
        /// Time spent waiting.
        waited: Duration,
    },
    /// A V4L2 camera cannot be opened, or did not reconnect in time.
    #[cfg(target_os = "linux")]
    #[error("camera {camera:?}: {problem}")]
    V4l2 {
        /// Name in the rig file.
        camera: String,
        /// Description of the problem.
        problem: Box<crate::v4l2::Problem>,
    },
    /// A RealSense camera or one of its files cannot be opened, or the camera did not reconnect in
    /// time.
    #[error("camera {camera:?}: {problem}")]
    Realsense {
        /// Name in the rig file.
        camera: String,
        /// Description of the problem.
        problem: Box<crate::realsense::Problem>,
    },
    /// The recorded file that replaces a camera has ended.
    #[error("camera {camera:?}: its file has ended")]
    Ended {
        /// Name in the rig file.
        camera: String,
    },
    /// The next image of a recorded file is due later. A later call returns it.
    #[error("camera {camera:?}: the next image of its file is due in {remaining:?}")]
    NotDue {
        /// Name in the rig file.
        camera: String,
        /// Time until the image is due.
        remaining: Duration,
    },
    /// A simulated device delivers nothing yet, because the computer is too slow for the simulation
    /// to keep up with real time. A later call returns a sample.
    #[error("{device}: the simulation lags {lag:.1?} behind real time")]
    SimulationLags {
        /// The device.
        device: String,
        /// By how much the simulation is late.
        lag: Duration,
    },
    /// A nokhwa camera cannot be opened, or did not reconnect in time.
    #[cfg(feature = "nokhwa")]
    #[error("camera {camera:?}: {problem}")]
    Nokhwa {
        /// Name in the rig file.
        camera: String,
        /// Description of the problem.
        problem: Box<crate::nokhwa::Problem>,
    },
    /// A camera was disconnected and the driver is trying to reconnect. A later call may succeed.
    #[error("camera {camera:?}: disconnected for {waited:?}, trying to reconnect")]
    Reconnecting {
        /// Name in the rig file.
        camera: String,
        /// Time since the camera was disconnected.
        waited: Duration,
    },
    /// An arm did not deliver joint states in time.
    #[error("arm: no joint states within {waited:?}")]
    NoJoints {
        /// Time spent waiting.
        waited: Duration,
    },
    /// A base did not deliver a pose in time.
    #[error("base: no pose within {waited:?}")]
    NoBasePose {
        /// Time spent waiting.
        waited: Duration,
    },
    /// A range scanner did not deliver a scan in time.
    #[error("range scanner {scanner:?}: no scan within {waited:?}")]
    NoScan {
        /// Name of the scanner.
        scanner: String,
        /// Time spent waiting.
        waited: Duration,
    },
    /// A CAN interface is not configured as required.
    #[error("CAN interface {interface:?}: {problem}; fix it with: {command}")]
    CanLink {
        /// Name of the interface.
        interface: String,
        /// Description of the problem.
        problem: String,
        /// Shell command that fixes the problem.
        command: String,
    },
    /// A CAN interface does not exist, or reading or writing it failed.
    #[error("CAN interface {interface:?}: {reason}")]
    CanBus {
        /// Name of the interface.
        interface: String,
        /// Error of the operating system.
        reason: std::io::Error,
    },
    /// A motor does not answer, or answers unexpectedly.
    #[error("joint {joint:?} on {interface:?}: {reason}")]
    Motor {
        /// Joint that the motor moves.
        joint: String,
        /// Name of its CAN interface, or path of its serial port.
        interface: String,
        /// Description of the problem and how to fix it.
        reason: String,
    },
    /// An arm cannot be moved at all, or cannot be moved as requested.
    #[error("the arm cannot be moved: {reason}")]
    Motion {
        /// Description of the problem.
        reason: String,
    },
    /// A base cannot be driven.
    #[error("the base cannot be driven: {reason}")]
    BaseMotion {
        /// Description of the problem.
        reason: String,
    },
    /// A serial port cannot be opened, or was disconnected.
    #[error("serial port {device:?}: {reason}")]
    SerialPort {
        /// Path of the port.
        device: PathBuf,
        /// Description of the problem and how to fix it.
        reason: String,
    },
    /// An arm was disconnected and the driver is trying to reconnect. A later call may succeed.
    #[error("{device}: disconnected for {waited:?}, trying to reconnect")]
    ArmReconnecting {
        /// Name of the arm, with its port or address.
        device: String,
        /// Time since the arm was disconnected.
        waited: Duration,
    },
    /// A Franka arm refused the connection, does not match the rig file, or was disconnected.
    #[error("arm at {address}: {reason}")]
    Fci {
        /// Address of the robot controller.
        address: String,
        /// Description of the problem and how to fix it.
        reason: String,
    },
    /// An arm of Universal Robots refused the connection, does not match the rig file, or was
    /// disconnected.
    #[error("arm at {address}: {reason}")]
    Rtde {
        /// Address of the robot controller.
        address: String,
        /// Description of the problem and how to fix it.
        reason: String,
    },
    /// A simulated device failed.
    #[error("simulated rig: {reason}")]
    Simulation {
        /// Error of the simulator.
        reason: String,
    },
    /// The address of a network device is in use, or does not belong to this computer.
    #[error("{device}: cannot listen on {address}")]
    Listen {
        /// Name of the device.
        device: String,
        /// Address to listen on.
        address: SocketAddr,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Receiving from the network failed.
    #[error("{device}: cannot receive from the network")]
    Network {
        /// Name of the device.
        device: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The thread that reads a device cannot be started.
    #[error("cannot start the thread of {device}")]
    Thread {
        /// Name of the device.
        device: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file cannot be opened.
    #[error("cannot open {path:?}")]
    Open {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A compressed image cannot be decoded.
    #[error("camera {camera:?}: the image at {} ns does not decode", stamp.0)]
    Undecodable {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Error of the decoder.
        source: image::ImageError,
    },
    /// An image differs from the announced size.
    #[error("camera {camera:?}: the image at {} ns has {got_px:?} pixels, expected {expected_px:?}", stamp.0)]
    ImageSize {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Size in the data.
        got_px: [u32; 2],
        /// Size announced by the device.
        expected_px: [u32; 2],
    },
    /// An uncompressed image has too few or too many bytes.
    #[error("camera {camera:?}: the image at {} ns has {got_bytes} bytes, expected {expected_bytes} for its size and format", stamp.0)]
    ImageLength {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Number of bytes found.
        got_bytes: usize,
        /// Number of bytes expected.
        expected_bytes: usize,
    },
    /// A device uses a color encoding that is not supported.
    #[error(
        "V4L2 colorspace {colorspace} with Y'CbCr encoding {ycbcr_enc}: only BT.601 and BT.709 are supported"
    )]
    YuvColors {
        /// `enum v4l2_colorspace`.
        colorspace: u32,
        /// `enum v4l2_ycbcr_encoding`.
        ycbcr_enc: u32,
    },
    /// Color was requested from a depth image, or depth from a color image.
    #[error("camera {camera:?}: the image at {} ns contains no {expected}", stamp.0)]
    WrongKind {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// "color" or "depth".
        expected: &'static str,
    },
    /// The file is not a recording.
    #[error("{path:?} is not a recording: it does not start with the MCAP magic bytes")]
    NotARecording {
        /// The file.
        path: PathBuf,
    },
    /// The recording contains no samples of a rig.
    #[error(
        "the recording {path:?} contains no images or joint states recorded by this program{reason}"
    )]
    EmptyRecording {
        /// The file.
        path: PathBuf,
        /// A description of the file's damage or of its other contents. The text starts with a
        /// semicolon. It is empty if there is nothing to describe.
        reason: String,
    },
    /// The file for a new recording already exists.
    #[error("{path:?} exists already: choose a new file for the recording")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Writing a recording failed, for example because the disk is full.
    #[error("cannot write the recording {path:?}: {recorded}")]
    Record {
        /// The file.
        path: PathBuf,
        /// Part that can be read.
        recorded: RecordedSpan,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Reading a recording failed before its end.
    #[error("cannot read the recording {path:?}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The contents of a topic of a recording do not match its name.
    #[error("the recording {path:?}: topic {topic:?}: {reason}")]
    BrokenTopic {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Contents found and expected.
        reason: String,
    },
    /// A message of a recording cannot be decoded.
    #[error("the recording {path:?} contains a malformed message on {topic:?}")]
    BrokenMessage {
        /// The file.
        path: PathBuf,
        /// Topic of the message.
        topic: String,
        /// Error of the decoder.
        source: crate::wire::Malformed,
    },
    /// A folder is not a dataset.
    #[error(
        "{path:?} is not a dataset: expected transforms.json (nerfstudio) or rgb.txt (TUM RGB-D) in it{hint}"
    )]
    NotADataset {
        /// The folder.
        path: PathBuf,
        /// Names the recognized format of another program and says what to do. The hint is empty if
        /// no format was recognized.
        hint: String,
    },
    /// A dataset file is malformed or has invalid contents.
    #[error("{path:?}: {reason}")]
    DatasetFile {
        /// The file.
        path: PathBuf,
        /// Description of the problem, with the frame or line.
        reason: String,
    },
    /// No frame of a dataset can be used.
    #[error(
        "{path:?} contains no usable image: {n_missing} are missing, {n_unusable} cannot be used{first_reason}"
    )]
    EmptyDataset {
        /// The folder.
        path: PathBuf,
        /// Number of missing images.
        n_missing: usize,
        /// Number of images that are corrupt or have no pose.
        n_unusable: usize,
        /// The first unusable image and the reason, in parentheses. The text is empty if all images
        /// are usable.
        first_reason: String,
    },
    /// The lens parameters of a TUM folder are unknown.
    #[error(
        "{path:?}: no lens parameters: write fx fy cx cy [k1 k2 p1 p2 k3] to calibration.txt, or keep freiburg1, 2 or 3 in the folder name"
    )]
    NoIntrinsics {
        /// The folder.
        path: PathBuf,
    },
    /// An image of a dataset cannot be decoded.
    #[error("{path:?} does not decode")]
    DatasetImage {
        /// The file.
        path: PathBuf,
        /// Error of the decoder.
        source: image::ImageError,
    },
    /// An image of a dataset has a format that is known but cannot be read.
    #[error(
        "{path:?} is a {format} file; photos must be JPEG, PNG, WebP, TIFF or BMP, and depth 16-bit PNG or TIFF: convert it, for example with ImageMagick"
    )]
    ImageFormat {
        /// The file.
        path: PathBuf,
        /// Name of its format.
        format: &'static str,
    },
    /// An image of a dataset is too large for the memory of most computers.
    #[error("{path:?} has {}x{} pixels, which exceeds the maximum of {max_px}; resize the file, because images are scaled only after they are decoded", .got_px[0], .got_px[1])]
    TooManyPixels {
        /// The file.
        path: PathBuf,
        /// Width and height.
        got_px: [u32; 2],
        /// Maximum number of pixels.
        max_px: u64,
    },
    /// The size of an image or mask differs from that in the dataset.
    #[error("{path:?} has {got_px:?} pixels, expected {expected_px:?}")]
    DatasetImageSize {
        /// The file.
        path: PathBuf,
        /// Size in the file.
        got_px: [u32; 2],
        /// Size according to the dataset.
        expected_px: [u32; 2],
    },
    /// A depth image is not 16-bit grayscale.
    #[error("{path:?} is not a depth image: expected 16-bit grayscale")]
    NotDepth {
        /// The file.
        path: PathBuf,
    },
}
