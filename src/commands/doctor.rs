//! `fieldrig doctor`: checks this computer and the devices of a rig, and prints a fix for each
//! problem.

use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::open_gpu::open_gpu;
use crate::{print, signals};
use anyhow::Context;
use capture::Rig;
use capture::doctor::{self, Finding, Verdict};
use capture::rig_facts;
use session::{gpu_findings, page_finding};
use std::path::PathBuf;

/// Default address of the page that `run` serves.
const DEFAULT_ADDRESS: &str = "127.0.0.1:7007";

/// Flags of `doctor`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file whose devices are also checked
    rig: Option<PathBuf>,
    /// After the checks, read all devices for S seconds and print rates, latencies and losses;
    /// nothing is moved
    #[arg(long, value_name = "S", requires = "rig", value_parser = number_in_range(1.0..=3600.0))]
    listen: Option<f64>,
    /// Write a picture of the rig to FILE.svg: side view and top view to scale, with the joints at
    /// rest
    #[arg(
        long,
        value_name = "FILE.svg",
        requires = "rig",
        long_help = "Write a picture of the rig to FILE.svg: side view and top view to scale, with the joints at rest. It \
                     shows the links of the robot, the positions that the flange reaches, the axes of world and flange (x \
                     red, y green, z blue), and the field of view of each camera. A camera that looks into the flange is \
                     red. An existing picture is replaced"
    )]
    picture: Option<PathBuf>,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Runs all checks; the exit code is 1 if one fails.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    // An invalid rig file is an error of the command and not a failed check, because its devices
    // are unknown.
    let rig = args
        .rig
        .as_ref()
        .map(|path| Rig::load(path, &[]))
        .transpose()?;
    let mut findings = Vec::new();
    if let Some(rig) = &rig {
        findings.extend(doctor::meaning(rig)?);
    }
    if let Some(path) = &args.rig {
        let text =
            files::read_text(path).with_context(|| format!("cannot read {}", path.display()))?;
        findings.extend(doctor::guesses(&text));
    }
    if let (Some(rig), Some(file)) = (&rig, &args.picture) {
        rig_facts::write_picture(rig, file)?;
    }
    findings.extend(gpu_findings(open_gpu));
    findings.push(doctor::simulation());
    findings.push(page_finding(DEFAULT_ADDRESS));
    findings.extend(doctor::check(rig.as_ref()));
    // The checks are printed before listening, because listening takes as long as the user asks
    // for.
    print_findings(&findings, args.json)?;
    if let (Some(rig), Some(secs)) = (&rig, args.listen) {
        let result = doctor::listen(rig, secs, &signals::stop_on_signals()?)?;
        for device in &result.devices {
            print::json_or_lines(args.json, device, [device])?;
        }
        print_findings(&result.findings, args.json)?;
        findings.extend(result.findings);
    }
    // Warnings do not change the exit code, so that a script can use it to decide whether a run can
    // start.
    let failed = findings
        .iter()
        .any(|finding| finding.verdict == Verdict::Fail);
    Ok(if failed { Exit::Failed } else { Exit::Done })
}

fn print_findings(findings: &[Finding], as_json: bool) -> anyhow::Result<()> {
    for finding in findings {
        print::json_or_lines(as_json, finding, finding.lines())?;
    }
    Ok(())
}
