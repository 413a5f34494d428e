//! Gradient of the contraction of the world to the unit cube.

use model_files::contraction::largest;

/// Backpropagates a gradient from the contracted point to the point.
pub fn contract_backward(at: [f64; 3], upstream: [f64; 3]) -> [f64; 3] {
    let (axis, max_abs) = largest(at);
    if max_abs <= 1.0 {
        return upstream.map(|v| v / 4.0);
    }
    // The contraction is x -> x (2 m - 1) / m^2, where m is the largest coordinate.
    let factor = (2.0 * max_abs - 1.0) / (max_abs * max_abs);
    let by_max = (2.0 - 2.0 * max_abs) / (max_abs * max_abs * max_abs);
    let along: f64 = at.iter().zip(upstream).map(|(x, v)| x * v).sum();
    let mut gradient = upstream.map(|v| v * factor);
    // A change of the largest coordinate changes the factor of all three coordinates.
    gradient[axis] += along * by_max * at[axis].signum();
    gradient.map(|v| v / 4.0)
}
