//! The keys in `[train]`, and the seeds that a rig file can have.

use super::error::{ConfigError, SourceLocation};
use super::key::{Key, Optional, distinct, keys};
use super::section::Section;
use super::table_schema::one_or_more;
use serde_json::json;
use std::ops::RangeInclusive;
use toml::Value;

/// Range of `max_splats`, as a key and as a flag.
pub const MAX_SPLATS_RANGE: RangeInclusive<u64> = 1..=100_000_000;
/// Range of `max_bytes`, as a key and as a flag.
pub const MAX_BYTES_RANGE: RangeInclusive<u64> = 1_000_000..=1 << 50;
/// Range of seeds, as keys and as a flag; TOML integers are at most `i64::MAX`.
pub const SEED_RANGE: RangeInclusive<u64> = 0..=i64::MAX.cast_unsigned();
/// Seed if neither a key nor a flag sets one.
pub const DEFAULT_SEED: u64 = 1;
/// The scene model that is trained if the rig file names none.
const DEFAULT_METHOD: &str = "splat";

keys! {
    /// How the model is trained.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Train {
        /// Scene model to train, or a list of models that are trained at once.
        pub methods: Methods as "method";
        /// Maximum number of splats. Without this key, the method's default.
        pub max_splats: Option<u64>, in MAX_SPLATS_RANGE;
        /// Maximum GPU memory of the model, bytes. Without this key, unlimited.
        pub max_bytes: Option<u64>, in MAX_BYTES_RANGE;
        /// Random seed of training.
        pub seed: u64 = DEFAULT_SEED, in SEED_RANGE;
        /// Maximum degree of the spherical harmonics.
        pub sh_degree: u32 = 3, in 0..=3;
        /// Width and height of training images relative to the undistorted camera images.
        pub scale: f64 = 1.0, in 0.05..=1.0;
    }
}

/// Names of scene models in a rig file: at least one, without duplicates.
#[derive(Clone, Debug)]
pub struct Methods {
    names: Vec<String>,
    location: SourceLocation,
}

impl PartialEq for Methods {
    fn eq(&self, other: &Self) -> bool {
        // The location in the file is not compared. A rig that was read from its effective rig file
        // must be equal to the original rig, although its lines differ.
        self.names == other.names
    }
}

impl Methods {
    /// The names, in the order of the file.
    #[must_use]
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Returns the same key with a single method.
    pub(super) fn with_single(&self, name: &str) -> Self {
        Self {
            names: vec![name.to_owned()],
            location: self.location.clone(),
        }
    }

    /// Looks up the methods by their names.
    ///
    /// # Errors
    ///
    /// If a name is not among `known`. The error contains its line in the rig file.
    pub fn resolve<T: Copy>(&self, known: &[(&str, T)]) -> Result<Vec<T>, ConfigError> {
        self.names
            .iter()
            .map(|name| self.resolve_one(name, known))
            .collect()
    }

    fn resolve_one<T: Copy>(&self, name: &str, known: &[(&str, T)]) -> Result<T, ConfigError> {
        known
            .iter()
            .find(|(known, _)| *known == name)
            .map(|(_, method)| *method)
            .ok_or_else(|| {
                let names: Vec<_> = known.iter().map(|(name, _)| format!("{name:?}")).collect();
                ConfigError::InvalidValue {
                    at: self.location.clone(),
                    key: "train.method".into(),
                    got: format!("{name:?}"),
                    allowed: format!(
                        "{}, or a list of these without duplicates",
                        names.join(", ")
                    ),
                }
            })
    }
}

impl Key for Methods {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        let location = keys.location(key);
        let word = |value: &Value| value.as_str().map(str::to_owned);
        let words = |value: &Value| distinct(value, word).filter(|words| !words.is_empty());
        let names = keys.parse(key, words, || {
            "a word in quotes, or a list of these without duplicates".into()
        })?;
        Some(Self { names, location })
    }

    fn write(&self) -> Option<Value> {
        match &self.names[..] {
            [one] => one.write(),
            _ => self.names.write(),
        }
    }

    fn schema((): ()) -> serde_json::Value {
        json!({ "anyOf": one_or_more(&String::schema(()), 1) })
    }
}

impl Optional for Methods {
    fn absent(keys: &mut Section<'_>, key: &'static str) -> Option<Self> {
        Some(Self {
            names: vec![DEFAULT_METHOD.to_owned()],
            location: keys.location(key),
        })
    }
}
