//! Rotation rates of two streams and their correlation, to show what an estimate is based on.

use super::coarse::Grid;
use super::stream::Stream;
use super::{PoseSample, TimeOffsetOptions};
use crate::Error;

/// Rotation rates of both streams, and their correlation at each offset.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionProfile {
    /// Rotation rates of A and B, without gaps: seconds on the clock of the stream, radians per
    /// second. The highest 5 % of the rates are clipped.
    pub rates: [Vec<[f64; 2]>; 2],
    /// Offset in seconds, and correlation of the rates at this offset.
    pub correlation: Vec<[f64; 2]>,
}

/// The rotation rates that [`super::estimate_time_offset`] compares. Available also if the estimate
/// is refused.
///
/// # Errors
/// [`Error::TimeOffsetInput`] if a stream is invalid.
pub fn motion_profile(
    a: &[PoseSample],
    b: &[PoseSample],
    options: &TimeOffsetOptions,
) -> Result<MotionProfile, Error> {
    let (a, b) = (Stream::new("A", a)?, Stream::new("B", b)?);
    let grid = Grid::new(&a, &b);
    let curve = |stream: &Stream, ix: usize| {
        let values = grid.rates[ix].values.iter().enumerate();
        values
            .filter_map(|(ix, rate)| {
                Some([stream.start_secs() + ix as f64 * grid.step_secs, (*rate)?])
            })
            .collect()
    };
    let correlations = grid.correlations(options.max_offset_secs);
    Ok(MotionProfile {
        rates: [curve(&a, 0), curve(&b, 1)],
        correlation: correlations
            .iter()
            .map(|at| [grid.offset_secs(at.lag), at.value])
            .collect(),
    })
}
