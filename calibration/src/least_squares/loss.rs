//! Robust loss functions.

/// Loss of one residual vector `r`, as a function of its squared norm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Loss {
    /// `|r|²`, which gives least squares.
    Squared,
    /// The loss is `|r|²` up to the threshold, and linear in `|r|` above it. This loss is convex.
    /// Source: Huber 1964, equation 2.16.
    Huber {
        /// Norm above which the loss is linear, in units of the residuals.
        threshold: f64,
    },
    /// The loss is `threshold² ln(1 + |r|² / threshold²)`. The influence of large residuals tends
    /// to zero. This loss is not convex, so the initial parameters must be close.
    Cauchy {
        /// Norm at which the weight of a residual has dropped to one half, in units of the
        /// residuals.
        threshold: f64,
    },
}

/// Loss of a residual vector and its derivatives.
pub(super) struct LossAt {
    pub(super) value: f64,
    /// Derivative with respect to the squared norm, which is the weight of iteratively reweighted
    /// least squares.
    pub(super) weight: f64,
    /// Derivative of `weight * |r|` with respect to `|r|`.
    pub(super) radial_derivative: f64,
}

impl Loss {
    /// The loss of a residual vector with this squared norm.
    pub(super) fn at(self, squared_norm: f64) -> LossAt {
        match self {
            Self::Squared => LossAt {
                value: squared_norm,
                weight: 1.0,
                radial_derivative: 1.0,
            },
            Self::Huber { threshold } if squared_norm <= threshold * threshold => LossAt {
                value: squared_norm,
                weight: 1.0,
                radial_derivative: 1.0,
            },
            Self::Huber { threshold } => {
                let norm = squared_norm.sqrt();
                LossAt {
                    value: threshold * (2.0 * norm - threshold),
                    weight: threshold / norm,
                    radial_derivative: 0.0,
                }
            }
            Self::Cauchy { threshold } => {
                let ratio = squared_norm / (threshold * threshold);
                let weight = 1.0 / (1.0 + ratio);
                LossAt {
                    value: threshold * threshold * ratio.ln_1p(),
                    weight,
                    radial_derivative: (1.0 - ratio) * weight * weight,
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_losses_match_central_differences() {
        const NUDGE: f64 = 1e-6;
        const CLOSE: f64 = 1e-8;
        for loss in [
            Loss::Squared,
            Loss::Huber { threshold: 1.5 },
            Loss::Cauchy { threshold: 1.5 },
        ] {
            for norm in [0.3, 1.4, 1.6, 4.0_f64] {
                let at = |norm: f64| loss.at(norm * norm);
                let gradient = (at(norm + NUDGE).value - at(norm - NUDGE).value) / (2.0 * NUDGE);
                assert!(
                    (gradient - 2.0 * norm * at(norm).weight).abs() < CLOSE,
                    "{loss:?} at {norm}"
                );
                let influence = |norm: f64| norm * at(norm).weight;
                let radial = (influence(norm + NUDGE) - influence(norm - NUDGE)) / (2.0 * NUDGE);
                assert!(
                    (radial - at(norm).radial_derivative).abs() < CLOSE,
                    "{loss:?} at {norm}"
                );
            }
        }
    }
}
