//! Passes camera images, the motion of the robot and range scans to viewers.

use capture::{InputObserver, ObservedImage, ObservedPixels, ObservedRangeScan, ObservedRobot};
use viz::{Hub, LiveImage, LivePixels, RangeScan, RobotState};

/// An observer of a run's input that passes it to the clients of a hub.
pub struct Viewers(pub Hub);

impl InputObserver for Viewers {
    fn needs_images(&self) -> bool {
        self.0.needs_live_images()
    }

    fn observe(&self, image: ObservedImage) {
        self.0.set_live_image(LiveImage {
            camera: image.camera,
            stamp: image.stamp,
            captured_at: image.captured_at,
            size_px: image.size_px,
            pixels: match image.pixels {
                ObservedPixels::Jpeg(jpeg) => LivePixels::Jpeg(jpeg),
                ObservedPixels::Rgb(rgb) => LivePixels::Rgb(rgb),
            },
            world_from_camera: Some(image.world_from_camera),
            focal_px: image.focal_px,
            principal_px: image.principal_px,
        });
    }

    fn needs_robot(&self) -> bool {
        self.0.needs_robot_state()
    }

    fn observe_robot(&self, robot: ObservedRobot) {
        self.0.set_robot_state(RobotState {
            stamp: robot.stamp,
            captured_at: robot.captured_at,
            world_from_base: robot.world_from_base,
            positions: robot.positions,
        });
    }

    fn observe_range_scan(&self, observed: ObservedRangeScan) {
        self.0.set_range_scan(RangeScan {
            scan: observed.scan,
            map_from_odom: observed.map_from_odom,
        });
    }
}
