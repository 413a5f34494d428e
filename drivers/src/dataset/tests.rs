//! Tests with real dataset folders and with small folders that the tests create.

use super::*;
use image::{ExtendedColorType, GrayImage, Luma, RgbImage};
use kinematics::{Lens, Stamp};
use nalgebra::{Point3, Vector3};
use serde_json::{Value, json};

/// Tolerance for positions written with a dozen digits.
const EXACT_M: f64 = 1e-9;

fn identity_rows() -> Value {
    json!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
}

/// A folder with two photos of 8 x 6 pixels, and its `transforms.json` for the test to modify.
fn small_folder() -> (tempfile::TempDir, Value) {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.png", "b.png"] {
        RgbImage::from_pixel(8, 6, image::Rgb([10, 20, 30])).save(folder.path().join(name)).unwrap();
    }
    let document = json!({
        "fl_x": 5.0, "fl_y": 6.0, "cx": 4.5, "cy": 3.25, "w": 8, "h": 6, "aabb_scale": 16,
        "frames": [
            { "file_path": "b.png", "transform_matrix": identity_rows(), "colmap_im_id": 3 },
            { "file_path": "a.png", "transform_matrix": identity_rows() },
        ],
    });
    (folder, document)
}

fn write_transforms(folder: &tempfile::TempDir, document: &Value) {
    std::fs::write(folder.path().join("transforms.json"), document.to_string()).unwrap();
}

fn save_counts(path: &Path, size_px: [u32; 2], counts: &[u16]) {
    let bytes: Vec<u8> = counts.iter().flat_map(|count| count.to_ne_bytes()).collect();
    image::save_buffer(path, &bytes, size_px[0], size_px[1], ExtendedColorType::L16).unwrap();
}

fn read_error(folder: &tempfile::TempDir) -> String {
    read(folder.path()).unwrap_err().to_string()
}

#[test]
fn fox_is_read_without_missing_photos() {
    let Some(folder) = test_support::data_folder("fox") else { return };
    let dataset = read(&folder).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_missing, dataset.n_unusable), (50, 17, 0));
    assert!(dataset.notes[0].starts_with("17 images are missing: "), "{:?}", dataset.notes);
    let first = &dataset.images[0];
    assert_eq!(first.name, "images/0001.jpg");
    assert_eq!(
        first.intrinsics.lens,
        Lens::BrownConrady([0.057_842_1, -0.080_509_9, -0.000_980_296, 0.000_155_75, 0.0])
    );
    assert_eq!((first.intrinsics.size_px, first.intrinsics.principal_px), ([540, 960], [277.279, 482.634]));
    // The camera in the file looks along its negative third column, with the second column up.
    let forward = first.world_from_camera * Vector3::z();
    assert!((forward - Vector3::new(-0.442_090_026, 0.894_068_914, 0.072_091_785)).norm() < 1e-6, "{forward}");
    let down = first.world_from_camera * Vector3::y();
    assert!(down.z < -0.99, "{down}");
    assert_eq!(first.load().unwrap().rgba_srgb.len(), 540 * 960 * 4);
    assert!(dataset.images.windows(2).all(|pair| pair[0].name < pair[1].name && pair[0].stamp < pair[1].stamp));
}

#[test]
fn redkitchen_has_depth_in_meters() {
    let Some(folder) = test_support::data_folder("redkitchen") else { return };
    let dataset = read(&folder).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_missing, dataset.notes.len()), (50, 0, 0));
    let depth = dataset.images[10].load().unwrap().depth.unwrap();
    assert_eq!(depth.intrinsics.focal_px, [525.0, 525.0]);
    let known: Vec<f32> = depth.depth_m.iter().copied().filter(|&depth_m| depth_m > 0.0).collect();
    assert!(known.len() > 100_000 && known.iter().all(|depth_m| (0.3..10.0).contains(depth_m)));
}

#[test]
fn poses_are_converted_and_frames_sorted() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["transform_matrix"][0][3] = json!(2.0);
    write_transforms(&folder, &document);
    let dataset = read(&folder.path().join("transforms.json")).unwrap();
    assert_eq!(dataset.images.iter().map(|image| image.name.as_str()).collect::<Vec<_>>(), ["a.png", "b.png"]);
    let point = dataset.images[0].world_from_camera * Point3::new(0.5, 1.0, 3.0);
    assert!((point - Point3::new(2.5, -1.0, -3.0)).norm() < EXACT_M);
    let intrinsics = &dataset.images[1].intrinsics;
    assert_eq!((intrinsics.focal_px, intrinsics.principal_px), ([5.0, 6.0], [4.5, 3.25]));
    assert_eq!(intrinsics.lens, Lens::Pinhole);
}

#[test]
fn frames_may_have_their_own_fisheye_and_no_extension() {
    let (folder, mut document) = small_folder();
    document["frames"][0]["file_path"] = json!("./b");
    document["frames"][0]["camera_model"] = json!("OPENCV_FISHEYE");
    document["frames"][0]["k4"] = json!(0.25);
    document["frames"][0]["fl_x"] = json!(7.0);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    let fisheye = dataset.images.iter().find(|image| image.name == "./b").unwrap();
    assert_eq!(fisheye.intrinsics.lens, Lens::KannalaBrandt([0.0, 0.0, 0.0, 0.25]));
    assert_eq!(fisheye.intrinsics.focal_px, [7.0, 6.0]);
    fisheye.load().unwrap();
}

#[test]
fn lens_parameters_follow_the_size_of_the_images() {
    let (folder, mut document) = small_folder();
    document["w"] = json!(16);
    document["h"] = json!(12);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!(dataset.images[0].intrinsics.focal_px, [2.5, 3.0]);
    assert_eq!(dataset.notes, ["images are 8x6, which differs from transforms.json; lens parameters are scaled"]);
    dataset.images[0].load().unwrap();
}

#[test]
fn masks_and_resized_depth_are_decoded() {
    let (folder, mut document) = small_folder();
    GrayImage::from_fn(8, 6, |x, _| Luma([if x < 2 { 0 } else { 200 }])).save(folder.path().join("mask.png")).unwrap();
    save_counts(&folder.path().join("depth.png"), [4, 3], &[0, 500, 1000, 65535, 0, 0, 0, 0, 0, 0, 0, 2000]);
    document["frames"][1]["mask_path"] = json!("mask.png");
    document["frames"][1]["depth_file_path"] = json!("depth.png");
    document["frames"][0]["depth_file_path"] = json!("lost.png");
    document["depth_unit_scale_factor"] = json!(0.0002);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!(dataset.notes, ["1 depth image is missing"]);
    let loaded = dataset.images[0].load().unwrap();
    let alphas: Vec<u8> = loaded.rgba_srgb.chunks_exact(4).take(8).map(|pixel| pixel[3]).collect();
    assert_eq!(alphas, [0, 0, 255, 255, 255, 255, 255, 255]);
    let depth = loaded.depth.unwrap();
    assert_eq!((depth.intrinsics.size_px, depth.intrinsics.focal_px), ([4, 3], [2.5, 3.0]));
    assert_eq!(depth.depth_m[..4], [0.0, 0.1, 0.2, 13.107]);
}

#[test]
fn missing_and_garbage_images_are_skipped_and_counted() {
    let (folder, mut document) = small_folder();
    let mut entry = document["frames"][0].clone();
    entry["file_path"] = json!("garbage.jpg");
    std::fs::write(folder.path().join("garbage.jpg"), b"not an image").unwrap();
    document["frames"].as_array_mut().unwrap().push(entry.clone());
    entry["file_path"] = json!("none.png");
    document["frames"].as_array_mut().unwrap().push(entry);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_missing, dataset.n_unusable), (2, 1, 1));
    assert_eq!(dataset.notes, ["1 image is missing: none.png"]);
    assert!(dataset.data_losses[0].starts_with("1 image cannot be used: garbage.jpg ("), "{:?}", dataset.data_losses);
    for name in ["a.png", "b.png"] {
        std::fs::remove_file(folder.path().join(name)).unwrap();
    }
    let text = read_error(&folder);
    assert!(text.contains("no usable image: 3 are missing, 1 cannot be used (garbage.jpg: "), "{text}");
}

#[test]
fn duplicate_photo_is_used_once() {
    let (folder, mut document) = small_folder();
    let duplicate = document["frames"][0].clone();
    document["frames"].as_array_mut().unwrap().push(duplicate);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (2, 1));
    assert!(dataset.notes[0].contains("b.png (listed twice"), "{:?}", dataset.notes);
}

#[test]
fn truncated_photo_error_names_it() {
    let (folder, document) = small_folder();
    write_transforms(&folder, &document);
    let photo = folder.path().join("a.png");
    let bytes = std::fs::read(&photo).unwrap();
    std::fs::write(&photo, &bytes[..bytes.len() - 30]).unwrap();
    let dataset = read(folder.path()).unwrap();
    let text = dataset.images[0].load().unwrap_err().to_string();
    assert!(text.contains("a.png") && text.contains("does not decode"), "{text}");
}

#[test]
fn implausibly_far_pose_skips_frame() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["transform_matrix"][2][3] = json!(1e30);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    assert_eq!(dataset.data_losses, ["1 image cannot be used: a.png (its pose is 1e30 m away, the maximum is 1e4 m)"]);
}

#[test]
fn undecodable_depth_keeps_photo() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["depth_file_path"] = json!("depth.png");
    std::fs::write(folder.path().join("depth.png"), b"not an image").unwrap();
    write_transforms(&folder, &document);
    let loaded = read(folder.path()).unwrap().images[0].load().unwrap();
    assert_eq!((loaded.rgba_srgb.len(), loaded.depth), (8 * 6 * 4, None));
    assert!(loaded.depth_error.is_some_and(|reason| reason.contains("depth.png")));
}

#[test]
fn invalid_camera_error_names_frame() {
    let (folder, document) = small_folder();
    write_transforms(&folder, &document);
    let good = document.to_string();
    let error_after_replacing = |from: &str, to: &str| {
        assert!(good.contains(from), "{from} is not in {good}");
        std::fs::write(folder.path().join("transforms.json"), good.replacen(from, to, 1)).unwrap();
        read_error(&folder)
    };
    assert!(error_after_replacing("[1.0,0.0,0.0,0.0]", "[1.0,0.0,0.0]").contains("has 15 numbers"));
    assert!(
        error_after_replacing("\"aabb_scale\":16", "\"camera_model\":\"EQUIRECTANGULAR\"").contains("EQUIRECTANGULAR")
    );
    assert!(error_after_replacing("\"aabb_scale\":16", "\"k4\":0.1").contains("k4 is 0.1"));
    assert!(error_after_replacing("\"fl_x\":5.0", "\"fl_x\":-5.0").contains("focal length x is -5"));
    assert!(error_after_replacing("\"fl_x\":5.0,", "").contains("no focal length"));
    assert!(
        error_after_replacing("\"aabb_scale\":16", "\"depth_unit_scale_factor\":0")
            .contains("expected a number above 0")
    );
    assert!(error_after_replacing("\"frames\"", "\"frame\"").contains("missing field `frames`"));
    assert!(error_after_replacing("{", "").contains("not a recording (.mcap), a dataset folder or a transforms.json"));
    assert!(error_after_replacing("}", "").contains("transforms.json"));
}

#[test]
fn nan_lens_parameter_is_an_error() {
    let (folder, document) = small_folder();
    let text = document.to_string().replace("\"fl_y\":6.0", "\"fl_y\":NaN");
    assert!(text.contains("NaN"));
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    assert!(read_error(&folder).contains("not a finite number"), "{}", read_error(&folder));
}

#[test]
fn invalid_pose_skips_image_with_note() {
    let (folder, document) = small_folder();
    // Python writes these values, but they are not valid JSON.
    for (row, reason) in [
        ("[1.0,0.0,0.0,NaN]", "not a finite number"),
        ("[1.0,-Infinity,0.0,0.0]", "not a finite number"),
        ("[2.0,0.0,0.0,0.0]", "not rigid"),
        ("[-1.0,0.0,0.0,0.0]", "not rigid"),
    ] {
        let corrupted = document.to_string().replacen("[1.0,0.0,0.0,0.0]", row, 1);
        std::fs::write(folder.path().join("transforms.json"), corrupted).unwrap();
        let dataset = read(folder.path()).unwrap();
        let [note] = &dataset.data_losses[..] else { panic!("{:?}", dataset.data_losses) };
        assert!(note.contains("b.png (") && note.contains(reason), "{note}");
        assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    }
}

#[test]
fn unknown_folder_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let text = read_error(&folder);
    assert!(text.ends_with("expected transforms.json (nerfstudio) or rgb.txt (TUM RGB-D) in it"), "{text}");
}

/// A TUM folder: four photos, three of them with poses close in time, two with depth.
fn tum_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    std::fs::create_dir(path_of("rgb")).unwrap();
    std::fs::create_dir(path_of("depth")).unwrap();
    for photo in ["1.000000", "1.100000", "1.200000", "9.000000"] {
        RgbImage::new(8, 6).save(path_of(&format!("rgb/{photo}.png"))).unwrap();
    }
    for depth in ["1.015000", "1.110000"] {
        save_counts(&path_of(&format!("depth/{depth}.png")), [8, 6], &[5000; 48]);
    }
    let list = |names: &[&str], kind: &str| {
        let lines = names.iter().map(|name| format!("{name} {kind}/{name}.png\n"));
        format!("# timestamp filename\n{}", lines.collect::<String>())
    };
    let photos = ["1.000000", "1.100000", "1.200000", "1.300000", "9.000000"];
    std::fs::write(path_of("rgb.txt"), list(&photos, "rgb")).unwrap();
    std::fs::write(path_of("depth.txt"), list(&["1.015000", "1.110000"], "depth")).unwrap();
    // Along x at 1 m/s, every 10 ms from just before the first photo until just after the third.
    let poses =
        (0..=25).map(|ix| format!("{:.4} {} 2 3 0 0 0 1\n", 0.995 + 0.01 * f64::from(ix), 0.01 * f64::from(ix)));
    std::fs::write(path_of("groundtruth.txt"), poses.collect::<String>()).unwrap();
    std::fs::write(path_of("calibration.txt"), "500 501 3.5 2.5\n").unwrap();
    folder
}

#[test]
fn tum_photos_interpolate_pose_and_use_nearest_depth() {
    let folder = tum_folder();
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_missing, dataset.n_unusable), (3, 1, 1));
    assert!(dataset.notes.iter().any(|note| note.contains("rgb/9.000000.png (no pose within 20 ms)")));
    assert!(dataset.notes.contains(&"1 photo has no depth image within 20 ms".to_owned()), "{:?}", dataset.notes);
    let second = &dataset.images[1];
    assert_eq!(second.stamp, Stamp(1_100_000_000));
    // Halfway between two poses. The depth image was taken 10 ms later and 1 cm further.
    assert!((second.world_from_camera.translation.vector - Vector3::new(0.105, 2.0, 3.0)).norm() < EXACT_M);
    let depth = second.depth.as_ref().unwrap();
    assert!((depth.world_from_camera.translation.x - 0.115).abs() < EXACT_M);
    assert_eq!(second.load().unwrap().depth.unwrap().depth_m, [1.0; 48]);
    assert_eq!(second.intrinsics.principal_px, [4.0, 3.0]);
    assert!(dataset.images[2].depth.is_none());
}

#[test]
fn tum_intrinsics_come_from_file_or_folder_name() {
    let folder = tum_folder();
    std::fs::remove_file(folder.path().join("calibration.txt")).unwrap();
    assert!(read_error(&folder).contains("no lens parameters"));
    let named = folder.path().join("rgbd_dataset_freiburg1_desk");
    std::fs::create_dir(&named).unwrap();
    for name in ["rgb", "depth", "rgb.txt", "depth.txt", "groundtruth.txt"] {
        std::fs::rename(folder.path().join(name), named.join(name)).unwrap();
    }
    let intrinsics = read(&named).unwrap().images[0].intrinsics.clone();
    assert_eq!((intrinsics.focal_px[0], intrinsics.size_px), (517.306_408, [8, 6]));
    assert_eq!(intrinsics.lens, Lens::BrownConrady([0.262_383, -0.953_104, -0.005_358, 0.002_628, 1.163_314]));
    std::fs::write(named.join("calibration.txt"), "500 500 1").unwrap();
    assert!(read(&named).unwrap_err().to_string().contains("3 numbers"));
}

#[test]
fn broken_tum_list_error_names_line() {
    let folder = tum_folder();
    std::fs::write(folder.path().join("rgb.txt"), "# list\nnoon rgb/1.png\n").unwrap();
    assert!(read_error(&folder).contains("line 2: \"noon\" is not a time in seconds"));
    std::fs::write(folder.path().join("rgb.txt"), "1.0\n").unwrap();
    assert!(read_error(&folder).contains("the time is not followed by a file name"));
    std::fs::write(folder.path().join("rgb.txt"), "1.0 rgb/1.000000.png\n").unwrap();
    std::fs::write(folder.path().join("groundtruth.txt"), "1.0 nan 0 0 0 0 0 1\n").unwrap();
    assert!(read_error(&folder).contains("no pose within 20 ms"), "an invalid pose is skipped");
    std::fs::write(folder.path().join("groundtruth.txt"), "0.99 0 0 0 0 0 0 0\n1.0 0 0 0 0 0 0 1\n").unwrap();
    assert_eq!(read(folder.path()).unwrap().images.len(), 1);
}

#[test]
fn tum_extreme_stamps_and_poses_are_not_matched() {
    let folder = tum_folder();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("rgb.txt", "1.0 rgb/1.000000.png\n9223372036 rgb/1.100000.png\n");
    write("depth.txt", "-9223372036 depth/1.015000.png\n");
    write("groundtruth.txt", "-9223372036 0 0 0 0 0 0 1\n0.995 1e308 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n");
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    assert!(dataset.images[0].depth.is_none());
}
