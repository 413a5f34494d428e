//! Settings of a motor in the rig file that depend on its family.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

/// A key of a motor's table in the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct MotorKey {
    /// Name.
    pub name: &'static str,
    /// Allowed values.
    pub allowed: AllowedValues,
    /// Description of the value, for the message that a required key is missing; `None` if the key
    /// is optional.
    pub required: Option<&'static str>,
}

/// Allowed values of a key.
#[derive(Clone, Debug, PartialEq)]
pub enum AllowedValues {
    /// A whole number.
    Whole(RangeInclusive<u64>),
    /// A number.
    Number(RangeInclusive<f64>),
    /// One of these words.
    Words(Vec<&'static str>),
}

/// Value of a key.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SettingValue {
    /// A whole number.
    Whole(u64),
    /// A number.
    Number(f64),
    /// A word.
    Word(&'static str),
}

/// Settings of a motor in the rig file, except those that motors of all families have.
#[derive(Clone, Debug, PartialEq)]
pub struct MotorSettings {
    /// ID of the motor, axis or node.
    pub id: u64,
    /// Values of [`MotorFamily::keys`](super::MotorFamily::keys), by name; optional keys may be
    /// absent.
    pub values: BTreeMap<&'static str, SettingValue>,
}

impl MotorSettings {
    /// Creates settings with an ID only.
    pub fn new(id: impl Into<u64>) -> Self {
        Self {
            id: id.into(),
            values: BTreeMap::new(),
        }
    }

    /// Returns the settings with an additional value.
    #[must_use]
    pub fn with(mut self, name: &'static str, value: SettingValue) -> Self {
        self.values.insert(name, value);
        self
    }

    /// A whole number; `None` if absent.
    pub fn whole(&self, name: &str) -> Option<u64> {
        match self.values.get(name)? {
            SettingValue::Whole(number) => Some(*number),
            _ => None,
        }
    }

    /// A number; `None` if absent.
    pub fn number(&self, name: &str) -> Option<f64> {
        match self.values.get(name)? {
            SettingValue::Number(number) => Some(*number),
            _ => None,
        }
    }

    /// The choice that a word stands for, according to a table of names; `None` if the setting is
    /// absent.
    pub fn choice<T: Copy>(&self, name: &str, choices: &[(&str, T)]) -> Option<T> {
        match self.values.get(name)? {
            // The rig file was checked against the allowed words, so the search fails only if the
            // two tables of a family differ.
            SettingValue::Word(word) => choices
                .iter()
                .find(|(known, _)| known == word)
                .map(|(_, choice)| *choice),
            _ => None,
        }
    }
}

/// The word for a choice in a table of names.
///
/// # Panics
/// If the table lacks the choice.
pub(super) fn word<T: PartialEq>(choices: &[(&'static str, T)], choice: &T) -> SettingValue {
    let found = choices.iter().find(|(_, known)| known == choice);
    SettingValue::Word(found.expect("the table has a name for each choice").0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::FAMILIES;
    use crate::can::damiao::Damiao;
    use crate::can::family::MotorProtocol;

    #[test]
    fn settings_recreate_motor_and_match_keys() {
        for (ix, family) in FAMILIES.iter().enumerate() {
            assert!(
                FAMILIES[..ix]
                    .iter()
                    .all(|other| other.name() != family.name()),
                "{family:?}: its name is taken"
            );
            let motor = family.fuzzing().motor;
            let settings = motor.settings();
            assert!(
                motor.family().name() == family.name() && family.ids().contains(&settings.id),
                "{motor:?}"
            );
            let keys = family.keys();
            assert!(
                settings.values.keys().eq(keys.iter().map(|key| &key.name)),
                "{motor:?}: {settings:?}"
            );
            for key in &keys {
                let is_allowed = match (settings.values[key.name], &key.allowed) {
                    (SettingValue::Whole(number), AllowedValues::Whole(range)) => {
                        range.contains(&number)
                    }
                    (SettingValue::Number(number), AllowedValues::Number(range)) => {
                        range.contains(&number)
                    }
                    (SettingValue::Word(word), AllowedValues::Words(words)) => {
                        words.contains(&word)
                    }
                    _ => false,
                };
                assert!(is_allowed, "{motor:?}: {key:?}");
            }
            assert_eq!(family.motor(&settings).as_ref(), Some(&motor));
            for key in keys.iter().filter(|key| key.required.is_some()) {
                let mut incomplete = settings.clone();
                incomplete.values.remove(key.name);
                assert_eq!(
                    family.motor(&incomplete),
                    None,
                    "{motor:?} without {}",
                    key.name
                );
            }
        }
    }

    #[test]
    fn motors_conflict_if_an_address_is_taken() {
        let conflicts = |motor, feedback| {
            let first: &dyn MotorProtocol = &Damiao {
                motor: 1,
                feedback: 0x11,
            };
            first.conflicts_with(&Damiao { motor, feedback })
        };
        assert!(
            conflicts(1, 0x12) && conflicts(2, 0x11) && conflicts(0x11, 0x12) && conflicts(2, 1)
        );
        assert!(!conflicts(2, 0x12));
        for family in FAMILIES {
            let motor = family.fuzzing().motor;
            for other in FAMILIES.iter().map(|family| family.fuzzing().motor) {
                assert_eq!(
                    motor.conflicts_with(&*other),
                    motor.as_ref() == other.as_ref(),
                    "{motor:?} {other:?}"
                );
            }
        }
    }
}
