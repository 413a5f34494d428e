//! What a calibration needs of the program that runs it: requests to stop, and someone to receive
//! its progress.

use calibration::BoardView;
use capture::Stop;
use capture::config::Camera;
use drivers::Image;
use session::ReadProgress;

/// What a calibration is about to do, and a user may stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activity {
    /// Images are read from a recording or from devices, until a stop is requested.
    ReadImages,
    /// An arm moves.
    MoveArm {
        /// Whether the arm is simulated, so that it cannot harm anyone.
        is_simulated: bool,
    },
}

/// The program that runs a calibration.
pub trait Host: Sync {
    /// Begins to listen for requests to stop; called at most once, before an activity.
    ///
    /// # Errors
    /// If the program cannot receive requests.
    fn stop_requests(&self, activity: Activity) -> anyhow::Result<Stop>;

    /// Images were read, or the target was searched in some of them. Called from several threads.
    fn on_progress(&self, progress: ReadProgress);

    /// No progress follows of the items that were counted last.
    fn on_progress_end(&self);

    /// Opens a view of a camera whose images are about to be taken from a device, by an activity
    /// that a user watches. It is closed when it is dropped.
    ///
    /// # Errors
    /// If images cannot be shown as requested.
    fn open_view(&self, camera: &Camera, activity: Activity)
    -> anyhow::Result<Box<dyn CameraView>>;
}

/// Shows a user who moves the target or the arm what the camera sees, and what to do next.
pub trait CameraView {
    /// Shows an image of any camera of the rig.
    fn show_live(&mut self, image: &Image);

    /// Shows a gray image in which the target was searched, with the corners that were found.
    fn show_searched(&mut self, size_px: [u32; 2], gray: &[u8], view: Option<&BoardView>);

    /// Shows what to do, or what happens.
    fn advise(&mut self, text: &str);

    /// Shows that no more images are taken.
    fn finish(&mut self);
}
