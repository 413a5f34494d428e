//! Sets of distortion coefficients that are estimated.

use kinematics::{Intrinsics, Lens};
use nalgebra::DVector;

/// A lens model and the set of its coefficients that are estimated. The other coefficients are
/// zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Coefficients {
    pub(super) family: Family,
    /// Whether each coefficient is estimated, in the order of [`Lens::coefficients`].
    is_estimated: [bool; 8],
}

/// A lens model without its coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    BrownConrady,
    RationalBrownConrady,
    KannalaBrandt,
}

impl Coefficients {
    pub(super) const PINHOLE: Self = Self::brown_conrady([false; 5]);
    pub(super) const BROWN_CONRADY: Self = Self::brown_conrady([true; 5]);
    pub(super) const RATIONAL: Self = Self {
        family: Family::RationalBrownConrady,
        is_estimated: [true; 8],
    };
    pub(super) const KANNALA_BRANDT: Self = Self {
        family: Family::KannalaBrandt,
        is_estimated: [true, true, true, true, false, false, false, false],
    };

    /// Selects among the coefficients k1, k2, p1, p2 and k3 of Brown-Conrady.
    pub(super) const fn brown_conrady([k1, k2, p1, p2, k3]: [bool; 5]) -> Self {
        Self {
            family: Family::BrownConrady,
            is_estimated: [k1, k2, p1, p2, k3, false, false, false],
        }
    }

    /// The rational model with all radial coefficients. The tangential coefficients are estimated
    /// if this set contains them.
    pub(super) fn rational(self) -> Self {
        let [_, _, p1, p2, ..] = self.is_estimated;
        Self {
            is_estimated: [true, true, p1, p2, true, true, true, true],
            ..Self::RATIONAL
        }
    }

    /// This set and the given coefficients of Brown-Conrady.
    pub(super) fn with(mut self, added: [bool; 5]) -> Self {
        self.is_estimated
            .iter_mut()
            .zip(added)
            .for_each(|(is_estimated, added)| *is_estimated |= added);
        self
    }

    /// Indices of the estimated parameters in [`Intrinsics::params`].
    pub(super) fn params(self) -> Vec<usize> {
        let coefficients = self
            .is_estimated
            .iter()
            .enumerate()
            .filter(|(_, is_estimated)| **is_estimated);
        (0..4).chain(coefficients.map(|(ix, _)| 4 + ix)).collect()
    }

    /// Names of the estimated parameters: `fx`, `fy`, `cx`, `cy`, and OpenCV's names of the
    /// coefficients.
    pub(super) fn names(self) -> Vec<&'static str> {
        const PLANE: [&str; 4] = ["fx", "fy", "cx", "cy"];
        const BROWN_CONRADY: [&str; 8] = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
        const KANNALA_BRANDT: [&str; 8] = ["k1", "k2", "k3", "k4", "", "", "", ""];
        let coefficients = match self.family {
            Family::KannalaBrandt => KANNALA_BRANDT,
            Family::BrownConrady | Family::RationalBrownConrady => BROWN_CONRADY,
        };
        self.params()
            .into_iter()
            .map(|param| *PLANE.iter().chain(&coefficients).nth(param).unwrap_or(&""))
            .collect()
    }

    /// Typical magnitudes of the estimated parameters.
    pub(super) fn scales(self, intrinsics: &Intrinsics) -> DVector<f64> {
        // Radial coefficients of common lenses are a few tenths. Tangential coefficients describe
        // lens elements that are not centered, and are ten times smaller.
        const COEFFICIENT: f64 = 0.1;
        const TANGENTIAL: f64 = 0.01;
        let [fx, fy] = intrinsics.focal_px.map(f64::abs);
        let [width, height] = intrinsics.size_px.map(f64::from);
        let plane = [fx, fy, width, height].map(|value| 0.1 * value);
        let has_tangential = self.family != Family::KannalaBrandt;
        let scale = |param: usize| match param {
            0..4 => plane[param],
            6 | 7 if has_tangential => TANGENTIAL,
            _ => COEFFICIENT,
        };
        DVector::from_iterator(self.params().len(), self.params().into_iter().map(scale))
    }

    /// Intrinsics with this lens model. Coefficients of the given intrinsics are kept if they exist
    /// in this model and are estimated.
    pub(super) fn applied_to(self, intrinsics: &Intrinsics) -> Intrinsics {
        // Coefficients of the two families have the same names but different meanings.
        let is_fisheye = |lens: &Lens| matches!(lens, Lens::KannalaBrandt(_));
        let mut k = [0.0; 8];
        if is_fisheye(&intrinsics.lens) == (self.family == Family::KannalaBrandt) {
            let known = intrinsics.lens.coefficients().iter().zip(self.is_estimated);
            k.iter_mut()
                .zip(known)
                .for_each(|(k, (value, is_estimated))| {
                    *k = if is_estimated { *value } else { 0.0 }
                });
        }
        let lens = match self.family {
            Family::BrownConrady => Lens::BrownConrady([k[0], k[1], k[2], k[3], k[4]]),
            Family::RationalBrownConrady => Lens::RationalBrownConrady(k),
            Family::KannalaBrandt => Lens::KannalaBrandt([k[0], k[1], k[2], k[3]]),
        };
        Intrinsics {
            lens,
            ..intrinsics.clone()
        }
    }

    /// Name of the lens model in rig files.
    pub(super) fn model_name(self) -> &'static str {
        match self.family {
            Family::KannalaBrandt => "kannala_brandt",
            Family::BrownConrady if self == Self::PINHOLE => "pinhole",
            Family::BrownConrady | Family::RationalBrownConrady => "brown_conrady",
        }
    }
}

impl std::fmt::Display for Coefficients {
    /// The lens model and the estimated coefficients, such as `brown_conrady k1 k2`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.model_name())?;
        self.names()
            .iter()
            .skip(4)
            .try_for_each(|name| write!(f, " {name}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_of_coefficients_are_named() {
        assert_eq!(Coefficients::PINHOLE.to_string(), "pinhole");
        assert_eq!(
            Coefficients::BROWN_CONRADY.to_string(),
            "brown_conrady k1 k2 p1 p2 k3"
        );
        let radial = Coefficients::PINHOLE.with([true, true, false, false, false]);
        assert_eq!(radial.names(), ["fx", "fy", "cx", "cy", "k1", "k2"]);
        assert_eq!(
            radial.rational().to_string(),
            "brown_conrady k1 k2 k3 k4 k5 k6"
        );
        assert_eq!(
            Coefficients::KANNALA_BRANDT.to_string(),
            "kannala_brandt k1 k2 k3 k4"
        );
    }
}
