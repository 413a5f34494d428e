//! A base whose poses come over UDP, for instance from a localiser of its own.

use super::counts::Counts;
use super::whole::WholeReadings;
use crate::wire::datagram::{PoseDatagram, decode_pose};
use crate::{Base, BasePose, Error};
use std::net::SocketAddr;
use std::time::Duration;

/// A base that is told where it is.
#[derive(Debug)]
pub struct UdpBase {
    poses: WholeReadings,
}

impl UdpBase {
    /// Listens; port 0 takes a free one.
    pub fn open(address: SocketAddr) -> Result<Self, Error> {
        Ok(Self { poses: WholeReadings::open("base", "poses", address)? })
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
        let decode =
            |bytes: &[u8]| decode_pose(bytes).map(|PoseDatagram { head, world_from_base }| (head, world_from_base));
        let (stamp, world_from_base) =
            self.poses.next(timeout, decode)?.ok_or(Error::NoBasePose { waited: timeout })?;
        Ok(BasePose { stamp, world_from_base })
    }
}
