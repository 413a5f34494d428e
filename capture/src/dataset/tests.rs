//! Loading dataset folders as keyframes.

use super::*;
use image::{GrayImage, Luma, RgbImage};
use serde_json::{Value, json};
use std::path::Path;

/// A folder with `n` photos of 64 x 48 pixels, brighter to the right, all from one pose, through
/// `lens`.
fn folder_of(n: usize, lens: &Value) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let rows = json!([
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0]
    ]);
    let mut frames = Vec::new();
    for ix in 0..n {
        let name = format!("{ix:02}.png");
        let photo = RgbImage::from_fn(64, 48, |x, _| {
            image::Rgb([4 * u8::try_from(x).unwrap(), 100, 7])
        });
        photo.save(folder.path().join(&name)).unwrap();
        frames.push(json!({ "file_path": name, "transform_matrix": rows }));
    }
    let mut document =
        json!({ "fl_x": 40.0, "fl_y": 40.0, "cx": 32.0, "cy": 24.0, "frames": frames });
    document
        .as_object_mut()
        .unwrap()
        .extend(lens.as_object().unwrap().clone());
    std::fs::write(folder.path().join("transforms.json"), document.to_string()).unwrap();
    folder
}

fn load_at(folder: &Path, scale_frac: f64) -> anyhow::Result<LoadedDataset> {
    load(&drivers::dataset::read(folder)?, None, scale_frac, &|_| ())
}

#[test]
fn fox_becomes_undistorted_keyframes() {
    let Some(folder) = test_support::data_folder("fox") else {
        return;
    };
    let max_done = AtomicUsize::new(0);
    let dataset = drivers::dataset::read(&folder).unwrap();
    let on_progress = |n_done| _ = max_done.fetch_max(n_done, Ordering::Relaxed);
    let loaded = load(&dataset, None, 0.25, &on_progress).unwrap();
    assert_eq!((loaded.keyframes.len(), max_done.into_inner()), (50, 50));
    assert!(
        loaded.notes[0].starts_with("17 images"),
        "{:?}",
        loaded.notes
    );
    let of = |split| {
        loaded
            .keyframes
            .iter()
            .filter(|keyframe| keyframe.split == split)
            .count()
    };
    assert_eq!(
        [of(Split::Test), of(Split::Validation), of(Split::Train)],
        [7, 6, 37]
    );
    let first = &loaded.keyframes[0];
    assert_eq!(
        (first.size_px, first.focal_px),
        ([135, 240], [687.76 / 4.0, 687.245 / 4.0])
    );
    let n_masked = first
        .rgba_srgb
        .chunks_exact(4)
        .filter(|pixel| pixel[3] == 0)
        .count();
    assert!(n_masked < 135 * 240 / 20, "{n_masked}");
}

#[test]
fn redkitchen_keeps_its_depth() {
    let Some(folder) = test_support::data_folder("redkitchen") else {
        return;
    };
    let loaded = load_at(&folder, 0.5).unwrap();
    let depth = loaded.keyframes[3].depth.as_ref().unwrap();
    assert_eq!(
        (loaded.keyframes[3].size_px, depth.size_px),
        ([320, 240], [640, 480])
    );
    assert!(
        depth
            .depth_m
            .iter()
            .filter(|&&depth_m| depth_m > 0.0)
            .count()
            > 100_000
    );
}

#[test]
fn fisheye_photo_is_undistorted_and_masked() {
    let folder = folder_of(3, &json!({ "camera_model": "OPENCV_FISHEYE", "k1": 0.3 }));
    let keyframe = load_at(folder.path(), 1.0).unwrap().keyframes[0].clone();
    let pixel = |x: usize, y: usize| &keyframe.rgba_srgb[4 * (y * 64 + x)..][..4];
    assert_eq!(pixel(32, 24)[3], 255);
    // Seven pixels right of the center, the fisheye with this k1 matches a pinhole to within one
    // pixel.
    assert!(
        pixel(39, 24)[0].abs_diff(4 * 39) <= 4,
        "{:?}",
        pixel(39, 24)
    );
    // With a large k1 the corner of the pinhole image lies outside the photo: theta_d exceeds its
    // half diagonal.
    let strong = folder_of(3, &json!({ "camera_model": "OPENCV_FISHEYE", "k1": 2.0 }));
    let keyframe = load_at(strong.path(), 1.0).unwrap().keyframes[0].clone();
    assert_eq!(keyframe.rgba_srgb[3], 0);
}

#[test]
fn scaling_averages_areas_and_propagates_masks() {
    let folder = folder_of(2, &json!({ "mask_path": null }));
    let text = std::fs::read_to_string(folder.path().join("transforms.json")).unwrap();
    let mut document: Value = serde_json::from_str(&text).unwrap();
    for frame in document["frames"].as_array_mut().unwrap() {
        frame["mask_path"] = json!("mask.png");
    }
    std::fs::write(folder.path().join("transforms.json"), document.to_string()).unwrap();
    GrayImage::from_fn(64, 48, |x, _| Luma([if x == 3 { 0 } else { 255 }]))
        .save(folder.path().join("mask.png"))
        .unwrap();
    let keyframe = load_at(folder.path(), 0.5).unwrap().keyframes[1].clone();
    let row: Vec<[u8; 4]> = keyframe.rgba_srgb.as_chunks::<4>().0[..32].to_vec();
    // Columns 0 and 1 hold 0 and 4; column 1 of the scaled image covers the masked column.
    assert_eq!(
        (row[0], row[1][3], row[2]),
        ([2, 100, 7, 255], 0, [18, 100, 7, 255])
    );
    assert_eq!(
        (keyframe.size_px, keyframe.principal_px),
        ([32, 24], [16.0, 12.0])
    );
    assert!(
        format!("{:#}", load_at(folder.path(), 0.2).unwrap_err())
            .contains("64x48 pixels would have 13x10")
    );
}

#[test]
fn large_photos_are_decoded_few_at_a_time() {
    assert_eq!(n_at_once([11_648, 8736], MAX_PX_AT_ONCE, 2), Some(1));
    assert_eq!(n_at_once([8192, 8192], MAX_PX_AT_ONCE, 16), Some(2));
    assert_eq!(
        n_at_once([8192, 8192], MAX_PX_AT_ONCE, 2),
        None,
        "one per thread"
    );
    assert_eq!(n_at_once([1920, 1080], MAX_PX_AT_ONCE, 64), None);
    assert_eq!(n_at_once([65_535, 65_535], MAX_PX_AT_ONCE, 1), Some(1));
    let folder = folder_of(20, &json!({}));
    let dataset = drivers::dataset::read(folder.path()).unwrap();
    let all = load_at(folder.path(), 0.5).unwrap();
    let one_by_one = load_few_at_once(&dataset, None, 0.5, 1, &|_| ()).unwrap();
    assert_eq!(one_by_one.names, all.names);
    let key =
        |keyframe: &Arc<Keyframe>| (keyframe.stamp, keyframe.split, keyframe.rgba_srgb.clone());
    assert!(
        one_by_one
            .keyframes
            .iter()
            .map(key)
            .eq(all.keyframes.iter().map(key))
    );
}

#[test]
fn photos_are_undistorted_and_scaled_without_a_copy() {
    let folder = folder_of(1, &json!({ "camera_model": "OPENCV_FISHEYE", "k1": 2.0 }));
    let dataset = drivers::dataset::read(folder.path()).unwrap();
    let (lens, image) = (
        &dataset.images[0].intrinsics,
        dataset.images[0].load().unwrap(),
    );
    let undistorted = Undistortion::new(lens)
        .apply_rgba(&image.rgba_srgb)
        .unwrap();
    assert_ne!(undistorted, image.rgba_srgb);
    for to_px in [[20, 15], [37, 48], [64, 48]] {
        let expected = downscale::rgba(undistorted.clone(), [64, 48], to_px);
        let scaled = LensMaps::of(lens)
            .scaled_color(image.rgba_srgb.clone(), [64, 48], to_px)
            .unwrap();
        assert_eq!(scaled, expected, "{to_px:?}");
    }
}

#[test]
fn photos_that_exceed_the_memory_are_refused_with_a_scale() {
    let folder = folder_of(10, &json!({}));
    let dataset = drivers::dataset::read(folder.path()).unwrap();
    let n_bytes = 10 * 4 * 64 * 48;
    check_memory(&dataset, 1.0, n_bytes).unwrap();
    check_memory(&dataset, 0.5, n_bytes / 4).unwrap();
    let message = |available_bytes| {
        check_memory(&dataset, 1.0, available_bytes)
            .unwrap_err()
            .to_string()
    };
    let text = message(n_bytes / 4);
    assert!(
        text.contains("10 photos take") && text.contains("scale them to 0.5 or less (scale of"),
        "{text}"
    );
    assert!(message(10).ends_with("use fewer photos"));
}

#[test]
fn truncated_photos_are_skipped_and_named() {
    let folder = folder_of(10, &json!({}));
    let truncate = |name: &str| {
        let path = folder.path().join(name);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    };
    truncate("03.png");
    let loaded = load_at(folder.path(), 1.0).unwrap();
    assert_eq!(
        (
            loaded.keyframes.len(),
            loaded.names.contains(&"03.png".to_owned())
        ),
        (9, false)
    );
    assert!(
        loaded.data_losses[0].contains("1 image cannot be used")
            && loaded.data_losses[0].contains("03.png")
    );
    // The other photos keep their splits.
    assert_eq!(loaded.keyframes[7].split, Split::Test);
    (0..10)
        .filter(|ix| *ix != 3)
        .for_each(|ix| truncate(&format!("{ix:02}.png")));
    let text = load_at(folder.path(), 1.0).unwrap_err().to_string();
    assert!(
        text.contains("no photo can be used") && text.ends_with("; and 7 more"),
        "{text}"
    );
}

#[test]
fn unreadable_depth_is_a_loss_but_photo_is_kept() {
    let folder = folder_of(3, &json!({}));
    let path = folder.path().join("transforms.json");
    let mut document: Value =
        serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    document["frames"][1]["depth_file_path"] = json!("depth.png");
    std::fs::write(&path, document.to_string()).unwrap();
    std::fs::write(folder.path().join("depth.png"), b"no picture").unwrap();
    let loaded = load_at(folder.path(), 1.0).unwrap();
    assert_eq!((loaded.keyframes.len(), loaded.data_losses.len()), (3, 1));
    assert!(
        loaded.data_losses[0].starts_with("1 depth image cannot be used")
            && loaded.data_losses[0].contains("depth.png")
    );
}
