//! When and how precisely each part of the scene was observed, for viewers.

use crate::Hub;
use crate::client::server_message::{BinaryHeader, ObservationsHeader, frame};
use crate::clock::ServerClock;
use crate::topics::shared_topic::{SharedTopic, only_message};
use crate::topics::{DefaultRate, Priority};
use axum::extract::ws::Message;
use flate2::Compression;
use flate2::write::ZlibEncoder;
use std::io::Write;
use std::sync::Arc;
use std::time::Instant;

/// Code of cells that no view has observed.
const UNOBSERVED: u8 = 0;
/// Code of observed cells whose position is not determined.
const UNDETERMINED: u8 = 255;
/// Age represented by code 1, seconds. Lower ages all count as current.
const MIN_AGE_SECS: f64 = 0.1;
/// Standard deviation represented by code 1, meters.
const MIN_SIGMA_M: f64 = 1e-5;
/// Natural logarithm of the ratio of two consecutive codes: code 254 stands for 31 hours and for 11
/// m.
const LOG_STEP: f64 = 0.055;
/// Neighboring cells have similar codes, so higher levels gain little.
const DEFLATE_LEVEL: u32 = 3;

/// A grid over the scene. Cells without an entry in [`Self::observed`] were not observed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ObservationMap {
    /// Corner of the grid with the smallest coordinates, in world, meters.
    pub min_m: [f64; 3],
    /// Edge of a cell, meters.
    pub cell_m: f64,
    /// Number of cells along x, y and z.
    pub n_cells: [u32; 3],
    /// The observed cells.
    pub observed: Vec<ObservedCell>,
    /// Number of views.
    pub n_keyframes: usize,
    /// When the newest view was captured; `None` if another process captured it.
    pub newest_at: Option<Instant>,
}

/// A cell that was observed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObservedCell {
    /// Index `x + n_cells[0] * (y + n_cells[1] * z)`.
    pub ix: usize,
    /// Time from its last observation to the newest view, seconds.
    pub age_secs: f64,
    /// Standard deviation of the position of its surface in the least certain direction, meters;
    /// infinite if one direction was not measured.
    pub sigma_m: f64,
}

/// The topic.
#[derive(Default)]
pub(crate) struct ObservationTopic;

impl SharedTopic for ObservationTopic {
    const NAME: &'static str = "observations";
    const DEFAULT: DefaultRate = DefaultRate::Off;
    const PRIORITY: Priority = Priority::Background;
    type Source = Option<Arc<PackedObservations>>;

    fn encode(&mut self, source: &Self::Source, clock: ServerClock) -> Vec<(Arc<str>, Message)> {
        let message = source
            .as_ref()
            .map(|packed| Message::binary(packed.message(clock)));
        only_message(message)
    }
}

impl Hub {
    /// Whether a client shows when and how precisely the scene was observed.
    pub fn needs_observations(&self) -> bool {
        self.demands().has_topic(ObservationTopic::NAME)
    }

    /// Sets the map of observations. Compresses it, which takes some milliseconds.
    pub fn set_observations(&self, map: &ObservationMap) {
        match PackedObservations::new(map) {
            Ok(packed) => {
                _ = self
                    .latest::<Option<Arc<PackedObservations>>>()
                    .send_replace(Some(Arc::new(packed)))
            }
            Err(error) => log::error!("cannot compress the map of observations: {error}"),
        }
    }
}

/// The message `observations` without the times that depend on the server's clock.
#[derive(Debug)]
pub(crate) struct PackedObservations {
    min_m: [f64; 3],
    cell_m: f64,
    n_cells: [u32; 3],
    n_keyframes: usize,
    newest_at: Option<Instant>,
    payload: Vec<u8>,
}

impl PackedObservations {
    /// Compresses a map.
    pub(crate) fn new(map: &ObservationMap) -> std::io::Result<Self> {
        // Two planes, because neighbors of the same kind are similar, which zlib needs.
        let n_cells: usize = map.n_cells.iter().map(|n| *n as usize).product();
        let mut codes = vec![UNOBSERVED; 2 * n_cells];
        let (ages, sigmas) = codes.split_at_mut(n_cells);
        // A cell outside the grid is a mistake of the caller, but it must not cause a panic on the
        // thread that computes the map.
        for cell in map.observed.iter().filter(|cell| cell.ix < n_cells) {
            ages[cell.ix] = code(cell.age_secs, MIN_AGE_SECS);
            sigmas[cell.ix] = code(cell.sigma_m, MIN_SIGMA_M);
        }
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::new(DEFLATE_LEVEL));
        encoder.write_all(&codes)?;
        Ok(Self {
            min_m: map.min_m,
            cell_m: map.cell_m,
            n_cells: map.n_cells,
            n_keyframes: map.n_keyframes,
            newest_at: map.newest_at,
            payload: encoder.finish()?,
        })
    }

    /// The binary message.
    pub(crate) fn message(&self, clock: ServerClock) -> Vec<u8> {
        let header = ObservationsHeader {
            min_m: self.min_m,
            cell_m: self.cell_m,
            n_cells: self.n_cells,
            n_keyframes: self.n_keyframes,
            // Each server has its own clock, so this time cannot be packed in advance.
            newest_millis: self.newest_at.map(|at| clock.millis(at)),
            min_age_secs: MIN_AGE_SECS,
            min_sigma_m: MIN_SIGMA_M,
            log_step: LOG_STEP,
        };
        frame(&BinaryHeader::Observations(header), &[&self.payload])
    }
}

/// The logarithmic code of a number.
fn code(value: f64, min: f64) -> u8 {
    // Ages and deviations extend over many orders of magnitude, and their relative error matters.
    // NaN becomes `min`, because `max` returns the other number.
    let steps = (value.max(min) / min).ln() / LOG_STEP;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 1 and 254"
    )]
    // The largest code, 254, stands for 253 steps. Infinity stands for a direction that was not
    // measured, and fails this comparison, too.
    if steps < f64::from(UNDETERMINED - 2) + 0.5 {
        1 + steps.round() as u8
    } else {
        UNDETERMINED
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::read::ZlibDecoder;
    use std::io::Read;

    #[test]
    fn codes_keep_ages_and_deviations_within_three_percent() {
        let cell = |ix, age_secs, sigma_m| ObservedCell {
            ix,
            age_secs,
            sigma_m,
        };
        let observed = vec![
            cell(0, 0.0, 0.0),
            cell(2, 12.0, 3e-4),
            cell(5, 90_000.0, 2.5),
            cell(11, 1e9, f64::INFINITY),
            cell(12, 1.0, 1.0), // Outside.
        ];
        let map = ObservationMap {
            cell_m: 0.1,
            n_cells: [2, 3, 2],
            observed,
            ..ObservationMap::default()
        };
        let packed = PackedObservations::new(&map).expect("packed");
        let mut codes = Vec::new();
        ZlibDecoder::new(&packed.payload[..])
            .read_to_end(&mut codes)
            .expect("a zlib stream");
        assert_eq!(codes.len(), 24);
        let number = |code: u8, min: f64| min * (LOG_STEP * f64::from(code - 1)).exp();
        let is_close = |got: f64, expected: f64| (got / expected - 1.0).abs() < 0.03;
        assert_eq!(
            (codes[0], codes[1], codes[12], codes[13]),
            (1, UNOBSERVED, 1, UNOBSERVED)
        );
        assert!(
            is_close(number(codes[2], MIN_AGE_SECS), 12.0)
                && is_close(number(codes[14], MIN_SIGMA_M), 3e-4)
        );
        assert!(
            is_close(number(codes[5], MIN_AGE_SECS), 90_000.0)
                && is_close(number(codes[17], MIN_SIGMA_M), 2.5)
        );
        assert_eq!((codes[11], codes[23]), (UNDETERMINED, UNDETERMINED));
    }
}
