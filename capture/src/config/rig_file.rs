//! Reads the text of a rig file into a checked rig, and writes the effective rig file.

use super::key::entry;
use super::section::{ParseContext, Section};
use super::{
    Arm, ArmDriver, Base, BaseDriver, ConfigError, Override, Rig, RigPath, arm, base, camera,
    camera_info_file, scanner, servo_calibration_file, sim,
};
use std::path::Path;
use toml::{Table, Value};

/// Reads a rig. `read_urdf` returns the robot description for the path in the file. Lens parameters
/// may be in other files only if the folder of the rig file is given.
pub(super) fn read(
    file: &str,
    text: &str,
    overrides: &[Override],
    folder: Option<&Path>,
    read_urdf: impl FnOnce(&str) -> Result<String, ConfigError>,
) -> Result<Rig, ConfigError> {
    let (rig, context) = keys(file, text, overrides, folder)?;
    if let Some(problem) = context.into_problem() {
        // Only the robot description lists the links, so a missing description comes
        // first.
        if let Some((_, urdf_path)) = &rig
            && problem.first().is_missing("arm.flange_link")
            && !urdf_path.is_empty()
        {
            read_urdf(urdf_path)?;
        }
        return Err(problem);
    }
    let (mut rig, urdf_path) = rig.expect("without problems, there is a rig");
    if !urdf_path.is_empty() {
        rig.arm.urdf_text = read_urdf(&urdf_path)?;
    } else if rig.arm.urdf_text.is_empty() {
        rig.arm.urdf_text = arm::EMPTY_URDF.to_owned();
    }
    arm::resolve_joints(file, &mut rig.arm)?;
    if let Some(motion) = &rig.base.motion {
        motion.check(file, rig.arm.joints.len())?;
    }
    Ok(rig)
}

/// Reads all keys. Returns the rig without its robot description, the path of the description, and
/// the problems found. Without problems, the rig is present.
pub(super) fn keys(
    file: &str,
    text: &str,
    overrides: &[Override],
    folder: Option<&Path>,
) -> Result<(Option<(Rig, String)>, ParseContext), ConfigError> {
    let context = ParseContext::new(
        file,
        text,
        overrides.iter().map(|flag| flag.key.to_owned()).collect(),
    )?;
    let syntax = |e: toml::de::Error| ConfigError::Syntax {
        file: file.to_owned(),
        line: 1,
        message: e.message().to_owned(),
    };
    let mut table: Table = toml::from_str(text).map_err(syntax)?;
    // Flags are applied to the text of the file, before anything is checked. The values of flags
    // therefore have the same ranges and defaults as keys.
    for flag in overrides {
        set(&mut table, flag.key, flag.value.clone());
    }
    if let Some(folder) = folder {
        camera_info_file::insert_contents(&mut table, folder, &context)?;
        servo_calibration_file::insert_contents(&mut table, folder, &context)?;
    }
    let root = Section::root(&context, table);
    Ok((rig(root), context))
}

fn rig(mut root: Section<'_>) -> Option<(Rig, String)> {
    // Every table is read before any error returns, so that all problems of the file are reported
    // at once.
    let arm = arm::read(root.section("arm"));
    let base = base::read(root.section("base"));
    let cameras: Vec<_> = root
        .named_sections("camera")
        .into_iter()
        .map(|(name, keys)| camera::read(&name, keys))
        .collect();
    let scanners = root.named_sections("range");
    let scanners: Vec<_> = scanners
        .into_iter()
        .map(|(name, keys)| scanner::read(&name, keys))
        .collect();
    // A rig needs no camera until it makes keyframes, but a file without any device is a mistake.
    let is_arm_none = |(arm, _): &(Arm, String)| arm.driver == ArmDriver::None;
    let is_base_fixed = |base: &Base| base.driver == BaseDriver::Fixed;
    if cameras.is_empty()
        && scanners.is_empty()
        && arm.as_ref().is_some_and(is_arm_none)
        && base.as_ref().is_some_and(is_base_fixed)
    {
        root.missing(
            "camera",
            "at least one table [camera.NAME], because the rig has no other device",
        );
    }
    let join = root.get_optional("join", ());
    let train = root.get_optional("train", ());
    let sim = sim::read(root.section("sim"));
    root.end();
    let (arm, urdf_path) = arm?;
    let cameras = cameras.into_iter().collect::<Option<_>>()?;
    let scanners = scanners.into_iter().collect::<Option<_>>()?;
    let rig = Rig {
        arm,
        base: base?,
        cameras,
        scanners,
        join: join?,
        train: train?,
        sim: sim?,
        path: RigPath::default(),
    };
    Some((rig, urdf_path))
}

/// Sets the value of a dotted key and creates missing tables.
fn set(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        None => {
            table.insert(key.to_owned(), value);
        }
        // If the file has a value where a flag needs a table, the flag is dropped here, and the
        // value is reported as invalid when the table is read.
        Some((parent, rest)) => {
            let inner = table
                .entry(parent.to_owned())
                .or_insert_with(|| Value::Table(Table::new()));
            if let Value::Table(inner) = inner {
                set(inner, rest, value);
            }
        }
    }
}

/// Writes the effective rig file, which contains every key of a checked rig. Reading it gives the
/// same rig.
pub(super) fn write(rig: &Rig) -> String {
    let cameras = rig
        .cameras
        .iter()
        .map(|camera| (camera.name.to_string(), Value::Table(camera::write(camera))));
    let scanners = rig
        .scanners
        .iter()
        .filter_map(|scanner| entry(&scanner.name, scanner));
    let tables = [
        ("arm", arm::write(&rig.arm)),
        ("base", base::write(&rig.base)),
        ("camera", cameras.collect()),
        ("range", scanners.collect()),
        ("sim", sim::write(&rig.sim)),
    ];
    let mut file: Table = tables
        .into_iter()
        .map(|(key, table)| (key.to_owned(), Value::Table(table)))
        .collect();
    file.extend(
        entry("join", &rig.join)
            .into_iter()
            .chain(entry("train", &rig.train)),
    );
    toml::to_string(&file).expect("tables of numbers and texts always serialize")
}
