//! Contraction of the world to the unit cube: near space is scaled uniformly, far space is
//! compressed.

/// Contracts a point, given in units of the scene radius around its center, to the unit cube. The
/// inner cube from -1 to 1 fills the central half along each axis; everything outside maps to the
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

/// Backpropagates a gradient from the contracted point to the point.
pub fn contract_backward(at: [f64; 3], upstream: [f64; 3]) -> [f64; 3] {
    let (axis, max_abs) = largest(at);
    if max_abs <= 1.0 {
        return upstream.map(|v| v / 4.0);
    }
    // x -> x (2 m - 1) / m^2, where m is the largest coordinate.
    let factor = (2.0 * max_abs - 1.0) / (max_abs * max_abs);
    let by_max = (2.0 - 2.0 * max_abs) / (max_abs * max_abs * max_abs);
    let along: f64 = at.iter().zip(upstream).map(|(x, v)| x * v).sum();
    let mut gradient = upstream.map(|v| v * factor);
    // Moving the largest coordinate changes the factor of all three.
    gradient[axis] += along * by_max * at[axis].signum();
    gradient.map(|v| v / 4.0)
}

/// The axis with the largest absolute coordinate, and that absolute value.
pub(crate) fn largest(point: [f64; 3]) -> (usize, f64) {
    let mut best = (0, 0.0);
    for (axis, along) in point.into_iter().enumerate() {
        if along.abs() > best.1 {
            best = (axis, along.abs());
        }
    }
    best
}
