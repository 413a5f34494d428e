//! A base whose poses are received over UDP, for example from its own localization.

use super::reader::DatagramReader;
use crate::datagrams::counts::{DatagramCounts, DatagramMonitor, count_and_warn};
use crate::wire::datagram::decode_pose;
use crate::{Base, BasePose, Error, device_names};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A base whose poses are received over UDP.
#[derive(Debug)]
pub struct UdpBase {
    poses: DatagramReader,
    max_sigma: [f64; 2],
}

impl UdpBase {
    /// Listens for poses. With port 0, a free port is used.
    ///
    /// Poses with a standard deviation above `max_sigma` are skipped. `max_sigma` contains the root
    /// mean square errors of position (meters) and rotation (radians). Poses without covariance are
    /// accepted.
    pub fn open(address: SocketAddr, max_sigma: [f64; 2]) -> Result<Self, Error> {
        Ok(Self {
            poses: DatagramReader::open(device_names::BASE, "poses", address)?,
            max_sigma,
        })
    }

    /// Address it listens on.
    pub fn address(&self) -> SocketAddr {
        self.poses.address()
    }

    /// Statistics of the datagrams so far.
    pub fn counts(&self) -> DatagramCounts {
        self.poses.counts()
    }

    /// A handle with which another thread can read these statistics.
    pub fn monitor(&self) -> DatagramMonitor {
        self.poses.monitor()
    }
}

impl Base for UdpBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error> {
        let until = Instant::now() + timeout;
        let decode = |bytes: &[u8]| decode_pose(bytes).map(|pose| (pose.header, Some(pose)));
        loop {
            // Skipped poses must not extend the wait.
            let remaining = until.saturating_duration_since(Instant::now());
            let (stamp, pose) = self
                .poses
                .next(remaining, decode)?
                .ok_or(Error::NoBasePose { waited: timeout })?;
            match pose.sigmas() {
                Some([m, rad]) if m > self.max_sigma[0] || rad > self.max_sigma[1] => {
                    let what = format_args!(
                        "skipped a pose with a standard deviation of {m:.3} m and {rad:.4} rad"
                    );
                    count_and_warn(
                        device_names::BASE,
                        &mut self.poses.counts.n_uncertain,
                        1,
                        what,
                    );
                    // The reader has published the counts before this pose was checked.
                    self.poses.publish_counts();
                }
                _ => {
                    return Ok(BasePose {
                        stamp,
                        world_from_base: pose.world_from_base,
                    });
                }
            }
        }
    }
}
