//! Instructions for the person who moves the target, in words.

use super::goals::{CoverageGoal, GoalProgress, ImagePart, NextPhotograph, Side};
use std::fmt;

impl fmt::Display for NextPhotograph {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ShowTarget => f.write_str("show the whole target to the camera"),
            Self::Toward(GoalProgress {
                goal,
                n_done,
                n_needed,
            }) => match (goal, n_needed.saturating_sub(*n_done)) {
                (CoverageGoal::Number, 1) => {
                    f.write_str("show the target once more, from another direction")
                }
                (CoverageGoal::Number, n) => write!(
                    f,
                    "show the target {n} more times, from other directions and distances"
                ),
                (goal, _) => goal.fmt(f),
            },
            Self::Enough => f.write_str("the images cover everything"),
        }
    }
}

/// What to do to reach a goal.
impl fmt::Display for CoverageGoal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Part(part) => write!(f, "move the target to {part}"),
            Self::Tilt(side) => write!(
                f,
                "tilt the target by 20 to 45 degrees, with its {side} side away from the camera"
            ),
            Self::Near => {
                f.write_str("bring the target closer, so that it fills half of the image")
            }
            Self::Far => f.write_str("move the target away, to about twice the distance"),
            Self::Number => f.write_str("show the target from other directions"),
        }
    }
}

impl fmt::Display for ImagePart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::UpperLeft => "the upper left of the image",
            Self::Upper => "the upper edge of the image",
            Self::UpperRight => "the upper right of the image",
            Self::Left => "the left edge of the image",
            Self::Center => "the center of the image",
            Self::Right => "the right edge of the image",
            Self::LowerLeft => "the lower left of the image",
            Self::Lower => "the lower edge of the image",
            Self::LowerRight => "the lower right of the image",
        })
    }
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Left => "left",
            Self::Right => "right",
            Self::Upper => "upper",
            Self::Lower => "lower",
        })
    }
}
