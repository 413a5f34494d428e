//! `fieldrig calibrate`: calibrates cameras, with a printed target or from images of any static
//! scene.

mod guide;
mod hand_eye;
mod images;
mod intrinsics;
mod json_object;
mod lens;
mod outputs;
mod page;
mod scan;
mod scene;
mod target;
mod time_offset;

use crate::exit::Exit;
use crate::print;
use clap::{Parser, Subcommand};
use kinematics::{Transform, transform};
use targets::TargetSpec;

/// Flags of `calibrate`.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: CalibrateCommand,
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Write a calibration target to print
    Target(target::Args),
    /// Estimate the lens of a camera from images of a target
    Intrinsics(intrinsics::Args),
    /// Estimate the pose of a camera on a robot from robot poses and images of a target
    HandEye(hand_eye::Args),
    /// Estimate the offset between the clocks of two pose streams, and the transform between their
    /// bodies
    TimeOffset(time_offset::Args),
    /// Estimate hand-eye transforms, time offsets, lenses, joint offsets and depth errors of a rig
    /// from images of a static scene, without a target
    Scene(scene::Args),
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    match &args.command {
        CalibrateCommand::Target(args) => target::run(args).map(|()| Exit::Done),
        CalibrateCommand::Intrinsics(args) => intrinsics::run(args),
        CalibrateCommand::HandEye(args) => hand_eye::run(args),
        CalibrateCommand::TimeOffset(args) => time_offset::run(args),
        CalibrateCommand::Scene(args) => scene::run(args),
    }
}

/// Parses the specification of a target.
fn target_argument(text: &str) -> Result<TargetSpec, String> {
    text.parse()
        .map_err(|error: targets::SpecError| error.to_string())
}

/// The matrix of a transform, row by row.
fn matrix_of(transform: &Transform) -> [[f64; 4]; 4] {
    let rows = transform::to_rows(transform);
    std::array::from_fn(|row| std::array::from_fn(|column| rows[4 * row + column]))
}

/// Prints a matrix row by row.
fn print_matrix(matrix: &[[f64; 4]; 4]) -> anyhow::Result<()> {
    for row in matrix {
        let row: Vec<String> = row.iter().map(|value| format!("{value:10.6}")).collect();
        print::line(format!("  {}", row.join(" ")))?;
    }
    Ok(())
}

/// The transform of a matrix in JSON: four lists of four numbers, or one list of 16, row by row.
fn transform_of(value: &serde_json::Value) -> Result<Transform, String> {
    let rows = value.as_array().map_or(0, Vec::len);
    let row_of = |row: &serde_json::Value| row.as_array().filter(|row| row.len() == 4).cloned();
    let given = value.as_array().cloned().unwrap_or_default();
    // Four rows of four, or else the numbers themselves. Other shapes fail at the conversion below.
    let flat = match given.iter().map(row_of).collect::<Option<Vec<_>>>() {
        Some(rows) => rows.concat(),
        None => given,
    };
    let numbers: Option<Vec<f64>> = flat.iter().map(serde_json::Value::as_f64).collect();
    let numbers: Option<[f64; 16]> = numbers.and_then(|numbers| numbers.try_into().ok());
    // One to three rows are likely a forgotten last row, which is worth a hint.
    let numbers = numbers.ok_or_else(|| match rows {
        1..=3 => format!("must be a matrix of 4 x 4 numbers, row by row; found {rows} rows"),
        _ => "must be a matrix of 4 x 4 numbers, row by row".to_owned(),
    })?;
    transform::from_rows(&numbers).map_err(|error| error.to_string())
}
