//! Tests with real dataset folders and with small folders that the tests create.

mod tum_tests;

use super::*;
use image::{ExtendedColorType, GrayImage, Luma, RgbImage};
use kinematics::{Lens, Stamp};
use nalgebra::{Point3, Vector3};
use serde_json::{Value, json};

/// Tolerance for positions written with a dozen digits.
const EXACT_M: f64 = 1e-9;

fn identity_rows() -> Value {
    json!([
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0]
    ])
}

/// A folder with two photos of 8 x 6 pixels, and its `transforms.json` for the test to modify.
fn small_folder() -> (tempfile::TempDir, Value) {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.png", "b.png"] {
        RgbImage::from_pixel(8, 6, image::Rgb([10, 20, 30]))
            .save(folder.path().join(name))
            .unwrap();
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
    let bytes: Vec<u8> = counts
        .iter()
        .flat_map(|count| count.to_ne_bytes())
        .collect();
    image::save_buffer(path, &bytes, size_px[0], size_px[1], ExtendedColorType::L16).unwrap();
}

fn read_error(folder: &tempfile::TempDir) -> String {
    read(folder.path()).unwrap_err().to_string()
}

#[test]
fn fox_is_read_without_missing_photos() {
    let Some(folder) = test_support::data_folder("fox") else {
        return;
    };
    let dataset = read(&folder).unwrap();
    assert_eq!(
        (dataset.images.len(), dataset.n_missing, dataset.n_unusable),
        (50, 17, 0)
    );
    let missing = &dataset.notes[0];
    assert!(
        missing.starts_with("17 images are missing: ") && missing.ends_with(" and 12 more"),
        "{missing}"
    );
    let first = &dataset.images[0];
    assert_eq!(first.name, "images/0001.jpg");
    assert_eq!(
        first.intrinsics.lens,
        Lens::BrownConrady([0.057_842_1, -0.080_509_9, -0.000_980_296, 0.000_155_75, 0.0])
    );
    assert_eq!(
        (first.intrinsics.size_px, first.intrinsics.principal_px),
        ([540, 960], [277.279, 482.634])
    );
    // The camera in the file looks along its negative third column, with the second column up.
    let forward = first.world_from_camera * Vector3::z();
    assert!(
        (forward - Vector3::new(-0.442_090_026, 0.894_068_914, 0.072_091_785)).norm() < 1e-6,
        "{forward}"
    );
    let down = first.world_from_camera * Vector3::y();
    assert!(down.z < -0.99, "{down}");
    assert_eq!(first.load().unwrap().rgba_srgb.len(), 540 * 960 * 4);
    assert!(
        dataset
            .images
            .windows(2)
            .all(|pair| pair[0].name < pair[1].name && pair[0].stamp < pair[1].stamp)
    );
}

#[test]
fn redkitchen_has_depth_in_meters() {
    let Some(folder) = test_support::data_folder("redkitchen") else {
        return;
    };
    let dataset = read(&folder).unwrap();
    assert_eq!(
        (dataset.images.len(), dataset.n_missing, dataset.notes.len()),
        (50, 0, 0)
    );
    let depth = dataset.images[10].load().unwrap().depth.unwrap();
    assert_eq!(depth.intrinsics.focal_px, [525.0, 525.0]);
    let known: Vec<f32> = depth
        .depth_m
        .iter()
        .copied()
        .filter(|&depth_m| depth_m > 0.0)
        .collect();
    assert!(known.len() > 100_000 && known.iter().all(|depth_m| (0.3..10.0).contains(depth_m)));
}

#[test]
fn poses_are_converted_and_frames_sorted() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["transform_matrix"][0][3] = json!(2.0);
    write_transforms(&folder, &document);
    let dataset = read(&folder.path().join("transforms.json")).unwrap();
    assert_eq!(
        dataset
            .images
            .iter()
            .map(|image| image.name.as_str())
            .collect::<Vec<_>>(),
        ["a.png", "b.png"]
    );
    let point = dataset.images[0].world_from_camera * Point3::new(0.5, 1.0, 3.0);
    assert!((point - Point3::new(2.5, -1.0, -3.0)).norm() < EXACT_M);
    let intrinsics = &dataset.images[1].intrinsics;
    assert_eq!(
        (intrinsics.focal_px, intrinsics.principal_px),
        ([5.0, 6.0], [4.5, 3.25])
    );
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
    let fisheye = dataset
        .images
        .iter()
        .find(|image| image.name == "./b")
        .unwrap();
    assert_eq!(
        fisheye.intrinsics.lens,
        Lens::KannalaBrandt([0.0, 0.0, 0.0, 0.25])
    );
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
    assert_eq!(
        dataset.notes,
        ["images are 8x6, which differs from transforms.json; lens parameters are scaled"]
    );
    dataset.images[0].load().unwrap();
}

#[test]
fn masks_and_resized_depth_are_decoded() {
    let (folder, mut document) = small_folder();
    GrayImage::from_fn(8, 6, |x, _| Luma([if x < 2 { 0 } else { 200 }]))
        .save(folder.path().join("mask.png"))
        .unwrap();
    save_counts(
        &folder.path().join("depth.png"),
        [4, 3],
        &[0, 500, 1000, 65535, 0, 0, 0, 0, 0, 0, 0, 2000],
    );
    document["frames"][1]["mask_path"] = json!("mask.png");
    document["frames"][1]["depth_file_path"] = json!("depth.png");
    document["frames"][0]["depth_file_path"] = json!("lost.png");
    document["depth_unit_scale_factor"] = json!(0.0002);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!(dataset.notes, ["1 depth image is missing: lost.png"]);
    let loaded = dataset.images[0].load().unwrap();
    let alphas: Vec<u8> = loaded
        .rgba_srgb
        .chunks_exact(4)
        .take(8)
        .map(|pixel| pixel[3])
        .collect();
    assert_eq!(alphas, [0, 0, 255, 255, 255, 255, 255, 255]);
    let depth = loaded.depth.unwrap();
    assert_eq!(
        (depth.intrinsics.size_px, depth.intrinsics.focal_px),
        ([4, 3], [2.5, 3.0])
    );
    assert_eq!(depth.depth_m[..4], [0.0, 0.1, 0.2, 13.107]);
}

#[test]
fn missing_and_garbage_images_are_skipped_and_counted() {
    let (folder, mut document) = small_folder();
    let mut entry = document["frames"][0].clone();
    entry["file_path"] = json!("garbage.jpg");
    std::fs::write(folder.path().join("garbage.jpg"), b"not an image").unwrap();
    document["frames"]
        .as_array_mut()
        .unwrap()
        .push(entry.clone());
    entry["file_path"] = json!("none.png");
    document["frames"].as_array_mut().unwrap().push(entry);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!(
        (dataset.images.len(), dataset.n_missing, dataset.n_unusable),
        (2, 1, 1)
    );
    assert_eq!(dataset.notes, ["1 image is missing: none.png"]);
    assert!(
        dataset.data_losses[0].starts_with("1 image cannot be used: garbage.jpg ("),
        "{:?}",
        dataset.data_losses
    );
    for name in ["a.png", "b.png"] {
        std::fs::remove_file(folder.path().join(name)).unwrap();
    }
    let text = read_error(&folder);
    assert!(
        text.contains("no usable image: 3 are missing, 1 cannot be used (garbage.jpg: "),
        "{text}"
    );
    std::fs::remove_file(folder.path().join("garbage.jpg")).unwrap();
    let text = read_error(&folder);
    assert!(
        text.contains("no usable image: 4 are missing, 0 cannot be used (such as "),
        "{text}"
    );
}

#[test]
fn duplicate_photo_is_used_once() {
    let (folder, mut document) = small_folder();
    let duplicate = document["frames"][0].clone();
    document["frames"].as_array_mut().unwrap().push(duplicate);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (2, 1));
    assert!(
        dataset.notes[0].contains("b.png (listed twice"),
        "{:?}",
        dataset.notes
    );
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
    assert!(
        text.contains("a.png") && text.contains("does not decode"),
        "{text}"
    );
}

#[test]
fn implausibly_far_pose_skips_frame() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["transform_matrix"][2][3] = json!(1e30);
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    assert_eq!(
        dataset.data_losses,
        ["1 image cannot be used: a.png (its pose is 1e30 m away, the maximum is 1e4 m)"]
    );
}

#[test]
fn undecodable_depth_keeps_photo() {
    let (folder, mut document) = small_folder();
    document["frames"][1]["depth_file_path"] = json!("depth.png");
    std::fs::write(folder.path().join("depth.png"), b"not an image").unwrap();
    write_transforms(&folder, &document);
    let loaded = read(folder.path()).unwrap().images[0].load().unwrap();
    assert_eq!((loaded.rgba_srgb.len(), loaded.depth), (8 * 6 * 4, None));
    assert!(
        loaded
            .depth_error
            .is_some_and(|reason| reason.contains("depth.png"))
    );
}

#[test]
fn invalid_camera_error_names_frame() {
    let (folder, document) = small_folder();
    write_transforms(&folder, &document);
    let good = document.to_string();
    let error_after_replacing = |from: &str, to: &str| {
        assert!(good.contains(from), "{from} is not in {good}");
        std::fs::write(
            folder.path().join("transforms.json"),
            good.replacen(from, to, 1),
        )
        .unwrap();
        read_error(&folder)
    };
    assert!(error_after_replacing("[1.0,0.0,0.0,0.0]", "[1.0,0.0,0.0]").contains("has 15 numbers"));
    assert!(
        error_after_replacing("\"aabb_scale\":16", "\"camera_model\":\"EQUIRECTANGULAR\"")
            .contains("EQUIRECTANGULAR")
    );
    assert!(error_after_replacing("\"aabb_scale\":16", "\"k4\":0.1").contains("k4 is 0.1"));
    assert!(
        error_after_replacing("\"fl_x\":5.0", "\"fl_x\":-5.0").contains("focal length x is -5")
    );
    assert!(error_after_replacing("\"fl_x\":5.0,", "").contains("no focal length"));
    assert!(
        error_after_replacing("\"aabb_scale\":16", "\"depth_unit_scale_factor\":0")
            .contains("expected a number from 1e-6 to 1")
    );
    assert!(error_after_replacing("\"frames\"", "\"frame\"").contains("missing field `frames`"));
    assert!(
        error_after_replacing("{", "")
            .contains("not a recording (.mcap), a dataset folder or a transforms.json")
    );
    assert!(error_after_replacing("}", "").contains("transforms.json"));
}

#[test]
fn nan_lens_parameter_is_an_error() {
    let (folder, document) = small_folder();
    let text = document.to_string().replace("\"fl_y\":6.0", "\"fl_y\":NaN");
    assert!(text.contains("NaN"));
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    assert!(
        read_error(&folder).contains("not a finite number"),
        "{}",
        read_error(&folder)
    );
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
        let [note] = &dataset.data_losses[..] else {
            panic!("{:?}", dataset.data_losses)
        };
        assert!(note.contains("b.png (") && note.contains(reason), "{note}");
        assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    }
}

#[test]
fn unknown_folder_is_rejected() {
    let folder = tempfile::tempdir().unwrap();
    let text = read_error(&folder);
    assert!(
        text.ends_with("expected transforms.json (nerfstudio) or rgb.txt (TUM RGB-D) in it"),
        "{text}"
    );
}

/// A TUM folder with four photos. Three of them have poses close in time, and two have depth.
fn tum_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    std::fs::create_dir(path_of("rgb")).unwrap();
    std::fs::create_dir(path_of("depth")).unwrap();
    for photo in ["1.000000", "1.100000", "1.200000", "9.000000"] {
        RgbImage::new(8, 6)
            .save(path_of(&format!("rgb/{photo}.png")))
            .unwrap();
    }
    for depth in ["1.015000", "1.110000"] {
        save_counts(&path_of(&format!("depth/{depth}.png")), [8, 6], &[5000; 48]);
    }
    let list = |names: &[&str], kind: &str| {
        let lines = names
            .iter()
            .map(|name| format!("{name} {kind}/{name}.png\n"));
        format!("# timestamp filename\n{}", lines.collect::<String>())
    };
    let photos = ["1.000000", "1.100000", "1.200000", "1.300000", "9.000000"];
    std::fs::write(path_of("rgb.txt"), list(&photos, "rgb")).unwrap();
    std::fs::write(
        path_of("depth.txt"),
        list(&["1.015000", "1.110000"], "depth"),
    )
    .unwrap();
    // The camera moves along x at 1 m/s. There is a pose every 10 ms, from just before the first
    // photo until just after the third.
    let poses = (0..=25).map(|ix| {
        format!(
            "{:.4} {} 2 3 0 0 0 1\n",
            0.995 + 0.01 * f64::from(ix),
            0.01 * f64::from(ix)
        )
    });
    std::fs::write(path_of("groundtruth.txt"), poses.collect::<String>()).unwrap();
    std::fs::write(path_of("calibration.txt"), "500 501 3.5 2.5\n").unwrap();
    folder
}

#[test]
fn tum_photos_interpolate_pose_and_use_nearest_depth() {
    let folder = tum_folder();
    let dataset = read(folder.path()).unwrap();
    assert_eq!(
        (dataset.images.len(), dataset.n_missing, dataset.n_unusable),
        (3, 1, 1)
    );
    assert!(dataset.notes.iter().any(|note| {
        note.contains("rgb/9.000000.png (its time is before the first or after the last pose)")
    }));
    assert!(
        dataset
            .notes
            .contains(&"1 photo has no depth image within 20 ms".to_owned()),
        "{:?}",
        dataset.notes
    );
    let second = &dataset.images[1];
    assert_eq!(second.stamp, Stamp(1_100_000_000));
    // The image is halfway between two poses. The depth image was taken 10 ms later and 1 cm
    // further.
    assert!(
        (second.world_from_camera.translation.vector - Vector3::new(0.105, 2.0, 3.0)).norm()
            < EXACT_M
    );
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
    assert!(
        read(&named)
            .unwrap_err()
            .to_string()
            .contains("are implausible for 8 x 6 pixels")
    );
    for photo in std::fs::read_dir(named.join("rgb")).unwrap() {
        RgbImage::new(640, 480).save(photo.unwrap().path()).unwrap();
    }
    let intrinsics = read(&named).unwrap().images[0].intrinsics.clone();
    assert_eq!(
        (intrinsics.focal_px[0], intrinsics.size_px),
        (517.306_408, [640, 480])
    );
    assert_eq!(
        intrinsics.lens,
        Lens::BrownConrady([0.262_383, -0.953_104, -0.005_358, 0.002_628, 1.163_314])
    );
    std::fs::write(named.join("calibration.txt"), "500 500 1").unwrap();
    assert!(read(&named).unwrap_err().to_string().contains("3 numbers"));
}

#[test]
fn broken_tum_list_error_names_line() {
    let folder = tum_folder();
    std::fs::write(folder.path().join("rgb.txt"), "# list\nnoon rgb/1.png\n").unwrap();
    assert!(read_error(&folder).contains("line 2: \"noon\" is not a time in seconds"));
    std::fs::write(folder.path().join("rgb.txt"), "1.0\n").unwrap();
    assert!(read_error(&folder).contains("line 1: nothing follows the time"));
    std::fs::write(folder.path().join("rgb.txt"), "1.0 rgb/1.000000.png\n").unwrap();
    std::fs::write(
        folder.path().join("groundtruth.txt"),
        "1.0 nan 0 0 0 0 0 1\n",
    )
    .unwrap();
    assert!(
        read_error(&folder).contains("line 1: the pose is not finite"),
        "{}",
        read_error(&folder)
    );
    std::fs::write(
        folder.path().join("groundtruth.txt"),
        "0.99 0 0 0 0 0 0 0\n1.0 0 0 0 0 0 0 1\n",
    )
    .unwrap();
    assert_eq!(read(folder.path()).unwrap().images.len(), 1);
}

#[test]
fn tum_extreme_stamps_and_poses_are_not_matched() {
    let folder = tum_folder();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write(
        "rgb.txt",
        "1.0 rgb/1.000000.png\n9223372036 rgb/1.100000.png\n",
    );
    write("depth.txt", "-9223372036 depth/1.015000.png\n");
    write(
        "groundtruth.txt",
        "-9223372036 0 0 0 0 0 0 1\n0.995 1e308 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n",
    );
    let dataset = read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.n_unusable), (1, 1));
    assert!(dataset.images[0].depth.is_none());
}

#[test]
fn listed_splits_are_kept_and_unlisted_images_left_out() {
    let (folder, mut document) = small_folder();
    document["val_filenames"] = json!(["./a.png"]);
    write_transforms(&folder, &document);
    let listed = || {
        read(folder.path())
            .unwrap()
            .images
            .iter()
            .map(|image| image.listed)
            .collect::<Vec<_>>()
    };
    let [train, validation, test] = [
        ListedSplit::Train,
        ListedSplit::Validation,
        ListedSplit::Test,
    ]
    .map(Some);
    assert_eq!(
        listed(),
        [test, train],
        "nerfstudio scores the validation images, if there are no test images"
    );
    document["test_filenames"] = json!(["b.png", "gone.png"]);
    write_transforms(&folder, &document);
    assert_eq!(listed(), [validation, test]);
    let notes = read(folder.path()).unwrap().notes;
    assert_eq!(
        notes,
        [
            "1 image is only in train_filenames, val_filenames or test_filenames, but not in frames: gone.png"
        ]
    );
    document["val_filenames"] = json!([]);
    document["train_filenames"] = json!(["b.png"]);
    document["test_filenames"] = json!([]);
    write_transforms(&folder, &document);
    assert_eq!(listed(), [train]);
    let notes = read(folder.path()).unwrap().notes;
    assert!(
        notes[0].starts_with("1 image is not used, because train_filenames")
            && notes[0].ends_with(": a.png"),
        "{notes:?}"
    );
    document["test_filenames"] = json!(["b.png"]);
    write_transforms(&folder, &document);
    assert!(
        read_error(&folder).ends_with(r#""b.png" is in both train_filenames and test_filenames"#)
    );
}

#[test]
fn rounded_poses_are_read_with_a_note() {
    let (folder, mut document) = small_folder();
    let round = |value: f64, decimals: f64| (value * decimals).round() / decimals;
    let mut n_notes = [0; 2];
    for angle_rad in (0..100).map(|ix| 0.01 * f64::from(ix)) {
        let (sin, cos) = angle_rad.sin_cos();
        for (n_notes, decimals) in n_notes.iter_mut().zip([1e3, 1e5]) {
            let (sin, cos) = (round(sin, decimals), round(cos, decimals));
            document["frames"][1]["transform_matrix"] = json!([
                [cos, -sin, 0, 0],
                [sin, cos, 0, 0],
                [0, 0, 1, 0],
                [0, 0, 0, 1]
            ]);
            write_transforms(&folder, &document);
            let dataset = read(folder.path()).unwrap();
            let expected = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
            let rotation = dataset.images[0].world_from_camera.rotation
                * nerfstudio::opengl_from_camera().rotation;
            assert!(rotation.angle_to(&expected) < 1.0 / decimals, "{rotation}");
            *n_notes += dataset.notes.len();
        }
    }
    assert!(n_notes[0] > 0 && n_notes[1] == 0, "{n_notes:?}");
    for (first, hint) in [
        (0.6, "write at least four decimals"),
        (2.0, "without scale"),
        (-1.0, "it is mirrored"),
    ] {
        document["frames"][1]["transform_matrix"] =
            json!([[first, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
        if hint == "write at least four decimals" {
            document["frames"][1]["transform_matrix"][0][0] = json!(0.99);
        }
        write_transforms(&folder, &document);
        let lost = &read(folder.path()).unwrap().data_losses[0];
        assert!(lost.contains("not rigid") && lost.contains(hint), "{lost}");
    }
    document["frames"][1]["transform_matrix"] = identity_rows();
    for (key, value, reason) in [
        ("fl_x", json!(1e-6), "are implausible for 8 x 6 pixels"),
        ("cx", json!(1e3), "are implausible"),
        ("camera_angle_x", json!(45), "is it in degrees?"),
        ("camera_model", json!("FISHEYE624"), "SIMPLE_RADIAL"),
    ] {
        let mut changed = document.clone();
        changed[key] = value;
        write_transforms(&folder, &changed);
        assert!(
            read_error(&folder).contains(reason),
            "{}",
            read_error(&folder)
        );
    }
}

#[test]
fn lens_coefficients_of_no_real_lens_are_refused() {
    let (folder, document) = small_folder();
    for (camera_model, k1) in [
        ("OPENCV", 10.0),
        ("OPENCV", -3.0),
        ("OPENCV_FISHEYE", -10.0),
    ] {
        let mut changed = document.clone();
        changed["camera_model"] = json!(camera_model);
        changed["k1"] = json!(k1);
        write_transforms(&folder, &changed);
        let text = read_error(&folder);
        assert!(
            text.contains("transforms.json")
                && text.contains(&format!("(k1 = {k1}) are implausible")),
            "{text}"
        );
    }
    // The directions of the corners are unknown, as with coefficients that were fitted to the
    // center of the images. The remaining pixels are used.
    let mut changed = document.clone();
    changed["k1"] = json!(-0.3);
    write_transforms(&folder, &changed);
    assert_eq!(read(folder.path()).unwrap().images.len(), 2);

    let folder = tum_folder();
    std::fs::write(
        folder.path().join("calibration.txt"),
        "5 5 3.5 2.5 10 0 0 0\n",
    )
    .unwrap();
    assert!(
        read_error(&folder).contains("(k1 = 10) are implausible"),
        "{}",
        read_error(&folder)
    );
}

#[test]
fn files_of_windows_programs_are_read() {
    let (folder, mut document) = small_folder();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for name in ["a", "b"] {
        let at = |name: &str| folder.path().join(name);
        std::fs::rename(
            at(&format!("{name}.png")),
            at(&format!("images/{name}.PNG")),
        )
        .unwrap();
    }
    document["frames"][0]["file_path"] = json!("images\\b.PNG");
    document["frames"][1]["file_path"] = json!(".\\images\\a");
    std::fs::write(
        folder.path().join("transforms.json"),
        format!("\u{FEFF}{document}"),
    )
    .unwrap();
    let dataset = read(folder.path()).unwrap();
    assert_eq!(
        (dataset.images.len(), dataset.notes.len()),
        (2, 0),
        "{:?}",
        dataset.notes
    );
    document["frames"].as_array_mut().unwrap().truncate(1);
    document["frames"][0]["file_path"] = json!("C:\\scan\\b.png");
    write_transforms(&folder, &document);
    assert!(
        read_error(&folder).ends_with("1 are missing, 0 cannot be used (such as C:\\scan\\b.png)")
    );
}

#[test]
fn every_readable_image_format_is_read_and_others_are_named() {
    let (folder, mut document) = small_folder();
    let photo = RgbImage::from_fn(8, 6, |x, y| {
        image::Rgb([
            if x < 4 { 10 } else { 200 },
            if y < 3 { 20 } else { 99 },
            30,
        ])
    });
    for extension in ["png", "webp", "bmp", "tiff"] {
        let name = format!("photo.{extension}");
        photo.save(folder.path().join(&name)).unwrap();
        document["frames"][1]["file_path"] = json!(name);
        write_transforms(&folder, &document);
        let dataset = read(folder.path()).unwrap();
        let loaded = dataset.images[1].load().unwrap();
        let rgb: Vec<u8> = loaded
            .rgba_srgb
            .chunks_exact(4)
            .flat_map(|pixel| &pixel[..3])
            .copied()
            .collect();
        assert_eq!(&rgb, photo.as_raw(), "{extension}");
    }
    for (start, format) in [
        (&b"\0\0\0\x18ftypheic"[..], "HEIC"),
        (b"\0\0\0\x18ftypavif", "AVIF"),
    ] {
        std::fs::write(folder.path().join("photo.png"), [start, &[0; 100]].concat()).unwrap();
        document["frames"][1]["file_path"] = json!("photo.png");
        write_transforms(&folder, &document);
        let lost = &read(folder.path()).unwrap().data_losses[0];
        assert!(
            lost.contains(&format!("is a {format} file")) && lost.contains("convert it"),
            "{lost}"
        );
    }
    std::fs::write(
        folder.path().join("depth.npy"),
        b"\x93NUMPY\x01\0v\0{'descr': '<f4'}",
    )
    .unwrap();
    document["frames"][0]["depth_file_path"] = json!("depth.npy");
    document["frames"].as_array_mut().unwrap().truncate(1);
    write_transforms(&folder, &document);
    let why = read(folder.path()).unwrap().images[0]
        .load()
        .unwrap()
        .depth_error
        .unwrap();
    assert!(
        why.contains("depth.npy\" is a NumPy file") && why.contains("depth 16-bit PNG"),
        "{why}"
    );
}

#[test]
fn huge_depth_of_a_small_file_is_refused() {
    let (folder, mut document) = small_folder();
    save_counts(
        &folder.path().join("depth.png"),
        [8192, 4097],
        &vec![0; 8192 * 4097],
    );
    document["frames"][0]["depth_file_path"] = json!("depth.png");
    write_transforms(&folder, &document);
    let dataset = read(folder.path()).unwrap();
    let loaded = dataset.images[1].load().unwrap();
    assert!(loaded.depth.is_none());
    let why = loaded.depth_error.unwrap();
    assert!(
        why.contains("has 8192x4097 pixels, which exceeds the maximum of 33554432"),
        "{why}"
    );
}

#[test]
fn mask_in_the_alpha_channel_is_named() {
    let (folder, mut document) = small_folder();
    let mask = image::RgbaImage::from_fn(8, 6, |x, _| {
        image::Rgba([0, 0, 0, if x < 4 { 0 } else { 255 }])
    });
    mask.save(folder.path().join("mask.png")).unwrap();
    document["frames"][1]["mask_path"] = json!("mask.png");
    write_transforms(&folder, &document);
    let loaded = read(folder.path()).unwrap().images[0].load().unwrap();
    assert!(
        loaded
            .mask_warning
            .unwrap()
            .contains("mask.png\" is all black and stores its content in the alpha channel")
    );
}

/// Tests each key of the tables in docs/reference/datasets.md in its own file.
#[test]
fn keys_of_transforms_json_are_used_refused_or_named_as_documented() {
    let documented = include_str!("../../../docs/reference/datasets.md");
    let rows: Vec<[&str; 3]> = documented
        .lines()
        .filter_map(|line| {
            line.strip_prefix("| `")?
                .trim_end_matches(" |")
                .split('|')
                .map(str::trim)
                .collect::<Vec<_>>()
                .try_into()
                .ok()
        })
        .map(|[key, place, _, used]: [&str; 4]| [key.trim_end_matches('`'), place, used])
        .collect();
    assert!(rows.len() > 30, "{rows:?}");
    for [key, place, use_of_key] in rows {
        let (folder, mut document) = small_folder();
        RgbImage::new(8, 6)
            .save(folder.path().join("c.png"))
            .unwrap();
        save_counts(&folder.path().join("depth.png"), [8, 6], &[1000; 48]);
        document["frames"][1]["depth_file_path"] = json!("depth.png");
        if let Some(axis) = key.strip_prefix("camera_angle_") {
            document
                .as_object_mut()
                .unwrap()
                .remove(&format!("fl_{axis}"));
            document[key] = json!(1.0);
        }
        let value = match key {
            "frames" | "file_path" | "transform_matrix" => continue, // Nothing can be read without them.
            "camera_model" => json!("OPENCV_FISHEYE"),
            "is_fisheye" => json!(true),
            "w" => json!(16),
            "h" => json!(12),
            "fl_x" | "fl_y" | "cx" | "cy" => json!(5.5),
            "camera_angle_x" | "camera_angle_y" => json!(1.5),
            "depth_file_path" => json!("gone.png"),
            "mask_path" => json!("c.png"),
            "depth_transform_matrix" => {
                json!([[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
            }
            "train_filenames" | "val_filenames" | "test_filenames" => json!(["a.png"]),
            "ply_file_path" => json!("points.ply"),
            _ => json!(0.01),
        };
        for place_of_key in ["file", "frame"]
            .into_iter()
            .filter(|one| place.contains(one))
        {
            write_transforms(&folder, &document);
            let before = read(folder.path()).unwrap();
            let mut changed = document.clone();
            let target = if place_of_key == "file" {
                &mut changed
            } else {
                &mut changed["frames"][1]
            };
            target[key] = value.clone();
            write_transforms(&folder, &changed);
            let after = read(folder.path());
            let context = format!("{key} of a {place_of_key}: {use_of_key}: {after:?}");
            let loaded = |dataset: &Dataset| {
                let load = |image: &DatasetImage| {
                    image
                        .load()
                        .map(|loaded| (loaded.rgba_srgb, loaded.depth))
                        .ok()
                };
                let files = dataset.images.iter().map(load).collect::<Vec<_>>();
                (dataset.images.clone(), files, dataset.points_path.clone())
            };
            match use_of_key {
                "yes" => assert!(
                    after.is_ok_and(|after| loaded(&after) != loaded(&before)),
                    "{context}"
                ),
                "refused" => assert!(after.unwrap_err().to_string().contains(key), "{context}"),
                "no" => {
                    let after = after.unwrap();
                    assert_eq!(
                        (loaded(&after), &after.notes),
                        (loaded(&before), &before.notes),
                        "{context}"
                    );
                }
                "note" => {
                    let after = after.unwrap();
                    assert_eq!(loaded(&after), loaded(&before), "{context}");
                    assert!(
                        after.notes.iter().any(|note| note.contains(key)),
                        "{context}"
                    );
                }
                other => panic!("unknown use {other:?}"),
            }
        }
    }
}

/// The points are in the frame of the poses. Their path follows the same rules as the paths of
/// images.
#[test]
fn path_of_points_is_returned() {
    let (folder, mut document) = small_folder();
    let read_path = |document: &Value| {
        write_transforms(&folder, document);
        let dataset = read(folder.path()).unwrap();
        assert!(dataset.notes.is_empty(), "{:?}", dataset.notes);
        dataset.points_path
    };
    assert_eq!(read_path(&document), None);
    std::fs::create_dir(folder.path().join("sparse")).unwrap();
    let points = folder.path().join("sparse/points.ply");
    std::fs::write(&points, "ply").unwrap();
    document["applied_transform"] = json!([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]);
    for name in [
        "sparse/points.ply",
        "sparse\\points.ply",
        points.to_str().unwrap(),
    ] {
        document["ply_file_path"] = json!(name);
        assert_eq!(read_path(&document).as_deref(), Some(&*points), "{name}");
    }
    document["ply_file_path"] = json!("../gone.ply");
    assert_eq!(
        read_path(&document),
        Some(folder.path().join("../gone.ply")),
        "reading it names the path"
    );
    document["ply_file_path"] = Value::Null;
    assert_eq!(read_path(&document), None);
}

#[test]
fn tum_times_may_have_exponents() {
    let folder = tum_folder();
    let read_stamps = |list: &str| {
        std::fs::write(folder.path().join("rgb.txt"), list).unwrap();
        read(folder.path())
            .unwrap()
            .images
            .iter()
            .map(|image| image.stamp.0)
            .collect::<Vec<_>>()
    };
    for time in [
        "1.100000",
        "+1.1",
        "1.1e0",
        "1.1e+00",
        "11E-1",
        "0.00011e4",
        "1100e-3",
        "1.100000000999",
    ] {
        assert_eq!(
            read_stamps(&format!("{time} rgb/1.100000.png\n")),
            [1_100_000_000],
            "{time}"
        );
    }
    std::fs::write(
        folder.path().join("groundtruth.txt"),
        "1.305031e+09 0 0 0 0 0 0 1\n1.30503100002e+09 1 0 0 0 0 0 1\n",
    )
    .unwrap();
    assert_eq!(
        read_stamps("1.305031000010000001e+09 rgb/1.100000.png\n"),
        [1_305_031_000_010_000_001]
    );
    for time in [
        "1e", "e5", "1.2.3", "0x10", "inf", "nan", "1e40", "--1", ".",
    ] {
        std::fs::write(folder.path().join("rgb.txt"), format!("{time} rgb/1.png\n")).unwrap();
        assert!(
            read_error(&folder).contains("is not a time in seconds"),
            "{time}"
        );
    }
}

#[test]
fn sparse_tum_poses_are_interpolated_but_not_over_gaps() {
    let folder = tum_folder();
    let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).unwrap();
    let photo = |secs: f64| format!("{secs} rgb/1.000000.png\n");
    // The poses have 20 Hz, but the poses from 1.2 s to 1.3 s are missing.
    let poses = (0..20)
        .filter(|ix| !(5..6).contains(ix))
        .map(|ix| f64::from(ix) * 0.05);
    write(
        "groundtruth.txt",
        poses
            .map(|secs| format!("{} {secs} 0 0 0 0 0 1\n", 1.0 + secs))
            .collect(),
    );
    write("rgb.txt", photo(1.125) + &photo(1.225) + &photo(1.425));
    let dataset = read(folder.path()).unwrap();
    let xs: Vec<f64> = dataset
        .images
        .iter()
        .map(|image| image.world_from_camera.translation.x)
        .collect();
    assert!(
        xs.len() == 2 && (xs[0] - 0.125).abs() < 1e-9 && (xs[1] - 0.425).abs() < 1e-9,
        "{xs:?}"
    );
    assert!(
        dataset
            .notes
            .iter()
            .any(|note| note.contains("before and after it are 100 ms apart, at most 75 ms")),
        "{:?}",
        dataset.notes
    );
}

#[test]
fn invalid_lines_and_repeated_times_of_tum_lists_are_named() {
    let folder = tum_folder();
    let poses = "0.99 0 0 0 0 0 0 1\n0.995 0 0 x 0 0 0 1\n1.0 1 0 0 0 0 0 1\n1.0 2 0 0 0 0 0 1\n1.005 0 0 0 0 0\n1.01 0 0 0 0 0 0 1";
    std::fs::write(folder.path().join("groundtruth.txt"), poses).unwrap();
    std::fs::write(folder.path().join("rgb.txt"), "1.0 rgb/1.000000.png\n1.1\n").unwrap();
    let dataset = read(folder.path()).unwrap();
    assert!((dataset.images[0].world_from_camera.translation.x - 1.0).abs() < 1e-9);
    let expected = [
        "rgb.txt: 1 line cannot be used: line 2: nothing follows the time",
        "groundtruth.txt: 2 lines cannot be used: line 2: expected seven numbers tx ty tz qx qy qz qw after the time, \
         line 5: expected seven numbers tx ty tz qx qy qz qw after the time",
        "groundtruth.txt: 1 pose is not used, because an earlier, different pose has the same time; write times with more decimals: line 4",
    ];
    assert_eq!(dataset.data_losses, expected);
}
