//! `fieldrig render`: renders images of a saved model.

use crate::console::CountedWork;
use crate::exit::Exit;
use crate::number_args::size_up_to;
use crate::open_gpu::open_gpu;
use crate::{print, signals};
use messages::{BadInput, counted};
use session::{RenderPlan, RenderedCameras};
use std::path::PathBuf;

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
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size_up_to(MAX_SIDE_PX))]
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

/// Renders every camera of the path.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let plan = args.plan()?;
    signals::remove_partial_files_on_signals()?;
    let mut progress = CountedWork::new("{bar:30} {pos} of {len}", args.json);
    let n_pictures = plan.run(open_gpu, &mut |n_done, n_all, rendered| {
        if progress.show(n_done, n_all) {
            print::notice(format_args!("rendered {n_done} of {n_all} images"));
        }
        match rendered {
            Some(rendered) if args.json => print::report_json(rendered),
            _ => Ok(()),
        }
    })?;
    drop(progress);
    if !args.json {
        let n_pictures = counted(n_pictures as u64, "image");
        print::report(format_args!("{n_pictures} in {}", args.out.display()));
    }
    Ok(Exit::Done)
}

impl Args {
    /// The flags as a plan.
    fn plan(&self) -> Result<RenderPlan, BadInput> {
        let cameras = match (&self.camera_path, &self.pose) {
            (Some(file), _) => RenderedCameras::Path(file.clone()),
            (None, Some(Numbers(pose))) => RenderedCameras::Pose(*pose),
            (None, None) => {
                return Err(BadInput("either --camera-path or --pose is needed".into()));
            }
        };
        Ok(RenderPlan {
            model: self.model.clone(),
            cameras,
            size_px: self.size,
            fov_y_deg: self.fov,
            is_equirectangular: self.equirect,
            crop_m: self
                .crop
                .map(|Numbers([x, y, z, to_x, to_y, to_z])| [[x, y, z], [to_x, to_y, to_z]]),
            depth: self.depth,
            out: self.out.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_parsed() {
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
