//! Passes camera images to viewers.

use capture::{ImageObserver, ObservedImage, ObservedPixels};
use viz::{Hub, LiveImage, LivePixels};

/// An observer of a run's input that passes images to the clients of a hub.
pub struct Viewers(pub Hub);

impl ImageObserver for Viewers {
    fn needs_images(&self) -> bool {
        self.0.n_clients() > 0
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
}
