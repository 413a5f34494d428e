//! The content of the web page while images of a target are taken. It shows the camera image, the
//! corners found so far, and the next instruction.

use crate::published_coverage::published;
use calibration::{BoardView, LensCoverage};
use capture::config::Camera;
use drivers::Image;
use kinematics::Stamp;
use std::sync::Arc;
use std::time::{Duration, Instant};
use viz::{Guidance, Hub, LiveImage, LivePixels, PhotographCoverage, Status};

/// Interval between live images.
const INTERVAL: Duration = Duration::from_millis(200);
/// Time for which an image with new corners is shown.
const DETECTED_FOR: Duration = Duration::from_millis(1200);
/// Colors of the corners of earlier images and of the newest image.
const EARLIER_SRGB: [u8; 3] = [227, 179, 65];
const NEWEST_SRGB: [u8; 3] = [76, 255, 140];

/// The page that guides a user through a calibration.
pub struct GuidancePage {
    hub: Hub,
    camera: Arc<str>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    began: Instant,
    /// Before this time, live images are not shown.
    next_live: Instant,
    n_views: u64,
    /// Corners of all images so far, pixels.
    corners_px: Vec<[f64; 2]>,
    /// What the photographs for a lens cover; `None` for other calibrations.
    coverage: Option<PhotographCoverage>,
    /// The instruction that is shown.
    text: String,
}

impl GuidancePage {
    /// The page for a camera.
    ///
    /// * `hub`: receives what the page shows.
    pub fn new(hub: Hub, camera: &Camera) -> Self {
        let began = Instant::now();
        Self {
            hub,
            camera: Arc::clone(&camera.name),
            focal_px: camera.intrinsics.focal_px,
            principal_px: camera.intrinsics.principal_px,
            began,
            next_live: began,
            n_views: 0,
            corners_px: Vec::new(),
            coverage: None,
            text: String::new(),
        }
    }

    /// Shows the next instruction.
    pub fn guide(&mut self, text: &str) {
        text.clone_into(&mut self.text);
        self.show_guidance();
    }

    /// Shows what the photographs cover.
    pub fn set_coverage(&mut self, coverage: &LensCoverage) {
        self.coverage = Some(published(&self.camera, coverage));
        self.show_guidance();
    }

    fn show_guidance(&self) {
        self.set_status(
            "calibrating",
            Guidance {
                text: self.text.clone(),
                is_finished: false,
                coverage: self.coverage.clone(),
            },
        );
    }

    /// Shows that no more images are taken. Clients keep this text when the server stops.
    pub fn finish(&self) {
        let text = format!(
            "{} images of the target were taken; the result is in the terminal",
            self.n_views
        );
        self.set_status(
            "finished",
            Guidance {
                text,
                is_finished: true,
                coverage: self.coverage.clone(),
            },
        );
    }

    fn set_status(&self, state: &str, guidance: Guidance) {
        self.hub.set_status(Status {
            state: state.to_owned(),
            seconds: self.began.elapsed().as_secs_f64(),
            keyframes: self.n_views,
            guidance: Some(guidance),
            ..Status::default()
        });
    }

    /// Shows an image of the camera with the corners of earlier images, unless no client shows
    /// images.
    pub fn show_live(&mut self, image: &Image) {
        // This is checked before decoding, because most images are not shown.
        let now = Instant::now();
        if image.camera != self.camera
            || image.is_depth()
            || now < self.next_live
            || !self.hub.needs_live_images()
        {
            return;
        }
        self.next_live = now + INTERVAL;
        // Images that cannot be decoded are counted where they are used.
        if let Ok(rgb) = image.decode_rgb() {
            self.publish(image.stamp, image.size_px, rgb, &[]);
        }
    }

    /// Shows a gray image in which the target was searched, with its corners.
    pub fn show_searched(&mut self, size_px: [u32; 2], gray: &[u8], view: Option<&BoardView>) {
        let newest: Vec<[f64; 2]> = view
            .iter()
            .flat_map(|view| &view.points)
            .map(|point| point.pixel)
            .collect();
        // The target is searched in gray images, so the same images are shown.
        let rgb = gray.iter().flat_map(|value| [*value; 3]).collect();
        // The stamp only has to differ from the stamp of the previous image.
        let stamp = Stamp::from_secs(self.began.elapsed().as_secs_f64());
        self.publish(stamp, size_px, rgb, &newest);
        if view.is_some() {
            self.n_views += 1;
            // Without this pause, the next live image would replace the new corners before anyone
            // has seen them.
            self.next_live = Instant::now() + DETECTED_FOR;
        }
        // The corners are added only after the image was published, because in this image they are
        // the newest.
        self.corners_px.extend(newest);
    }

    fn publish(&self, stamp: Stamp, size_px: [u32; 2], mut rgb: Vec<u8>, newest_px: &[[f64; 2]]) {
        // This size is visible even if the page shows the image in the width of a phone.
        const WIDTH_PER_DOT: u32 = 320;
        let radius = size_px[0].div_ceil(2 * WIDTH_PER_DOT);
        // The newest corners are drawn last, so that dots of earlier corners do not hide them.
        for (corners_px, color, radius) in [
            (&self.corners_px[..], EARLIER_SRGB, radius),
            (newest_px, NEWEST_SRGB, 3 * radius),
        ] {
            for corner_px in corners_px {
                draw_dot(&mut rgb, size_px, *corner_px, radius, color);
            }
        }
        self.hub.set_live_image(LiveImage {
            camera: Arc::clone(&self.camera),
            stamp,
            captured_at: Instant::now(),
            size_px,
            pixels: LivePixels::Rgb(rgb.into()),
            // The pose is what the calibration estimates.
            world_from_camera: None,
            focal_px: self.focal_px,
            principal_px: self.principal_px,
        });
    }
}

/// Draws a square dot; pixel centers are at +0.5.
fn draw_dot(rgb: &mut [u8], size_px: [u32; 2], [x, y]: [f64; 2], radius: u32, color: [u8; 3]) {
    let [width, height] = size_px.map(i64::from);
    #[expect(
        clippy::cast_possible_truncation,
        reason = "corners are within the image"
    )]
    let (x, y) = (x.floor() as i64, y.floor() as i64);
    let radius = i64::from(radius);
    // A dot at the border is cut, not moved.
    for row in (y - radius).max(0)..=(y + radius).min(height - 1) {
        for column in (x - radius).max(0)..=(x + radius).min(width - 1) {
            let first =
                usize::try_from(3 * (row * width + column)).expect("the pixel is within the image");
            rgb[first..first + 3].copy_from_slice(&color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dots_are_cut_at_the_border() {
        let size_px = [4, 3];
        let mut rgb = vec![0; 3 * 4 * 3];
        draw_dot(&mut rgb, size_px, [0.5, 2.9], 1, [1, 2, 3]);
        let drawn: Vec<usize> = (0..12)
            .filter(|ix| rgb[3 * ix..3 * ix + 3] == [1, 2, 3])
            .collect();
        assert_eq!(drawn, [4, 5, 8, 9]);
        assert_eq!(rgb.iter().filter(|value| **value > 0).count(), 12);
        draw_dot(&mut rgb, size_px, [-9.0, 9.0], 1, [9; 3]);
        assert!(!rgb.contains(&9), "it is outside");
    }
}
