//! Depth filters of the library that the rig file enables, with their default parameters.

use super::sdk::{Frame, as_depth};
use super::{Filter, Problem};
use realsense_rust::frame::DepthFrame;
use realsense_rust::processing_blocks::hole_filling::HoleFillingFilter;
use realsense_rust::processing_blocks::spatial_filter::SpatialFilter;
use realsense_rust::processing_blocks::temporal_filter::TemporalFilter;
use std::fmt::Display;
use std::time::Duration;

/// Filters run on the calling thread, so their result is available immediately.
const FILTER_TIMEOUT: Duration = Duration::from_secs(1);

/// Filters in the order in which they are applied.
#[derive(Debug, Default)]
pub(super) struct Filters(Vec<Block>);

#[derive(Debug)]
enum Block {
    Spatial(SpatialFilter),
    Temporal(TemporalFilter),
    HoleFilling(HoleFillingFilter),
}

// SAFETY: the library may be called from any thread, one at a time. Blocks are never cloned, so
// these are the only pointers.
#[expect(unsafe_code, reason = "the wrapper lacks a Send implementation")]
unsafe impl Send for Filters {}

impl Filters {
    pub(super) fn new(filters: &[Filter]) -> Result<Self, Problem> {
        let block = |filter: &Filter| match filter {
            Filter::Spatial => SpatialFilter::new(1)
                .map(Block::Spatial)
                .map_err(filter_problem),
            Filter::Temporal => TemporalFilter::new(1)
                .map(Block::Temporal)
                .map_err(filter_problem),
            Filter::HoleFilling => HoleFillingFilter::new(1)
                .map(Block::HoleFilling)
                .map_err(filter_problem),
        };
        filters
            .iter()
            .map(block)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Applies all filters to a depth image.
    pub(super) fn apply(&mut self, frame: Frame) -> Result<DepthFrame, Problem> {
        let mut frame = as_depth(frame)?;
        for block in &mut self.0 {
            frame = match block {
                Block::Spatial(filter) => filter
                    .queue(frame)
                    .and_then(|()| filter.wait(FILTER_TIMEOUT)),
                Block::Temporal(filter) => filter
                    .queue(frame)
                    .and_then(|()| filter.wait(FILTER_TIMEOUT)),
                Block::HoleFilling(filter) => filter
                    .queue(frame)
                    .and_then(|()| filter.wait(FILTER_TIMEOUT)),
            }
            .map_err(filter_problem)?;
        }
        Ok(frame)
    }
}

fn filter_problem(error: impl Display) -> Problem {
    Problem::Library {
        what: "filter depth",
        reason: error.to_string(),
    }
}
