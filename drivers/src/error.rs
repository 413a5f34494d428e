//! What can go wrong with a device or a recording.

use kinematics::Stamp;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

/// How much of a recording has reached the file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RecordedSpan {
    /// Samples that can be read.
    pub n_samples: u64,
    /// From the first of their stamps to the last, seconds.
    pub seconds: f64,
}

impl std::fmt::Display for RecordedSpan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.n_samples {
            0 => f.write_str("nothing of it is kept"),
            n_samples => write!(f, "which keeps the first {:.1} s ({n_samples} samples)", self.seconds),
        }
    }
}

/// Errors of devices, recordings and datasets.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A camera stayed silent.
    #[error("camera {camera:?}: no image within {waited:?}")]
    NoImage {
        /// Name in the rig file.
        camera: String,
        /// How long the call waited.
        waited: Duration,
    },
    /// A V4L2 camera cannot be opened, or was lost for good.
    #[cfg(target_os = "linux")]
    #[error("camera {camera:?}: {problem}")]
    V4l2 {
        /// Name in the rig file.
        camera: String,
        /// What is wrong.
        problem: Box<crate::v4l2::Problem>,
    },
    /// A RealSense camera or a file of one cannot be opened, or was lost for good.
    #[error("camera {camera:?}: {problem}")]
    Realsense {
        /// Name in the rig file.
        camera: String,
        /// What is wrong.
        problem: Box<crate::realsense::Problem>,
    },
    /// The file that a camera was played from is at its end.
    #[error("camera {camera:?}: its file is at the end")]
    Ended {
        /// Name in the rig file.
        camera: String,
    },
    /// The next image of a file that a camera is played from is due later; asking again then gives it.
    #[error("camera {camera:?}: the next image of its file is due in {remaining:?}")]
    NotDue {
        /// Name in the rig file.
        camera: String,
        /// From now on.
        remaining: Duration,
    },
    /// A camera read by nokhwa cannot be opened, or was lost for good.
    #[cfg(feature = "nokhwa")]
    #[error("camera {camera:?}: {problem}")]
    Nokhwa {
        /// Name in the rig file.
        camera: String,
        /// What is wrong.
        problem: Box<crate::nokhwa::Problem>,
    },
    /// A camera was lost and is looked for; asking again may find it.
    #[error("camera {camera:?}: lost for {waited:?}, looking for it")]
    Reconnecting {
        /// Name in the rig file.
        camera: String,
        /// Since when.
        waited: Duration,
    },
    /// An arm stayed silent.
    #[error("arm: no joint readings within {waited:?}")]
    NoJoints {
        /// How long the call waited.
        waited: Duration,
    },
    /// A base stayed silent.
    #[error("base: no pose within {waited:?}")]
    NoBasePose {
        /// How long the call waited.
        waited: Duration,
    },
    /// A range scanner stayed silent.
    #[error("range scanner {scanner:?}: no scan within {waited:?}")]
    NoScan {
        /// Name of the scanner.
        scanner: String,
        /// How long the call waited.
        waited: Duration,
    },
    /// A CAN interface is not set up as it must be.
    #[error("CAN interface {interface:?}: {problem}; fix it with: {command}")]
    CanLink {
        /// Name of the interface.
        interface: String,
        /// What is wrong.
        problem: String,
        /// What a person types to mend it.
        command: String,
    },
    /// A CAN interface could not be read or written, or does not exist.
    #[error("CAN interface {interface:?}: {reason}")]
    CanBus {
        /// Name of the interface.
        interface: String,
        /// What the system said.
        reason: std::io::Error,
    },
    /// A motor does not answer, or not as it should.
    #[error("joint {joint:?} on {interface:?}: {reason}")]
    Motor {
        /// The joint that it moves.
        joint: String,
        /// The bus that it is on.
        interface: String,
        /// What is wrong, and what mends it.
        reason: String,
    },
    /// An arm cannot be moved, or not so.
    #[error("the arm is not moved: {reason}")]
    Motion {
        /// Why.
        reason: String,
    },
    /// A Franka arm does not let us in, is another than the rig file says, or was lost.
    #[error("arm at {address}: {reason}")]
    Fci {
        /// Of its controller.
        address: String,
        /// What is wrong, and what mends it.
        reason: String,
    },
    /// A simulated device failed.
    #[error("simulated rig: {reason}")]
    Simulation {
        /// What the simulator says.
        reason: String,
    },
    /// The address of a device that sends over the network is not free, or not of this computer.
    #[error("{device}: cannot listen on {address}")]
    Listen {
        /// Which device.
        device: String,
        /// The address.
        address: SocketAddr,
        /// Why.
        source: std::io::Error,
    },
    /// Nothing can be received any more.
    #[error("{device}: the network broke off")]
    Network {
        /// Which device.
        device: String,
        /// Why.
        source: std::io::Error,
    },
    /// A thread that reads a device cannot be started.
    #[error("cannot start the thread of {device}")]
    Thread {
        /// Which device.
        device: String,
        /// Why.
        source: std::io::Error,
    },
    /// A file cannot be opened.
    #[error("cannot open {path:?}")]
    Open {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A compressed image is broken.
    #[error("camera {camera:?}: the image at {} ns does not decode", stamp.0)]
    Undecodable {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Why.
        source: image::ImageError,
    },
    /// An image has another size than announced.
    #[error("camera {camera:?}: the image at {} ns is {got_px:?} pixels, announced were {expected_px:?}", stamp.0)]
    ImageSize {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Size in the file.
        got_px: [u32; 2],
        /// Size announced.
        expected_px: [u32; 2],
    },
    /// An uncompressed image has too few or too many bytes.
    #[error("camera {camera:?}: the image at {} ns has {got_bytes} bytes, its size and format need {expected_bytes}", stamp.0)]
    ImageLength {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// Bytes there.
        got_bytes: usize,
        /// Bytes needed.
        expected_bytes: usize,
    },
    /// A device tells colours that are not decoded.
    #[error("V4L2 colorspace {colorspace} with Y'CbCr encoding {ycbcr_enc}: only BT.601 and BT.709 are decoded")]
    YuvColors {
        /// `enum v4l2_colorspace`.
        colorspace: u32,
        /// `enum v4l2_ycbcr_encoding`.
        ycbcr_enc: u32,
    },
    /// Colour was asked of a depth image or depth of a colour image.
    #[error("camera {camera:?}: the image at {} ns holds no {expected}", stamp.0)]
    WrongKind {
        /// Name in the rig file.
        camera: String,
        /// Stamp of the image.
        stamp: Stamp,
        /// "color" or "depth".
        expected: &'static str,
    },
    /// A file that is no recording.
    #[error("{path:?} is not a recording: it does not begin like an MCAP file")]
    NotARecording {
        /// The file.
        path: PathBuf,
    },
    /// A recording that holds no sample of a rig.
    #[error("the recording {path:?} holds no images or joint readings of this program")]
    EmptyRecording {
        /// The file.
        path: PathBuf,
    },
    /// A recording was to be written over a file that is there.
    #[error("{path:?} exists already: a recording only goes into a new file")]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A recording cannot be written further, for instance because the disk is full.
    #[error("cannot write the recording {path:?}, {recorded}")]
    Record {
        /// The file.
        path: PathBuf,
        /// What of it can be read.
        recorded: RecordedSpan,
        /// Why.
        source: std::io::Error,
    },
    /// A recording cannot be read further for another reason than its end.
    #[error("cannot read the recording {path:?}")]
    Replay {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A message of a recording does not decode.
    #[error("the recording {path:?} holds a broken message on {topic:?}")]
    BrokenMessage {
        /// The file.
        path: PathBuf,
        /// Topic of the message.
        topic: String,
        /// Why.
        source: crate::wire::Malformed,
    },
    /// A folder is no dataset.
    #[error("{path:?} is not a dataset: it holds neither transforms.json (nerfstudio) nor rgb.txt (TUM RGB-D)")]
    NotADataset {
        /// The folder.
        path: PathBuf,
    },
    /// A file of a dataset does not say what it should.
    #[error("{path:?}: {reason}")]
    DatasetFile {
        /// The file.
        path: PathBuf,
        /// What is wrong, with the frame or line.
        reason: String,
    },
    /// No frame of a dataset can be used.
    #[error("{path:?} holds no usable image: {n_missing} are not there, {n_unusable} cannot be used{first_reason}")]
    EmptyDataset {
        /// The folder.
        path: PathBuf,
        /// Images that are not there.
        n_missing: usize,
        /// Images that are broken or have no pose.
        n_unusable: usize,
        /// The first of these and why, in brackets; empty when there is none.
        first_reason: String,
    },
    /// Nothing tells the lens parameters of a TUM folder.
    #[error(
        "{path:?}: no lens parameters: put fx fy cx cy [k1 k2 p1 p2 k3] into calibration.txt, or keep freiburg1, 2 or 3 in the name"
    )]
    NoIntrinsics {
        /// The folder.
        path: PathBuf,
    },
    /// An image of a dataset does not decode.
    #[error("{path:?} does not decode")]
    DatasetImage {
        /// The file.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
    /// An image of a dataset has another size than its frame.
    #[error("{path:?} is {got_px:?} pixels, expected {expected_px:?}")]
    DatasetImageSize {
        /// The file.
        path: PathBuf,
        /// Size in the file.
        got_px: [u32; 2],
        /// Size of the frame.
        expected_px: [u32; 2],
    },
    /// A depth image is not 16 bits of grey.
    #[error("{path:?} is no depth image: expected 16-bit grey")]
    NotDepth {
        /// The file.
        path: PathBuf,
    },
}
