//! A base whose poses come over UDP, for instance from a localiser of its own.

use super::counts::{DatagramCounts, count_and_warn};
use super::reader::DatagramReader;
use crate::wire::datagram::decode_pose;
use crate::{Base, BasePose, Error};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A base that is told where it is.
#[derive(Debug)]
pub struct UdpBase {
    poses: DatagramReader,
    max_sigma: [f64; 2],
}

impl UdpBase {
    /// Listens; port 0 takes a free one. Poses that their sender is less sure of than `max_sigma` are passed over: root mean squares of
    /// the position's error and of the turn's, metres and radians. Those without a word on that are taken.
    pub fn open(address: SocketAddr, max_sigma: [f64; 2]) -> Result<Self, Error> {
        Ok(Self { poses: DatagramReader::open("base", "poses", address)?, max_sigma })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.poses.address()
    }

    /// What became of the datagrams so far.
    pub fn counts(&self) -> DatagramCounts {
        self.poses.counts()
    }
}

impl Base for UdpBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error> {
        let until = Instant::now() + timeout;
        let decode = |bytes: &[u8]| decode_pose(bytes).map(|pose| (pose.header, pose));
        loop {
            let remaining = until.saturating_duration_since(Instant::now());
            let (stamp, pose) = self.poses.next(remaining, decode)?.ok_or(Error::NoBasePose { waited: timeout })?;
            match pose.sigmas() {
                Some([m, rad]) if m > self.max_sigma[0] || rad > self.max_sigma[1] => {
                    let what = format_args!("a pose is known to {m:.3} m and {rad:.4} rad only, and passed over");
                    count_and_warn("base", &mut self.poses.counts.n_uncertain, 1, what);
                }
                _ => return Ok(BasePose { stamp, world_from_base: pose.world_from_base }),
            }
        }
    }
}
