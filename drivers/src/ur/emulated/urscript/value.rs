//! Values of URScript.

/// A value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Value {
    /// Of functions without a result.
    None,
    Bool(bool),
    Number(f64),
    Text(String),
    List(Vec<f64>),
}

impl Value {
    pub(crate) fn number(&self) -> Result<f64, String> {
        match self {
            Self::Number(number) => Ok(*number),
            other => Err(format!("{other:?} is not a number")),
        }
    }

    pub(crate) fn bool(&self) -> Result<bool, String> {
        match self {
            Self::Bool(bool) => Ok(*bool),
            other => Err(format!("{other:?} is not True or False")),
        }
    }

    pub(crate) fn text(&self) -> Result<&str, String> {
        match self {
            Self::Text(text) => Ok(text),
            other => Err(format!("{other:?} is not a string")),
        }
    }

    /// A list of this length.
    pub(crate) fn list<const N: usize>(&self) -> Result<[f64; N], String> {
        match self {
            Self::List(numbers) => numbers
                .as_slice()
                .try_into()
                .map_err(|_| format!("{numbers:?} does not have {N} numbers")),
            other => Err(format!("{other:?} is not a list")),
        }
    }
}
