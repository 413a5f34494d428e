//! `fieldrig calibrate scene`: calibrates the cameras of a rig from images of a static scene.

use super::flags::ReportFlag;
use super::terminal::Terminal;
use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::print;
use calibrate::SceneTask;
use messages::listed;
use session::{Refine, SCENE_PARAMS};
use std::path::PathBuf;

/// Flags of `calibrate scene`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Recording (.mcap), nerfstudio or TUM RGB-D folder, or rig file (.toml) whose devices are
    /// read
    #[arg(value_name = "RIG|DATA")]
    input: PathBuf,
    /// Use exactly the keyframes listed by an earlier run (keyframes.txt)
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
    /// Read a recording with this rig file instead of the rig file stored in the recording
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// What to estimate: auto (the parameters that improve the prediction of validation images), or
    /// a list of extrinsics, time-offset, lens and, with depth, joints, depth-pose, depth-scale and
    /// readout
    #[arg(long, value_name = "PARAMS", value_delimiter = ',', default_value = "auto", value_parser = scene_param)]
    params: Vec<Refine>,
    /// With a rig file: simulate all devices
    #[arg(long)]
    sim: bool,
    /// With a rig file: read the devices for S seconds [default: 30]
    #[arg(long, value_name = "S", value_parser = number_in_range(1.0..=3600.0))]
    seconds: Option<f64>,
    /// Write the rig file with the accepted corrections. An existing file is kept with the
    /// extension .old
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Calibrates and prints the estimates. Exit code 4 if the data do not determine the extrinsics of
/// any camera.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let outcome = args.task().run(&Terminal::new(None, args.json))?;
    let exit = exit::from_losses(&outcome.data.data_losses);
    let is_refused = outcome.refused.is_some();
    if args.json {
        print::json(&outcome.document())?;
    } else {
        print::lines(outcome.lines())?;
        for warning in outcome.warnings() {
            log::warn!("{warning}");
        }
    }
    match outcome.finish() {
        // The reason is part of the JSON output, so it is not printed again.
        Err(_) if is_refused && args.json => Ok(Exit::InsufficientData),
        finished => finished.map(|()| exit),
    }
}

fn scene_param(text: &str) -> Result<Refine, String> {
    SCENE_PARAMS
        .into_iter()
        .find(|param| param.name() == text)
        .ok_or_else(|| {
            let names = SCENE_PARAMS.map(Refine::name);
            format!(
                "unknown parameter {text:?}, expected {}",
                listed(&names, "or")
            )
        })
}

impl Args {
    fn task(&self) -> SceneTask {
        SceneTask {
            input: self.input.clone(),
            keyframes: self.keyframes.clone(),
            rig: self.rig.clone(),
            params: self.params.clone(),
            sim: self.sim,
            seconds: self.seconds,
            write_rig: self.write_rig.clone(),
            report: self.report.options(),
        }
    }
}
