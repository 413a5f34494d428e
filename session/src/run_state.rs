//! What a live run does at the moment.

/// The state of a live run until it is saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RunState {
    /// No image has arrived.
    Waiting,
    /// There are too few keyframes to train on.
    Collecting,
    /// The models are trained.
    Training,
    /// An operator has paused training.
    Paused,
    /// The input has ended, and all training is done.
    Finished,
}

impl RunState {
    /// The state in `status` messages.
    #[must_use]
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Waiting => "waiting for images",
            Self::Collecting => "collecting keyframes",
            Self::Training => "training",
            Self::Paused => "paused",
            Self::Finished => "finished",
        }
    }
}
