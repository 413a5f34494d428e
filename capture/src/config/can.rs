//! The keys of arms on CAN buses: `[arm.bus.NAME]` and `[arm.motor.NAME]`.

use super::key::{Keys, choices, entry, keys};
use super::section::Section;
use drivers::can::{BusConfig, Family, Gains, MotorConfig};
use drivers::wire::can::cia402::Units;
use drivers::wire::can::{canopen, odrive, robstride, tmotor};
use toml::{Table, Value};

/// Maximum length of an interface name in Linux.
const MAX_INTERFACE_BYTES: usize = 15;
/// Meaning of the key `id` of every motor family.
const ID: &str = "ID of the motor, axis or node";
/// Meaning of the key `model` of the families whose motors do not report it.
const MODEL: &str = "model printed on the motor: rs00 to rs06 of Robstride, ak10-9 to ak80-64 of T-Motor";

keys! {
    /// The keys of a bus.
    struct BusKeys {
        bitrate_hz: u32 = 1_000_000, in 10_000..=1_000_000;
        data_bitrate_hz: Option<u32>, in 10_000..=8_000_000;
        accept_no_restart: bool = false;
    }

    /// The keys of every motor.
    struct MotorKeys {
        family: FamilyName, required "damiao, robstride, tmotor, odrive or cia402";
        bus: String, required "interface of the motor, which has a table [arm.bus.NAME]";
        /// Ratios outside the limits are considered typing errors.
        gear_ratio: f64 = 1.0, in 0.001..=10_000.0;
        reversed: bool = false;
        offset_rad: f64 = 0.0, in -100.0..=100.0;
    }

    struct DamiaoKeys {
        id: u16, in 0..=0x7FE, required ID;
        feedback_id: u16, in 0..=0x7FE, required "CAN ID of the motor's feedback, its register MST_ID";
    }

    struct RobstrideKeys {
        id: u8, in 0..=255, required ID;
        model: robstride::Model, required MODEL;
    }

    struct TMotorKeys {
        id: u8, in 0..=255, required ID;
        model: tmotor::Model, required MODEL;
    }

    struct OdriveKeys {
        id: u8, in 0..=62, required ID;
    }

    struct Cia402Keys {
        id: u8, in 1..=127, required ID;
        counts_per_turn: f64, in 1.0..=1e12, required "position counts of the drive per turn of its encoder";
        rated_torque_nm: f64 = 0.0, in 0.0..=1e6;
    }

    /// The gains of the families whose commands include them; they need each other.
    struct GainKeys {
        stiffness_nm_rad: Option<f64>, in 0.0..=1e6;
        damping_nm_s_rad: Option<f64>, in 0.0..=1e5;
    }
}

/// A motor family without its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FamilyName {
    Damiao,
    Robstride,
    TMotor,
    Odrive,
    Cia402,
}

choices! {
    FamilyName { Damiao = "damiao", Robstride = "robstride", TMotor = "tmotor", Odrive = "odrive", Cia402 = "cia402" }
    robstride::Model {
        Rs00 = "rs00", Rs01 = "rs01", Rs02 = "rs02", Rs03 = "rs03", Rs04 = "rs04", Rs05 = "rs05", Rs06 = "rs06"
    }
    tmotor::Model {
        Ak10x9 = "ak10-9", Ak60x6 = "ak60-6", Ak70x10 = "ak70-10", Ak80x6 = "ak80-6", Ak80x9 = "ak80-9",
        Ak80x64 = "ak80-64"
    }
}

/// Reads buses and motors, ordered by name.
pub(super) fn read(keys: &mut Section<'_>) -> (Vec<BusConfig>, Vec<MotorConfig>) {
    let buses: Vec<_> = keys.named_sections("bus").into_iter().filter_map(|(name, keys)| bus(name, keys)).collect();
    let motors = keys.named_sections("motor").into_iter().filter_map(|(joint, keys)| motor(joint, keys, &buses));
    let motors = motors.collect();
    (buses, motors)
}

fn bus(interface: String, keys: Section<'_>) -> Option<BusConfig> {
    let is_name = (1..=MAX_INTERFACE_BYTES).contains(&interface.len())
        && !interface.contains(|letter: char| letter == '/' || letter.is_whitespace());
    if !is_name {
        let allowed = "an interface name of 1 to 15 characters without spaces and slashes, as the name of the table";
        keys.invalid::<()>("interface", &Value::from(interface.as_str()), allowed);
    }
    let BusKeys { bitrate_hz, data_bitrate_hz, accept_no_restart } = keys.read()?;
    Some(BusConfig { interface, bitrate_hz, data_bitrate_hz, accept_no_restart })
}

/// Returns `None` if a value is invalid, which has been reported.
fn motor(joint: String, mut keys: Section<'_>, buses: &[BusConfig]) -> Option<MotorConfig> {
    let motor = MotorKeys::read_keys(&mut keys);
    let Some(MotorKeys { family, bus, gear_ratio, reversed, offset_rad }) = motor else {
        // The keys of no family are unknown then.
        DamiaoKeys::read_keys(&mut keys);
        RobstrideKeys::read_keys(&mut keys);
        Cia402Keys::read_keys(&mut keys);
        gains(&mut keys);
        keys.end();
        return None;
    };
    let bus_ix = buses.iter().position(|known| known.interface == bus).or_else(|| {
        let names: Vec<_> = buses.iter().map(|bus| format!("{:?}", bus.interface)).collect();
        let allowed = if names.is_empty() { "the name of a table [arm.bus.NAME]".to_owned() } else { names.join(", ") };
        keys.invalid("bus", &Value::String(bus), &allowed)
    });
    let has_gains = matches!(family, FamilyName::Damiao | FamilyName::Robstride | FamilyName::TMotor);
    let gains = if has_gains { gains(&mut keys) } else { None };
    let family = match family {
        FamilyName::Damiao => {
            DamiaoKeys::read_keys(&mut keys).map(|own| Family::Damiao { motor: own.id, feedback: own.feedback_id })
        }
        FamilyName::Robstride => {
            RobstrideKeys::read_keys(&mut keys).map(|own| Family::Robstride { motor: own.id, model: own.model })
        }
        FamilyName::TMotor => {
            TMotorKeys::read_keys(&mut keys).map(|own| Family::TMotor { motor: own.id, model: own.model })
        }
        FamilyName::Odrive => OdriveKeys::read_keys(&mut keys)
            .and_then(|own| Some(Family::Odrive { node: odrive::Node::new(own.id).ok()? })),
        FamilyName::Cia402 => Cia402Keys::read_keys(&mut keys).and_then(|own| {
            let units = Units { counts_per_turn: own.counts_per_turn, rated_torque_nm: own.rated_torque_nm };
            Some(Family::Cia402 { node: canopen::Node::new(own.id).ok()?, units })
        }),
    };
    keys.end();
    Some(MotorConfig { joint, bus_ix: bus_ix?, family: family?, gear_ratio, is_reversed: reversed, offset_rad, gains })
}

/// Reads both gains; they need each other.
fn gains(keys: &mut Section<'_>) -> Option<Gains> {
    let GainKeys { stiffness_nm_rad, damping_nm_s_rad } = GainKeys::read_keys(keys)?;
    match (stiffness_nm_rad, damping_nm_s_rad) {
        (Some(_), None) => keys.missing("damping_nm_s_rad", "required with stiffness_nm_rad"),
        (None, Some(_)) => keys.missing("stiffness_nm_rad", "required with damping_nm_s_rad"),
        _ => {}
    }
    Some(Gains { stiffness_nm_rad: stiffness_nm_rad?, damping_nm_s_rad: damping_nm_s_rad? })
}

/// The tables of buses and motors that are not empty.
pub(super) fn write(buses: &[BusConfig], motors: &[MotorConfig]) -> Table {
    let bus = |bus: &BusConfig| {
        let BusConfig { bitrate_hz, data_bitrate_hz, accept_no_restart, .. } = *bus;
        entry(&bus.interface, &BusKeys { bitrate_hz, data_bitrate_hz, accept_no_restart })
    };
    let motor =
        |motor: &MotorConfig| (motor.joint.clone(), Value::Table(write_motor(motor, &buses[motor.bus_ix].interface)));
    let tables: [(_, Table); 2] =
        [("bus", buses.iter().filter_map(bus).collect()), ("motor", motors.iter().map(motor).collect())];
    let filled = tables.into_iter().filter(|(_, tables)| !tables.is_empty());
    filled.map(|(key, tables)| (key.to_owned(), Value::Table(tables))).collect()
}

fn write_motor(motor: &MotorConfig, bus: &str) -> Table {
    let (family, own) = match motor.family {
        Family::Damiao { motor: id, feedback: feedback_id } => {
            (FamilyName::Damiao, DamiaoKeys { id, feedback_id }.write_keys())
        }
        Family::Robstride { motor: id, model } => (FamilyName::Robstride, RobstrideKeys { id, model }.write_keys()),
        Family::TMotor { motor: id, model } => (FamilyName::TMotor, TMotorKeys { id, model }.write_keys()),
        Family::Odrive { node } => (FamilyName::Odrive, OdriveKeys { id: node.number() }.write_keys()),
        Family::Cia402 { node, units: Units { counts_per_turn, rated_torque_nm } } => {
            let own = Cia402Keys { id: node.number(), counts_per_turn, rated_torque_nm };
            (FamilyName::Cia402, own.write_keys())
        }
    };
    let MotorConfig { gear_ratio, is_reversed: reversed, offset_rad, gains, .. } = *motor;
    let gains = GainKeys {
        stiffness_nm_rad: gains.map(|gains| gains.stiffness_nm_rad),
        damping_nm_s_rad: gains.map(|gains| gains.damping_nm_s_rad),
    };
    let mut table = MotorKeys { family, bus: bus.to_owned(), gear_ratio, reversed, offset_rad }.write_keys();
    table.extend(own);
    table.extend(gains.write_keys());
    table
}
