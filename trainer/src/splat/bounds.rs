//! Bounds of a cloud of splats, without outliers.

use crate::Bounds;
use model_files::splat::arrays::SplatArrays;

/// Minimum fraction of opaque splats. Below this fraction, the bounds are computed from all splats,
/// because a few opaque splats may be outliers. At the start of training without depth, all splats
/// are transparent.
const MIN_OPAQUE_FRAC: f64 = 0.02;

/// Bounds around the median of the splats that are at least half opaque. `None` without splats.
pub(super) fn bounds(splats: &SplatArrays) -> Option<Bounds> {
    // A logit above 0 is an opacity above one half.
    let n_opaque = splats
        .opacity_logits
        .iter()
        .filter(|logit| **logit > 0.0)
        .count();
    let uses_all = (n_opaque as f64) < MIN_OPAQUE_FRAC * splats.n_splats() as f64;
    let selected = splats
        .means
        .iter()
        .zip(&splats.opacity_logits)
        .filter(|(_, logit)| uses_all || **logit > 0.0);
    Bounds::of_points(
        &selected
            .map(|(mean, _)| mean.map(f64::from))
            .collect::<Vec<_>>(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds::MIN_RADIUS_M;

    /// Creates splats with these positions and opacity logits.
    fn splats(points: &[([f32; 3], f32)]) -> SplatArrays {
        SplatArrays {
            means: points.iter().map(|(mean, _)| *mean).collect(),
            log_scales: vec![[-3.0; 3]; points.len()],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; points.len()],
            opacity_logits: points.iter().map(|(_, logit)| *logit).collect(),
            sh: vec![[0.0; 3]; points.len()],
            sh_degree: 0,
            is_antialiased: false,
        }
    }

    #[test]
    fn outliers_and_transparent_splats_do_not_affect_bounds() {
        let mut points: Vec<([f32; 3], f32)> = Vec::new();
        // A disk filled evenly along a golden-angle spiral.
        for ix in 0u8..100 {
            let (radius, angle) = ((f32::from(ix) / 100.0).sqrt(), f32::from(ix) * 2.399_963);
            points.push(([2.0 + radius * angle.cos(), radius * angle.sin(), 1.0], 3.0));
        }
        let alone = bounds(&splats(&points)).expect("splats");
        assert!(
            (alone.center_m[0] - 2.0).abs() < 0.1 && (alone.radius_m - 0.9).abs() < 0.1,
            "{alone:?}"
        );
        points.extend([([500.0, 0.0, 0.0], 3.0); 5]);
        points.extend([([-50.0, 9.0, 0.0], -4.0); 300]);
        let with_strays = bounds(&splats(&points)).expect("splats");
        assert!(
            (with_strays.center_m[0] - 2.0).abs() < 0.2 && with_strays.radius_m < 1.2,
            "{with_strays:?}"
        );
    }

    #[test]
    fn bounds_of_few_or_no_splats() {
        assert_eq!(bounds(&splats(&[])), None);
        let one = bounds(&splats(&[([1.0, 2.0, 3.0], -9.0)])).expect("a splat");
        assert_eq!(
            one,
            Bounds {
                center_m: [1.0, 2.0, 3.0],
                radius_m: MIN_RADIUS_M,
                outer_radius_m: MIN_RADIUS_M
            }
        );
    }
}
