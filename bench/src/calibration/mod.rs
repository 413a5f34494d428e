//! Measures accuracy, reported uncertainty, speed and limits of calibration, on simulated
//! measurements with a known truth.
//!
//! Corners of a chessboard are computed with normal errors, without rendering. Calibration without
//! a target ([`CalibrationOptions::rig`]) needs the simulator.

mod arm_configurations;
mod coverage;
mod method;
mod pages;
mod rigs;
mod scene;
mod speed;
mod stability;

use crate::findings::BenchResult;
use anyhow::{Context, Result};
use arm_configurations::ArmConfiguration;
use coverage::Coverage;
use rigs::RigResult;
use serde::Serialize;
use speed::Speed;
use stability::Cell;
use std::path::PathBuf;

/// A part of the bench.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Time and error by the number of poses.
    Speed,
    /// Coverage of the reported uncertainty.
    Coverage,
    /// Failures by rotation, number of poses and outliers.
    Stability,
    /// Joint offsets near singular arm configurations.
    ArmConfigurations,
    /// Calibration of rigs without a target.
    Rigs,
}

impl Part {
    /// All parts.
    pub const ALL: [Self; 5] = [
        Self::Speed,
        Self::Coverage,
        Self::Stability,
        Self::ArmConfigurations,
        Self::Rigs,
    ];

    /// Its name in options.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Speed => "speed",
            Self::Coverage => "coverage",
            Self::Stability => "stability",
            Self::ArmConfigurations => "arm",
            Self::Rigs => "rigs",
        }
    }

    /// What is measured.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::Speed => "Time and error by the number of poses",
            Self::Coverage => "How often the 95 % ellipsoid contains the truth",
            Self::Stability => "Failures by rotation, number of poses and outliers",
            Self::ArmConfigurations => "Joint offsets near singular configurations of an arm",
            Self::Rigs => "Calibration without a target",
        }
    }
}

/// Scenes for the coverage of the reported uncertainty.
#[derive(Clone, Copy, Debug)]
pub struct CoverageScenes {
    /// Calibrations per kind.
    pub runs: u64,
    /// Seed of the first scene.
    pub first_seed: u64,
    /// Images or robot poses per calibration.
    pub n_poses: usize,
    /// Standard deviation of the corners, pixels.
    pub corner_px: f64,
}

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct CalibrationOptions {
    /// What to measure.
    pub parts: Vec<Part>,
    /// Scenes of [`Part::Coverage`].
    pub coverage: CoverageScenes,
    /// Number of scenes for each number of poses, and for each combination of conditions.
    pub seeds: u64,
    /// Rig file for [`Part::Rigs`]. If it is `None`, this part is skipped.
    pub rig: Option<PathBuf>,
    /// Number of rigs. Each is the first camera of the rig file with different errors.
    pub rigs: u64,
    /// Number of the first of these rigs, from 1.
    pub first_rig: u64,
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

impl CalibrationOptions {
    /// Results of a part, or none if it was not requested.
    fn measured<T>(&self, part: Part, measure: impl FnOnce() -> Vec<T>) -> Vec<T> {
        if !self.parts.contains(&part) {
            return Vec::new();
        }
        log::info!("{part:?}");
        measure()
    }
}

/// Measures the requested parts.
///
/// # Errors
///
/// Fails if the rig cannot be simulated, or if the folder cannot be written.
pub fn run(options: &CalibrationOptions) -> Result<BenchResult> {
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot create {}", options.out.display()))?;
    // Speed is measured before the other parts, which use all processors.
    let mut results = Results {
        speed: options.measured(Part::Speed, || speed::measure(options.seeds)),
        coverage: options.measured(Part::Coverage, || coverage::measure(options.coverage)),
        stability: options.measured(Part::Stability, || stability::measure(options.seeds)),
        arm_configurations: options.measured(Part::ArmConfigurations, || {
            arm_configurations::measure(options.seeds)
        }),
        rigs: Vec::new(),
    };
    let rig = options
        .rig
        .as_ref()
        .filter(|_| options.parts.contains(&Part::Rigs));
    for seed in options.first_rig..options.first_rig + options.rigs {
        let Some(rig) = rig else { break };
        results
            .rigs
            .push(rigs::measure(rig, seed, options.scan_secs)?);
        log::info!("rig {seed}: {:?}", results.rigs.last());
        // Results are written after each rig, so that they are kept if the bench is interrupted.
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
    Ok(BenchResult {
        findings,
        page,
        data_losses: Vec::new(),
    })
}
