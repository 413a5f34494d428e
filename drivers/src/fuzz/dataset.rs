//! Fuzz targets for dataset lists. The images to which the lists refer are valid.

use super::scratch::Scratch;
use crate::dataset;
use kinematics::transform;

thread_local! {
    /// Folders with a photo and a depth image. Their lists are rewritten for each input.
    static NERFSTUDIO: Scratch = folder("nerfstudio");
    static TUM: Scratch = folder("tum");
}

/// Reads a complete `transforms.json`.
pub fn nerfstudio(bytes: &[u8]) {
    NERFSTUDIO.with(|folder| {
        folder.write("transforms.json", bytes);
        read(folder);
    });
}

/// Reads the lists of a TUM folder: photos, depth images, poses, lens. Lines of three equals signs
/// separate the lists.
pub fn tum(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let mut lists = text.splitn(4, "===\n");
    TUM.with(|folder| {
        for name in ["rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt"] {
            folder.write(name, lists.next().unwrap_or_default().as_bytes());
        }
        read(folder);
    });
}

fn read(folder: &Scratch) {
    let Ok(dataset) = dataset::read(&folder.0) else {
        return;
    };
    assert!(!dataset.images.is_empty());
    for image in &dataset.images {
        assert!(transform::is_finite(&image.world_from_camera), "{image:?}");
        let _ = image.load();
    }
}

fn folder(name: &str) -> Scratch {
    let folder = Scratch::new(name);
    let photo = image::RgbImage::from_pixel(4, 3, image::Rgb([40, 60, 7]));
    photo
        .save(folder.0.join("photo.png"))
        .expect("a small image");
    let depth = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(4, 3, image::Luma([1000]));
    depth
        .save(folder.0.join("depth.png"))
        .expect("a small image");
    folder
}
