//! What can be wrong with a RealSense camera, and what to do about it.

use std::path::PathBuf;
use std::time::Duration;

/// What is wrong with a RealSense camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The library does not work at all.
    #[error("librealsense2 refuses to {what}: {reason}")]
    Library {
        /// What was asked of it.
        what: &'static str,
        /// What it says.
        reason: String,
    },
    /// None is plugged in, or not this one.
    #[error(
        "no RealSense camera {}is plugged in; there {}",
        if serial.is_empty() { String::new() } else { format!("with the serial number {serial:?} ") },
        if connected.is_empty() { "is none at all (`lsusb -d 8086:` shows them; udev rules of the SDK let them be opened)".to_owned() }
        else { format!("are {}", connected.join(", ")) }
    )]
    NoDevice {
        /// Serial number of the rig file; empty where it names none.
        serial: String,
        /// Names and serial numbers of those that are.
        connected: Vec<String>,
    },
    /// Several are plugged in and the rig file does not say which.
    #[error("several RealSense cameras are plugged in, write device = \"SERIAL\" with one of: {}", connected.join(", "))]
    Ambiguous {
        /// Names and serial numbers.
        connected: Vec<String>,
    },
    /// A recorded file cannot be played.
    #[error("cannot play {path:?}: {reason}")]
    File {
        /// The file.
        path: PathBuf,
        /// What the library says.
        reason: String,
    },
    /// It does not offer what is asked for.
    #[error("it does not offer {requested}; it offers {offered}")]
    NoMode {
        /// Stream, size and rate of the rig file.
        requested: String,
        /// All that it has of that stream.
        offered: String,
    },
    /// A setting is not there.
    #[error("it has no {setting}: leave the key out")]
    NoSetting {
        /// Name of the key.
        setting: &'static str,
    },
    /// The rig file sets something to a value that the camera does not know.
    #[error("{setting} is {requested}, it takes {allowed}")]
    SettingRange {
        /// Name of the key.
        setting: &'static str,
        /// Asked for, in the units of the key.
        requested: String,
        /// What there is.
        allowed: String,
    },
    /// It took a setting and tells another one.
    #[error("{setting} was set to {requested} and reads {got}")]
    ReadBack {
        /// Name of the key.
        setting: &'static str,
        /// What was set, in the camera's units.
        requested: f32,
        /// What it tells.
        got: f32,
    },
    /// Its lens is not one of ours.
    #[error("its {stream} has the lens model {model}, which is not read here")]
    Lens {
        /// Which stream.
        stream: &'static str,
        /// What the library calls the model.
        model: String,
    },
    /// It sends nothing.
    #[error("it sent no image for {waited:?}")]
    Silent {
        /// How long.
        waited: Duration,
    },
    /// It went away, or hung, and did not come back in time.
    #[error("it was lost, and not there again after {waited:?}, {n_tries} tries and {n_resets} resets: {last}")]
    Lost {
        /// Since when.
        waited: Duration,
        /// How often it was tried.
        n_tries: u32,
        /// How often it was reset.
        n_resets: u32,
        /// What came of the last try.
        last: Box<Self>,
    },
}
