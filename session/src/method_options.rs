//! Options of models, as set by flags and by keys of rig files.
//!
//! [`OPTIONS`] lists the options that only some methods have. Checks of flags, the effective rig
//! file, and the options of new models follow from this list.

use crate::methods::describe;
use crate::training_options::{REALIGN, TrainingOptions};
use capture::Override;
use capture::config::{DEFAULT_SEED, Train};
use messages::{BadInput, Setting, listed};
use serde_json::{Value, json};
use trainer::splat::CountPolicy;
use trainer::{CommonOptions, ModelKind, ModelOptions, ModelSpec};

/// An option that only some methods have.
struct MethodOption {
    /// Name of the field in the options of the method.
    name: &'static str,
    /// Name of the flag in messages; `None` if there is no flag.
    setting: Option<Setting>,
    /// Value of the flag, if it is given.
    of_flags: fn(&TrainingOptions) -> Option<Value>,
    /// Key of a rig file; `None` if there is no key.
    key: Option<&'static str>,
    /// Value of the key, if it is set.
    of_rig: fn(&Train) -> Option<Value>,
}

/// How the number of splats is chosen.
const COUNT: &str = "count";

/// All options that users can set and that only some methods have.
const OPTIONS: &[MethodOption] = &[
    MethodOption {
        name: "max_splats",
        setting: Some(Setting::MaxSplats),
        of_flags: |options| options.max_splats.map(Value::from),
        key: Some("train.max_splats"),
        of_rig: |train| train.max_splats.map(Value::from),
    },
    MethodOption {
        name: COUNT,
        setting: Some(Setting::Count),
        of_flags: |options| options.count.map(|count| json!(count)),
        key: None,
        of_rig: |_| None,
    },
    MethodOption {
        name: "sh_degree",
        setting: None,
        of_flags: |_| None,
        key: Some("train.sh_degree"),
        of_rig: |train| Some(Value::from(train.sh_degree)),
    },
];

impl MethodOption {
    /// The key of a rig file with this value.
    fn as_key(&self, value: &Value) -> Option<Override> {
        Some(Override::new(self.key?, toml_value(value)?))
    }
}

/// The same value in TOML; `None` for null, and for types that no option has.
fn toml_value(value: &Value) -> Option<toml::Value> {
    match value {
        Value::Bool(is_on) => Some(toml::Value::Boolean(*is_on)),
        Value::Number(number) => number
            .as_i64()
            .map(toml::Value::Integer)
            .or_else(|| number.as_f64().map(toml::Value::Float)),
        Value::String(text) => Some(toml::Value::String(text.clone())),
        Value::Null | Value::Array(_) | Value::Object(_) => None,
    }
}

/// The options that all methods share. If there is a rig file, they come from it; the flags have
/// already overridden its keys. `steps` is the number of training steps, if known in advance.
pub(crate) fn common(
    options: &TrainingOptions,
    train: Option<&Train>,
    steps: Option<u64>,
) -> CommonOptions {
    let defaults = CommonOptions::default();
    CommonOptions {
        seed: train.map_or(options.seed.unwrap_or(DEFAULT_SEED), |train| train.seed),
        max_bytes: train.map_or(options.max_bytes, |train| train.max_bytes),
        n_planned_steps: steps.unwrap_or(defaults.n_planned_steps),
        ..defaults
    }
}

/// Names and values of the options that only some methods have.
pub(crate) fn settings(
    options: &TrainingOptions,
    train: Option<&Train>,
    default_count: CountPolicy,
) -> Vec<(&'static str, Value)> {
    let given = OPTIONS.iter().filter_map(|option| {
        let of_rig = train.and_then(option.of_rig);
        Some((option.name, of_rig.or_else(|| (option.of_flags)(options))?))
    });
    // If a name occurs twice, the last value counts.
    std::iter::once((COUNT, json!(default_count)))
        .chain(given)
        .collect()
}

/// One model spec per kind. Each gets the common options and those `settings` that its method has.
pub(crate) fn specs(
    kinds: &[ModelKind],
    common: &CommonOptions,
    settings: &[(&str, Value)],
) -> anyhow::Result<Vec<ModelSpec>> {
    // Options that a method does not have are skipped, so that one list serves a run of several
    // methods. Flags that no method has were rejected before.
    let spec = |kind: &ModelKind| ModelSpec::new(*kind, common.clone(), settings);
    kinds
        .iter()
        .map(spec)
        .collect::<Result<_, _>>()
        .map_err(|error| BadInput(error.to_string()).into())
}

/// The keys of a rig file for the method-specific options of a model.
pub(crate) fn keys_of(options: &ModelOptions) -> Vec<Override> {
    OPTIONS
        .iter()
        .filter_map(|option| option.as_key(options.specific.get(option.name)?))
        .collect()
}

impl TrainingOptions {
    /// Rejects flags for options that none of the methods has.
    pub fn check_for(&self, kinds: &[ModelKind]) -> anyhow::Result<()> {
        for option in OPTIONS {
            let is_unused = !kinds.iter().any(|kind| kind.has_option(option.name));
            if let Some(setting) = option.setting
                && is_unused
                && (option.of_flags)(self).is_some()
            {
                let having = ModelKind::ALL
                    .iter()
                    .filter(|kind| kind.has_option(option.name))
                    .map(|kind| kind.name());
                return Err(BadInput(format!(
                    "{setting}: needs the method {}, but the method is {}",
                    listed(&having.collect::<Vec<_>>(), "or"),
                    describe(kinds)
                ))
                .into());
            }
        }
        Ok(())
    }

    /// The rig file keys that the flags override.
    pub fn overrides(&self) -> Vec<Override> {
        let mut overrides = Vec::new();
        if let Some(kinds) = self.methods() {
            overrides.push(Override::new("train.method", method_names(kinds)));
        }
        if let Some(seed) = self.seed {
            overrides.push(Override::new("train.seed", seed.cast_signed()));
        }
        if let Some(bytes) = self.max_bytes {
            overrides.push(Override::new("train.max_bytes", bytes.cast_signed()));
        }
        let specific = OPTIONS
            .iter()
            .filter_map(|option| option.as_key(&(option.of_flags)(self)?));
        overrides.extend(specific);
        overrides.extend(self.realign().map(|is_on| Override::new(REALIGN, is_on)));
        overrides
    }
}

/// The value of `train.method`: a string, or a list of strings for several methods.
fn method_names(kinds: &[ModelKind]) -> toml::Value {
    match kinds {
        [one] => one.name().into(),
        several => several
            .iter()
            .map(|kind| kind.name())
            .collect::<Vec<_>>()
            .into(),
    }
}

#[cfg(test)]
mod tests {
    use super::{OPTIONS, toml_value};
    use serde_json::{Value, json};
    use trainer::ModelKind;

    #[test]
    fn every_option_belongs_to_a_method() {
        for option in OPTIONS {
            let name = option.name;
            assert!(
                ModelKind::ALL.iter().any(|kind| kind.has_option(name)),
                "{name}"
            );
            let key = option.key.map(|key| key.strip_prefix("train."));
            assert!(key.is_none_or(|key| key == Some(name)), "{name}: {key:?}");
        }
        assert!(
            !ModelKind::ALL
                .iter()
                .any(|kind| kind.has_option("max-splats"))
        );
    }

    #[test]
    fn values_keep_their_type_in_toml() {
        assert_eq!(toml_value(&json!(3)), Some(toml::Value::Integer(3)));
        assert_eq!(toml_value(&json!(0.005)), Some(toml::Value::Float(0.005)));
        assert_eq!(toml_value(&json!(true)), Some(toml::Value::Boolean(true)));
        assert_eq!(toml_value(&json!("tested")), Some("tested".into()));
        assert_eq!(toml_value(&Value::Null), None);
    }
}
