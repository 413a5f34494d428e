//! Flags of several commands.

use crate::number_args::number_in_range;
use crate::page_args::PageArgs;
use calibrate::{ReportOptions, RigOptions};
use messages::BadInput;
use session::next_commands;
use std::path::PathBuf;

/// Flags of commands that calibrate one camera, from files, a recording or the devices of a rig.
#[derive(Debug, clap::Args)]
pub(super) struct RigFlags {
    /// With a recording or rig file as input: the camera to calibrate. With --write-rig: the camera
    /// in the rig file [default: the only camera]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// With a recording: read it with this rig file instead of the stored rig file. With image
    /// files: the rig file to write the result into
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    /// Write the rig file with the result. An existing file is kept with the extension .old
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    /// With a rig file: simulate all devices
    #[arg(long)]
    sim: bool,
    /// With a rig file: read the devices for S seconds [default: 30; for a lens, until the photographs
    /// cover everything]
    #[arg(long, value_name = "S", value_parser = number_in_range(1.0..=3600.0))]
    seconds: Option<f64>,
    /// With a rig file: the page that shows the camera images and the next instruction.
    #[command(flatten)]
    pub(super) page: PageArgs,
}

impl RigFlags {
    /// Options of the calibration.
    pub(super) fn options(&self) -> Result<RigOptions, BadInput> {
        self.page.check()?;
        Ok(RigOptions {
            camera: self.camera.clone(),
            rig: self.rig.clone(),
            write_rig: self.write_rig.clone(),
            sim: self.sim,
            seconds: self.seconds,
            has_page_flags: self.page.is_given(),
        })
    }
}

/// The flag of commands that write a report.
#[derive(Debug, clap::Args)]
pub(super) struct ReportFlag {
    /// Write a report as an HTML page, with the result, its uncertainty and the errors of all
    /// samples. The report is also written if the calibration is refused
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
}

impl ReportFlag {
    /// The report to write, if any.
    pub(super) fn options(&self) -> Option<ReportOptions> {
        self.report.clone().map(|file| ReportOptions {
            file,
            command: next_commands::this_command(),
        })
    }
}
