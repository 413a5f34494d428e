//! Lens parameters of ROS, as the JSON keys of samples files.
//!
//! Source: `sensor_msgs/CameraInfo`, and the files that `camera_calibration` writes.

use serde_json::{Map, Value, json};

/// Replaces a ROS `CameraInfo` object, of a message or file, by one with our keys; leaves an object without a camera matrix
/// unchanged.
///
/// ROS counts pixels from the center of the first one, so half a pixel is added to the principal point.
///
/// # Errors
/// If the values are malformed or have no equivalent.
pub fn convert(intrinsics: &mut Value) -> Result<(), String> {
    let Some(object) = intrinsics.as_object() else { return Ok(()) };
    let first = |keys: [&'static str; 3]| keys.into_iter().find_map(|key| Some((key, object.get(key)?)));
    let Some((matrix_key, matrix)) = first(["camera_matrix", "k", "K"]) else { return Ok(()) };
    let matrix: [f64; 9] = numbers(matrix)
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| format!("{matrix_key} must have 9 numbers"))?;
    let [fx, skew, cx, zero, fy, cy, ..] = matrix;
    if skew != 0.0 || zero != 0.0 || matrix[6..] != [0.0, 0.0, 1.0] {
        return Err(format!("{matrix_key} must be fx, 0, cx, 0, fy, cy, 0, 0, 1"));
    }
    let mut coefficients = match first(["distortion_coefficients", "d", "D"]) {
        Some((key, list)) => numbers(list).ok_or_else(|| format!("{key} must be numbers"))?,
        None => Vec::new(),
    };
    while coefficients.last() == Some(&0.0) {
        coefficients.pop();
    }
    let name = object.get("distortion_model").and_then(Value::as_str).unwrap_or("plumb_bob");
    let (model, max) = match name {
        _ if coefficients.is_empty() => ("pinhole", 0),
        "plumb_bob" => ("brown_conrady", 5),
        "rational_polynomial" => ("brown_conrady", 8),
        "equidistant" | "fisheye" => ("kannala_brandt", 4),
        other => return Err(format!("distortion_model {other:?} is not supported")),
    };
    if coefficients.len() > max {
        return Err(format!("{} distortion coefficients that are not 0; {name} has at most {max}", coefficients.len()));
    }
    let mut converted = Map::new();
    converted.insert("focal_px".to_owned(), json!([fx, fy]));
    converted.insert("principal_px".to_owned(), json!([cx + 0.5, cy + 0.5]));
    converted.insert("model".to_owned(), model.into());
    converted.insert("distortion".to_owned(), coefficients.into());
    let size = ["width", "height"].map(|side| object.get(&format!("image_{side}")).or_else(|| object.get(side)));
    if let [Some(width), Some(height)] = size {
        converted.insert("size_px".to_owned(), json!([width, height]));
    }
    *intrinsics = converted.into();
    Ok(())
}

/// The numbers of a list, or of a matrix with its numbers in `data`.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    value.get("data").unwrap_or(value).as_array()?.iter().map(Value::as_f64).collect()
}

/// Whether a text is a list of keys in YAML.
pub fn is_yaml(text: &str) -> bool {
    let mut lines = text.lines().filter(|line| !line.is_empty() && !line.starts_with(['#', '%']) && *line != "---");
    let is_key = |word: &str| !word.is_empty() && word.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c));
    lines.next().and_then(|line| line.split_once(':')).is_some_and(|(key, _)| is_key(key.trim_start_matches("- ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn converted(mut value: Value) -> Result<Value, String> {
        convert(&mut value).map(|()| value)
    }

    #[test]
    fn camera_info_of_files_and_messages_is_converted() {
        let file = json!({
            "image_width": 640, "image_height": 480, "camera_name": "c",
            "camera_matrix": {"rows": 3, "cols": 3, "data": [610, 0, 322.5, 0, 608, 241, 0, 0, 1]},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, -0.2, 0.001, 0, 0]},
        });
        let expected = json!({
            "size_px": [640, 480], "focal_px": [610.0, 608.0], "principal_px": [323.0, 241.5],
            "model": "brown_conrady", "distortion": [0.1, -0.2, 0.001],
        });
        assert_eq!(converted(file.clone()), Ok(expected));
        let message = |model: &str, d: &[f64]| json!({"width": 64, "height": 48, "k": [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1], "distortion_model": model, "d": d});
        let model_of = |value: Value| converted(value).map(|value| value["model"].as_str().map(str::to_owned));
        assert_eq!(model_of(message("plumb_bob", &[0.0; 8])), Ok(Some("pinhole".to_owned())));
        assert_eq!(model_of(message("equidistant", &[0.1, 0.0, 0.0, 0.0])), Ok(Some("kannala_brandt".to_owned())));
        assert!(model_of(message("plumb_bob", &[0.1; 8])).is_err_and(|why| why.contains("8 distortion coefficients")));
        assert!(model_of(message("omni", &[0.1])).is_err_and(|why| why.contains("omni")));
        let own = json!({"focal_px": [1, 1]});
        assert_eq!(converted(own.clone()), Ok(own));
        let mut skewed = file;
        skewed["camera_matrix"]["data"][1] = 1.into();
        assert!(converted(skewed).is_err());
    }

    #[test]
    fn yaml_is_recognized() {
        for yaml in ["samples:\n- a: 1", "# comment\n---\nimage_width: 640", "%YAML:1.0\nK: [1]", "- a: 1"] {
            assert!(is_yaml(yaml), "{yaml}");
        }
        for other in ["{\"a\": 1}", "", "[1]", "hello", "\"a\": 1"] {
            assert!(!is_yaml(other), "{other}");
        }
    }
}
