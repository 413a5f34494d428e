//! Workspace files: what an operator sees, with which pages can start. The page applies them; this
//! module checks them before a run starts. The format is in `docs/reference/workspace.md`.

use crate::{Error, Hub};
use serde::Deserialize;
use serde::de::{Error as _, Unexpected};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;

const FORMAT: &str = "fieldrig-workspace";
const VERSION: u32 = 1;
/// Far more than a workspace with all layers and the longest path.
const MAX_BYTES: usize = 65_536;
const MAX_PATH_VIEWS: usize = 64;
const MAX_NAMES: usize = 64;
/// Beyond it, single-precision numbers of the GPU are too coarse.
const MAX_COORDINATE_M: f64 = 1e5;
const MIN_VIEW_DISTANCE_M: f64 = 1e-5;

/// The text of a valid workspace file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Workspace(Arc<str>);

impl Workspace {
    /// Reads and checks a file.
    ///
    /// # Errors
    ///
    /// If the file cannot be read, or is no workspace of this version.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let refused = |reason: String| Error::Workspace {
            file: path.to_owned(),
            reason,
        };
        let text = read_limited(path).map_err(|error| refused(error.to_string()))?;
        check(&text).map_err(refused)?;
        Ok(Self(text.into()))
    }

    /// The text of the file.
    pub(crate) fn text(&self) -> &str {
        &self.0
    }
}

impl Hub {
    /// Sets the workspace with which pages start, unless their address has a view.
    pub fn set_workspace(&self, workspace: Workspace) {
        self.latest::<Option<Workspace>>()
            .send_replace(Some(workspace));
    }

    pub(crate) fn workspace(&self) -> Option<Workspace> {
        self.latest::<Option<Workspace>>().borrow().clone()
    }
}

/// The text of a file, or the beginning of a file that is too long.
fn read_limited(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    let mut limited = File::open(path)?.take(MAX_BYTES as u64 + 1);
    limited.read_to_string(&mut text)?;
    Ok(text)
}

/// Checks the text of a file. The error is the reason why it is no workspace.
fn check(text: &str) -> Result<(), String> {
    /// The keys that identify a workspace file and its version. These come first, because each of their keys
    /// would be unknown.
    #[derive(Deserialize)]
    struct Head {
        format: Option<String>,
        version: Option<serde_json::Number>,
    }
    if text.len() > MAX_BYTES {
        return Err(format!("it has more than {MAX_BYTES} bytes"));
    }
    let head: Head = serde_json::from_str(text)
        .map_err(|error| format!("{error}; expected a file that the page has saved"))?;
    if head.format.as_deref() != Some(FORMAT) {
        return Err(format!(
            "format is not {FORMAT:?}; expected a file that the page has saved"
        ));
    }
    if head.version.as_ref().and_then(serde_json::Number::as_f64) != Some(f64::from(VERSION)) {
        return Err(format!(
            "its version is not {VERSION}; open the file with the fieldrig that saved it"
        ));
    }
    serde_json::from_str::<Checked>(text)
        .map(|_| ())
        .map_err(|error| error.to_string())
}

/// The format. Types check the ranges of their values as they are read.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(
    dead_code,
    reason = "the fields are only checked, because the page uses them"
)]
struct Checked {
    format: String,
    version: f64,
    #[serde(default, deserialize_with = "present")]
    camera: Option<Camera>,
    #[serde(default, deserialize_with = "present")]
    crop: Option<Crop>,
    #[serde(default, deserialize_with = "present")]
    layers: Option<Layers>,
    #[serde(default, deserialize_with = "present")]
    panels: Option<Panels>,
    #[serde(default, deserialize_with = "present")]
    model: Option<Name>,
    #[serde(default, deserialize_with = "present")]
    mode: Option<DrawingMode>,
    #[serde(default, deserialize_with = "present")]
    path: Option<List<PathView, MAX_PATH_VIEWS>>,
}

/// Reads a value that may be absent, but not null.
fn present<'de, D, T>(deserializer: D) -> Result<Option<T>, D::Error>
where
    D: serde::Deserializer<'de>,
    T: Deserialize<'de>,
{
    T::deserialize(deserializer).map(Some)
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum DrawingMode {
    Pictures,
    Direct,
    Panel,
    Sphere,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum ViewMode {
    Overview,
    Orbit,
    Fly,
    Chase,
    Ride,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFields {
    #[serde(rename = "mode")]
    _mode: ViewMode,
    position_m: Point,
    target_m: Point,
    #[serde(default, deserialize_with = "present")]
    up: Option<Point>,
    #[serde(default, rename = "fov_degrees", deserialize_with = "present")]
    _fov_degrees: Option<Fov>,
    #[serde(default, rename = "attached_to", deserialize_with = "present")]
    _attached_to: Option<Frame>,
}

#[derive(Deserialize)]
#[serde(try_from = "CameraFields")]
struct Camera;

impl TryFrom<CameraFields> for Camera {
    type Error = String;

    fn try_from(camera: CameraFields) -> Result<Self, String> {
        check_distance(&camera.position_m, &camera.target_m)?;
        match camera.up.map(|up| length(&up.0)) {
            Some(length) if !(length > 0.5 && length < 2.0) => {
                Err(format!("camera.up has the length {length:.3}, expected 1"))
            }
            _ => Ok(Self),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PathViewFields {
    position_m: Point,
    target_m: Point,
    #[serde(rename = "fov_degrees")]
    _fov_degrees: Fov,
}

#[derive(Deserialize)]
#[serde(try_from = "PathViewFields")]
struct PathView;

impl TryFrom<PathViewFields> for PathView {
    type Error = String;

    fn try_from(view: PathViewFields) -> Result<Self, String> {
        check_distance(&view.position_m, &view.target_m).map(|()| Self)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(
    dead_code,
    reason = "the fields are only checked, because the page uses them"
)]
struct Crop {
    is_on: bool,
    #[serde(default, deserialize_with = "present")]
    r#box: Option<CropBox>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BoxFields {
    #[serde(rename = "center_m")]
    _center_m: Point,
    size_m: Point,
    #[serde(default)]
    yaw_rad: f64,
}

#[derive(Deserialize)]
#[serde(try_from = "BoxFields")]
struct CropBox;

impl TryFrom<BoxFields> for CropBox {
    type Error = String;

    fn try_from(fields: BoxFields) -> Result<Self, String> {
        if !fields.size_m.0.iter().all(|length| *length > 0.0) {
            return Err("crop.box.size_m has a length of 0 or less, expected more".to_owned());
        }
        if fields.yaw_rad.abs() > std::f64::consts::TAU {
            return Err(format!(
                "crop.box.yaw_rad is {}, expected -6.283 to 6.283",
                fields.yaw_rad
            ));
        }
        Ok(Self)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(
    dead_code,
    reason = "the fields are only checked, because the page uses them"
)]
struct Panels {
    #[serde(default, deserialize_with = "present")]
    side: Option<bool>,
    #[serde(default, deserialize_with = "present")]
    open: Option<Name>,
    #[serde(default, deserialize_with = "present")]
    docked_cameras: Option<List<Frame, MAX_NAMES>>,
}

#[derive(Deserialize)]
#[serde(try_from = "BTreeMap<String, bool>")]
struct Layers;

impl TryFrom<BTreeMap<String, bool>> for Layers {
    type Error = String;

    fn try_from(layers: BTreeMap<String, bool>) -> Result<Self, String> {
        if layers.len() > MAX_NAMES {
            return Err(format!(
                "layers has {} entries, expected at most {MAX_NAMES}",
                layers.len()
            ));
        }
        layers
            .into_keys()
            .try_for_each(|name| Name::try_from(name).map(|_| ()))?;
        Ok(Self)
    }
}

/// A list of at most `N` entries.
#[derive(Deserialize)]
#[serde(try_from = "Vec<T>", bound = "T: Deserialize<'de>")]
struct List<T, const N: usize>(std::marker::PhantomData<T>);

impl<T, const N: usize> TryFrom<Vec<T>> for List<T, N> {
    type Error = String;

    fn try_from(entries: Vec<T>) -> Result<Self, String> {
        if entries.len() > N {
            return Err(format!(
                "a list has {} entries, expected at most {N}",
                entries.len()
            ));
        }
        Ok(Self(std::marker::PhantomData))
    }
}

/// A place or a direction.
struct Point([f64; 3]);

impl<'de> Deserialize<'de> for Point {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let values = <[f64; 3]>::deserialize(deserializer)?;
        match values.iter().find(|value| value.abs() > MAX_COORDINATE_M) {
            Some(value) => Err(D::Error::invalid_value(
                Unexpected::Float(*value),
                &"a coordinate from -100000 to 100000",
            )),
            None => Ok(Self(values)),
        }
    }
}

#[derive(Deserialize)]
#[serde(try_from = "f64")]
struct Fov;

impl TryFrom<f64> for Fov {
    type Error = String;

    fn try_from(degrees: f64) -> Result<Self, String> {
        if (1.0..=150.0).contains(&degrees) {
            return Ok(Self);
        }
        Err(format!(
            "fov_degrees is {degrees}, expected a number from 1 to 150"
        ))
    }
}

/// The name of a layer, a panel or a method.
#[derive(Deserialize)]
#[serde(try_from = "String")]
struct Name;

impl TryFrom<String> for Name {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        let is_valid =
            |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || b"-_".contains(&byte);
        if (1..=32).contains(&name.len()) && name.bytes().all(is_valid) {
            return Ok(Self);
        }
        Err(format!(
            "the name {name:?} has other characters than a-z, 0-9, - and _, or not 1 to 32 of them"
        ))
    }
}

/// The name of a camera or of a robot link.
#[derive(Deserialize)]
#[serde(try_from = "String")]
struct Frame;

impl TryFrom<String> for Frame {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        if (1..=64).contains(&name.chars().count()) && !name.contains(char::is_control) {
            return Ok(Self);
        }
        Err(format!(
            "the name {name:?} has control characters, or not 1 to 64 characters"
        ))
    }
}

fn length(vector: &[f64; 3]) -> f64 {
    vector.iter().map(|value| value * value).sum::<f64>().sqrt()
}

fn check_distance(position: &Point, target: &Point) -> Result<(), String> {
    let offset: [f64; 3] = std::array::from_fn(|axis| position.0[axis] - target.0[axis]);
    if length(&offset) > MIN_VIEW_DISTANCE_M {
        return Ok(());
    }
    Err(
        "target_m is the same place as position_m, expected a point that the camera looks at"
            .to_owned(),
    )
}

#[cfg(test)]
mod tests {
    use super::check;
    use serde_json::Value;

    /// Files that the unit tests of the page read, too.
    const CASES: &str = include_str!("../tests/workspaces.json");

    #[test]
    fn the_same_files_are_accepted_as_by_the_page() {
        let cases: Vec<Value> = serde_json::from_str(CASES).expect("JSON");
        assert!(cases.len() > 30, "{} cases", cases.len());
        for case in &cases {
            let text = match &case["text"] {
                Value::String(text) => text.clone(),
                _ => case["file"].to_string(),
            };
            let is_valid = case["problem"].is_null();
            let checked = check(&text);
            assert_eq!(checked.is_ok(), is_valid, "{}: {checked:?}", case["name"]);
        }
    }

    #[test]
    fn large_files_are_refused() {
        let text = format!(
            "{{\"format\": \"fieldrig-workspace\", \"version\": 1}}{}",
            " ".repeat(70_000)
        );
        assert_eq!(check(&text), Err("it has more than 65536 bytes".to_owned()));
    }
}
