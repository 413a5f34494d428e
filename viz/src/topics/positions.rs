//! Positions of points in messages: 16-bit counts of a common size.

use nalgebra::Vector3;

/// Packs positions relative to an origin as 3 signed little-endian counts each. Returns the counts
/// and the meters per count. Returns `None` if all points are at the origin, or if a coordinate is
/// not finite.
pub(crate) fn pack_positions(points_m: &[Vector3<f64>]) -> Option<(Vec<u8>, f64)> {
    let extent_m = points_m
        .iter()
        .flat_map(|point| point.iter())
        .fold(0.0_f64, |max, value| max.max(value.abs()));
    // The scale below would be 0 or not finite. NaN is checked separately, because `f64::max`
    // ignores it, and the cast below would turn it into 0.
    let has_nan = points_m
        .iter()
        .any(|point| point.iter().any(|value| value.is_nan()));
    if has_nan || extent_m <= 0.0 || !extent_m.is_finite() {
        return None;
    }
    // The largest coordinate gets the largest count, so that the step is as small as 16 bits allow.
    let meters_per_count = extent_m / f64::from(i16::MAX);
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the largest coordinate is i16::MAX counts"
    )]
    let count = |value: &f64| ((value / meters_per_count).round() as i16).to_le_bytes();
    Some((
        points_m
            .iter()
            .flat_map(|point| point.iter().flat_map(count))
            .collect(),
        meters_per_count,
    ))
}

#[cfg(test)]
mod tests {
    use super::pack_positions;
    use nalgebra::Vector3;

    #[test]
    fn only_finite_points_away_from_the_origin_are_packed() {
        let point = Vector3::new(1.0, -2.0, 0.5);
        let (bytes, meters_per_count) = pack_positions(&[point]).expect("a finite point");
        assert_eq!(
            (bytes.len(), meters_per_count),
            (6, 2.0 / f64::from(i16::MAX))
        );
        for wrong in [f64::NAN, f64::INFINITY] {
            assert!(
                pack_positions(&[point, Vector3::new(0.0, wrong, 0.0)]).is_none(),
                "{wrong}"
            );
        }
        assert!(pack_positions(&[]).is_none() && pack_positions(&[Vector3::zeros()]).is_none());
    }
}
