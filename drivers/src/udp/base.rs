//! A base whose poses come over UDP, for instance from a localiser of its own.

use super::counts::{Counts, tell};
use super::whole::WholeReadings;
use crate::wire::datagram::decode_pose;
use crate::{Base, BasePose, Error};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A base that is told where it is.
#[derive(Debug)]
pub struct UdpBase {
    poses: WholeReadings,
    max_sigma: [f64; 2],
}

impl UdpBase {
    /// Listens; port 0 takes a free one. Poses that their sender is less sure of than `max_sigma` are passed over: root mean squares of
    /// the position's error and of the turn's, metres and radians. Those without a word on that are taken.
    pub fn open(address: SocketAddr, max_sigma: [f64; 2]) -> Result<Self, Error> {
        Ok(Self { poses: WholeReadings::open("base", "poses", address)?, max_sigma })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.poses.address()
    }

    /// What became of the datagrams so far.
    pub fn counts(&self) -> Counts {
        self.poses.counts()
    }
}

impl Base for UdpBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error> {
        let until = Instant::now() + timeout;
        let decode = |bytes: &[u8]| decode_pose(bytes).map(|pose| (pose.head, pose));
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let (stamp, pose) = self.poses.next(left, decode)?.ok_or(Error::NoBasePose { waited: timeout })?;
            match pose.sigmas() {
                Some([m, rad]) if m > self.max_sigma[0] || rad > self.max_sigma[1] => {
                    let what = format_args!("a pose is known to {m:.3} m and {rad:.4} rad only, and passed over");
                    tell("base", &mut self.poses.counts.n_unsure, 1, what);
                }
                _ => return Ok(BasePose { stamp, world_from_base: pose.world_from_base }),
            }
        }
    }
}
