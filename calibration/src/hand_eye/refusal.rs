//! Reasons to refuse a calibration: unobservable directions or mistakes, and their remedies.

/// Why no calibration is returned although the input is valid.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// What is missing or wrong, with values.
    pub why: String,
    /// Axis in the flange frame, a unit vector: the only axis of rotation seen, or the direction
    /// that is not observable. `None` if the reason is not about an axis.
    pub axis: Option<[f64; 3]>,
    /// The motion or correction that would help.
    pub motion: String,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; {}", self.why, self.motion)
    }
}

impl Refusal {
    pub(crate) fn new(why: impl Into<String>, motion: impl Into<String>) -> Self {
        Self {
            why: why.into(),
            axis: None,
            motion: motion.into(),
        }
    }

    /// Adds warnings, which may be the cause: wrong samples enlarge the uncertainty, for example.
    ///
    /// * `except`: a warning that is reported in another way.
    pub(super) fn with_warnings(self, warnings: &[String], except: Option<&str>) -> Self {
        let added = warnings
            .iter()
            .filter(|warning| Some(warning.as_str()) != except);
        let why = std::iter::once(&self.why)
            .chain(added)
            .cloned()
            .collect::<Vec<_>>()
            .join("; ");
        Self { why, ..self }
    }
}
