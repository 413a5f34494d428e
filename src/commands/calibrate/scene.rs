//! `fieldrig calibrate scene`: calibrates the cameras of a rig from images of a static scene.

use crate::console::ReadBar;
use crate::data_args::DataArgs;
use crate::exit::{self, BadArgument, Exit, InsufficientData};
use crate::training_args::refine;
use crate::{print, signals};
use calibration::{Estimate, Trial};
use capture::config::{Override, Rig};
use capture::open::{self, Devices};
use drivers::Sample;
use kinematics::{Stamp, Transform};
use serde::Serialize;
use session::{Data, Purpose, Refine, SceneCalibration, calibrate_scene, corrected_rig};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Time for which devices are read if no flag limits it, seconds.
const DEFAULT_SECS: f64 = 30.0;

/// Flags of `calibrate scene`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Recording (.mcap), nerfstudio or TUM RGB-D folder, or rig file (.toml) whose devices are read
    #[arg(value_name = "RIG|DATA")]
    input: PathBuf,
    #[command(flatten)]
    images: DataArgs,
    /// What to estimate: auto (the parameters that improve the prediction of validation images), or a list of
    /// extrinsics, time-offset, lens and, with depth, joints, depth-pose, depth-scale and readout
    #[arg(long, value_name = "PARAMS", value_delimiter = ',', hide_possible_values = true, value_parser = refine(), default_value = "auto")]
    params: Vec<Refine>,
    /// With a rig file: simulate all devices
    #[arg(long)]
    sim: bool,
    /// With a rig file: read the devices for S seconds [default: 30]
    #[arg(long, value_name = "S", value_parser = super::super::number_in_range(1.0..=3600.0))]
    seconds: Option<f64>,
    /// Write the rig file with the accepted corrections. An existing file is kept with the extension .old
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// The printed result.
#[derive(Debug, Serialize)]
struct Printed<'a> {
    n_images: usize,
    /// Calibration after the accepted corrections, by name of the camera; without a rig file, empty.
    cameras: BTreeMap<&'a str, PrintedCamera>,
    estimates: &'a [Estimate],
    trials: &'a [Trial],
    /// Directions in parameter space that the motion does not determine.
    unobservable: Vec<String>,
    refused: Option<&'a str>,
}

#[derive(Debug, Serialize)]
struct PrintedCamera {
    parent_from_camera: [[f64; 4]; 4],
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Time from the stamps of the images to mid-exposure, milliseconds.
    stamp_to_mid_exposure_millis: Option<f64>,
}

/// Calibrates and prints the estimates. Exit code 4 if the data do not determine the extrinsics.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let data = args.data()?;
    if let (Some(file), None) = (&args.write_rig, &data.rig) {
        let input = args.input.display();
        return Err(BadArgument(format!("--write-rig {}: {input} contains no rig file", file.display())).into());
    }
    if let (Some(file), Some(rig)) = (&args.write_rig, &data.rig) {
        corrected_rig::check_target_file(rig, file)?;
    }
    let calibration = calibrate_scene(&data, &args.params)?;
    let printed = printed(&data, &calibration);
    if args.json {
        print::json(&printed)?;
    } else {
        describe(&printed, &calibration)?;
    }
    if let Some(reason) = calibration.refused {
        return if args.json { Ok(Exit::InsufficientData) } else { Err(InsufficientData(reason).into()) };
    }
    if let (Some(file), Some(rig)) = (&args.write_rig, &calibration.rig) {
        corrected_rig::write(rig, file)?;
        log::info!("rig file written to {}", file.display());
    }
    Ok(exit::from_losses(&data.data_losses))
}

impl Args {
    fn data(&self) -> anyhow::Result<Data> {
        session::expect(&self.input)?;
        let bar = ReadBar::new(self.json);
        if !is_rig_file(&self.input) {
            if self.sim || self.seconds.is_some() {
                return Err(BadArgument("--sim and --seconds need a rig file (.toml) as input".into()).into());
            }
            let options = self.images.options();
            return Ok(Data::load(&self.input, &options, Purpose::Training, &[], &|read| bar.show(read))?);
        }
        if !self.images.options().flags().is_empty() {
            return Err(BadArgument(
                "--holdout, --keyframes, --rig and --scale need a recording or a folder as input".into(),
            )
            .into());
        }
        let stop = signals::stop_on_signals_logging("calibrating with the images so far; Ctrl-C again exits at once")?;
        let overrides = if self.sim { vec![Override::new("sim.lockstep", true)] } else { Vec::new() };
        let rig = Rig::load(&self.input, &overrides)?;
        let opened = open::rig(rig, if self.sim { Devices::Sim } else { Devices::Real })?;
        let seconds = self.seconds.unwrap_or(DEFAULT_SECS);
        let mut first: Option<Stamp> = None;
        let is_end = |sample: &Sample| {
            let since_first = sample.stamp().secs_since(*first.get_or_insert(sample.stamp()));
            since_first > seconds || stop.requested()
        };
        Ok(Data::from_devices(opened, is_end, &|read| bar.show(read))?)
    }
}

fn is_rig_file(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "toml")
}

fn printed<'a>(data: &Data, calibration: &'a SceneCalibration) -> Printed<'a> {
    let cameras = calibration.rig.iter().flat_map(|rig| &rig.cameras).map(|camera| {
        let printed = PrintedCamera {
            parent_from_camera: rows(&camera.parent_from_camera),
            focal_px: camera.intrinsics.focal_px,
            principal_px: camera.intrinsics.principal_px,
            stamp_to_mid_exposure_millis: camera.stamp_to_mid_exposure.as_ref().map(|offset| offset.value_millis),
        };
        (&*camera.name, printed)
    });
    let alignment = &calibration.alignment;
    Printed {
        n_images: data.keyframes.len(),
        cameras: cameras.collect(),
        estimates: &alignment.estimates,
        trials: &alignment.trials,
        unobservable: alignment.unobservable.iter().map(ToString::to_string).collect(),
        refused: calibration.refused.as_deref(),
    }
}

/// The matrix of a transform, as rows.
fn rows(transform: &Transform) -> [[f64; 4]; 4] {
    let matrix = transform.to_homogeneous();
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}

fn describe(printed: &Printed<'_>, calibration: &SceneCalibration) -> anyhow::Result<()> {
    print::line(format!("{} images, {} pairs", printed.n_images, calibration.alignment.n_pairs))?;
    for line in calibration.alignment.lines() {
        print::line(line)?;
    }
    if printed.estimates.is_empty() {
        print::line("nothing to correct: no parameter improves the prediction of validation images")?;
    }
    for (name, camera) in &printed.cameras {
        print::line(format!("parent_from_camera of {name}, row by row:"))?;
        for row in &camera.parent_from_camera {
            let row: Vec<String> = row.iter().map(|value| format!("{value:10.6}")).collect();
            print::line(format!("  {}", row.join(" ")))?;
        }
    }
    Ok(())
}
