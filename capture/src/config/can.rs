//! The keys of arms on CAN buses: `[arm.bus.NAME]` and `[arm.motor.NAME]`.

use super::key::{Key, Keys, entry, keys, table_of};
use super::section::Section;
use super::table_schema::TableSchema;
use drivers::can::{
    AllowedValues, BusConfig, FAMILIES, FollowingLimits, Gains, MotorConfig, MotorFamily, MotorKey,
    MotorProtocol, MotorSettings, SettingValue,
};
use serde_json::json;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use toml::{Table, Value};

/// Maximum length of an interface name in Linux.
const MAX_INTERFACE_BYTES: usize = 15;

keys! {
    /// The keys of a bus.
    struct BusKeys {
        /// Nominal bit rate, bit/s. The interface must be configured for this rate.
        bitrate_hz: u32 = 1_000_000, in 10_000..=1_000_000;
        /// Bit rate of the data phase of CAN FD frames, bit/s. Without this key, classic CAN.
        data_bitrate_hz: Option<u32>, in 10_000..=8_000_000;
        /// Whether an interface without `restart-ms` is accepted.
        accept_no_restart: bool = false;
    }

    /// The keys of every motor. The motor's family adds further keys.
    struct MotorKeys {
        /// Motor protocol.
        family: &'static dyn MotorFamily, required family_names();
        /// Interface to which the motor is connected. It has a table [arm.bus.NAME].
        bus: String, required "interface of the motor, which has a table [arm.bus.NAME]";
        /// CAN ID of the motor, axis or node.
        id: u64, in family.map_or(0..=u64::MAX, MotorFamily::ids), within all_ids(), required "ID of the motor, axis or node";
        /// Revolutions that the motor reports per revolution of the joint.
        gear_ratio: f64 = 1.0, in 0.001..=10_000.0;
        /// Whether the motor turns opposite to the joint.
        reversed: bool = false;
        /// Joint angle at which the motor reports 0, radians.
        offset_rad: f64 = 0.0, in -100.0..=100.0;
        /// Largest allowed difference between the commanded and the reported position of the joint,
        /// rad or m. If the difference is larger, a moved arm stops.
        max_following_error_rad: f64 = FollowingLimits::default().max_error_rad, in 0.001..=10.0;
        /// Largest allowed torque or force at the joint, N m or N. Without this key, the effort limit
        /// in the URDF.
        max_effort_nm: Option<f64>, in 0.01..=1e6;
        /// Whether following error and effort are not checked.
        accept_following_errors: bool = false;
    }

    /// The gains of motors whose commands include them. Either both keys or none must be set.
    struct GainKeys {
        /// Position gain at the joint, N m/rad.
        stiffness_nm_rad: Option<f64>, in 0.0..=1e6;
        /// Velocity gain at the joint, N m s/rad.
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

    fn schema((): ()) -> serde_json::Value {
        let names: Vec<_> = FAMILIES.iter().map(|family| family.name()).collect();
        json!({ "type": "string", "enum": names })
    }
}

/// IDs that a motor of some family can have.
fn all_ids() -> RangeInclusive<u64> {
    let ids = || FAMILIES.iter().map(|family| family.ids());
    let first = ids().map(|ids| *ids.start()).min().unwrap_or(0);
    let last = ids().map(|ids| *ids.end()).max().unwrap_or(0);
    first..=last
}

/// Adds buses and motors to the schema of the arm.
pub(super) fn describe(arm: &mut TableSchema) {
    let about =
        "CAN buses of the motors. The name of a table is the interface, such as [arm.bus.can0].";
    let bus = table_of::<BusKeys>();
    arm.named("bus", about, "^[^/\\s]{1,15}$", bus);
    let mut motor = table_of::<MotorKeys>();
    GainKeys::describe(&mut motor);
    for family in FAMILIES {
        describe_family(*family, &mut motor);
    }
    let about = "Motors on the CAN buses. The name of a table is the joint of its motor.";
    arm.named("motor", about, "", motor);
}

/// Adds the keys of a family to the schema of motors, with a rule for motors of this family.
fn describe_family(family: &dyn MotorFamily, motor: &mut TableSchema) {
    let mut values = serde_json::Map::new();
    values.insert("id".to_owned(), u64::schema(family.ids()));
    let mut required = Vec::new();
    for key in family.keys() {
        let about = format!(
            "{}: {}.",
            families_with(key.name).join(" and "),
            key.required.unwrap_or("optional")
        );
        // Families may have keys of the same name with other values, so the values are in the rule.
        motor.add(key.name, &about, json!({}));
        values.insert(key.name.to_owned(), allowed_schema(&key.allowed));
        required.extend(key.required.map(|_| key.name));
    }
    motor.condition(json!({
        "if": { "properties": { "family": { "const": family.name() } }, "required": ["family"] },
        "then": { "properties": values, "required": required },
    }));
}

/// Titles of the families whose motors have a key.
fn families_with(key: &str) -> Vec<&'static str> {
    FAMILIES
        .iter()
        .filter(|family| family.keys().iter().any(|own| own.name == key))
        .map(|family| family.title())
        .collect()
}

fn allowed_schema(allowed: &AllowedValues) -> serde_json::Value {
    match allowed {
        AllowedValues::Whole(range) => u64::schema(range.clone()),
        AllowedValues::Number(range) => f64::schema(range.clone()),
        AllowedValues::Words(words) => json!({ "type": "string", "enum": words }),
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
