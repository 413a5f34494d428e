//! Matrices of transforms in results.

use kinematics::{Transform, transform};

/// A transform as a 4x4 matrix, row by row.
pub(crate) type Matrix = [[f64; 4]; 4];

/// The matrix of a transform, row by row.
pub(crate) fn matrix_of(transform: &Transform) -> Matrix {
    let rows = transform::to_rows(transform);
    std::array::from_fn(|row| std::array::from_fn(|column| rows[4 * row + column]))
}

/// A matrix as text, one line per row.
pub(crate) fn matrix_lines(matrix: &Matrix) -> impl Iterator<Item = String> {
    matrix.iter().map(|row| {
        let row: Vec<String> = row.iter().map(|value| format!("{value:10.6}")).collect();
        format!("  {}", row.join(" "))
    })
}
