//! The only place where f64 is converted to f32, for images and the GPU.
#![expect(
    clippy::cast_possible_truncation,
    reason = "rounding to f32 is the purpose of this file"
)]

/// Rounds to the nearest f32.
pub fn f32_of(value: f64) -> f32 {
    value as f32
}

/// Rounds each element to the nearest f32.
pub fn f32s_of<const N: usize>(values: [f64; N]) -> [f32; N] {
    values.map(f32_of)
}
