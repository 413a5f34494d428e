//! Detects tags in images on a separate thread.

use crate::{Error, Image};
use apriltag::families::Family as ApriltagFamily;
use apriltag::{Detector, Image as Gray};
use kinematics::Stamp;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

/// Maximum number of wrong cells that are corrected. With two or more corrected cells, noise is
/// occasionally detected as a tag (Olson 2011, section V.B).
const CORRECTED_BITS: usize = 1;
/// Minimum mean difference in gray value between the cells of a tag and the decision threshold. The
/// authors of AprilTag regard values below 10 as noise. The limit here is higher, because the
/// corners of a barely visible tag are not accurate enough.
const MIN_MARGIN: f32 = 20.0;
/// Images with at least this many pixels are searched for quads at half resolution. Corners are
/// always refined at full resolution.
const DECIMATE_ABOVE_PX: usize = 1_000_000;

/// Minimum width and height. The detector reads out of bounds if an image is smaller than a few of
/// its 4-pixel tiles. Such images are too small for a tag in any case.
const MIN_SIDE_PX: usize = 16;

/// Tag family to detect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// `tag36h11`, the most common family.
    Tag36h11,
    /// `tag25h9`.
    Tag25h9,
    /// `tag16h5`, prone to false detections.
    Tag16h5,
    /// `tagStandard41h12`.
    Standard41h12,
    /// `tagStandard52h13`.
    Standard52h13,
}

impl Family {
    /// Number of tags in the family. Valid ids are below this number.
    pub fn n_tags(self) -> u32 {
        match self {
            Self::Tag36h11 => 587,
            Self::Tag25h9 => 35,
            Self::Tag16h5 => 30,
            Self::Standard41h12 => 2115,
            Self::Standard52h13 => 48_714,
        }
    }
}

/// A tag detected in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct TagDetection {
    /// Id in the family.
    pub id: u32,
    /// Corners in the image, pixels, in the order lower left, lower right, upper right, upper left
    /// of the printed tag.
    pub corners_px: [[f64; 2]; 4],
}

/// Tags detected in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct TagDetections {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// The device's stamp of the image.
    pub stamp: Stamp,
    /// Detected tags in no particular order. An id may occur twice if a tag was printed twice.
    pub tags: Vec<TagDetection>,
}

/// Detects tags in one image at a time.
#[derive(Debug)]
pub struct TagDetector {
    images: SyncSender<Image>,
    detections: Receiver<Result<TagDetections, Error>>,
    n_pending: usize,
}

impl TagDetector {
    /// Starts the thread, which ends when this value is dropped.
    ///
    /// # Errors
    /// Fails if the thread cannot be started.
    pub fn start(family: Family) -> Result<Self, Error> {
        // The channel has a capacity of 0, so a busy thread accepts no images.
        let (images, incoming) = sync_channel(0);
        // The thread can continue while the last result waits to be received.
        let (sender, detections) = sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("tags".to_owned())
            .spawn(move || detect_all(family, &incoming, &sender));
        thread.map_err(|source| Error::Thread {
            device: "tags".to_owned(),
            source,
        })?;
        Ok(Self {
            images,
            detections,
            n_pending: 0,
        })
    }

    /// Submits a color image. Returns false if the thread is busy.
    pub fn detect(&mut self, image: Image) -> bool {
        let is_accepted = self.images.try_send(image).is_ok();
        self.n_pending += usize::from(is_accepted);
        is_accepted
    }

    /// Detects tags in a color image and waits for the result. Also returns the results of earlier
    /// images.
    pub fn detect_blocking(&mut self, image: Image) -> Vec<Result<TagDetections, Error>> {
        // Sending succeeds, because the thread only ends after this value is dropped.
        let is_accepted = self.images.send(image).is_ok();
        self.n_pending += usize::from(is_accepted);
        self.finish()
    }

    /// Returns the results since the last call. An image that cannot be decoded gives an error.
    pub fn new_detections(&mut self) -> Vec<Result<TagDetections, Error>> {
        let new_detections: Vec<_> = self.detections.try_iter().collect();
        self.n_pending -= new_detections.len();
        new_detections
    }

    /// Waits until all submitted images are processed and returns the results.
    pub fn finish(&mut self) -> Vec<Result<TagDetections, Error>> {
        let new_detections: Vec<_> = self.detections.iter().take(self.n_pending).collect();
        self.n_pending = 0;
        new_detections
    }
}

/// Thread function: detects tags until either channel is closed.
fn detect_all(
    family: Family,
    incoming: &Receiver<Image>,
    sender: &SyncSender<Result<TagDetections, Error>>,
) {
    // The detector is created on this thread because it cannot be sent between threads.
    let mut detector = detector(family);
    while let Ok(image) = incoming.recv() {
        if sender.send(detect(&mut detector, &image)).is_err() {
            return;
        }
    }
}

fn detector(family: Family) -> Detector {
    let tag_family = match family {
        Family::Tag36h11 => ApriltagFamily::tag_36h11(),
        Family::Tag25h9 => ApriltagFamily::tag_25h9(),
        Family::Tag16h5 => ApriltagFamily::tag_16h5(),
        Family::Standard41h12 => ApriltagFamily::tag_standard_41h12(),
        Family::Standard52h13 => ApriltagFamily::tag_standard_52h13(),
    };
    let detector = Detector::builder()
        .add_family_bits(tag_family, CORRECTED_BITS)
        .build();
    let mut detector = detector.expect("the detector has a family");
    // The detector runs on one thread. More threads would compete with training for the processor.
    detector.set_thread_number(1);
    detector
}

/// Detects all tags in an image.
fn detect(detector: &mut Detector, image: &Image) -> Result<TagDetections, Error> {
    let rgb = image.decode_rgb()?;
    let [width, height] = image.size_px.map(|side| side as usize);
    let mut detections = TagDetections {
        camera: Arc::clone(&image.camera),
        stamp: image.stamp,
        tags: Vec::new(),
    };
    if width.min(height) < MIN_SIDE_PX {
        return Ok(detections);
    }
    let mut gray =
        Gray::zeros_with_alignment(width, height, 1).map_err(|_| image.wrong_kind("color"))?;
    for (gray, [red, green, blue]) in gray.as_slice_mut().iter_mut().zip(rgb.as_chunks().0) {
        // Rec. 601 luma weights in units of 1/256.
        // The weights add up to 256, so the second byte of the sum is the gray value.
        let parts = 77 * u32::from(*red) + 150 * u32::from(*green) + 29 * u32::from(*blue);
        *gray = parts.to_le_bytes()[1];
    }
    // At half the resolution, the search takes a quarter of the time. The tags of a large image
    // still have enough pixels.
    detector.set_decimation(if width * height < DECIMATE_ABOVE_PX {
        1.0
    } else {
        2.0
    });
    let new_detections = detector.detect(&gray);
    let clear = new_detections
        .iter()
        .filter(|tag| tag.decision_margin() >= MIN_MARGIN);
    detections.tags = clear.filter_map(detection).collect();
    Ok(detections)
}

/// The id and corners of a tag. `None` if the id does not fit into its type, which does not occur
/// in any family.
fn detection(tag: &apriltag::Detection) -> Option<TagDetection> {
    Some(TagDetection {
        id: tag.id().try_into().ok()?,
        corners_px: tag.corners(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PixelFormat;
    use numbers::random::Random;

    fn image(size_px: [u32; 2], format: PixelFormat, data: Vec<u8>) -> Image {
        let (camera, stamp) = ("wrist".into(), Stamp(5));
        Image {
            camera,
            stamp,
            size_px,
            format,
            data: data.into(),
            exposure_secs: None,
            n_skipped: 0,
        }
    }

    /// Parses corners of two numbers in parentheses, four per line.
    fn parse_annotations(text: &str) -> Vec<[[f64; 2]; 4]> {
        let corner = |text: &str| {
            let (x, y) = text.split_once(')')?.0.split_once(' ')?;
            Some([x.parse().ok()?, y.parse().ok()?])
        };
        let line = |line: &str| {
            <[[f64; 2]; 4]>::try_from(line.split('(').filter_map(corner).collect::<Vec<_>>()).ok()
        };
        text.lines().filter_map(line).collect()
    }

    #[test]
    fn tags_in_photo_match_annotations() {
        /// The annotations were made by an earlier version of the detector with other settings.
        const NEAR_PX: f64 = 1.5;
        let Some(folder) = test_support::data_folder("apriltag") else {
            return;
        };
        let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
        let photo = image(
            [799, 533],
            PixelFormat::Jpeg,
            read("33369213973_9d9bb4cc96_c.jpg"),
        );
        let annotated =
            parse_annotations(&String::from_utf8(read("33369213973_9d9bb4cc96_c.txt")).unwrap());
        assert_eq!(annotated.len(), 12);
        let mut spotter = TagDetector::start(Family::Tag36h11).unwrap();
        let detections = spotter.detect_blocking(photo);
        let tag_detections = detections[0].as_ref().unwrap();
        assert_eq!(
            (&*tag_detections.camera, tag_detections.stamp),
            ("wrist", Stamp(5))
        );
        let is_near = |a: [f64; 2], b: &[f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < NEAR_PX;
        let is_found = |annotated: &&[[f64; 2]; 4]| {
            let matches_annotation = |tag: &&TagDetection| {
                tag.corners_px
                    .iter()
                    .all(|detected| annotated.iter().any(|corner| is_near(*detected, corner)))
            };
            tag_detections
                .tags
                .iter()
                .find(matches_annotation)
                .is_some_and(|tag| tag.id == 0)
        };
        let n_found = annotated.iter().filter(is_found).count();
        assert!(n_found >= 10, "{n_found} of 12: {:?}", tag_detections.tags);
    }

    #[test]
    fn noise_yields_no_tags_and_broken_image_is_error() {
        let mut spotter = TagDetector::start(Family::Tag36h11).unwrap();
        let mut random = Random::new(3);
        let odd = (1..40_u32).flat_map(|side| [[side, 41 - side], [side, 2000], [999, side]]);
        for size_px in odd.chain([[320, 240], [1201, 901]]) {
            let pixels = random.bytes((size_px[0] * size_px[1]) as usize);
            let detections = spotter.detect_blocking(image(size_px, PixelFormat::Gray8, pixels));
            assert_eq!(detections[0].as_ref().unwrap().tags, [], "{size_px:?}");
        }
        assert!(
            spotter.detect_blocking(image([320, 240], PixelFormat::Jpeg, vec![1, 2, 3]))[0]
                .is_err()
        );
        assert!(spotter.new_detections().is_empty() && spotter.finish().is_empty());
    }
}
