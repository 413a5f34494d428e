//! The keys of arms on CAN buses: `[arm.bus.NAME]` and `[arm.motor.NAME]`.

use super::section::Section;
use super::values::{is, name_of, table, whole};
use drivers::can::{BusConfig, Family, Gains, MotorConfig};
use drivers::wire::can::cia402::Units;
use drivers::wire::can::{canopen, odrive, robstride, tmotor};
use toml::{Table, Value};

/// A motor family without its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FamilyKind {
    Damiao,
    Robstride,
    TMotor,
    Odrive,
    Cia402,
}

const FAMILIES: [(&str, FamilyKind); 5] = [
    ("damiao", FamilyKind::Damiao),
    ("robstride", FamilyKind::Robstride),
    ("tmotor", FamilyKind::TMotor),
    ("odrive", FamilyKind::Odrive),
    ("cia402", FamilyKind::Cia402),
];

/// Motor models with known scaling, of the two families whose motors do not report it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Model {
    Robstride(robstride::Model),
    TMotor(tmotor::Model),
}

const MODELS: [(&str, Model); 13] = [
    ("rs00", Model::Robstride(robstride::Model::Rs00)),
    ("rs01", Model::Robstride(robstride::Model::Rs01)),
    ("rs02", Model::Robstride(robstride::Model::Rs02)),
    ("rs03", Model::Robstride(robstride::Model::Rs03)),
    ("rs04", Model::Robstride(robstride::Model::Rs04)),
    ("rs05", Model::Robstride(robstride::Model::Rs05)),
    ("rs06", Model::Robstride(robstride::Model::Rs06)),
    ("ak10-9", Model::TMotor(tmotor::Model::Ak10x9)),
    ("ak60-6", Model::TMotor(tmotor::Model::Ak60x6)),
    ("ak70-10", Model::TMotor(tmotor::Model::Ak70x10)),
    ("ak80-6", Model::TMotor(tmotor::Model::Ak80x6)),
    ("ak80-9", Model::TMotor(tmotor::Model::Ak80x9)),
    ("ak80-64", Model::TMotor(tmotor::Model::Ak80x64)),
];
/// Gear ratios outside this range are considered typing errors.
const GEAR_RATIO_RANGE: std::ops::RangeInclusive<f64> = 0.001..=10_000.0;

/// Reads buses and motors, ordered by name.
pub(super) fn read(keys: &mut Section<'_>) -> (Vec<BusConfig>, Vec<MotorConfig>) {
    let buses: Vec<BusConfig> = keys.named_sections("bus").into_iter().map(|(name, keys)| bus(name, keys)).collect();
    let motors = keys.named_sections("motor").into_iter().filter_map(|(joint, keys)| motor(joint, keys, &buses));
    let motors = motors.collect();
    (buses, motors)
}

/// Maximum length of an interface name in Linux.
const MAX_INTERFACE_BYTES: usize = 15;

fn bus(interface: String, mut keys: Section<'_>) -> BusConfig {
    let is_name = (1..=MAX_INTERFACE_BYTES).contains(&interface.len())
        && !interface.contains(|letter: char| letter == '/' || letter.is_whitespace());
    if !is_name {
        let allowed = "an interface name of 1 to 15 characters without spaces and slashes, as the name of the table";
        keys.invalid::<()>("interface", &Value::from(interface.as_str()), allowed);
    }
    let rate = |value: Option<u64>| value.and_then(|rate| u32::try_from(rate).ok());
    let bus = BusConfig {
        interface,
        bitrate_hz: rate(keys.whole("bitrate_hz", 10_000..=1_000_000)).unwrap_or(1_000_000),
        data_bitrate_hz: rate(keys.whole("data_bitrate_hz", 10_000..=8_000_000)),
        accept_no_restart: keys.flag("accept_no_restart").unwrap_or(false),
    };
    keys.end();
    bus
}

/// Returns `None` if a value is invalid, which has been reported.
fn motor(joint: String, mut keys: Section<'_>, buses: &[BusConfig]) -> Option<MotorConfig> {
    let kind = keys.choice("family", &FAMILIES);
    if kind.is_none() {
        keys.missing("family", "damiao, robstride, tmotor, odrive or cia402");
    }
    let bus = keys.text("bus");
    if bus.is_none() {
        keys.missing("bus", "interface of the motor, which has a table [arm.bus.NAME]");
    }
    let bus_ix = bus.and_then(|bus| {
        let found = buses.iter().position(|known| known.interface == bus);
        let names: Vec<_> = buses.iter().map(|bus| format!("{:?}", bus.interface)).collect();
        let allowed = if names.is_empty() { "the name of a table [arm.bus.NAME]".to_owned() } else { names.join(", ") };
        found.or_else(|| keys.invalid("bus", &Value::String(bus), &allowed))
    });
    let max_id = match kind {
        Some(FamilyKind::Damiao) => 0x7FE,
        Some(FamilyKind::Odrive) => 62,
        Some(FamilyKind::Cia402) => 127,
        _ => 255,
    };
    let id = keys.whole("id", u64::from(kind == Some(FamilyKind::Cia402))..=max_id);
    if id.is_none() {
        keys.missing("id", "ID of the motor, axis or node");
    }
    // Keys of other families are unknown; without a valid family, all keys are known.
    let applies = |own: &[FamilyKind]| kind.is_none_or(|kind| own.contains(&kind));
    let feedback = applies(&[FamilyKind::Damiao]).then(|| keys.whole("feedback_id", 0..=0x7FE)).flatten();
    let model = applies(&[FamilyKind::Robstride, FamilyKind::TMotor]).then(|| keys.choice("model", &MODELS)).flatten();
    let counts_per_turn = applies(&[FamilyKind::Cia402]).then(|| keys.number("counts_per_turn", 1.0..=1e12)).flatten();
    let rated_torque_nm = applies(&[FamilyKind::Cia402]).then(|| keys.number("rated_torque_nm", 0.0..=1e6)).flatten();
    let rated_torque_nm = rated_torque_nm.unwrap_or(0.0);
    let gains =
        applies(&[FamilyKind::Damiao, FamilyKind::Robstride, FamilyKind::TMotor]).then(|| gains(&mut keys)).flatten();
    let gear_ratio = keys.number("gear_ratio", GEAR_RATIO_RANGE).unwrap_or(1.0);
    let is_reversed = keys.flag("reversed").unwrap_or(false);
    let offset_rad = keys.number("offset_rad", -100.0..=100.0).unwrap_or(0.0);
    let to_u8 = |id: u64| u8::try_from(id).ok();
    let Some(kind) = kind else {
        keys.end();
        return None;
    };
    let family = match (kind, id) {
        (FamilyKind::Damiao, id) => {
            if feedback.is_none() {
                keys.missing("feedback_id", "CAN ID of the motor's feedback, its register MST_ID");
            }
            let to_u16 = |id: u64| u16::try_from(id).ok();
            id.and_then(to_u16)
                .zip(feedback.and_then(to_u16))
                .map(|(motor, feedback)| Family::Damiao { motor, feedback })
        }
        (kind @ (FamilyKind::Robstride | FamilyKind::TMotor), id) => {
            let family = match (kind, model, id.and_then(to_u8)) {
                (FamilyKind::Robstride, Some(Model::Robstride(model)), Some(motor)) => {
                    Some(Family::Robstride { motor, model })
                }
                (FamilyKind::TMotor, Some(Model::TMotor(model)), Some(motor)) => Some(Family::TMotor { motor, model }),
                _ => None,
            };
            let expected_models = match (kind, model) {
                (FamilyKind::TMotor, Some(Model::Robstride(_))) => Some("ak10-9 to ak80-64, as the family is tmotor"),
                (FamilyKind::Robstride, Some(Model::TMotor(_))) => Some("rs00 to rs06, as the family is robstride"),
                _ => None,
            };
            if let (Some(allowed), Some(value)) = (expected_models, model.and_then(|model| name_of(&MODELS, &model))) {
                keys.invalid::<()>("model", &value, allowed);
            } else if family.is_none() && id.is_some() {
                keys.missing(
                    "model",
                    "model printed on the motor: rs00 to rs06 of Robstride, ak10-9 to ak80-64 of T-Motor",
                );
            }
            family
        }
        (FamilyKind::Odrive, id) => {
            id.and_then(to_u8).and_then(|id| odrive::Node::new(id).ok()).map(|node| Family::Odrive { node })
        }
        (FamilyKind::Cia402, id) => {
            if counts_per_turn.is_none() {
                keys.missing("counts_per_turn", "position counts of the drive per turn of its encoder");
            }
            let node = id.and_then(to_u8).and_then(|id| canopen::Node::new(id).ok());
            let units = counts_per_turn.map(|counts_per_turn| Units { counts_per_turn, rated_torque_nm });
            node.zip(units).map(|(node, units)| Family::Cia402 { node, units })
        }
    };
    keys.end();
    Some(MotorConfig { joint, bus_ix: bus_ix?, family: family?, gear_ratio, is_reversed, offset_rad, gains })
}

/// Reads both gains; they need each other.
fn gains(keys: &mut Section<'_>) -> Option<Gains> {
    let stiffness_nm_rad = keys.number("stiffness_nm_rad", 0.0..=1e6);
    let damping_nm_s_rad = keys.number("damping_nm_s_rad", 0.0..=1e5);
    match (stiffness_nm_rad, damping_nm_s_rad) {
        (Some(_), None) => keys.missing("damping_nm_s_rad", "required with stiffness_nm_rad"),
        (None, Some(_)) => keys.missing("stiffness_nm_rad", "required with damping_nm_s_rad"),
        _ => {}
    }
    Some(Gains { stiffness_nm_rad: stiffness_nm_rad?, damping_nm_s_rad: damping_nm_s_rad? })
}

/// The tables of buses and motors; `None` if empty.
pub(super) fn write(buses: &[BusConfig], motors: &[MotorConfig]) -> [Option<Value>; 2] {
    let bus = |bus: &BusConfig| {
        table([
            ("bitrate_hz", whole(bus.bitrate_hz.into())),
            ("data_bitrate_hz", bus.data_bitrate_hz.and_then(|rate| whole(rate.into()))),
            ("accept_no_restart", is(bus.accept_no_restart)),
        ])
    };
    let named = |tables: Table| (!tables.is_empty()).then_some(Value::Table(tables));
    let buses_table = buses.iter().map(|config| (config.interface.clone(), Value::Table(bus(config)))).collect();
    let motors_table = motors
        .iter()
        .map(|config| (config.joint.clone(), Value::Table(motor_table(config, &buses[config.bus_ix].interface))))
        .collect();
    [named(buses_table), named(motors_table)]
}

fn motor_table(motor: &MotorConfig, bus: &str) -> Table {
    let mut model = None;
    let mut feedback = None;
    let mut units = None;
    let (kind, id) = match motor.family {
        Family::Damiao { motor, feedback: answers } => {
            feedback = Some(answers);
            (FamilyKind::Damiao, motor)
        }
        Family::Robstride { motor, model: own } => {
            model = Some(Model::Robstride(own));
            (FamilyKind::Robstride, motor.into())
        }
        Family::TMotor { motor, model: own } => {
            model = Some(Model::TMotor(own));
            (FamilyKind::TMotor, motor.into())
        }
        Family::Odrive { node } => (FamilyKind::Odrive, node.number().into()),
        Family::Cia402 { node, units: own } => {
            units = Some(own);
            (FamilyKind::Cia402, node.number().into())
        }
    };
    table([
        ("family", name_of(&FAMILIES, &kind)),
        ("bus", is(bus)),
        ("id", whole(id.into())),
        ("feedback_id", feedback.and_then(|id| whole(id.into()))),
        ("model", model.and_then(|model| name_of(&MODELS, &model))),
        ("counts_per_turn", units.and_then(|units| is(units.counts_per_turn))),
        ("rated_torque_nm", units.and_then(|units| is(units.rated_torque_nm))),
        ("gear_ratio", is(motor.gear_ratio)),
        ("reversed", is(motor.is_reversed)),
        ("offset_rad", is(motor.offset_rad)),
        ("stiffness_nm_rad", motor.gains.and_then(|gains| is(gains.stiffness_nm_rad))),
        ("damping_nm_s_rad", motor.gains.and_then(|gains| is(gains.damping_nm_s_rad))),
    ])
}
