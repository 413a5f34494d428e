//! Passes camera images, the motion of the robot and range scans to viewers.

use capture::InputObserver;
use gpu::Gpu;
use viz::{Hub, LiveImage, RangeScan, RobotState};

/// An observer of a run's input that passes it to the clients of a hub.
pub struct Viewers(pub Hub);

impl InputObserver for Viewers {
    fn needs_images(&self) -> bool {
        self.0.needs_live_images()
    }

    fn observe(&self, image: LiveImage) {
        self.0.set_live_image(image);
    }

    fn needs_robot(&self) -> bool {
        self.0.needs_robot_state()
    }

    fn observe_robot(&self, state: RobotState) {
        self.0.set_robot_state(state);
    }

    fn observe_range_scan(&self, scan: RangeScan) {
        self.0.set_range_scan(scan);
    }
}

/// Notes about the GPU that the page shows to its viewers.
pub(crate) fn gpu_notes(gpu: &Gpu) -> Vec<String> {
    if gpu.is_software() {
        vec!["no GPU: kernels run on the CPU, which is slow".to_owned()]
    } else {
        Vec::new()
    }
}
