//! A scene of a few tiny photos of a colorful wall, and a function that runs the program on it.

use image::{ImageBuffer, Luma, RgbImage};
use serde_json::json;
use std::path::Path;
use std::process::{Command, Output};

const N_PHOTOS: u32 = 10;
const SIZE_PX: [u32; 2] = [48, 36];

/// Writes a nerfstudio folder: a camera slides along a colorful wall, 1 m away from it and `up_m`
/// higher than in other datasets.
pub(crate) fn write(folder: &Path, has_depth: bool, up_m: f64) {
    std::fs::create_dir(folder).expect("the disk has space");
    let ([w, h], focal_px) = (SIZE_PX, 45.0);
    let mut frames = Vec::new();
    for ix in 0..N_PHOTOS {
        let x_m = 0.05 * f64::from(ix);
        let color = |u: u32, v: u32| {
            let (x, y) = (
                x_m + (f64::from(u) - 23.5) / focal_px,
                (f64::from(v) - 17.5) / focal_px,
            );
            #[expect(clippy::cast_possible_truncation, reason = "27 to 227")]
            let wave = |phase: f64| {
                (127.0 + 100.0 * (8.0 * x + phase).sin() * (7.0 * y + phase).cos()) as u8
            };
            image::Rgb([wave(0.0), wave(1.0), wave(2.0)])
        };
        let [photo, depth] = ["", "depth_"].map(|kind| format!("{kind}{ix:02}.png"));
        RgbImage::from_fn(w, h, color)
            .save(folder.join(&photo))
            .expect("the disk has space");
        let rows = [
            [1.0, 0.0, 0.0, x_m],
            [0.0, 1.0, 0.0, up_m],
            [0.0, 0.0, 1.0, 1.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        let mut frame = json!({ "file_path": photo, "transform_matrix": rows });
        if has_depth {
            let depth_image = ImageBuffer::<Luma<u16>, _>::from_pixel(w, h, Luma([1000]));
            depth_image
                .save(folder.join(&depth))
                .expect("the disk has space");
            frame["depth_file_path"] = depth.into();
        }
        frames.push(frame);
    }
    let lens = json!({ "fl_x": focal_px, "fl_y": focal_px, "cx": 24.0, "cy": 18.0, "w": w, "h": h, "frames": frames });
    std::fs::write(folder.join("transforms.json"), lens.to_string()).expect("the disk has space");
}

/// Runs the program with these arguments in a folder.
pub(crate) fn fieldrig(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .current_dir(folder)
        .env_remove("FIELDRIG_LPIPS_WEIGHTS")
        .args(args)
        .output()
        .expect("fieldrig starts")
}
