//! `fieldrig calibrate intrinsics`: the lens of a camera from images of a target.

use super::flags::{ReportFlag, RigFlags};
use super::target_argument;
use super::terminal::Terminal;
use crate::exit::Exit;
use crate::named_args::one_of;
use crate::print;
use calibrate::IntrinsicsTask;
use calibration::LensModel;
use messages::BadInput;
use std::path::PathBuf;
use targets::TargetSpec;

const TARGET_HELP: &str = "The target, such as chessboard:9x6:25mm, charuco:5x7:34mm:26mm:5X5_100 or aprilgrid:6x6:20mm:0.3";

const DETAILS: &str = "With a rig file, the photographs are taken for you. Move the target in front of the camera, or \
    let the arm move the camera. A photograph is taken when the target is still and sharp and shows something new. The \
    terminal and the page show what is missing next, such as another tilt or a corner of the image. It ends when \
    everything is covered, or with Ctrl-C, and then estimates the lens. Only this camera is opened, also if an arm carries \
    it. With --seconds, all devices are opened, and all images of that time are used that show no fast motion of the arm.\n\n\
    Examples:\n  \
    fieldrig calibrate target --target charuco:5x7:34mm:26mm:5X5_100 --out target.pdf\n  \
    fieldrig calibrate intrinsics rig.toml --target charuco:5x7:34mm:26mm:5X5_100 --write-rig rig.toml\n  \
    fieldrig calibrate intrinsics photographs/ --target chessboard:9x6:25mm";

/// Flags of `calibrate intrinsics`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = DETAILS)]
pub(crate) struct Args {
    /// Folder of images (.jpg, .png) of the target, all from one camera and of one size. Or a
    /// recording (.mcap) or rig file (.toml) whose camera sees the target
    #[arg(value_name = "IMAGES|RECORDING|RIG")]
    input: PathBuf,
    #[arg(long, value_name = "SPEC", value_parser = target_argument, help = TARGET_HELP)]
    target: TargetSpec,
    /// Lens model
    #[arg(long, value_name = "MODEL", default_value = LensModel::Auto.name(),
        value_parser = one_of(LensModel::ALL.map(|model| (model, model.name(), model.description()))))]
    model: LensModel,
    #[command(flatten)]
    rig: RigFlags,
    /// With a rig file: save the photographs in this folder (PNG), which must be new or empty.
    /// `calibrate intrinsics FOLDER` repeats the calibration
    #[arg(long, value_name = "FOLDER")]
    save_images: Option<PathBuf>,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Detects the target, calibrates, and prints the result.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let host = Terminal::new(Some(&args.rig.page), args.json);
    let outcome = args.task()?.run(&host)?;
    let document = outcome.document();
    print::json_or_lines(args.json, &document, document.lines())?;
    for warning in outcome.warnings() {
        log::warn!("{warning}");
    }
    outcome.finish()?;
    Ok(Exit::Done)
}

impl Args {
    fn task(&self) -> Result<IntrinsicsTask, BadInput> {
        Ok(IntrinsicsTask {
            input: self.input.clone(),
            target: self.target.clone(),
            model: self.model,
            rig: self.rig.options()?,
            report: self.report.options(),
            save_images: self.save_images.clone(),
        })
    }
}
