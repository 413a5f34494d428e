//! The keys of arms on CAN buses: `[arm.bus.NAME]` and `[arm.motor.NAME]`.

use super::section::Section;
use super::values::{is, table, whole};
use drivers::can::{
    AllowedValues, BusConfig, FAMILIES, Gains, MotorConfig, MotorFamily, MotorKey, MotorSettings, SettingValue,
};
use std::collections::BTreeMap;
use toml::{Table, Value};

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
    let families: Vec<_> = FAMILIES.iter().map(|family| (family.name(), *family)).collect();
    let family = keys.choice("family", &families);
    if family.is_none() {
        keys.missing("family", family_names());
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
    let id = keys.whole("id", family.map_or(0..=u64::MAX, MotorFamily::ids));
    if id.is_none() {
        keys.missing("id", "ID of the motor, axis or node");
    }
    let values = match family {
        Some(family) => family.keys().iter().filter_map(|key| Some((key.name, setting(&mut keys, key)?))).collect(),
        // Keys of other families are unknown; without a valid family, all keys are known.
        None => {
            all_keys().for_each(|key| keys.ignore(key.name));
            BTreeMap::new()
        }
    };
    let gains = family.is_none_or(MotorFamily::has_gains).then(|| gains(&mut keys)).flatten();
    let gear_ratio = keys.number("gear_ratio", GEAR_RATIO_RANGE).unwrap_or(1.0);
    let is_reversed = keys.flag("reversed").unwrap_or(false);
    let offset_rad = keys.number("offset_rad", -100.0..=100.0).unwrap_or(0.0);
    let protocol = family.and_then(|family| {
        check_settings(&keys, family, &values);
        family.motor(&MotorSettings { id: id?, values })
    });
    keys.end();
    Some(MotorConfig { joint, bus_ix: bus_ix?, protocol: protocol?, gear_ratio, is_reversed, offset_rad, gains })
}

/// Names of all families, for example "a, b or c".
fn family_names() -> String {
    let names: Vec<_> = FAMILIES.iter().map(|family| family.name()).collect();
    match names.split_last() {
        Some((last, [])) => (*last).to_owned(),
        Some((last, others)) => format!("{} or {last}", others.join(", ")),
        None => String::new(),
    }
}

/// Keys that depend on the family.
fn all_keys() -> impl Iterator<Item = MotorKey> {
    FAMILIES.iter().flat_map(|family| family.keys())
}

/// Reads a key that depends on the family. Words of other families are accepted here, so that [`check_settings`] can
/// report what is wrong with them.
fn setting(keys: &mut Section<'_>, key: &MotorKey) -> Option<SettingValue> {
    match &key.allowed {
        AllowedValues::Whole(range) => keys.whole(key.name, range.clone()).map(SettingValue::Whole),
        AllowedValues::Number(range) => keys.number(key.name, range.clone()).map(SettingValue::Number),
        AllowedValues::Words(_) => {
            let words = all_keys().filter(|known| known.name == key.name).flat_map(|known| words(&known));
            let choices: Vec<_> = words.map(|word| (word, word)).collect();
            keys.choice(key.name, &choices).map(SettingValue::Word)
        }
    }
}

/// Allowed words of a key; empty if its values are numbers.
fn words(key: &MotorKey) -> Vec<&'static str> {
    match &key.allowed {
        AllowedValues::Words(words) => words.clone(),
        AllowedValues::Whole(_) | AllowedValues::Number(_) => Vec::new(),
    }
}

/// The first and the last word of a list.
fn span(words: &[&str]) -> Option<String> {
    Some(format!("{} to {}", words.first()?, words.last()?))
}

/// Reports missing settings and words of other families.
fn check_settings(keys: &Section<'_>, family: &dyn MotorFamily, values: &BTreeMap<&str, SettingValue>) {
    for key in family.keys() {
        let own_words = words(&key);
        match (values.get(key.name), key.required) {
            (None, Some(meaning)) => keys.missing(key.name, meaning_with_words(key.name, meaning)),
            (Some(SettingValue::Word(word)), _) if !own_words.contains(word) => {
                let allowed = span(&own_words).unwrap_or_default();
                let allowed = format!("{allowed}, as the family is {}", family.name());
                keys.invalid::<()>(key.name, &Value::from(*word), &allowed);
            }
            _ => {}
        }
    }
}

/// Meaning of a key, with its words for each family.
fn meaning_with_words(name: &str, meaning: &str) -> String {
    let spans = FAMILIES.iter().flat_map(|family| {
        let keys = family.keys().into_iter().filter(|key| key.name == name);
        keys.filter_map(|key| Some(format!("{} of {}", span(&words(&key))?, family.title()))).collect::<Vec<_>>()
    });
    let spans: Vec<_> = spans.collect();
    if spans.is_empty() { meaning.to_owned() } else { format!("{meaning}: {}", spans.join(", ")) }
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
    let MotorSettings { id, values } = motor.protocol.settings();
    let mut keys = table([
        ("family", is(motor.protocol.family().name())),
        ("bus", is(bus)),
        ("id", whole(id)),
        ("gear_ratio", is(motor.gear_ratio)),
        ("reversed", is(motor.is_reversed)),
        ("offset_rad", is(motor.offset_rad)),
        ("stiffness_nm_rad", motor.gains.and_then(|gains| is(gains.stiffness_nm_rad))),
        ("damping_nm_s_rad", motor.gains.and_then(|gains| is(gains.damping_nm_s_rad))),
    ]);
    for (name, value) in values {
        let value = match value {
            SettingValue::Whole(number) => whole(number),
            SettingValue::Number(number) => is(number),
            SettingValue::Word(word) => is(word),
        };
        keys.extend(value.map(|value| (name.to_owned(), value)));
    }
    keys
}
