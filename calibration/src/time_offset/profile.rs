//! Rotation rates of two streams and their correlation, for charts that show the basis of an
//! estimate.

use super::coarse::Grid;
use super::stream::Stream;
use super::{PoseSample, TimeOffsetOptions};
use crate::Error;

/// Rotation rates of both streams, and their correlation at each offset.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionProfile {
    /// Rotation rates of A and B, without gaps. Each entry contains seconds on the clock of the
    /// stream, and radians per second. The highest 5 % of the rates are clipped.
    pub rates: [Vec<[f64; 2]>; 2],
    /// Offset in seconds, and correlation of the rates at this offset.
    pub correlation: Vec<[f64; 2]>,
}

/// The rotation rates that [`super::estimate_time_offset`] compares. They are available even if the
/// estimate is refused.
///
/// # Errors
/// Returns [`Error::TimeOffsetInput`] if a stream is invalid.
pub fn motion_profile(
    a: &[PoseSample],
    b: &[PoseSample],
    options: &TimeOffsetOptions,
) -> Result<MotionProfile, Error> {
    let a = Stream::new("A", a)?;
    let b = Stream::new("B", b)?;
    let grid = Grid::new(&a, &b);
    let curves = [curve(&a, &grid, 0), curve(&b, &grid, 1)];
    let correlations = grid.correlations(options.max_offset_secs);
    Ok(MotionProfile {
        rates: curves,
        correlation: correlations
            .iter()
            .map(|at| [grid.offset_secs(at.lag), at.value])
            .collect(),
    })
}

/// Times and rates of one of the two streams, sampled on the grid. Gaps are left out.
fn curve(stream: &Stream, grid: &Grid, stream_ix: usize) -> Vec<[f64; 2]> {
    let values = grid.rates[stream_ix].values.iter().enumerate();
    values
        .filter_map(|(ix, rate)| Some([stream.start_secs() + ix as f64 * grid.step_secs, (*rate)?]))
        .collect()
}
