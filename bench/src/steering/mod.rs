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
#[cfg(feature = "sim")]
mod goals;
mod grips;
mod inverse;
mod link;
mod matrix;
mod operator;
mod rig;
mod scene;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod stopped_program;
mod trace;
mod tracking;
mod trial;
mod views;

pub use arms::ArmKind;
pub use faults::Fault;
#[cfg(feature = "sim")]
pub use goals::{GoalKind, GoalRow, GoalScene};
pub use grips::Grips;
pub use inverse::InverseRates;
pub use matrix::{FaultRow, Spread};
#[cfg(all(feature = "sim", target_os = "linux"))]
pub use stopped_program::serve_robot;
pub use trace::{Excess, LimitKind};
pub use tracking::Tracking;
pub use views::{ViewOptions, ViewRow};

use crate::findings::{BenchResult, Findings};
use anyhow::{Context, Result};
use rig::SteeredRig;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Options of [`run`]. A part with the size 0 is left out.
#[derive(Clone, Debug)]
pub struct SteeringOptions {
    /// The arms and bases.
    pub arms: Vec<ArmKind>,
    /// The faults. Each robot gets those that concern it.
    pub faults: Vec<Fault>,
    /// Trials of each fault with each robot.
    pub n_trials: u32,
    /// Duration of the figure of eight with each arm, seconds.
    pub tracking_secs: f64,
    /// Poses of each robot for inverse kinematics.
    pub n_poses: u32,
    /// Grips with the hand anywhere.
    pub n_grips: u32,
    /// Goals of each kind in each simulated scene.
    pub n_goals: u32,
    /// Views that the scan never had; `None` leaves them out.
    pub views: Option<ViewOptions>,
    /// Other processes of this program, some of which are stopped and killed. `None` leaves these
    /// faults out.
    pub processes: Option<Processes>,
    /// Folder for charts and numbers.
    pub out: PathBuf,
}

/// Commands that start this program again. Their output is read.
#[derive(Clone, Copy, Debug)]
pub struct Processes {
    /// Steers the robot whose emulated device is at an address ([`serve_robot`]), and prints the
    /// address of its server.
    pub serve: fn(ArmKind, address: &str) -> Result<Command>,
    /// Runs a rig file as a simulation that an operator may steer. It prints its events as JSON and
    /// writes to a folder.
    pub run: fn(rig: &Path, out: &Path) -> Result<Command>,
}

/// Results so far.
#[derive(Clone, Debug, Default, Serialize)]
struct Results {
    faults: Vec<FaultRow>,
    tracking: Vec<Tracking>,
    inverse: Vec<InverseRates>,
    grips: Option<Grips>,
    #[cfg(feature = "sim")]
    goals: Vec<GoalRow>,
    views: Vec<ViewRow>,
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
    if options.n_goals > 0 {
        measure_goals(options, &mut results)?;
    }
    if let Some(views) = &options.views {
        let processes = options.processes.context("no run can be started")?;
        results.views = views::measure(views, processes.run, &options.out.join("run"))?;
    }
    for arm in &options.arms {
        let is_tracked = options.tracking_secs > 0.0 && !arm.is_base();
        if !is_tracked && options.n_trials == 0 {
            continue;
        }
        log::info!("steering {:?}", arm.name());
        let rig = SteeredRig::start(arms::start(*arm)?)?;
        if is_tracked {
            let tracking = tracking::measure(&rig, options.tracking_secs)?;
            results.tracking.push(tracking);
        }
        if options.n_trials == 0 {
            continue;
        }
        for fault in options.faults.iter().filter(|fault| fault.concerns(*arm)) {
            if fault.ends_program() {
                continue;
            }
            let row = matrix::measure(&rig, *fault, options.n_trials)?;
            on_row(&row)?;
            results.faults.push(row);
            // An interrupted bench keeps its results.
            findings(options, &results)?.write(&options.out)?;
        }
    }
    for (arm, fault) in faults_of_programs(options) {
        let row = end_program(options, arm, fault)?;
        on_row(&row)?;
        results.faults.push(row);
        findings(options, &results)?.write(&options.out)?;
    }
    let findings = findings(options, &results)?;
    let page = findings.write(&options.out)?;
    Ok(BenchResult {
        findings,
        page,
        data_losses: Vec::new(),
    })
}

/// The faults that end the program, with the devices that they concern.
fn faults_of_programs(options: &SteeringOptions) -> Vec<(ArmKind, Fault)> {
    if options.n_trials == 0 || options.processes.is_none() {
        return Vec::new();
    }
    let faults = options.faults.iter().filter(|fault| fault.ends_program());
    let of_fault = |fault: &Fault| {
        let arms = options.arms.iter().filter(|arm| fault.concerns(**arm));
        arms.map(|arm| (*arm, *fault)).collect::<Vec<_>>()
    };
    faults.flat_map(of_fault).collect()
}

#[cfg(all(feature = "sim", target_os = "linux"))]
fn end_program(options: &SteeringOptions, arm: ArmKind, fault: Fault) -> Result<FaultRow> {
    let processes = options.processes.context("no program can be stopped")?;
    log::info!("{}: {}", arm.name(), fault.title());
    stopped_program::measure(arm, fault, options.n_trials, processes.serve)
}

#[cfg(not(all(feature = "sim", target_os = "linux")))]
fn end_program(_options: &SteeringOptions, arm: ArmKind, _fault: Fault) -> Result<FaultRow> {
    anyhow::bail!("{:?} is not part of this program", arm.name())
}

/// Tries goals in all scenes.
#[cfg(feature = "sim")]
fn measure_goals(options: &SteeringOptions, results: &mut Results) -> Result<()> {
    for scene in GoalScene::ALL {
        log::info!("goals: {}", scene.title());
        results
            .goals
            .extend(goals::measure(scene, options.n_goals)?);
        // An interrupted bench keeps its results.
        findings(options, results)?.write(&options.out)?;
    }
    Ok(())
}

#[cfg(not(feature = "sim"))]
fn measure_goals(_options: &SteeringOptions, _results: &mut Results) -> Result<()> {
    Err(messages::BadInput(
        "goals in simulated scenes need a program with the simulator: build it with \
         `cargo build --release --features sim`"
            .to_owned(),
    )
    .into())
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
    #[cfg(feature = "sim")]
    if !results.goals.is_empty() {
        tables.push(goals::table(&results.goals));
    }
    if !results.views.is_empty() {
        tables.push(views::table(&results.views));
    }
    let faults = format!(
        "Each fault happens {} times while the tip follows a hand at 0.1 m/s, or a base drives at \
         0.25 m/s. Times are from the \
         fault, or from the release of the switch while the fault lasts. A brake begins with the \
         first cycle from which the robot only becomes slower, and not before it reports the end of \
         its motion. The prediction follows from the limits of braking. The position, velocity, \
         acceleration and jerk of each joint, or the velocities and accelerations of a base, are \
         checked in each cycle.",
        options.n_trials
    );
    let path = "Faults take the way of a run in real time: a client of /steer on a real connection, \
                the server, the thread of the decisions, and the thread of the robot. Loss is the \
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
