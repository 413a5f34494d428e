//! Maximum rate of periodic traffic on a bus.

use super::config::BusConfig;
use crate::wire::can::Frame;
use crate::wire::can::frame::{Stuffing, load_frac};

/// Maximum fraction of the bus for polls, commands and answers. Errors cause retransmissions, and
/// other nodes may send, too. With a larger fraction, frames with high identifiers wait longer,
/// because lower identifiers have priority. With a smaller fraction, the rate of cycles drops in
/// proportion.
const MAX_LOAD_FRAC: f64 = 0.7;

/// Rate of cycles, Hz. It is the requested rate, or the highest rate that keeps the bus load within
/// its limit.
///
/// `cycle_frames`: all frames of a cycle, sent and received. `unsolicited`: other frames, with
/// their rate in Hz.
pub(super) fn max_cycle_rate_hz(
    bus: &BusConfig,
    cycle_frames: &[Frame],
    unsolicited: &[(Frame, f64)],
    requested_hz: f64,
) -> f64 {
    // Stuff bits depend on the data, which change with every position. Only the worst case bounds
    // the load.
    let bits = |frame: &Frame| frame.bits(Stuffing::Worst);
    let unsolicited = load_frac(
        unsolicited
            .iter()
            .map(|(frame, rate_hz)| (bits(frame), *rate_hz)),
        bus.rates(),
    );
    let per_cycle = load_frac(
        cycle_frames.iter().map(|frame| (bits(frame), 1.0)),
        bus.rates(),
    );
    // Unsolicited reports cannot be slowed down, so the cycle gets the part of the limit that they
    // leave. If they leave nothing, a rate of 1 Hz keeps the period finite.
    let rate_hz = requested_hz.min(((MAX_LOAD_FRAC - unsolicited) / per_cycle).max(1.0));
    let load_percent = 100.0 * (unsolicited + per_cycle * rate_hz);
    let interface = &bus.interface;
    if rate_hz < requested_hz {
        log::warn!(
            "{interface}: a rate of {requested_hz} Hz would exceed {:.0} % bus load; reduced to {rate_hz:.0} Hz ({load_percent:.0} %); \
             use a second bus or CAN FD for a higher rate",
            100.0 * MAX_LOAD_FRAC
        );
    } else {
        log::info!(
            "{interface}: a rate of {rate_hz:.0} Hz takes at most {load_percent:.0} % of the bus"
        );
    }
    rate_hz
}
