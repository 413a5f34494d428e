//! Lens parameters of ROS: messages `sensor_msgs/CameraInfo`, and the files that
//! `camera_calibration` writes.
//!
//! The keys are listed in docs/reference/camera-info.md. Source: the definition of
//! `sensor_msgs/CameraInfo`, and of its distortion models in `image_geometry`.

use kinematics::Lens;
use serde_json::{Map, Value, json};
use serde_saphyr::UserMessageFormatter;

/// Lens parameters of the raw images of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Width and height of the images, pixels; `None` if the file does not contain them.
    pub size_px: Option<[u32; 2]>,
    /// Focal lengths along x and y, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels. Half a pixel is added to the value of ROS, which is measured from
    /// the center of the first pixel.
    pub principal_px: [f64; 2],
    /// Distortion.
    pub lens: Lens,
    /// Notes for the user about keys that are not used: one sentence each.
    pub notes: Vec<String>,
}

/// Names of a key in files, in messages of ROS 1 and in messages of ROS 2. A file may use at most
/// one of them.
type Names = &'static [&'static str];

const WIDTH: Names = &["image_width", "width"];
const HEIGHT: Names = &["image_height", "height"];
const CAMERA_MATRIX: Names = &["camera_matrix", "K", "k"];
const DISTORTION_MODEL: Names = &["distortion_model"];
const DISTORTION: Names = &["distortion_coefficients", "D", "d"];
const RECTIFICATION: Names = &["rectification_matrix", "R", "r"];
const PROJECTION: Names = &["projection_matrix", "P", "p"];
const BINNING: [Names; 2] = [&["binning_x"], &["binning_y"]];
const ROI: Names = &["roi"];
/// Keys that do not change the lens.
const UNUSED: Names = &["camera_name", "header"];

/// Maximum number of unknown keys in a note.
const MAX_NAMED: usize = 5;

impl CameraInfo {
    /// Reads a file in YAML or JSON.
    ///
    /// # Errors
    /// If the text is neither, a value is malformed, or the lens or the image region has no
    /// equivalent. The message names the line or the key.
    pub fn parse(text: &str) -> Result<Self, String> {
        Self::of(&parse_value(text)?)
    }

    fn of(value: &Value) -> Result<Self, String> {
        let object = value
            .as_object()
            .ok_or("expected keys such as camera_matrix, found a single value or a list")?;
        let (matrix_key, matrix) =
            find(object, CAMERA_MATRIX)?.ok_or("camera_matrix is missing")?;
        let camera_matrix: [f64; 9] = matrix_of(matrix_key, matrix)?;
        let [fx, skew, cx, zero, fy, cy, ..] = camera_matrix;
        if camera_matrix == [0.0; 9] {
            return Err(format!(
                "{matrix_key} contains only zeros: the camera is not calibrated"
            ));
        }
        if skew != 0.0 || zero != 0.0 || camera_matrix[6..] != [0.0, 0.0, 1.0] {
            return Err(format!(
                "{matrix_key} must be fx, 0, cx, 0, fy, cy, 0, 0, 1"
            ));
        }
        let size_px = size_px(object)?;
        check_region(object, size_px)?;
        Ok(Self {
            size_px,
            focal_px: [fx, fy],
            principal_px: [cx + 0.5, cy + 0.5],
            lens: lens(object)?,
            notes: notes(object, &camera_matrix)?,
        })
    }

    /// These parameters, with the keys of samples files.
    fn to_json(&self) -> Value {
        let (model, distortion): (_, &[f64]) = match &self.lens {
            Lens::Pinhole => ("pinhole", &[]),
            Lens::BrownConrady(k) => ("brown_conrady", k),
            Lens::RationalBrownConrady(k) => ("brown_conrady", k),
            Lens::KannalaBrandt(k) => ("kannala_brandt", k),
        };
        let mut converted = json!({
            "focal_px": self.focal_px, "principal_px": self.principal_px, "model": model, "distortion": distortion,
        });
        if let Some(size_px) = self.size_px {
            converted["size_px"] = json!(size_px);
        }
        converted
    }
}

/// Replaces a ROS `CameraInfo` object from a message or file with an object that has the keys of
/// fieldrig's samples files. Does not change objects without a camera matrix. Returns notes for the
/// user.
///
/// # Errors
/// As for [`CameraInfo::parse`].
pub fn convert(intrinsics: &mut Value) -> Result<Vec<String>, String> {
    let has_matrix =
        |object: &Map<String, Value>| CAMERA_MATRIX.iter().any(|name| object.contains_key(*name));
    if !intrinsics.as_object().is_some_and(has_matrix) {
        return Ok(Vec::new());
    }
    let info = CameraInfo::of(intrinsics)?;
    *intrinsics = info.to_json();
    Ok(info.notes)
}

/// Parses YAML or JSON. Ignores the line of dashes that `rostopic echo` and `ros2 topic echo` print
/// after a message.
///
/// # Errors
/// If the text is neither; the message gives line and column.
pub fn parse_value(text: &str) -> Result<Value, String> {
    // OpenCV's header is not a valid YAML directive, and the message of the parser would not name
    // the cause. The header is therefore checked first.
    if text.starts_with("%YAML:") {
        return Err("it is YAML of OpenCV, expected a camera_info file of ROS".to_owned());
    }
    // JSON is tried first. Most JSON is also valid YAML, but the JSON parser is stricter.
    if let Ok(value) = serde_json::from_str(text) {
        return Ok(value);
    }
    let text = text.trim_end();
    let message = text.strip_suffix("\n---").unwrap_or(text);
    // Without a snippet, the message is a single line.
    let options = serde_saphyr::options! { with_snippet: false };
    serde_saphyr::from_str_with_options(message, options)
        .map_err(|error| error.render_with_formatter(&UserMessageFormatter))
}

/// Whether a text is a list of keys in YAML.
pub fn is_yaml(text: &str) -> bool {
    let mut lines = text
        .lines()
        .filter(|line| !line.is_empty() && !line.starts_with(['#', '%']) && *line != "---");
    lines
        .next()
        .and_then(|line| line.split_once(':'))
        .is_some_and(|(key, _)| is_key(key.trim_start_matches("- ")))
}

/// Whether a word can be a key. Because of this test, other formats with colons are not mistaken
/// for YAML.
fn is_key(word: &str) -> bool {
    !word.is_empty()
        && word
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || "_-".contains(c))
}

/// The name under which a key appears, and its value. `None` if the key is missing. A value `null`
/// counts as missing.
fn find(
    object: &Map<String, Value>,
    names: Names,
) -> Result<Option<(&'static str, &Value)>, String> {
    let mut found = names
        .iter()
        .filter_map(|name| Some((*name, object.get(*name).filter(|value| !value.is_null())?)));
    // If a file contains two names of a key, it is unclear which of them counts.
    match (found.next(), found.next()) {
        (Some((name, _)), Some((other, _))) => Err(format!(
            "{name} and {other} mean the same: keep one of them"
        )),
        (first, _) => Ok(first),
    }
}

/// The numbers of a list, or of an object with `rows`, `cols` and `data`.
fn numbers(key: &str, value: &Value) -> Result<Vec<f64>, String> {
    let list = match value.as_object() {
        Some(object) => {
            if let Some(unknown) = object
                .keys()
                .find(|name| !["rows", "cols", "data"].contains(&name.as_str()))
            {
                return Err(format!(
                    "{key} has an unknown key {unknown:?}, expected rows, cols and data"
                ));
            }
            object
                .get("data")
                .ok_or_else(|| format!("{key}: data is missing"))?
        }
        None => value,
    };
    // A value that is no number makes the whole list invalid. If it were skipped, the values after
    // it would shift.
    let numbers: Option<Vec<f64>> = list
        .as_array()
        .and_then(|list| list.iter().map(Value::as_f64).collect());
    let numbers = numbers.ok_or_else(|| format!("{key} must be a list of numbers"))?;
    // A file that was edited by hand may have lost a number.
    if let (Some(rows), Some(cols)) = (
        dimension(key, value, "rows")?,
        dimension(key, value, "cols")?,
    ) && rows.checked_mul(cols) != Some(numbers.len() as u64)
    {
        return Err(format!(
            "{key} has {rows} rows and {cols} columns, but {} numbers",
            numbers.len()
        ));
    }
    Ok(numbers)
}

/// The value of `rows` or `cols` of a matrix; `None` if it is not given.
fn dimension(key: &str, value: &Value, name: &str) -> Result<Option<u64>, String> {
    value
        .get(name)
        .map(|side| {
            side.as_u64()
                .ok_or_else(|| format!("{key}: {name} is {side}, expected a number"))
        })
        .transpose()
}

fn matrix_of<const N: usize>(key: &str, value: &Value) -> Result<[f64; N], String> {
    let numbers = numbers(key, value)?;
    let n = numbers.len();
    numbers
        .try_into()
        .map_err(|_| format!("{key} has {n} numbers, expected {N}"))
}

fn size_px(object: &Map<String, Value>) -> Result<Option<[u32; 2]>, String> {
    match (side_px(object, WIDTH)?, side_px(object, HEIGHT)?) {
        (Some(width), Some(height)) => Ok(Some([width, height])),
        (None, None) => Ok(None),
        (Some(_), None) => Err("the height of the images is missing".to_owned()),
        (None, Some(_)) => Err("the width of the images is missing".to_owned()),
    }
}

/// The width or height of the images; `None` if it is not given.
fn side_px(object: &Map<String, Value>, names: Names) -> Result<Option<u32>, String> {
    let Some((key, value)) = find(object, names)? else {
        return Ok(None);
    };
    let px = value
        .as_u64()
        .and_then(|px| u32::try_from(px).ok())
        .filter(|px| *px > 0);
    px.map(Some)
        .ok_or_else(|| format!("{key} is {value}, expected a number of pixels"))
}

/// Rejects binned and cropped images, because the camera matrix is that of whole images.
fn check_region(object: &Map<String, Value>, size_px: Option<[u32; 2]>) -> Result<(), String> {
    const REMEDY: &str =
        "the camera matrix is that of whole images; calibrate with images as they are recorded";
    for names in BINNING {
        // 0 and 1 both mean that pixels are not combined.
        if let Some((key, value)) =
            find(object, names)?.filter(|(_, value)| ![0, 1].map(Value::from).contains(value))
        {
            return Err(format!("{key} is {value}: {REMEDY}"));
        }
    }
    let Some((key, roi)) = find(object, ROI)? else {
        return Ok(());
    };
    if !roi.is_object() {
        return Err(format!(
            "{key} must have the keys x_offset, y_offset, width and height"
        ));
    }
    // Drivers write zeros for a region that is the whole image, or its full size.
    let number = |name: &str| roi.get(name).unwrap_or(&Value::Null).clone();
    let is_zero = |name: &str| number(name).is_null() || number(name) == 0;
    let is_whole = |name: &str, ix: usize| {
        is_zero(name) || size_px.is_some_and(|size_px| number(name) == size_px[ix])
    };
    if is_zero("x_offset") && is_zero("y_offset") && is_whole("width", 0) && is_whole("height", 1) {
        return Ok(());
    }
    Err(format!("{key} is a part of the image: {REMEDY}"))
}

fn lens(object: &Map<String, Value>) -> Result<Lens, String> {
    let mut coefficients = match find(object, DISTORTION)? {
        Some((key, list)) => numbers(key, list)?,
        None => Vec::new(),
    };
    // Zeros at the end change nothing. Without them, a longer list of coefficients fits a model
    // with fewer.
    while coefficients.last() == Some(&0.0) {
        coefficients.pop();
    }
    let model = match find(object, DISTORTION_MODEL)? {
        Some((key, model)) => model
            .as_str()
            .ok_or_else(|| format!("{key} is {model}, expected a name"))?,
        None => "",
    };
    // Drivers of cameras without distortion often leave the model empty.
    let model = if model.is_empty() { "plumb_bob" } else { model };
    let n = coefficients.len();
    match model {
        "plumb_bob" | "rational_polynomial" if n == 0 => Ok(Lens::Pinhole),
        "plumb_bob" | "rational_polynomial" if n <= 5 => {
            Ok(Lens::BrownConrady(padded(&coefficients)))
        }
        "plumb_bob" => too_many(n, model, 5),
        "rational_polynomial" if n <= 8 => Ok(Lens::RationalBrownConrady(padded(&coefficients))),
        "rational_polynomial" => too_many(n, model, 8),
        // Without coefficients, the lens is still a fisheye: the radius is proportional to the
        // angle.
        "equidistant" | "fisheye" if n <= 4 => Ok(Lens::KannalaBrandt(padded(&coefficients))),
        "equidistant" | "fisheye" => too_many(n, model, 4),
        other => Err(format!(
            "distortion_model {other:?} is not supported, expected plumb_bob, rational_polynomial, equidistant or fisheye"
        )),
    }
}

/// The error for a list with `n` nonzero coefficients if the model has at most `max`.
fn too_many(n: usize, model: &str, max: usize) -> Result<Lens, String> {
    Err(format!(
        "{n} distortion coefficients that are not 0; {model} has at most {max}"
    ))
}

/// The coefficients, followed by zeros.
fn padded<const N: usize>(coefficients: &[f64]) -> [f64; N] {
    std::array::from_fn(|ix| coefficients.get(ix).copied().unwrap_or(0.0))
}

fn notes(object: &Map<String, Value>, camera_matrix: &[f64; 9]) -> Result<Vec<String>, String> {
    const IDENTITY: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let mut rectified = Vec::new();
    if let Some((key, value)) = find(object, RECTIFICATION)? {
        let rotation: [f64; 9] = matrix_of(key, value)?;
        // Drivers write zeros if they do not know the rectification.
        rectified.extend((rotation != IDENTITY && rotation != [0.0; 9]).then_some(key));
    }
    if let Some((key, value)) = find(object, PROJECTION)? {
        let projection: [f64; 12] = matrix_of(key, value)?;
        // The projection matrix of an unrectified monocular camera repeats the camera matrix, with
        // 0 in the fourth column. Anything else describes rectified images or the baseline of a
        // stereo pair.
        let [a, b, c, d] =
            [0, 1, 2, 3].map(|column| [0, 1, 2].map(|row| projection[4 * row + column]));
        let of_raw_images =
            [0, 1, 2].map(|column| [0, 1, 2].map(|row| camera_matrix[3 * row + column]));
        rectified.extend(
            ([a, b, c] != of_raw_images && projection != [0.0; 12] || d != [0.0; 3]).then_some(key),
        );
    }
    let mut notes = Vec::new();
    if !rectified.is_empty() {
        notes.push(format!(
            "not used, because lens parameters are those of raw images, not of rectified ones: {}",
            rectified.join(", ")
        ));
    }
    let unknown: Vec<&String> = object.keys().filter(|key| !is_known(key)).collect();
    if !unknown.is_empty() {
        notes.push(format!(
            "unknown keys are not used: {}",
            messages::shortened(&unknown, MAX_NAMED, ", ")
        ));
    }
    Ok(notes)
}

/// Whether a key belongs to camera info.
fn is_known(key: &str) -> bool {
    const KNOWN: [Names; 9] = [
        WIDTH,
        HEIGHT,
        CAMERA_MATRIX,
        DISTORTION_MODEL,
        DISTORTION,
        RECTIFICATION,
        PROJECTION,
        ROI,
        UNUSED,
    ];
    KNOWN
        .iter()
        .chain(&BINNING)
        .any(|names| names.contains(&key))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn converted(mut value: Value) -> Result<Value, String> {
        convert(&mut value).map(|_| value)
    }

    /// A file of `camera_calibration`, as yaml-cpp formats it.
    const FILE: &str = "\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [610.5, 0.     , 322.5,
         0.   , 608.   , 241. ,
         0.   , 0.     , 1.   ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -2e-01, 0.001, 0, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [610.5, 0., 322.5, 0., 0., 608., 241., 0., 0., 0., 1., 0.]
";

    fn info_of_file() -> CameraInfo {
        CameraInfo {
            size_px: Some([640, 480]),
            focal_px: [610.5, 608.0],
            principal_px: [323.0, 241.5],
            lens: Lens::BrownConrady([0.1, -0.2, 0.001, 0.0, 0.0]),
            notes: Vec::new(),
        }
    }

    #[test]
    fn files_in_yaml_and_json_are_read() {
        assert_eq!(CameraInfo::parse(FILE), Ok(info_of_file()));
        assert_eq!(
            CameraInfo::parse(&FILE.replace('\n', "\r\n")),
            Ok(info_of_file())
        );
        let json = parse_value(FILE).unwrap().to_string();
        assert_eq!(CameraInfo::parse(&json), Ok(info_of_file()));
        let printed = "header: {seq: 1, frame_id: ''}\nheight: 48\nwidth: 64\ndistortion_model: \"plumb_bob\"\n\
            D: [0.5, 0.0, 0.0, 0.0, 0.0]\nK: [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]\nbinning_x: 0\n\
            binning_y: 1\nroi: \n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 64\n  do_rectify: False\n---\n";
        let message = CameraInfo::parse(printed).unwrap();
        assert_eq!(
            (message.size_px, message.principal_px),
            (Some([64, 48]), [32.0, 24.0])
        );
        assert_eq!(
            (message.lens, message.notes.len()),
            (Lens::BrownConrady([0.5, 0.0, 0.0, 0.0, 0.0]), 0)
        );
    }

    #[test]
    fn camera_info_of_files_and_messages_is_converted() {
        let expected = json!({
            "size_px": [640, 480], "focal_px": [610.5, 608.0], "principal_px": [323.0, 241.5],
            "model": "brown_conrady", "distortion": [0.1, -0.2, 0.001, 0.0, 0.0],
        });
        assert_eq!(converted(parse_value(FILE).unwrap()), Ok(expected));
        let own = json!({"focal_px": [1, 1]});
        assert_eq!(converted(own.clone()), Ok(own));
    }

    #[test]
    fn distortion_models_map_to_lenses() {
        let lens = |model: &str, d: &[f64]| {
            let k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0];
            CameraInfo::of(&json!({"k": k, "distortion_model": model, "d": d}))
                .map(|info| info.lens)
        };
        let eight = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8];
        assert_eq!(lens("plumb_bob", &[0.0; 8]), Ok(Lens::Pinhole));
        assert_eq!(lens("", &[]), Ok(Lens::Pinhole));
        assert_eq!(
            lens("plumb_bob", &eight[..4]),
            Ok(Lens::BrownConrady([0.1, 0.2, 0.3, 0.4, 0.0]))
        );
        assert_eq!(
            lens("rational_polynomial", &eight),
            Ok(Lens::RationalBrownConrady(eight))
        );
        let with_thin_prism = [&eight[..], &[0.0; 6]].concat();
        assert_eq!(
            lens("rational_polynomial", &with_thin_prism),
            Ok(Lens::RationalBrownConrady(eight))
        );
        for model in ["equidistant", "fisheye"] {
            assert_eq!(
                lens(model, &eight[..4]),
                Ok(Lens::KannalaBrandt([0.1, 0.2, 0.3, 0.4]))
            );
            assert_eq!(
                lens(model, &[0.0; 4]),
                Ok(Lens::KannalaBrandt([0.0; 4])),
                "not a pinhole"
            );
            assert!(
                lens(model, &eight).is_err_and(|why| why.contains("8 distortion coefficients"))
            );
        }
        assert!(
            lens("plumb_bob", &eight).is_err_and(|why| why.contains("8 distortion coefficients"))
        );
        assert!(
            lens("rational_polynomial", &[0.1; 12]).is_err_and(|why| why.contains("at most 8"))
        );
        assert!(lens("omni", &[]).is_err_and(|why| why.contains("omni")));
    }

    #[test]
    fn malformed_files_are_rejected_with_the_line_or_key() {
        let reason_after = |was: &str, is: &str| {
            assert!(FILE.contains(was), "{was}");
            CameraInfo::parse(&FILE.replacen(was, is, 1)).expect_err(is)
        };
        for (was, is, expected) in [
            (
                "610.5, 0. ",
                "610.5, 0.1",
                "camera_matrix must be fx, 0, cx",
            ),
            (
                "  cols: 3\n",
                "  cols: 2\n",
                "camera_matrix has 3 rows and 2 columns, but 9 numbers",
            ),
            (
                "  rows: 3\n",
                "  dt: d\n",
                "camera_matrix has an unknown key \"dt\"",
            ),
            (
                "  data: [610.5",
                "  dada: [610.5",
                "camera_matrix has an unknown key \"dada\"",
            ),
            (
                "data: [0.1",
                "data: [one",
                "distortion_coefficients must be a list of numbers",
            ),
            ("data: [0.1", "data: [.nan", "line 14"),
            (
                "image_width: 640",
                "image_width: 640.5",
                "image_width is 640.5, expected a number of pixels",
            ),
            ("image_width: 640", "", "the width of the images is missing"),
            (
                "image_width: 640",
                "image_width: 640\nwidth: 640",
                "image_width and width mean the same",
            ),
            (
                "image_width: 640",
                "image_width: 640\nimage_width: 641",
                "line 2",
            ),
            (
                "camera_matrix:",
                "camera_matrices:",
                "camera_matrix is missing",
            ),
            (
                "plumb_bob",
                "[plumb_bob]",
                "distortion_model is [\"plumb_bob\"], expected a name",
            ),
            ("  cols: 5\n", "  cols: 5\n bad\n", "line 1"),
        ] {
            let reason = reason_after(was, is);
            assert!(
                reason.contains(expected) && !reason.contains('\n'),
                "{was} -> {is}: {reason}"
            );
        }
        assert!(
            CameraInfo::parse("%YAML:1.0\n---\nK: 1")
                .is_err_and(|why| why.contains("YAML of OpenCV"))
        );
        assert!(
            CameraInfo::parse("").is_err()
                && CameraInfo::parse("- 1").is_err()
                && CameraInfo::parse("[").is_err()
        );
        let zeros = json!({"k": vec![0; 9]});
        assert!(CameraInfo::of(&zeros).is_err_and(|why| why.contains("k contains only zeros")));
        // Each alias would double the size.
        let aliases: String = (1..40)
            .map(|ix| format!("a{ix}: &a{ix} [*a{}, *a{}]\n", ix - 1, ix - 1))
            .collect();
        assert!(CameraInfo::parse(&format!("a0: &a0 [1]\n{aliases}")).is_err());
        assert!(
            CameraInfo::parse(&"[".repeat(100_000)).is_err(),
            "deep nesting"
        );
    }

    /// Tests each name of the table in docs/reference/camera-info.md in its own file.
    #[test]
    fn keys_are_used_refused_or_named_as_documented() {
        let page = include_str!("../../docs/reference/camera-info.md");
        let (documented, _) = page
            .split_once("\n## ")
            .expect("the table comes before the first section");
        let rows: Vec<[&str; 3]> = documented
            .lines()
            .filter(|line| line.starts_with("| `"))
            .filter_map(|line| {
                line.trim_matches(['|', ' '])
                    .split(" | ")
                    .collect::<Vec<_>>()
                    .try_into()
                    .ok()
            })
            .collect();
        assert!(rows.len() > 10, "{rows:?}");
        let base = json!({"k": [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1], "width": 64, "height": 48, "d": [0.1, 0.2]});
        let mut tested = Vec::new();
        for (names, use_of_key) in rows
            .iter()
            .map(|[names, _, use_of_key]| (*names, *use_of_key))
        {
            for name in names.split(", ").map(|name| name.trim_matches('`')) {
                let value = match name {
                    "image_width" | "width" => json!(65),
                    "image_height" | "height" => json!(49),
                    "camera_matrix" | "K" | "k" => json!([61, 0, 31.5, 0, 60, 23.5, 0, 0, 1]),
                    "distortion_model" => json!("equidistant"),
                    "distortion_coefficients" | "D" | "d" => json!([0.3]),
                    "rectification_matrix" | "R" | "r" => json!([0, 1, 0, -1, 0, 0, 0, 0, 1]),
                    "projection_matrix" | "P" | "p" => {
                        json!([60, 0, 31.5, -7, 0, 60, 23.5, 0, 0, 0, 1, 0])
                    }
                    "binning_x" | "binning_y" => json!(2),
                    "roi" => {
                        json!({"x_offset": 8, "y_offset": 0, "width": 32, "height": 48, "do_rectify": false})
                    }
                    "camera_name" => json!("left"),
                    "header" => json!({"frame_id": "left"}),
                    _ => json!(7),
                };
                tested.push(name);
                let mut changed = base.clone();
                let object = changed.as_object_mut().unwrap();
                // Names with the same meaning must not be used together.
                let groups = [WIDTH, HEIGHT, CAMERA_MATRIX, DISTORTION];
                groups
                    .iter()
                    .filter(|names| names.contains(&name))
                    .flat_map(|names| names.iter())
                    .for_each(|name| {
                        object.remove(*name);
                    });
                object.insert(name.to_owned(), value);
                let (before, after) = (CameraInfo::of(&base).unwrap(), CameraInfo::of(&changed));
                let context = format!("{name}: {use_of_key}: {after:?}");
                let without_notes = |info: &CameraInfo| CameraInfo {
                    notes: Vec::new(),
                    ..info.clone()
                };
                match use_of_key {
                    "yes" => assert!(
                        after.is_ok_and(|after| after != before && after.notes.is_empty()),
                        "{context}"
                    ),
                    "no" => assert_eq!(after, Ok(before), "{context}"),
                    "refused" => assert!(after.unwrap_err().starts_with(name), "{context}"),
                    "note" => {
                        let after = after.unwrap();
                        assert_eq!(without_notes(&after), before, "{context}");
                        assert!(
                            after.notes.len() == 1
                                && after.notes[0].ends_with(&format!(": {name}")),
                            "{context}"
                        );
                    }
                    other => panic!("unknown use {other:?}"),
                }
            }
        }
        let all = [
            WIDTH,
            HEIGHT,
            CAMERA_MATRIX,
            DISTORTION_MODEL,
            DISTORTION,
            RECTIFICATION,
            PROJECTION,
            ROI,
            UNUSED,
        ];
        let untested: Vec<_> = all
            .iter()
            .chain(&BINNING)
            .flat_map(|names| names.iter())
            .filter(|name| !tested.contains(name))
            .collect();
        assert!(untested.is_empty(), "not documented: {untested:?}");
    }

    #[test]
    fn yaml_is_recognized() {
        for yaml in [
            "samples:\n- a: 1",
            "# comment\n---\nimage_width: 640",
            "%YAML:1.0\nK: [1]",
            "- a: 1",
        ] {
            assert!(is_yaml(yaml), "{yaml}");
        }
        for other in ["{\"a\": 1}", "", "[1]", "hello", "\"a\": 1"] {
            assert!(!is_yaml(other), "{other}");
        }
    }
}
