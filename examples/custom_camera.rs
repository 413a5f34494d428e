//! Adds your own camera: implements `drivers::Camera`, and reads this camera as a source of
//! samples.
//!
//! The camera computes its images. A real camera would wait for its hardware in `next_image`, and
//! stamp each image at mid-exposure with the clock of `drivers::clock`. `LiveDevices` reads each
//! device on a separate thread, and returns the samples of all devices in the order of their
//! stamps.
//!
//! ```text
//! cargo run --example custom_camera
//! ```
#![expect(clippy::print_stdout, reason = "an example prints its result")]

use drivers::{Camera, Devices, Error, Image, LiveDevices, PixelFormat, Sample, Source, clock};
use kinematics::{Intrinsics, Lens, Stamp};
use std::sync::Arc;
use std::time::Duration;

const SIZE_PX: [u32; 2] = [320, 240];
/// Time between two images, for a rate of 20 images per second.
const PERIOD: Duration = Duration::from_millis(50);
const N_IMAGES: usize = 10;

/// A camera that computes a moving pattern.
struct PatternCamera {
    name: Arc<str>,
    intrinsics: Intrinsics,
    /// Stamp of the next image.
    due: Stamp,
    /// Number of pixels by which the pattern has moved.
    shift_px: u32,
}

impl PatternCamera {
    fn new(name: &str) -> Self {
        Self {
            name: name.into(),
            intrinsics: Intrinsics {
                size_px: SIZE_PX,
                focal_px: [300.0, 300.0],
                principal_px: [160.0, 120.0],
                lens: Lens::Pinhole,
                rectified: false,
            },
            due: clock::now(),
            shift_px: 0,
        }
    }
}

impl Camera for PatternCamera {
    fn name(&self) -> &str {
        &self.name
    }

    fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error> {
        let until_due = self.due.duration_since(clock::now());
        std::thread::sleep(until_due.min(timeout));
        if until_due > timeout {
            return Err(Error::NoImage {
                camera: self.name.to_string(),
                waited: timeout,
            });
        }
        let image = Image {
            camera: Arc::clone(&self.name),
            stamp: self.due,
            size_px: SIZE_PX,
            format: PixelFormat::Rgb8,
            data: pattern_rgb(self.shift_px).into(),
            exposure_secs: None,
            n_skipped: 0,
        };
        self.due += PERIOD;
        self.shift_px += 4;
        Ok(image)
    }
}

fn main() -> anyhow::Result<()> {
    let mut source = LiveDevices::new(Devices {
        cameras: vec![Box::new(PatternCamera::new("pattern"))],
        ..Devices::default()
    })?;
    let start = clock::now();
    for _ in 0..N_IMAGES {
        let Some(sample) = source.next_sample()? else {
            break;
        };
        if let Sample::Image(image) = sample {
            let [width, height] = image.size_px;
            let secs = image.stamp.secs_since(start);
            println!("{}: {width}x{height} at {secs:.3} s", image.camera);
        }
    }
    Ok(())
}

/// The pixels of a gradient that has moved to the left, in the shape `[height, width, 3]`.
fn pattern_rgb(shift_px: u32) -> Vec<u8> {
    let [width, height] = SIZE_PX;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
    pixels
        .flat_map(|[x, y]| [low_byte(x + shift_px), low_byte(y), 128])
        .collect()
}

fn low_byte(number: u32) -> u8 {
    number.to_le_bytes()[0]
}
