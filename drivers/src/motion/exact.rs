//! Serialization without loss, for records that are replayed bit for bit.
//!
//! JSON has no NaN and no infinity, but commands may contain them, and a replay must refuse the
//! same commands. These numbers are written as texts.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Written {
    Finite(f64),
    Other(String),
}

impl From<f64> for Written {
    fn from(value: f64) -> Self {
        if value.is_finite() {
            Self::Finite(value)
        } else {
            Self::Other(value.to_string())
        }
    }
}

impl Written {
    fn read<E: serde::de::Error>(self) -> Result<f64, E> {
        match self {
            Self::Finite(value) => Ok(value),
            Self::Other(text) => text
                .parse()
                .map_err(|_| E::custom(format!("{text:?} is not a number, NaN, inf or -inf"))),
        }
    }
}

/// A list of numbers of any length.
pub mod list {
    use super::{Deserialize, Deserializer, Serializer, Written};

    /// For `#[serde(with = ..)]`.
    pub fn serialize<S: Serializer>(values: &[f64], to: S) -> Result<S::Ok, S::Error> {
        to.collect_seq(values.iter().map(|value| Written::from(*value)))
    }

    /// For `#[serde(with = ..)]`.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f64>, D::Error> {
        let written = Vec::<Written>::deserialize(from)?;
        written.into_iter().map(Written::read).collect()
    }
}

/// A list of a known number of numbers.
pub mod array {
    use super::{Deserializer, Serializer, list};
    use serde::de::Error;

    /// For `#[serde(with = ..)]`.
    pub fn serialize<S: Serializer, const N: usize>(
        values: &[f64; N],
        to: S,
    ) -> Result<S::Ok, S::Error> {
        list::serialize(values, to)
    }

    /// For `#[serde(with = ..)]`.
    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(
        from: D,
    ) -> Result<[f64; N], D::Error> {
        let values = list::deserialize(from)?;
        let n = values.len();
        values
            .try_into()
            .map_err(|_| D::Error::custom(format!("{n} numbers instead of {N}")))
    }
}

/// One number.
pub mod number {
    use super::{Deserialize, Deserializer, Serialize, Serializer, Written};

    /// For `#[serde(with = ..)]`.
    pub fn serialize<S: Serializer>(value: &f64, to: S) -> Result<S::Ok, S::Error> {
        Written::from(*value).serialize(to)
    }

    /// For `#[serde(with = ..)]`.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
        Written::deserialize(from)?.read()
    }
}

/// A pose as x, y, z in meters, and a quaternion x, y, z, w, which is not normalized again.
pub mod pose {
    use super::{Deserializer, Serializer, array};
    use kinematics::{Transform, transform};

    /// For `#[serde(with = ..)]`.
    pub fn serialize<S: Serializer>(pose: &Transform, to: S) -> Result<S::Ok, S::Error> {
        array::serialize(&transform::to_xyz_xyzw(pose), to)
    }

    /// For `#[serde(with = ..)]`.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Transform, D::Error> {
        array::deserialize(from).map(transform::from_xyz_xyzw)
    }
}

/// A stamp as nanoseconds.
pub mod stamp {
    use super::{Deserialize, Deserializer, Serializer};
    use kinematics::Stamp;

    /// For `#[serde(with = ..)]`.
    pub fn serialize<S: Serializer>(stamp: &Stamp, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_i64(stamp.0)
    }

    /// For `#[serde(with = ..)]`.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Stamp, D::Error> {
        i64::deserialize(from).map(Stamp)
    }
}
