//! Reads camera info files of ROS, which replace `intrinsics` tables in rig files.

use super::ConfigError;
use super::key::{entry, number};
use super::section::ParseContext;
use crate::camera_info::CameraInfo;
use kinematics::Intrinsics;
use std::path::Path;
use toml::{Table, Value};

const KEY: &str = "intrinsics";

/// Replaces the paths of camera info files with tables of their contents, for the color and depth
/// images of all cameras of a rig. The paths are relative to `folder`. Logs notes about the
/// contents.
pub(super) fn insert_contents(
    rig: &mut Table,
    folder: &Path,
    context: &ParseContext,
) -> Result<(), ConfigError> {
    let Some(Value::Table(cameras)) = rig.get_mut("camera") else {
        return Ok(());
    };
    for (name, camera) in cameras {
        let Value::Table(camera) = camera else {
            continue;
        };
        let files = Files { folder, context };
        files.insert(&format!("camera.{name}"), camera, &Table::new())?;
        // Depth images inherit the size of the color images if the rig file sets no size for depth.
        let color = camera.clone();
        if let Some(Value::Table(depth)) = camera.get_mut("depth") {
            files.insert(&format!("camera.{name}.depth"), depth, &color)?;
        }
    }
    Ok(())
}

struct Files<'a> {
    folder: &'a Path,
    context: &'a ParseContext,
}

impl Files<'_> {
    /// Replaces the path in the table of a camera or of its depth. `defaults` contains the values
    /// of keys that are absent in `table`.
    fn insert(
        &self,
        table_path: &str,
        table: &mut Table,
        defaults: &Table,
    ) -> Result<(), ConfigError> {
        let Some(Value::String(file)) = table.get(KEY) else {
            return Ok(());
        };
        let key = format!("{table_path}.{KEY}");
        let path = self.folder.join(file);
        let rejected = |reason: String| ConfigError::CameraInfo {
            at: self.context.location(&key),
            key: key.clone(),
            reason: format!("{path:?}: {reason}"),
        };
        let text = files::read_text(&path).map_err(|source| ConfigError::Read {
            description: "the lens parameters",
            path: path.clone(),
            source,
        })?;
        let info = CameraInfo::parse(&text).map_err(&rejected)?;
        let setting = |name: &str| table.get(name).or_else(|| defaults.get(name));
        // With `rectified = true`, distortion would be ignored, and the camera matrix would belong
        // to other images.
        if setting("rectified") == Some(&Value::Boolean(true)) {
            return Err(rejected(
                "these are the lens parameters of raw images, but rectified = true; remove that key, or use the numbers of \
                 projection_matrix"
                    .to_owned(),
            ));
        }
        let sides = setting("size_px").and_then(Value::as_array);
        let sides = sides.and_then(|sides| sides.iter().map(number).collect::<Option<Vec<f64>>>());
        // The parameters are not scaled to another size. A camera may crop its images instead of
        // scaling them, and the file does not show which of the two it does.
        if let (Some([width, height]), Some(sides)) = (info.size_px, sides)
            && sides != [f64::from(width), f64::from(height)]
        {
            return Err(rejected(format!(
                "these are the lens parameters of images of {width}x{height} pixels, but size_px is {sides:?}; calibrate \
                 this resolution"
            )));
        }
        for note in &info.notes {
            log::warn!("{key}: {}: {note}", path.display());
        }
        let CameraInfo {
            size_px,
            focal_px,
            principal_px,
            lens,
            ..
        } = info;
        let size_px = size_px.unwrap_or_default(); // Not written: it is a key of the camera.
        table.extend(entry(
            KEY,
            &Intrinsics {
                size_px,
                focal_px,
                principal_px,
                lens,
                rectified: false,
            },
        ));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rig;
    use kinematics::Lens;

    const RIG: &str = r#"
[arm]
driver = "none"
[camera.front]
driver = "v4l2"
size_px = [640, 480]
rate_hz = 30
parent = "base"
intrinsics = "left.yaml"
"#;
    const INFO: &str = "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n\
        camera_matrix: {rows: 3, cols: 3, data: [600, 0, 319.5, 0, 601, 239.5, 0, 0, 1]}\n\
        distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0, 0, 0]}\n";

    fn load(rig: &str, info: &str) -> Result<Rig, ConfigError> {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("rig.toml"), rig).expect("written");
        std::fs::write(folder.path().join("left.yaml"), info).expect("written");
        Rig::load(&folder.path().join("rig.toml"), &[])
    }

    #[test]
    fn lens_of_color_and_depth_is_read() {
        let expected = Intrinsics {
            size_px: [640, 480],
            focal_px: [600.0, 601.0],
            principal_px: [320.0, 240.0],
            lens: Lens::BrownConrady([0.1, -0.2, 0.0, 0.0, 0.0]),
            rectified: false,
        };
        let rig = load(RIG, INFO).expect("a rig");
        assert_eq!(rig.cameras[0].intrinsics, expected);
        let effective = Rig::parse("rig.toml", &rig.to_toml(), &rig.arm.urdf_text, &[])
            .expect("no file is needed");
        assert_eq!(effective.cameras[0].intrinsics, expected);

        let depth = "[camera.front.depth]\nintrinsics = \"left.yaml\"\n";
        let color = RIG.replace(
            "\"left.yaml\"",
            "{ focal_px = [500, 500], principal_px = [320, 240] }",
        );
        let rig = load(&format!("{color}{depth}"), INFO).expect("a rig");
        assert_eq!(
            rig.cameras[0].depth.as_ref().map(|depth| &depth.intrinsics),
            Some(&expected)
        );
        assert_eq!(rig.cameras[0].intrinsics.focal_px, [500.0, 500.0]);
        let error = load(&format!("{color}{depth}size_px = [320, 240]\n"), INFO)
            .expect_err("another size")
            .to_string();
        assert!(
            error.starts_with("rig.toml line 11: camera.front.depth.intrinsics: "),
            "{error}"
        );
        assert!(
            error.contains("640x480 pixels, but size_px is [320.0, 240.0]"),
            "{error}"
        );
    }

    #[test]
    fn problems_name_line_and_file() {
        let other_size = RIG.replace("[640, 480]", "[1280, 960]");
        let rectified = RIG.replace("rate_hz", "rectified = true\nrate_hz");
        let broken = INFO.replace("plumb_bob", "omni");
        for (rig, info, line, expected) in [
            (
                other_size.as_str(),
                INFO,
                9,
                "640x480 pixels, but size_px is [1280.0, 960.0]; calibrate this resolution",
            ),
            (
                rectified.as_str(),
                INFO,
                10,
                "raw images, but rectified = true",
            ),
            (
                RIG,
                broken.as_str(),
                9,
                "distortion_model \"omni\" is not supported",
            ),
            (RIG, "image_width: [", 9, " at line "),
        ] {
            let error = load(rig, info).expect_err(expected).to_string();
            assert!(
                error.starts_with(&format!("rig.toml line {line}: camera.front.intrinsics: ")),
                "{error}"
            );
            assert!(
                error.contains("left.yaml") && error.contains(expected),
                "{error}"
            );
        }
        let missing = load(&RIG.replace("left", "right"), INFO)
            .expect_err("missing")
            .to_string();
        assert!(
            missing.contains("cannot read the lens parameters") && missing.contains("right.yaml"),
            "{missing}"
        );
        let tiny = load(RIG, &INFO.replace("[600,", "[0.5,"))
            .expect_err("the range is checked")
            .to_string();
        assert!(tiny.contains("camera.front.intrinsics.focal_px"), "{tiny}");
    }
}
