//! Distances between neighboring points, from a k-d tree.

use rayon::prelude::*;

/// Number of nearest points whose distances are averaged, as in Kerbl et al. 2023.
const N_NEAREST: usize = 3;

/// Mean distance of each point to the three nearest points, meters. `None` for a single point. The
/// points must be distinct.
pub(crate) fn mean_spacings_m(points: &[[f32; 3]]) -> Vec<Option<f64>> {
    let tree = Tree::new(points);
    points
        .par_iter()
        .map(|point| tree.mean_spacing_m(point))
        .collect()
}

/// A balanced tree, represented by the order of the points. In each range of `order`, the middle
/// point separates points with smaller coordinates along one axis from points with larger
/// coordinates. The axes alternate.
struct Tree<'a> {
    points: &'a [[f32; 3]],
    /// Indices of the points.
    order: Vec<u32>,
}

impl<'a> Tree<'a> {
    fn new(points: &'a [[f32; 3]]) -> Self {
        let n = u32::try_from(points.len())
            .expect("at most as many points as splats, whose number is a u32");
        let mut order: Vec<u32> = (0..n).collect();
        separate(points, &mut order, 0);
        Self { points, order }
    }

    fn mean_spacing_m(&self, from: &[f32; 3]) -> Option<f64> {
        let mut nearest = [f64::INFINITY; N_NEAREST];
        self.search(&self.order, 0, from, &mut nearest);
        let distances: Vec<f64> = nearest
            .into_iter()
            // With fewer than four points, some of the distances remain infinite.
            .filter(|squared| squared.is_finite())
            .map(f64::sqrt)
            .collect();
        (!distances.is_empty()).then(|| distances.iter().sum::<f64>() / distances.len() as f64)
    }

    /// Updates `nearest`, the smallest squared distances in ascending order, with the points in
    /// `range`.
    fn search(&self, range: &[u32], axis: usize, from: &[f32; 3], nearest: &mut [f64; N_NEAREST]) {
        let middle = range.len() / 2;
        let Some(ix) = range.get(middle) else { return };
        let point = &self.points[*ix as usize];
        let offset = |axis: usize| f64::from(from[axis]) - f64::from(point[axis]);
        let squared: f64 = (0..3).map(|axis| offset(axis) * offset(axis)).sum();
        // A distance of zero means that a point is compared with itself.
        if squared > 0.0 && squared < nearest[N_NEAREST - 1] {
            nearest[N_NEAREST - 1] = squared;
            nearest.sort_unstable_by(f64::total_cmp);
        }
        let smaller = &range[..middle];
        let larger = &range[middle + 1..];
        // The side of the query point is searched first, because its points are likely to be near.
        // The distances found there often exclude the other side.
        let (near, far) = if offset(axis) < 0.0 {
            (smaller, larger)
        } else {
            (larger, smaller)
        };
        let next_axis = (axis + 1) % 3;
        self.search(near, next_axis, from, nearest);
        // No point beyond the separating plane is closer than the plane.
        if offset(axis) * offset(axis) < nearest[N_NEAREST - 1] {
            self.search(far, next_axis, from, nearest);
        }
    }
}

/// Arranges a range of indices as described at [`Tree`].
fn separate(points: &[[f32; 3]], range: &mut [u32], axis: usize) {
    if range.len() < 2 {
        return;
    }
    // Selection is sufficient, because the halves need not be sorted. It takes linear time per
    // level. The order of points with equal coordinates does not matter, because `search` visits
    // both sides.
    let middle = range.len() / 2;
    range.select_nth_unstable_by(middle, |a, b| {
        points[*a as usize][axis].total_cmp(&points[*b as usize][axis])
    });
    let (smaller, rest) = range.split_at_mut(middle);
    let next_axis = (axis + 1) % 3;
    separate(points, smaller, next_axis);
    separate(points, &mut rest[1..], next_axis);
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::f32_of;
    use numbers::random::Random;

    /// Relative tolerance for sums of three numbers in another order.
    const TOLERANCE: f64 = 1e-12;

    fn by_comparing_all(points: &[[f32; 3]], from: &[f32; 3]) -> f64 {
        let distance = |point: &[f32; 3]| {
            (0..3)
                .map(|axis| (f64::from(point[axis]) - f64::from(from[axis])).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let mut distances: Vec<f64> = points
            .iter()
            .map(distance)
            .filter(|distance| *distance > 0.0)
            .collect();
        distances.sort_by(f64::total_cmp);
        distances[..3].iter().sum::<f64>() / 3.0
    }

    #[test]
    fn spacings_match_a_search_through_all_points() {
        let mut random = Random::new(5);
        let mut points: Vec<[f32; 3]> = (0..500)
            .map(|_| std::array::from_fn(|_| f32_of(2.0 * random.unit() - 1.0)))
            .collect();
        // The points are a plane, on which many coordinates are equal, and a dense cluster far
        // away.
        points.extend((0..400).map(|ix| [0.25 * (ix % 20) as f32, 3.0, 0.25 * (ix / 20) as f32]));
        points.extend(
            (0..100).map(|_| std::array::from_fn(|_| f32_of(500.0 + 1e-2 * random.unit()))),
        );
        let spacings_m = mean_spacings_m(&points);
        for (point, spacing_m) in points.iter().zip(&spacings_m) {
            let (got, expected) = (spacing_m.unwrap(), by_comparing_all(&points, point));
            assert!(
                (got - expected).abs() <= TOLERANCE * expected,
                "{point:?}: {got}, expected {expected}"
            );
        }
        assert!(
            spacings_m[500..900]
                .iter()
                .all(|spacing_m| spacing_m.is_some_and(|m| (0.25..0.31).contains(&m)))
        );
        assert_eq!(mean_spacings_m(&points), spacings_m, "repeated");
    }

    #[test]
    fn few_points_have_fewer_neighbors() {
        assert!(mean_spacings_m(&[]).is_empty());
        assert_eq!(mean_spacings_m(&[[1.0, 2.0, 3.0]]), [None]);
        assert_eq!(
            mean_spacings_m(&[[0.0; 3], [0.0, 3.0, 4.0]]),
            [Some(5.0), Some(5.0)]
        );
        assert_eq!(
            mean_spacings_m(&[[0.0; 3], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]]),
            [Some(3.0), Some(2.5), Some(4.5)]
        );
    }
}
