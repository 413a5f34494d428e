//! Splats as plain arrays, in the layout of splat files.

use crate::Error;
use crate::edits::Edits;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;
use std::path::Path;

/// Maximum number of color coefficients per splat (degree 3).
const MAX_COEFFICIENTS: usize = 16;
/// Splats that are more transparent are not drawn, see `projection.wgsl` of the trainer.
const MIN_ALPHA: f64 = 1.0 / 255.0;
/// Maximum absolute coordinate of a mean in a file. It exceeds the size of the Earth, even if the
/// unit is millimeters.
const MAX_MEAN: f32 = 1e11;
/// Logarithm of the maximum standard deviation in a file, which is 1000 km. Larger splats cover
/// every picture.
const MAX_LOG_SCALE: f32 = 13.8;
/// Maximum absolute color coefficient in a file. The sum of 16 larger coefficients might not be
/// finite.
const MAX_COLOR: f32 = 1e6;

/// A cloud of splats in the world frame, as raw optimized values with one entry per splat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatArrays {
    /// Centers, meters.
    pub means: Vec<[f32; 3]>,
    /// Logarithms of the standard deviations along the splat's own axes, meters.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations of the splats' axes as quaternions of any nonzero length, w first.
    pub rotations_wxyz: Vec<[f32; 4]>,
    /// Opacities before the logistic function.
    pub opacity_logits: Vec<f32>,
    /// Spherical-harmonic coefficients of red, green and blue. Each splat has a contiguous range,
    /// constant term first.
    pub sh: Vec<[f32; 3]>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Whether opacities are corrected for the low-pass filter (Mip-Splatting, Yu et al. 2024,
    /// equation 12). It is true only for files of other programs that were trained this way. It is
    /// false for splats that fieldrig has trained.
    pub is_antialiased: bool,
}

impl SplatArrays {
    /// Returns the arrays unchanged if they are valid.
    ///
    /// # Errors
    ///
    /// Fails if lengths differ, the degree exceeds 3, a value is not finite, or a rotation has
    /// length zero.
    ///
    /// ```
    /// use model_files::splat::arrays::SplatArrays;
    ///
    /// let one = SplatArrays {
    ///     means: vec![[0.0; 3]],
    ///     log_scales: vec![[-3.0; 3]],
    ///     rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]],
    ///     opacity_logits: vec![2.0],
    ///     sh: vec![[0.5, 0.1, 0.1]],
    ///     sh_degree: 0,
    ///     is_antialiased: false,
    /// };
    /// assert_eq!(one.checked()?.n_splats(), 1);
    /// # Ok::<(), model_files::Error>(())
    /// ```
    pub fn checked(self) -> Result<Self, Error> {
        if self.n_coefficients() > MAX_COEFFICIENTS {
            return Err(Error::SplatArrays(format!(
                "SH degree {}, expected at most 3",
                self.sh_degree
            )));
        }
        self.check_lengths()?;
        self.check_finite()?;
        match self
            .rotations_wxyz
            .iter()
            .position(|rotation| rotation.iter().all(|&part| part == 0.0))
        {
            Some(splat_ix) => Err(Error::SplatArrays(format!(
                "rotation of splat {splat_ix} has length zero"
            ))),
            None => Ok(self),
        }
    }

    /// Like [`Self::checked`], but leaves out splats with invalid or absurd numbers and names the
    /// first of them in a warning. An infinite opacity is limited.
    ///
    /// # Errors
    /// Fails if the lengths of the arrays do not match, or there are splats but none is valid.
    pub(crate) fn without_invalid(mut self, path: &Path) -> Result<Self, Error> {
        const MAX_LOGIT: f32 = 30.0;
        self.check_lengths()?;
        // Other programs write opacities of 0 and 1, whose logits are infinite. Beyond +-30, the
        // logistic function is 0 or 1 up to f32 rounding.
        for logit in self
            .opacity_logits
            .iter_mut()
            .filter(|logit| logit.is_infinite())
        {
            *logit = MAX_LOGIT.copysign(*logit);
        }
        let n_splats = self.n_splats();
        let mut invalid = (0..n_splats).filter_map(|ix| Some((ix, self.fault(ix)?)));
        let Some((first, fault)) = invalid.next() else {
            return self.checked();
        };
        let n_invalid = 1 + invalid.count();
        // `checked` has more precise messages for the usual causes.
        if n_invalid == n_splats {
            self.checked()?;
            return Err(Error::SplatArrays(format!(
                "none of {n_splats} can be used; splat {first}: {fault}"
            )));
        }
        log::warn!(
            "{}: left out {n_invalid} of {n_splats} splats with invalid numbers; the first has index {first}: {fault}",
            path.display()
        );
        self.filtered(|ix| self.fault(ix).is_none()).checked()
    }

    /// The reason why a splat from a file cannot be used. `None` if it can be used.
    fn fault(&self, ix: usize) -> Option<&'static str> {
        let n_coeffs = self.n_coefficients();
        let mean = &self.means[ix];
        let log_scales = &self.log_scales[ix];
        let rotation = &self.rotations_wxyz[ix];
        let color = self.sh[ix * n_coeffs..(ix + 1) * n_coeffs].as_flattened();
        let mut all = mean
            .iter()
            .chain(log_scales)
            .chain(rotation)
            .chain(color)
            .chain([&self.opacity_logits[ix]]);
        let squared_length: f32 = rotation.iter().map(|part| part * part).sum();
        // Each condition describes valid numbers, so that it is false for NaN.
        let checks = [
            (all.all(|value| value.is_finite()), "a number is not finite"),
            (
                mean.iter().all(|meters| meters.abs() <= MAX_MEAN),
                "the mean is more than 1e11 m from the origin",
            ),
            (
                log_scales
                    .iter()
                    .all(|log_scale| *log_scale <= MAX_LOG_SCALE),
                "a standard deviation exceeds 1e6 m",
            ),
            (
                squared_length.is_normal(),
                "the length of the rotation is zero, or its square exceeds the range of f32",
            ),
            (
                color
                    .iter()
                    .all(|coefficient| coefficient.abs() <= MAX_COLOR),
                "a color coefficient exceeds 1e6",
            ),
        ];
        checks
            .into_iter()
            .find(|(is_valid, _)| !is_valid)
            .map(|(_, fault)| fault)
    }

    /// Number of splats.
    pub fn n_splats(&self) -> usize {
        self.means.len()
    }

    /// Number of color coefficients of one splat: 1, 4, 9 or 16.
    pub fn n_coefficients(&self) -> usize {
        (self.sh_degree as usize + 1).pow(2)
    }

    /// Opacity of a splat, 0 to 1.
    pub fn opacity(&self, splat_ix: usize) -> f64 {
        1.0 / (1.0 + (-f64::from(self.opacity_logits[splat_ix])).exp())
    }

    /// Indices of the splats that are drawn. Splats with values that are not finite are not drawn.
    pub fn visible(&self) -> Vec<u32> {
        let is_visible =
            |ix: &u32| self.opacity(*ix as usize) > MIN_ALPHA && self.is_finite(*ix as usize);
        (0..u32::try_from(self.n_splats()).unwrap_or(u32::MAX))
            .filter(is_visible)
            .collect()
    }

    /// Whether the shape and the constant color of a splat are finite.
    fn is_finite(&self, ix: usize) -> bool {
        let shape = self.means[ix]
            .iter()
            .chain(&self.log_scales[ix])
            .chain(&self.rotations_wxyz[ix]);
        shape
            .chain(&self.sh[ix * self.n_coefficients()])
            .all(|value| value.is_finite())
    }

    /// The splats for whose index `is_kept` returns true.
    #[must_use]
    pub fn filtered(&self, is_kept: impl Fn(usize) -> bool + Sync) -> Self {
        // The splats are tested in parallel, because the condition may search through edits. Their
        // order is kept.
        let kept: Vec<usize> = (0..self.n_splats())
            .into_par_iter()
            .filter(|ix| is_kept(*ix))
            .collect();
        let n_coeffs = self.n_coefficients();
        Self {
            means: kept.iter().map(|ix| self.means[*ix]).collect(),
            log_scales: kept.iter().map(|ix| self.log_scales[*ix]).collect(),
            rotations_wxyz: kept.iter().map(|ix| self.rotations_wxyz[*ix]).collect(),
            opacity_logits: kept.iter().map(|ix| self.opacity_logits[*ix]).collect(),
            sh: kept
                .iter()
                .flat_map(|ix| self.sh[ix * n_coeffs..(ix + 1) * n_coeffs].iter().copied())
                .collect(),
            sh_degree: self.sh_degree,
            is_antialiased: self.is_antialiased,
        }
    }

    /// The splats of which pictures show a part. Boxes cut splats pixel by pixel, so a splat with
    /// its mean in an erased box may remain.
    #[must_use]
    pub fn without_hidden(self, edits: &Edits) -> Self {
        if edits.is_empty() {
            self
        } else {
            self.filtered(|ix| {
                !edits.hide_splat(self.means[ix].map(f64::from), self.half_axes_m(ix))
            })
        }
    }

    /// Half axes in world of the ellipsoid within which a splat is drawn, meters.
    fn half_axes_m(&self, ix: usize) -> [[f64; 3]; 3] {
        let [w, x, y, z] = self.rotations_wxyz[ix].map(f64::from);
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        // At this number of standard deviations, alpha falls below the minimum.
        let opacity = 1.0 / (1.0 + (-f64::from(self.opacity_logits[ix])).exp());
        let reach = (2.0 * (opacity / MIN_ALPHA).ln()).max(0.0).sqrt();
        std::array::from_fn(|axis| {
            let half_m = reach * f64::from(self.log_scales[ix][axis]).exp();
            let mut half_axis = Vector3::zeros();
            half_axis[axis] = half_m;
            (rotation * half_axis).into()
        })
    }

    /// The splats whose means are not in erased space. Files contain whole splats, so these splats
    /// are exported.
    #[must_use]
    pub fn without_erased(self, edits: &Edits) -> Self {
        if edits.is_empty() {
            self
        } else {
            self.filtered(|ix| !edits.erases(self.means[ix].map(f64::from)))
        }
    }

    fn check_lengths(&self) -> Result<(), Error> {
        let n_splats = self.n_splats();
        let arrays = [
            ("log scales", self.log_scales.len(), n_splats),
            ("rotations", self.rotations_wxyz.len(), n_splats),
            ("opacities", self.opacity_logits.len(), n_splats),
            (
                "color coefficients",
                self.sh.len(),
                n_splats * self.n_coefficients(),
            ),
        ];
        for (what, got, expected) in arrays {
            if got != expected {
                return Err(Error::SplatArrays(format!(
                    "{got} {what} for {n_splats} means, expected {expected}"
                )));
            }
        }
        Ok(())
    }

    fn check_finite(&self) -> Result<(), Error> {
        let not_finite = |values: &[f32]| values.iter().position(|value| !value.is_finite());
        let arrays = [
            ("mean", not_finite(self.means.as_flattened()), 3),
            ("log scale", not_finite(self.log_scales.as_flattened()), 3),
            (
                "rotation",
                not_finite(self.rotations_wxyz.as_flattened()),
                4,
            ),
            ("opacity", not_finite(&self.opacity_logits), 1),
            (
                "color",
                not_finite(self.sh.as_flattened()),
                3 * self.n_coefficients(),
            ),
        ];
        for (what, position, values_per_splat) in arrays {
            if let Some(position) = position {
                let splat_ix = position / values_per_splat;
                return Err(Error::SplatArrays(format!(
                    "{what} of splat {splat_ix} is not finite"
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_splats() -> SplatArrays {
        SplatArrays {
            means: vec![[0.0; 3], [1.0, 2.0, 3.0]],
            log_scales: vec![[-3.0; 3]; 2],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0, 2.0],
            sh: vec![[0.1; 3]; 8],
            sh_degree: 1,
            is_antialiased: false,
        }
    }

    /// Applies `change` to two valid splats and returns the error message of
    /// [`SplatArrays::checked`].
    fn error_after(change: impl FnOnce(&mut SplatArrays)) -> String {
        let mut splats = two_splats();
        change(&mut splats);
        splats.checked().unwrap_err().to_string()
    }

    #[test]
    fn valid_arrays_pass_unchanged() {
        assert_eq!(two_splats().checked().unwrap(), two_splats());
        assert_eq!(SplatArrays::default().checked().unwrap().n_splats(), 0);
    }

    #[test]
    fn error_names_the_invalid_array() {
        assert_eq!(
            error_after(|s| s.log_scales.truncate(1)),
            "splats: 1 log scales for 2 means, expected 2"
        );
        assert_eq!(
            error_after(|s| s.sh.truncate(5)),
            "splats: 5 color coefficients for 2 means, expected 8"
        );
        assert_eq!(
            error_after(|s| s.sh_degree = 4),
            "splats: SH degree 4, expected at most 3"
        );
        assert_eq!(
            error_after(|s| s.means[1][2] = f32::NAN),
            "splats: mean of splat 1 is not finite"
        );
        assert_eq!(
            error_after(|s| s.sh[4][0] = f32::INFINITY),
            "splats: color of splat 1 is not finite"
        );
        assert_eq!(
            error_after(|s| s.rotations_wxyz[0] = [0.0; 4]),
            "splats: rotation of splat 0 has length zero"
        );
    }

    type Change<'a> = &'a dyn Fn(&mut SplatArrays);

    #[test]
    fn splats_with_absurd_numbers_are_left_out() {
        let valid_after = |change: &dyn Fn(&mut SplatArrays)| {
            let mut splats = two_splats();
            change(&mut splats);
            splats.without_invalid(Path::new("test.ply"))
        };
        let limits = |s: &mut SplatArrays| {
            s.means[0][1] = -MAX_MEAN;
            s.log_scales[0] = [MAX_LOG_SCALE, -200.0, 0.0];
            s.rotations_wxyz[0] = [0.0, 1e-15, 0.0, 1e15];
            s.sh[1][2] = -MAX_COLOR;
            s.opacity_logits[0] = 1e30;
        };
        assert_eq!(
            valid_after(&limits).unwrap().n_splats(),
            2,
            "values at the limits are kept"
        );
        let faults: [(&str, Change<'_>); 8] = [
            ("not finite", &|s| s.opacity_logits[0] = f32::NAN),
            ("not finite", &|s| s.sh[3][0] = f32::NEG_INFINITY),
            ("1e11 m", &|s| s.means[0][2] = 2e11),
            ("1e6 m", &|s| s.log_scales[0][0] = 200.0),
            ("rotation", &|s| s.rotations_wxyz[0] = [0.0; 4]),
            ("rotation", &|s| s.rotations_wxyz[0] = [1e30; 4]),
            ("rotation", &|s| s.rotations_wxyz[0] = [1e-30; 4]),
            ("color", &|s| s.sh[0][1] = 2e6),
        ];
        for (what, change) in faults {
            let splats = valid_after(change).unwrap();
            assert_eq!(
                (splats.n_splats(), splats.means[0]),
                (1, two_splats().means[1]),
                "{what}"
            );
            let mut splats = two_splats();
            change(&mut splats);
            assert!(
                splats.fault(0).is_some_and(|fault| fault.contains(what))
                    && splats.fault(1).is_none(),
                "{what}"
            );
        }
        let error = valid_after(&|s| s.log_scales.fill([200.0; 3]))
            .unwrap_err()
            .to_string();
        assert_eq!(
            error,
            "splats: none of 2 can be used; splat 0: a standard deviation exceeds 1e6 m"
        );
        let limited = valid_after(&|s| s.opacity_logits[0] = f32::INFINITY).unwrap();
        assert_eq!(limited.opacity_logits[0], 30.0);
    }
}
