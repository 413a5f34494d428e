//! An arm whose joint states are received over UDP, for example from the program that moves it.

use super::reader::DatagramReader;
use crate::datagrams::counts::{DatagramCounts, DatagramMonitor};
use crate::wire::datagram::decode_joints;
use crate::{Arm, Error, device_names};
use kinematics::JointState;
use std::net::SocketAddr;
use std::time::Duration;

/// An arm whose joint states are received over UDP.
#[derive(Debug)]
pub struct UdpArm {
    names: Vec<String>,
    states: DatagramReader,
}

impl UdpArm {
    /// Listens for states of these joints. With port 0, a free port is used.
    pub fn open(joint_names: &[String], address: SocketAddr) -> Result<Self, Error> {
        let mut states = DatagramReader::open(device_names::ARM, "joint states", address)?;
        states.joint_names = joint_names.to_vec();
        Ok(Self {
            names: joint_names.to_vec(),
            states,
        })
    }

    /// Address it listens on.
    pub fn address(&self) -> SocketAddr {
        self.states.address()
    }

    /// Statistics of the datagrams so far.
    pub fn counts(&self) -> DatagramCounts {
        self.states.counts()
    }

    /// A handle with which another thread can read these statistics.
    pub fn monitor(&self) -> DatagramMonitor {
        self.states.monitor()
    }
}

impl Arm for UdpArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let Self { names, states } = self;
        let read = states.next(timeout, |bytes| decode_joints(bytes, names))?;
        let (stamp, reported) = read.ok_or(Error::NoJoints { waited: timeout })?;
        Ok(JointState {
            stamp,
            position: reported.position,
            velocity: reported.velocity,
            effort: reported.effort,
        })
    }
}
