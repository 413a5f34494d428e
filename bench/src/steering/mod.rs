//! Measures steering: how fast arms brake after faults, how well they follow a hand, and how fast
//! inverse kinematics is.
//!
//! The faults take the way that they have in a run, in real time: a client of `/steer` on a
//! connection that can be cut, the server, the thread of the decisions, and the thread of the arm.
//! There are no cameras and no training, and the space around the arm is free. `trial.rs` has one
//! trial, `faults.rs` the list of faults, and `arms.rs` the arms.

mod arms;
mod braking;
mod client;
mod faults;
mod grips;
mod inverse;
mod link;
mod matrix;
mod operator;
mod rig;
mod scene;
mod trace;
mod tracking;
mod trial;

pub use arms::ArmKind;
pub use faults::Fault;
pub use grips::Grips;
pub use inverse::InverseRates;
pub use matrix::{FaultRow, Spread};
pub use trace::{Excess, LimitKind};
pub use tracking::Tracking;

use crate::findings::{BenchResult, Findings};
use anyhow::{Context, Result};
use rig::SteeredRig;
use serde::Serialize;
use std::path::PathBuf;

/// Options of [`run`]. A part with the size 0 is left out.
#[derive(Clone, Debug)]
pub struct SteeringOptions {
    /// The arms.
    pub arms: Vec<ArmKind>,
    /// The faults.
    pub faults: Vec<Fault>,
    /// Trials of each fault with each arm.
    pub n_trials: u32,
    /// Duration of the figure of eight with each arm, seconds.
    pub tracking_secs: f64,
    /// Poses of each robot for inverse kinematics.
    pub n_poses: u32,
    /// Grips with the hand anywhere.
    pub n_grips: u32,
    /// Folder for charts and numbers.
    pub out: PathBuf,
}

/// Results so far.
#[derive(Clone, Debug, Default, Serialize)]
struct Results {
    faults: Vec<FaultRow>,
    tracking: Vec<Tracking>,
    inverse: Vec<InverseRates>,
    grips: Option<Grips>,
}

/// Measures, and writes the files after each part.
///
/// * `on_row`: receives each row of the fault matrix. If it returns an error, the bench ends.
///
/// # Errors
///
/// Fails if an arm is not part of this program or cannot be steered, or a file cannot be written.
pub fn run(
    options: &SteeringOptions,
    mut on_row: impl FnMut(&FaultRow) -> Result<()>,
) -> Result<BenchResult> {
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot create the folder {}", options.out.display()))?;
    let mut results = Results::default();
    if options.n_poses > 0 {
        results.inverse = inverse::measure(options.n_poses)?;
    }
    if options.n_grips > 0 {
        results.grips = Some(grips::measure(options.n_grips)?);
    }
    for arm in &options.arms {
        let is_used = options.tracking_secs > 0.0 || options.n_trials > 0;
        if !is_used {
            break;
        }
        log::info!("steering the arm {:?}", arm.name());
        let rig = SteeredRig::start(arms::start(*arm)?)?;
        if options.tracking_secs > 0.0 {
            let tracking = tracking::measure(&rig, options.tracking_secs)?;
            results.tracking.push(tracking);
        }
        if options.n_trials == 0 {
            continue;
        }
        for fault in &options.faults {
            let row = matrix::measure(&rig, *fault, options.n_trials)?;
            on_row(&row)?;
            results.faults.push(row);
            // An interrupted bench keeps its results.
            findings(options, &results)?.write(&options.out)?;
        }
    }
    let findings = findings(options, &results)?;
    let page = findings.write(&options.out)?;
    Ok(BenchResult {
        findings,
        page,
        data_losses: Vec::new(),
    })
}

fn findings(options: &SteeringOptions, results: &Results) -> Result<Findings> {
    let mut tables = Vec::new();
    let mut charts = Vec::new();
    if !results.faults.is_empty() {
        tables.push(matrix::table(&results.faults));
        charts.push(("-faults", matrix::chart(&results.faults)));
    }
    if !results.tracking.is_empty() {
        tables.push(tracking::table(&results.tracking));
    }
    if !results.inverse.is_empty() {
        tables.push(inverse::table(&results.inverse));
    }
    if let Some(grips) = &results.grips {
        tables.push(grips::table(grips));
    }
    let faults = format!(
        "Each fault happens {} times while the tip follows a hand at 0.1 m/s. Times are from the \
         fault, or from the release of the switch while the fault lasts. A brake begins with the \
         first cycle from which the arm only becomes slower, and not before the arm reports the end \
         of its motion. The prediction follows from the limits of braking. The position, velocity, \
         acceleration and jerk of each joint are checked in each cycle.",
        options.n_trials
    );
    let path = "Faults take the way of a run in real time: a client of /steer on a real connection, \
                the server, the thread of the decisions, and the thread of the arm. Loss is the \
                delay with which TCP delivers a lost packet. Grips are measured on a simulated \
                clock, without a server.";
    Ok(Findings {
        name: "steering",
        title: "Steering".to_owned(),
        sentences: vec![faults, path.to_owned()],
        charts,
        tables,
        numbers: serde_json::to_value(results)?,
    })
}

#[cfg(test)]
mod tests;
