//! How often a bus can carry what goes over it again and again.

use super::config::BusConfig;
use crate::wire::can::Frame;
use crate::wire::can::frame::{Stuffing, load_frac};

/// Most of the bus that asking, commanding and answering may take: errors are repeated, and others may speak too.
const MAX_LOAD_FRAC: f64 = 0.7;

/// How many cycles a second, as many as wanted or as keep the bus's load in bounds.
///
/// `of_a_cycle`: all frames of a cycle, of both sides; `unasked`: frames that come besides, and how often in a second.
pub(super) fn affordable_hz(bus: &BusConfig, of_a_cycle: &[Frame], unasked: &[(Frame, f64)], wanted_hz: f64) -> f64 {
    let bits = |frame: &Frame| frame.bits(Stuffing::Worst);
    let unasked = load_frac(unasked.iter().map(|(frame, rate_hz)| (bits(frame), *rate_hz)), bus.rates());
    let per_cycle = load_frac(of_a_cycle.iter().map(|frame| (bits(frame), 1.0)), bus.rates());
    let rate_hz = wanted_hz.min(((MAX_LOAD_FRAC - unasked) / per_cycle).max(1.0));
    let load = 100.0 * (unasked + per_cycle * rate_hz);
    let interface = &bus.interface;
    if rate_hz < wanted_hz {
        log::warn!(
            "{interface}: {wanted_hz} cycles a second would take more than {:.0} % of the bus; there are {rate_hz:.0} ({load:.0} %): \
             a second bus or FD makes room",
            100.0 * MAX_LOAD_FRAC
        );
    } else {
        log::info!("{interface}: {rate_hz:.0} cycles a second take {load:.0} % of the bus at most");
    }
    rate_hz
}
