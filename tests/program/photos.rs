//! A few small photos with poses, for short training runs.

use serde_json::json;
use std::path::Path;

const SIZE_PX: [u32; 2] = [64, 48];

/// Ten photos of a patterned wall, taken from positions in a row.
pub(crate) fn dataset(folder: &Path) {
    std::fs::create_dir_all(folder).expect("the disk has space");
    let mut frames = Vec::new();
    for ix in 0..10 {
        let name = format!("{ix:03}.png");
        let shade =
            |x: u32, y: u32| u8::try_from((x / 8 + y / 8 + ix) % 2 * 150 + x).expect("small");
        let photo = image::RgbImage::from_fn(SIZE_PX[0], SIZE_PX[1], |x, y| {
            image::Rgb([
                shade(x, y),
                shade(y, x),
                u8::try_from(5 * y).expect("small"),
            ])
        });
        photo.save(folder.join(&name)).expect("the disk has space");
        let x = 0.05 * f64::from(ix);
        let pose = [
            [1.0, 0.0, 0.0, x],
            [0.0, 1.0, 0.0, 0.1],
            [0.0, 0.0, 1.0, 2.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        frames.push(json!({ "file_path": name, "transform_matrix": pose }));
    }
    let lens = json!({ "w": 64, "h": 48, "fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "frames": frames });
    std::fs::write(folder.join("transforms.json"), lens.to_string()).expect("the disk has space");
}
