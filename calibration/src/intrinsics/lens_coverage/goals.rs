//! What photographs must show.

/// A part of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImagePart {
    /// The upper left.
    UpperLeft,
    /// The upper edge.
    Upper,
    /// The upper right.
    UpperRight,
    /// The left edge.
    Left,
    /// The middle.
    Center,
    /// The right edge.
    Right,
    /// The lower left.
    LowerLeft,
    /// The lower edge.
    Lower,
    /// The lower right.
    LowerRight,
}

impl ImagePart {
    /// All parts, row by row from the upper left.
    pub const ALL: [Self; 9] = [
        Self::UpperLeft,
        Self::Upper,
        Self::UpperRight,
        Self::Left,
        Self::Center,
        Self::Right,
        Self::LowerLeft,
        Self::Lower,
        Self::LowerRight,
    ];

    /// The order in which the parts are requested. Opposite corners come first, because they show
    /// whether the lens is distorted.
    pub(super) const REQUESTED: [Self; 9] = [
        Self::Center,
        Self::UpperLeft,
        Self::LowerRight,
        Self::UpperRight,
        Self::LowerLeft,
        Self::Left,
        Self::Right,
        Self::Upper,
        Self::Lower,
    ];
}

/// A side of the target as the camera sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The left side.
    Left,
    /// The right side.
    Right,
    /// The upper side.
    Upper,
    /// The lower side.
    Lower,
}

impl Side {
    /// All sides.
    pub const ALL: [Self; 4] = [Self::Left, Self::Right, Self::Upper, Self::Lower];
}

/// Something that photographs must show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CoverageGoal {
    /// The target in this part of the image.
    Part(ImagePart),
    /// The target tilted with this side away from the camera.
    Tilt(Side),
    /// A target that is large in the image.
    Near,
    /// A target that is smaller than the largest so far.
    Far,
    /// Enough different photographs.
    Number,
}

/// How far a goal is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GoalProgress {
    /// The goal.
    pub goal: CoverageGoal,
    /// Number of cells with corners if the goal is a part of the image, otherwise the number of
    /// photographs. It may exceed `n_needed`.
    pub n_done: usize,
    /// The required number.
    pub n_needed: usize,
}

impl GoalProgress {
    /// Whether the goal is reached.
    pub fn is_reached(&self) -> bool {
        self.n_done >= self.n_needed
    }
}

/// The photograph to take next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NextPhotograph {
    /// Any view that shows the whole target.
    ShowTarget,
    /// A view that helps to reach this goal.
    Toward(GoalProgress),
    /// No view is needed, because everything is covered.
    Enough,
}
