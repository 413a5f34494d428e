//! Contraction of the world to the unit cube. Near space is scaled uniformly, and far space is
//! compressed. The cells of edits and the neural fields divide this cube.

/// Contracts a point, given in units of the scene radius around its center, to the unit cube. The
/// inner cube from -1 to 1 fills the central half along each axis. Everything outside maps to the
/// surrounding shell.
///
/// Source: Barron et al. 2022, equation 10, with the largest coordinate in place of the length, so
/// that cubes stay cubes.
pub fn contract(at: [f64; 3]) -> [f64; 3] {
    let (_, largest) = largest(at);
    if largest <= 1.0 {
        return at.map(|x| (x + 2.0) / 4.0);
    }
    at.map(|x| (x / largest * (2.0 - 1.0 / largest) + 2.0) / 4.0)
}

/// The axis with the largest absolute coordinate, and that absolute value.
pub fn largest(point: [f64; 3]) -> (usize, f64) {
    let mut best = (0, 0.0);
    for (axis, along) in point.into_iter().enumerate() {
        if along.abs() > best.1 {
            best = (axis, along.abs());
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contraction_is_linear_inside_and_bounded_outside() {
        assert_eq!(contract([0.0; 3]), [0.5; 3]);
        assert_eq!(contract([1.0, -1.0, 0.0]), [0.75, 0.25, 0.5]);
        let far = contract([1e9, 0.0, 0.0]);
        assert!(
            far[0] > 0.999_999 && far[0] < 1.0 && (far[1] - 0.5).abs() < 1e-9,
            "{far:?}"
        );
    }
}
