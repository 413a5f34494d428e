//! How often a bus can carry what goes over it again and again.

use super::config::BusConfig;
use crate::wire::can::Frame;
use crate::wire::can::frame::{Stuffing, load_frac};

/// Most of the bus that asking, commanding and answering may take: errors are repeated, and others may speak too.
const MAX_LOAD_FRAC: f64 = 0.7;

/// How many cycles a second, as many as wanted or as keep the bus's load in bounds.
///
/// `cycle_frames`: all frames of a cycle, of both sides; `unsolicited`: frames that come besides, and how often in a second.
pub(super) fn max_cycle_rate_hz(
    bus: &BusConfig,
    cycle_frames: &[Frame],
    unsolicited: &[(Frame, f64)],
    requested_hz: f64,
) -> f64 {
    let bits = |frame: &Frame| frame.bits(Stuffing::Worst);
    let unsolicited = load_frac(unsolicited.iter().map(|(frame, rate_hz)| (bits(frame), *rate_hz)), bus.rates());
    let per_cycle = load_frac(cycle_frames.iter().map(|frame| (bits(frame), 1.0)), bus.rates());
    let rate_hz = requested_hz.min(((MAX_LOAD_FRAC - unsolicited) / per_cycle).max(1.0));
    let load_percent = 100.0 * (unsolicited + per_cycle * rate_hz);
    let interface = &bus.interface;
    if rate_hz < requested_hz {
        log::warn!(
            "{interface}: {requested_hz} cycles a second would take more than {:.0} % of the bus; there are {rate_hz:.0} ({load_percent:.0} %): \
             a second bus or FD makes room",
            100.0 * MAX_LOAD_FRAC
        );
    } else {
        log::info!("{interface}: {rate_hz:.0} cycles a second take {load_percent:.0} % of the bus at most");
    }
    rate_hz
}
