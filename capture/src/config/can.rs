//! The keys of arms on CAN buses: `[arm.bus.NAME]` and `[arm.motor.NAME]`.

use super::key::{Key, Keys, entry, keys};
use super::section::Section;
use drivers::can::{
    AllowedValues, BusConfig, FAMILIES, FollowingLimits, Gains, MotorConfig, MotorFamily, MotorKey,
    MotorProtocol, MotorSettings, SettingValue,
};
use std::collections::BTreeMap;
use std::sync::Arc;
use toml::{Table, Value};

/// Maximum length of an interface name in Linux.
const MAX_INTERFACE_BYTES: usize = 15;

keys! {
    /// The keys of a bus.
    struct BusKeys {
        bitrate_hz: u32 = 1_000_000, in 10_000..=1_000_000;
        data_bitrate_hz: Option<u32>, in 10_000..=8_000_000;
        accept_no_restart: bool = false;
    }

    /// The keys of every motor. The motor's family adds further keys.
    struct MotorKeys {
        family: &'static dyn MotorFamily, required family_names();
        bus: String, required "interface of the motor, which has a table [arm.bus.NAME]";
        id: u64, in family.map_or(0..=u64::MAX, MotorFamily::ids), required "ID of the motor, axis or node";
        /// Ratios outside this range are considered typing errors.
        gear_ratio: f64 = 1.0, in 0.001..=10_000.0;
        reversed: bool = false;
        offset_rad: f64 = 0.0, in -100.0..=100.0;
        max_following_error_rad: f64 = FollowingLimits::default().max_error_rad, in 0.001..=10.0;
        max_effort_nm: Option<f64>, in 0.01..=1e6;
        accept_following_errors: bool = false;
    }

    /// The gains of motors whose commands include them. Either both keys or none must be set.
    struct GainKeys {
        stiffness_nm_rad: Option<f64>, in 0.0..=1e6;
        damping_nm_s_rad: Option<f64>, in 0.0..=1e5;
    }
}

impl Key for &'static dyn MotorFamily {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        keys.parse(key, family_named, family_names)
    }

    fn write(&self) -> Option<Value> {
        Some(self.name().into())
    }
}

/// The family with this name.
fn family_named(value: &Value) -> Option<&'static dyn MotorFamily> {
    FAMILIES
        .iter()
        .copied()
        .find(|family| value.as_str() == Some(family.name()))
}

/// The names of all families.
fn family_names() -> String {
    quoted(FAMILIES.iter().map(|family| family.name()))
}

fn quoted<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    let words: Vec<_> = words.into_iter().map(|word| format!("{word:?}")).collect();
    words.join(", ")
}

/// Reads buses and motors, ordered by name.
pub(super) fn read(keys: &mut Section<'_>) -> (Vec<BusConfig>, Vec<MotorConfig>) {
    let buses: Vec<_> = keys
        .named_sections("bus")
        .into_iter()
        .filter_map(|(name, keys)| bus(name, keys))
        .collect();
    let motors = keys
        .named_sections("motor")
        .into_iter()
        .filter_map(|(joint, keys)| motor(joint, keys, &buses));
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
    let BusKeys {
        bitrate_hz,
        data_bitrate_hz,
        accept_no_restart,
    } = keys.read()?;
    Some(BusConfig {
        interface,
        bitrate_hz,
        data_bitrate_hz,
        accept_no_restart,
    })
}

/// Reads a motor. Reports an invalid value and returns `None`.
fn motor(joint: String, mut keys: Section<'_>, buses: &[BusConfig]) -> Option<MotorConfig> {
    let Some(motor) = MotorKeys::read_keys(&mut keys) else {
        // Without a valid family, the keys of all families are accepted, so that they are not
        // reported as unknown.
        FAMILIES
            .iter()
            .flat_map(|family| family.keys())
            .for_each(|key| drop(keys.take(key.name)));
        gains(&mut keys);
        keys.end();
        return None;
    };
    let MotorKeys {
        family,
        bus,
        id,
        gear_ratio,
        reversed: is_reversed,
        offset_rad,
        ..
    } = motor;
    let following = FollowingLimits {
        max_error_rad: motor.max_following_error_rad,
        max_effort_nm: motor.max_effort_nm,
        is_off: motor.accept_following_errors,
    };
    let bus_ix = buses
        .iter()
        .position(|known| known.interface == bus)
        .or_else(|| {
            let interfaces = quoted(buses.iter().map(|bus| &*bus.interface));
            let allowed = if interfaces.is_empty() {
                "the name of a table [arm.bus.NAME]".to_owned()
            } else {
                interfaces
            };
            keys.invalid("bus", &Value::String(bus), &allowed)
        });
    // Families without gains do not read their keys, so that these keys are reported as unknown.
    let gains = if family.has_gains() {
        gains(&mut keys)
    } else {
        None
    };
    let protocol = protocol(&mut keys, family, id);
    keys.end();
    // The function returns only now, so that all problems of the motor have been reported.
    let bus_ix = bus_ix?;
    let protocol = protocol?;
    Some(MotorConfig {
        joint,
        bus_ix,
        protocol,
        gear_ratio,
        is_reversed,
        offset_rad,
        gains,
        following,
    })
}

/// Reads the keys of the family. Reports a required key that is missing or invalid, and returns
/// `None`.
fn protocol(
    keys: &mut Section<'_>,
    family: &dyn MotorFamily,
    id: u64,
) -> Option<Arc<dyn MotorProtocol>> {
    let mut values = BTreeMap::new();
    for key in family.keys() {
        match (setting(keys, &key), key.required) {
            (Some(value), _) => drop(values.insert(key.name, value)),
            (None, Some(meaning)) => keys.missing(key.name, meaning_of(&key.allowed, meaning)),
            (None, None) => {}
        }
    }
    family.motor(&MotorSettings { id, values })
}

/// Meaning of a required key, with its allowed words if it is a choice.
fn meaning_of(allowed: &AllowedValues, meaning: &'static str) -> String {
    match allowed {
        AllowedValues::Words(words) => format!("{meaning}: {}", quoted(words.iter().copied())),
        AllowedValues::Whole(_) | AllowedValues::Number(_) => meaning.to_owned(),
    }
}

fn setting(keys: &mut Section<'_>, key: &MotorKey) -> Option<SettingValue> {
    match &key.allowed {
        AllowedValues::Whole(range) => keys.get(key.name, range.clone()).map(SettingValue::Whole),
        AllowedValues::Number(range) => keys.get(key.name, range.clone()).map(SettingValue::Number),
        AllowedValues::Words(words) => {
            let find = |value: &Value| {
                words
                    .iter()
                    .copied()
                    .find(|word| value.as_str() == Some(word))
            };
            keys.parse(key.name, find, || quoted(words.iter().copied()))
                .map(SettingValue::Word)
        }
    }
}

/// Reads both gains. Reports an error if only one is set.
fn gains(keys: &mut Section<'_>) -> Option<Gains> {
    let GainKeys {
        stiffness_nm_rad,
        damping_nm_s_rad,
    } = GainKeys::read_keys(keys)?;
    match (stiffness_nm_rad, damping_nm_s_rad) {
        (Some(_), None) => keys.missing("damping_nm_s_rad", "required with stiffness_nm_rad"),
        (None, Some(_)) => keys.missing("stiffness_nm_rad", "required with damping_nm_s_rad"),
        _ => {}
    }
    Some(Gains {
        stiffness_nm_rad: stiffness_nm_rad?,
        damping_nm_s_rad: damping_nm_s_rad?,
    })
}

/// The tables of buses and motors that are not empty.
pub(super) fn write(buses: &[BusConfig], motors: &[MotorConfig]) -> Table {
    let motors = motors.iter().map(|motor| {
        let bus = &buses[motor.bus_ix].interface;
        (motor.joint.clone(), Value::Table(write_motor(motor, bus)))
    });
    let tables: [(_, Table); 2] = [
        ("bus", buses.iter().filter_map(bus_entry).collect()),
        ("motor", motors.collect()),
    ];
    // Rigs without CAN motors have no empty tables in their effective rig file.
    let filled = tables.into_iter().filter(|(_, tables)| !tables.is_empty());
    filled
        .map(|(key, tables)| (key.to_owned(), Value::Table(tables)))
        .collect()
}

/// The table of one bus, with its interface as the name.
fn bus_entry(bus: &BusConfig) -> Option<(String, Value)> {
    let BusConfig {
        bitrate_hz,
        data_bitrate_hz,
        accept_no_restart,
        ..
    } = *bus;
    entry(
        &bus.interface,
        &BusKeys {
            bitrate_hz,
            data_bitrate_hz,
            accept_no_restart,
        },
    )
}

fn write_motor(motor: &MotorConfig, bus: &str) -> Table {
    let MotorConfig {
        gear_ratio,
        is_reversed: reversed,
        offset_rad,
        gains,
        following,
        ..
    } = *motor;
    let family = motor.protocol.family();
    let MotorSettings { id, values } = motor.protocol.settings();
    let gains = GainKeys {
        stiffness_nm_rad: gains.map(|gains| gains.stiffness_nm_rad),
        damping_nm_s_rad: gains.map(|gains| gains.damping_nm_s_rad),
    };
    let keys = MotorKeys {
        family,
        bus: bus.to_owned(),
        id,
        gear_ratio,
        reversed,
        offset_rad,
        max_following_error_rad: following.max_error_rad,
        max_effort_nm: following.max_effort_nm,
        accept_following_errors: following.is_off,
    };
    let mut table = keys.write_keys();
    table.extend(
        values
            .into_iter()
            .filter_map(|(name, value)| Some((name.to_owned(), write_setting(value)?))),
    );
    table.extend(gains.write_keys());
    table
}

fn write_setting(value: SettingValue) -> Option<Value> {
    match value {
        SettingValue::Whole(number) => number.write(),
        SettingValue::Number(number) => number.write(),
        SettingValue::Word(word) => Some(word.into()),
    }
}
