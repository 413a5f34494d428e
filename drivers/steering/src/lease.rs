//! First link: one operator at a time may move the arm.

use crate::reason::Reason;
use crate::request::{Command, Operator};
use drivers::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// How long leases last.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeaseConfig {
    /// Silence after which the lease expires. Browsers run the timers of hidden tabs once a second,
    /// so a shorter lease would not survive a look at another tab.
    pub expiry_secs: f64,
    /// How long another operator may accept an offer.
    pub offer_secs: f64,
}

impl Default for LeaseConfig {
    fn default() -> Self {
        Self {
            expiry_secs: 5.0,
            offer_secs: 20.0,
        }
    }
}

/// The holder of the lease.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Holder {
    operator: Operator,
    #[serde(with = "exact::stamp")]
    since: Stamp,
    #[serde(with = "exact::stamp")]
    heard_at: Stamp,
    offer: Option<Offer>,
}

/// An offer, and its end.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Offer {
    to: Operator,
    #[serde(with = "exact::stamp")]
    until: Stamp,
}

/// The right to move the arm.
#[derive(Clone, Debug)]
pub(crate) struct Lease {
    config: LeaseConfig,
    /// The state, for records.
    pub(crate) holder: Option<Holder>,
}

impl Lease {
    /// A lease that nobody holds.
    pub(crate) fn new(config: LeaseConfig) -> Self {
        Self {
            config,
            holder: None,
        }
    }

    /// The holder, and the time since when.
    pub(crate) fn holder(&self) -> Option<(Operator, Stamp)> {
        self.holder.map(|holder| (holder.operator, holder.since))
    }

    /// Time until the lease expires if its holder is silent.
    pub(crate) fn left_secs(&self, now: Stamp) -> Option<f64> {
        let silent_secs = now.secs_since(self.holder?.heard_at);
        Some((self.config.expiry_secs - silent_secs).max(0.0))
    }

    /// The operator who may take the lease over now.
    pub(crate) fn offered_to(&self, now: Stamp) -> Option<Operator> {
        let Offer { to, until } = self.holder?.offer?;
        (now <= until).then_some(to)
    }

    /// Ends the lease if its holder has been silent for too long.
    pub(crate) fn expire(&mut self, now: Stamp) -> Option<Reason> {
        let holder = self.holder?;
        let silent_secs = now.secs_since(holder.heard_at);
        if silent_secs <= self.config.expiry_secs {
            return None;
        }
        self.holder = None;
        Some(Reason::LeaseExpired {
            holder: holder.operator,
            silent_secs,
        })
    }

    /// Ends the lease, whoever holds it.
    pub(crate) fn end(&mut self) {
        self.holder = None;
    }

    /// Gives the lease to an operator, if nobody else holds it or if it is offered. Returns the
    /// reason why the previous holder lost it, if there was one.
    pub(crate) fn take(
        &mut self,
        now: Stamp,
        operator: Operator,
    ) -> Result<Option<Reason>, Reason> {
        let mut lost = None;
        if let Some(holder) = &self.holder {
            if holder.operator == operator {
                return self.renew(now, operator).map(|()| None);
            }
            let is_offered = holder
                .offer
                .is_some_and(|offer| offer.to == operator && now <= offer.until);
            if !is_offered {
                return Err(self.refusal(now));
            }
            lost = Some(Reason::LeaseGivenUp {
                holder: holder.operator,
            });
        }
        self.holder = Some(Holder {
            operator,
            since: now,
            heard_at: now,
            offer: None,
        });
        Ok(lost)
    }

    /// Checks that an operator holds the lease, and remembers that the operator was heard.
    pub(crate) fn renew(&mut self, now: Stamp, operator: Operator) -> Result<(), Reason> {
        match &mut self.holder {
            Some(holder) if holder.operator == operator => {
                holder.heard_at = now;
                Ok(())
            }
            _ => Err(self.refusal(now)),
        }
    }

    /// Like [`Lease::renew`] for a command: its sender was heard when the command arrived.
    pub(crate) fn hear(&mut self, now: Stamp, command: &Command) -> Result<(), Reason> {
        match &mut self.holder {
            Some(holder) if holder.operator == command.operator => {
                holder.heard_at = holder.heard_at.max(command.received_by(now));
                Ok(())
            }
            _ => Err(self.refusal(now)),
        }
    }

    /// Ends the lease at the request of its holder.
    pub(crate) fn release(&mut self, now: Stamp, operator: Operator) -> Result<Reason, Reason> {
        self.renew(now, operator)?;
        self.holder = None;
        Ok(Reason::LeaseGivenUp { holder: operator })
    }

    /// Offers the lease to another operator. The holder keeps it until the other takes it.
    pub(crate) fn offer(&mut self, now: Stamp, from: Operator, to: Operator) -> Result<(), Reason> {
        self.renew(now, from)?;
        let until = now.plus_secs(self.config.offer_secs);
        if let Some(holder) = &mut self.holder {
            holder.offer = Some(Offer { to, until });
        }
        Ok(())
    }

    /// Why another operator may not move the arm.
    fn refusal(&self, now: Stamp) -> Reason {
        match &self.holder {
            None => Reason::NoLease,
            Some(holder) => Reason::LeaseHeld {
                holder: holder.operator,
                left_secs: (self.config.expiry_secs - now.secs_since(holder.heard_at)).max(0.0),
            },
        }
    }
}
