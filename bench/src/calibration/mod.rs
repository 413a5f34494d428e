//! Accuracy, reported uncertainty, speed and limits of calibration, on simulated measurements with a known truth.
//!
//! Corners of a chessboard are computed with normal errors, without rendering. Calibration without a target
//! ([`CalibrationOptions::rig`]) needs the simulator.

mod arm_configurations;
mod coverage;
mod method;
mod pages;
mod rigs;
mod scene;
mod speed;
mod stability;

use crate::Result;
use crate::findings::BenchResult;
use arm_configurations::ArmConfiguration;
use coverage::Coverage;
use rigs::RigResult;
use serde::Serialize;
use session::Context;
use speed::Speed;
use stability::Cell;
use std::path::PathBuf;

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct CalibrationOptions {
    /// Calibrations per kind, for the coverage of the reported uncertainty.
    pub runs: u64,
    /// Scenes per number of poses or combination of conditions.
    pub seeds: u64,
    /// Rig file for calibration without a target; skipped if `None`.
    pub rig: Option<PathBuf>,
    /// Number of rigs: the first camera of the rig file with different errors.
    pub rigs: u64,
    /// Length of the scan of a rig, seconds.
    pub scan_secs: f64,
    /// Folder for charts and numbers.
    pub out: PathBuf,
}

/// All results.
#[derive(Debug, Serialize)]
struct Results {
    coverage: Vec<Coverage>,
    speed: Vec<Speed>,
    stability: Vec<Cell>,
    arm_configurations: Vec<ArmConfiguration>,
    rigs: Vec<RigResult>,
}

/// Measures everything.
///
/// # Errors
///
/// If the rig cannot be simulated, or the folder cannot be written.
pub fn run(options: &CalibrationOptions) -> Result<BenchResult> {
    std::fs::create_dir_all(&options.out).with_context(|| format!("cannot create {}", options.out.display()))?;
    log::info!("speed");
    // Before the other measurements, which use all processors.
    let speed = speed::measure(options.seeds);
    log::info!("coverage");
    let coverage = coverage::measure(options.runs);
    log::info!("stability");
    let stability = stability::measure(options.seeds);
    log::info!("arm configurations");
    let arm_configurations = arm_configurations::measure(options.seeds);
    let mut results = Results { coverage, speed, stability, arm_configurations, rigs: Vec::new() };
    for seed in 1..=options.rig.as_ref().map_or(0, |_| options.rigs) {
        let Some(rig) = &options.rig else { break };
        results.rigs.push(rigs::measure(rig, seed, options.scan_secs)?);
        log::info!("rig {seed}: {:?}", results.rigs.last());
        // An interrupted bench leaves results.
        write(options, &results)?;
    }
    write(options, &results)
}

fn write(options: &CalibrationOptions, results: &Results) -> Result<BenchResult> {
    let findings = pages::findings(options, results);
    let page = findings.write(&options.out)?;
    let tables = options.out.join("calibration.md");
    std::fs::write(&tables, pages::markdown(&findings.tables))
        .with_context(|| format!("cannot write {}", tables.display()))?;
    Ok(BenchResult { findings, page, data_losses: Vec::new() })
}
