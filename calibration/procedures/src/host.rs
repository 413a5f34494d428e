//! The interface between a calibration and the program that runs it. It covers stop requests,
//! progress, and views of camera images.

use calibration::{BoardView, LensCoverage};
use capture::Stop;
use capture::config::Camera;
use drivers::Image;
use session::ReadProgress;

/// An activity of a calibration that a user can stop.
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
    /// Starts listening for stop requests. It is called at most once, before an activity.
    ///
    /// # Errors
    /// Fails if the program cannot receive stop requests.
    fn stop_requests(&self, activity: Activity) -> anyhow::Result<Stop>;

    /// Reports how many images have been read or searched for the target. It is called from several
    /// threads.
    fn on_progress(&self, progress: ReadProgress);

    /// Reports that the items counted last are complete.
    fn on_progress_end(&self);

    /// Opens a view in which a user can watch the images of a camera during an activity. Dropping
    /// the view closes it.
    ///
    /// # Errors
    /// Fails if images cannot be shown as requested.
    fn open_view(&self, camera: &Camera, activity: Activity)
    -> anyhow::Result<Box<dyn CameraView>>;
}

/// Shows camera images and instructions to the user who moves the target or watches the arm.
pub trait CameraView {
    /// Shows an image of any camera of the rig.
    fn show_live(&mut self, image: &Image);

    /// Shows a gray image in which the target was searched, with the corners that were found.
    fn show_searched(&mut self, size_px: [u32; 2], gray: &[u8], view: Option<&BoardView>);

    /// Shows what the photographs of the target cover so far.
    fn show_coverage(&mut self, coverage: &LensCoverage);

    /// Shows an instruction or a status.
    fn advise(&mut self, text: &str);

    /// Shows that no more images are taken.
    fn finish(&mut self);
}
