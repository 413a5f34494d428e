//! Connects the program that steers a base with the base's own thread. Neither side waits for the
//! other.

use super::{BaseLimits, BaseOutput, BaseState, BaseTarget};
use parking_lot::Mutex;
use std::sync::Arc;

/// Steers a base from any thread. Clones refer to the same base.
#[derive(Clone, Debug)]
pub struct BasePort(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    limits: BaseLimits,
    exchange: Mutex<Exchange>,
}

#[derive(Debug, Default)]
struct Exchange {
    orders: BaseOrders,
    newest_motion: u64,
    state: Option<BaseState>,
}

/// Orders that the base's thread has not taken yet.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct BaseOrders {
    /// Brake, and end all motions up to this number. This comes before the target.
    pub(super) brake_motion: Option<u64>,
    /// The newest target.
    pub(super) target: Option<BaseTarget>,
}

impl BasePort {
    /// The port of a base with these limits, which must be valid.
    pub(super) fn new(limits: BaseLimits) -> Self {
        Self(Arc::new(Shared {
            limits,
            exchange: Mutex::default(),
        }))
    }

    /// Sends an output to the base's thread. A new target replaces a target that the thread has not
    /// taken yet. It does not replace an order to brake, which ends the motions of all earlier
    /// targets.
    pub fn send(&self, output: &BaseOutput) {
        let mut exchange = self.0.exchange.lock();
        match output {
            BaseOutput::Drive(target) => {
                exchange.newest_motion = exchange.newest_motion.max(target.motion);
                exchange.orders.target = Some(*target);
            }
            BaseOutput::Brake => {
                exchange.orders = BaseOrders {
                    brake_motion: Some(exchange.newest_motion),
                    target: None,
                };
            }
        }
    }

    /// The newest state of the base; `None` before it has reported one.
    #[must_use]
    pub fn state(&self) -> Option<BaseState> {
        self.0.exchange.lock().state.clone()
    }

    /// The limits of the base.
    #[must_use]
    pub fn limits(&self) -> &BaseLimits {
        &self.0.limits
    }

    /// Takes the orders that were sent since the last call.
    pub(super) fn take_orders(&self) -> BaseOrders {
        std::mem::take(&mut self.0.exchange.lock().orders)
    }

    /// Sets the state that the program sees.
    pub(super) fn report(&self, state: BaseState) {
        self.0.exchange.lock().state = Some(state);
    }
}
