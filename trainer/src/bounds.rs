//! Bounds of most of a saved model, for the first view of a model without a list of cameras.

use trainer::splat::arrays::SplatArrays;
use trainer::tsdf::VoxelGrid;
use trainer::tsdf::block::{BLOCK_EDGE, GridCoord};

/// Fraction of the points inside the radius, so that stray points and distant backgrounds stay outside.
const INSIDE_FRAC: f64 = 0.8;
/// Minimum radius, meters: even a model of one point needs some size.
const MIN_RADIUS_M: f64 = 0.01;
/// If a smaller fraction of the splats is opaque, all splats count.
const MIN_OPAQUE_FRAC: f64 = 0.02;

/// A sphere that contains most of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bounds {
    /// In world, meters.
    pub(crate) center_m: [f64; 3],
    pub(crate) radius_m: f64,
}

impl Bounds {
    /// Bounds around the median of the splats that are at least half opaque; `None` without splats.
    pub(crate) fn of_splats(splats: &SplatArrays) -> Option<Self> {
        let n_opaque = splats.opacity_logits.iter().filter(|logit| **logit > 0.0).count();
        let uses_all = (n_opaque as f64) < MIN_OPAQUE_FRAC * splats.n_splats() as f64;
        let selected = splats.means.iter().zip(&splats.opacity_logits).filter(|(_, logit)| uses_all || **logit > 0.0);
        Self::of_points(&selected.map(|(mean, _)| mean.map(f64::from)).collect::<Vec<_>>())
    }

    /// Bounds around the blocks of a distance field; `None` without blocks.
    pub(crate) fn of_blocks<'a>(blocks: impl Iterator<Item = &'a GridCoord>, voxel_grid: &VoxelGrid) -> Option<Self> {
        let center = |block: &GridCoord| {
            let coordinate = |axis: usize| (f64::from(block[axis]) + 0.5) * f64::from(BLOCK_EDGE) * voxel_grid.voxel_m;
            [0, 1, 2].map(|axis| voxel_grid.anchor_m[axis] + coordinate(axis))
        };
        Self::of_points(&blocks.map(center).collect::<Vec<_>>())
    }

    /// The median along each axis, and the radius that contains [`INSIDE_FRAC`] of the points.
    fn of_points(points_m: &[[f64; 3]]) -> Option<Self> {
        if points_m.is_empty() {
            return None;
        }
        let center_m = [0, 1, 2].map(|axis| quantile(points_m.iter().map(|point| point[axis]).collect(), 0.5));
        let distance_m = |point: &[f64; 3]| {
            let squared = point.iter().zip(center_m).map(|(coordinate, center)| (coordinate - center).powi(2));
            squared.sum::<f64>().sqrt()
        };
        let radius_m = quantile(points_m.iter().map(distance_m).collect(), INSIDE_FRAC);
        Some(Self { center_m, radius_m: radius_m.max(MIN_RADIUS_M) })
    }
}

/// The value that the fraction `frac` of all values does not exceed; `values` must not be empty.
fn quantile(mut values: Vec<f64>, frac: f64) -> f64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a length")]
    let rank = (frac * (values.len() - 1) as f64).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cloud of splats, given by position and opacity logit.
    fn splats(points: &[([f32; 3], f32)]) -> SplatArrays {
        SplatArrays {
            means: points.iter().map(|(mean, _)| *mean).collect(),
            log_scales: vec![[-3.0; 3]; points.len()],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; points.len()],
            opacity_logits: points.iter().map(|(_, logit)| *logit).collect(),
            sh: vec![[0.0; 3]; points.len()],
            sh_degree: 0,
        }
    }

    #[test]
    fn outliers_and_transparent_splats_do_not_affect_bounds() {
        let mut points: Vec<([f32; 3], f32)> = Vec::new();
        // A disk, evenly filled along a spiral of golden angles.
        for ix in 0u8..100 {
            let (radius, angle) = ((f32::from(ix) / 100.0).sqrt(), f32::from(ix) * 2.399_963);
            points.push(([2.0 + radius * angle.cos(), radius * angle.sin(), 1.0], 3.0));
        }
        let alone = Bounds::of_splats(&splats(&points)).expect("splats");
        assert!((alone.center_m[0] - 2.0).abs() < 0.1 && (alone.radius_m - 0.9).abs() < 0.1, "{alone:?}");
        points.extend([([500.0, 0.0, 0.0], 3.0); 5]);
        points.extend([([-50.0, 9.0, 0.0], -4.0); 300]);
        let with_strays = Bounds::of_splats(&splats(&points)).expect("splats");
        assert!((with_strays.center_m[0] - 2.0).abs() < 0.2 && with_strays.radius_m < 1.2, "{with_strays:?}");
    }

    #[test]
    fn bounds_of_few_or_no_splats() {
        assert_eq!(Bounds::of_splats(&splats(&[])), None);
        let one = Bounds::of_splats(&splats(&[([1.0, 2.0, 3.0], -9.0)])).expect("a splat");
        assert_eq!(one, Bounds { center_m: [1.0, 2.0, 3.0], radius_m: MIN_RADIUS_M });
    }

    #[test]
    fn block_bounds_follow_the_lattice() {
        let voxel_grid = VoxelGrid {
            voxel_m: 0.125,
            truncation_m: 0.5,
            scale_m: 0.5,
            noise_per_m2: 0.0,
            max_depth_m: 9.0,
            max_weight: 1,
            anchor_m: [10.0, 0.0, -1.0],
        };
        let bounds = Bounds::of_blocks([[0, 0, 0], [1, 0, 0], [2, 0, 0]].iter(), &voxel_grid).expect("blocks");
        assert_eq!(bounds.center_m, [11.5, 0.5, -0.5]);
        assert_eq!(bounds.radius_m, 1.0);
    }
}
