//! `fieldrig render`: renders images of a saved model.

use crate::console::ProgressLines;
use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::{print, signals};
use anyhow::Context;
use messages::{BadInput, Setting, counted};
use model_files::Aabb;
use serde::Serialize;
use session::camera_path::{CameraPath, PathCamera};
use session::evaluate::{covered_frac, warn_if_hardly_covered};
use session::run_folder::expect_model;
use session::{methods, rendered_files};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use trainer::{LoadedModel, Projection, RenderRequest};

/// Image size if neither a flag nor the camera path gives one.
const DEFAULT_SIZE_PX: [u32; 2] = [1280, 720];
/// Maximum width and height of an image.
const MAX_SIDE_PX: u32 = 16_384;

/// Flags of `render`.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("where").required(true)))]
pub(crate) struct Args {
    /// Folder of a saved model, or a splat file (.ply, .spz, .splat)
    model: PathBuf,
    /// Camera path in nerfstudio's format (JSON)
    #[arg(long, value_name = "FILE", group = "where")]
    camera_path: Option<PathBuf>,
    /// Pose of the camera, `world_from_camera`: 16 numbers, row major, separated by spaces or
    /// commas. The camera frame is x right, y down, z forward
    #[arg(long, value_name = "NUMBERS", group = "where", allow_hyphen_values = true, value_parser = numbers::<16>)]
    pose: Option<Numbers<16>>,
    /// Size of the images [default: size in the camera path, else 1280x720]
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Vertical field of view, degrees [default: value in the camera path, else 60]
    #[arg(long, value_name = "DEGREES")]
    fov: Option<f64>,
    /// Render a 360-degree equirectangular image instead of a pinhole view
    #[arg(long, conflicts_with = "fov")]
    equirect: bool,
    /// Render only the part of the scene in this box: x y z of the lower corner, then x y z of the
    /// upper corner, in the world frame, meters
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true, value_parser = corners)]
    crop: Option<Numbers<6>>,
    /// Also write depth as .npy: meters along the camera's z axis (distance with --equirect)
    #[arg(long)]
    depth: bool,
    /// Folder for the images; existing images are not overwritten
    #[arg(long, value_name = "FOLDER", default_value = "renders")]
    out: PathBuf,
    /// Print JSON, one object per image
    #[arg(long)]
    json: bool,
}

/// An argument that consists of `N` numbers.
#[derive(Clone, Copy, Debug)]
struct Numbers<const N: usize>([f64; N]);

fn numbers<const N: usize>(text: &str) -> Result<Numbers<N>, String> {
    let words = text.split([' ', ',']).filter(|word| !word.is_empty());
    let values: Vec<f64> = words
        .map(|word| {
            word.parse()
                .map_err(|_| format!("{word:?} is not a number"))
        })
        .collect::<Result<_, _>>()?;
    let n = values.len();
    <[f64; N]>::try_from(values)
        .map(Numbers)
        .map_err(|_| format!("got {n} numbers, expected {N}"))
}

/// Two opposite corners of a box, the lower one first.
fn corners(text: &str) -> Result<Numbers<6>, String> {
    let corners = numbers::<6>(text)?;
    let Numbers([x, y, z, to_x, to_y, to_z]) = corners;
    for (axis, from, to) in [("x", x, to_x), ("y", y, to_y), ("z", z, to_z)] {
        if !(from.is_finite() && to.is_finite() && from < to) {
            return Err(format!(
                "{axis} ranges from {from} to {to}; both must be finite and increasing"
            ));
        }
    }
    Ok(corners)
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text
        .split_once('x')
        .and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    sides
        .filter(|sides: &[u32; 2]| sides.iter().all(|side| (1..=MAX_SIDE_PX).contains(side)))
        .ok_or_else(|| {
            format!("expected WIDTHxHEIGHT, such as 1280x720, each side at most {MAX_SIDE_PX}")
        })
}

/// A rendered image.
#[derive(Debug, Serialize)]
struct RenderedPicture {
    picture: PathBuf,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<PathBuf>,
    size_px: [u32; 2],
    /// Wall time from the request to the pixels, milliseconds.
    draw_millis: f64,
}

/// Renders every camera of the path.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let path = match (&args.camera_path, &args.pose) {
        (Some(file), _) => CameraPath::load(file)?,
        (None, Some(pose)) => CameraPath::of_pose(&pose.0)?,
        (None, None) => {
            return Err(BadInput("either --camera-path or --pose is needed".into()).into());
        }
    };
    for note in &path.notes {
        log::warn!("--camera-path: {note}");
    }
    if path.is_panoramic && !args.equirect {
        return Err(BadInput(
            "--camera-path: the path was made for panoramas; add --equirect".into(),
        )
        .into());
    }
    let size_px = args.size.or(path.size_px).unwrap_or(DEFAULT_SIZE_PX);
    let requests = path
        .cameras
        .iter()
        .map(|camera| args.request(camera, size_px))
        .collect::<Result<Vec<_>, _>>()?;
    // Everything that can be refused is checked before the GPU is opened and the model is loaded.
    expect_model(&args.model)?;
    capture::check_output_folder(Setting::Out, &args.out)?;
    rendered_files::check_no_overwrite(&args.out, requests.len())?;
    signals::remove_partial_files_on_signals()?;
    let loaded = methods::load(open_gpu()?, &args.model)?;
    let is_empty = methods::note_if_empty(&args.model, &loaded).is_some();
    let LoadedModel {
        method: mut model,
        edits,
        ..
    } = loaded;
    // All requests share the edits, because a model may have many of them.
    let edits = Arc::new(edits);
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create the folder {}", args.out.display()))?;
    let bar = print::bar(
        Some(requests.len() as u64),
        "{bar:30} {pos} of {len}",
        args.json,
    );
    let mut lines = ProgressLines::new(bar.is_hidden() && !args.json, Instant::now());
    let mut covered_fracs = Vec::new();
    for (ix, request) in requests.iter().enumerate() {
        // Only the request is timed, because encoding and writing files are not part of drawing.
        let since = Instant::now();
        let picture = model.model_mut().render(&RenderRequest {
            edits: Arc::clone(&edits),
            ..request.clone()
        })?;
        let draw_millis = since.elapsed().as_secs_f64() * 1e3;
        covered_fracs.push(covered_frac(&picture));
        let (picture, depth) = rendered_files::write(&args.out, ix, &picture, args.depth)?;
        let rendered = RenderedPicture {
            picture,
            depth,
            size_px,
            draw_millis,
        };
        bar.inc(1);
        if lines.is_due(ix + 1, requests.len(), Instant::now()) {
            print::notice(format_args!(
                "rendered {} of {} images",
                ix + 1,
                requests.len()
            ));
        }
        if args.json {
            print::report_json(&rendered)?;
        }
    }
    bar.finish_and_clear();
    // An empty model has a separate note.
    if !is_empty {
        warn_if_hardly_covered(&covered_fracs);
    }
    if !args.json {
        let n_pictures = counted(requests.len() as u64, "image");
        print::report(format_args!("{n_pictures} in {}", args.out.display()));
    }
    Ok(Exit::Done)
}

impl Args {
    fn request(&self, camera: &PathCamera, size_px: [u32; 2]) -> Result<RenderRequest, BadInput> {
        const DEFAULT_FOV_DEGREES: f64 = 60.0;
        let fov_y_rad = self
            .fov
            .map(f64::to_radians)
            .or(camera.fov_y_rad)
            .unwrap_or(DEFAULT_FOV_DEGREES.to_radians());
        if !(fov_y_rad > 0.0 && fov_y_rad < std::f64::consts::PI) {
            return Err(BadInput(format!(
                "field of view {} degrees: must be above 0 and below 180",
                fov_y_rad.to_degrees()
            )));
        }
        let [width, height] = size_px.map(f64::from);
        let focal_px = 0.5 * height / (0.5 * fov_y_rad).tan();
        let pinhole = Projection::Pinhole {
            focal_px: [focal_px; 2],
            principal_px: [0.5 * width, 0.5 * height],
        };
        Ok(RenderRequest {
            world_from_camera: camera.world_from_camera,
            size_px,
            projection: if self.equirect {
                Projection::Equirectangular
            } else {
                pinhole
            },
            shutter: None,
            near_m: 0.01,
            far_m: 1000.0,
            crop: self.crop.map(|Numbers([x, y, z, to_x, to_y, to_z])| Aabb {
                world_from_box: kinematics::Transform::identity(),
                min_m: [x, y, z],
                max_m: [to_x, to_y, to_z],
            }),
            edits: Arc::default(),
            background_srgb: [0.0; 3],
            appearance_of: None,
            depth: self.depth,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_numbers_are_parsed() {
        assert_eq!(size("640x480"), Ok([640, 480]));
        for invalid in ["640", "640x", "0x480", "99999x1", "640x480x3"] {
            assert!(size(invalid).is_err(), "{invalid}");
        }
        assert_eq!(
            numbers::<3>("1, -2 3.5").map(|Numbers(values)| values),
            Ok([1.0, -2.0, 3.5])
        );
        assert!(numbers::<3>("1 2").is_err_and(|error| error.contains("got 2")));
        assert!(numbers::<1>("one").is_err());
        assert!(corners("0 0 0 1 1 1").is_ok());
        for invalid in [
            "0 0 1 1 1 0",
            "0 0 0 1 1 nan",
            "0 0 0 1 0 1",
            "-inf 0 0 1 1 1",
            "0 0 0",
        ] {
            assert!(corners(invalid).is_err(), "{invalid}");
        }
    }
}
