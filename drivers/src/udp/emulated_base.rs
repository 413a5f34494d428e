//! An emulated controller of a base, on a real UDP socket. It follows the rules for controllers in
//! `docs/reference/udp.md`.

use crate::base_motion::BaseVelocity;
use crate::wire::base_drive::{DriveCommand, DriveReply, decode_command, encode_reply};
use std::net::{SocketAddr, UdpSocket};

/// Silence after which another session may begin.
const SESSION_END_NANOS: i64 = 1_000_000_000;
/// Latest end of a velocity that is accepted.
const MAX_VALID_NANOS: i64 = 1_000_000_000;

/// The controller of a base. It has no clock, so that tests can set the time.
#[derive(Debug)]
pub struct EmulatedBase {
    socket: UdpSocket,
    session: Option<u64>,
    seq: u64,
    n_accepted: u64,
    heard_nanos: i64,
    velocity: BaseVelocity,
    expires_nanos: i64,
    /// Why the base cannot move, if it should report a fault.
    pub fault: Option<String>,
    /// Whether replies are sent.
    pub replies: bool,
}

impl EmulatedBase {
    /// Listens on a free port of this computer.
    ///
    /// # Errors
    /// If no socket can be opened.
    pub fn start() -> std::io::Result<Self> {
        let socket = UdpSocket::bind("127.0.0.1:0")?;
        socket.set_nonblocking(true)?;
        Ok(Self {
            socket,
            session: None,
            seq: 0,
            n_accepted: 0,
            heard_nanos: 0,
            velocity: BaseVelocity::ZERO,
            expires_nanos: 0,
            fault: None,
            replies: true,
        })
    }

    /// Address on which it listens.
    ///
    /// # Errors
    /// If the socket has no address.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// The velocity of the base, which stops and starts at once.
    #[must_use]
    pub fn velocity(&self) -> BaseVelocity {
        self.velocity
    }

    /// Number of commands that were neither repeated nor of another program.
    #[must_use]
    pub fn n_accepted(&self) -> u64 {
        self.n_accepted
    }

    /// One cycle of the controller: takes the datagrams that have arrived, and ends an expired
    /// velocity.
    ///
    /// * `now_nanos`: time on the clock of the base.
    pub fn cycle(&mut self, now_nanos: i64) {
        let mut bytes = [0; 2048];
        while let Ok((n_bytes, sender)) = self.socket.recv_from(&mut bytes) {
            let Ok(command) = decode_command(&bytes[..n_bytes]) else {
                continue;
            };
            let refusal = self.obey(&command, now_nanos).err();
            let reply = DriveReply {
                session: command.session,
                seq: command.seq,
                stamp_nanos: now_nanos,
                velocity: self.velocity,
                fault: self.fault.clone(),
                refusal: refusal.map(str::to_owned),
            };
            if self.replies {
                // Senders must tolerate lost replies.
                let _ = self.socket.send_to(&encode_reply(&reply), sender);
            }
        }
        if now_nanos > self.expires_nanos {
            self.velocity = BaseVelocity::ZERO;
        }
    }

    fn obey(&mut self, command: &DriveCommand, now_nanos: i64) -> Result<(), &'static str> {
        let is_stop = command.velocity == BaseVelocity::ZERO;
        if self.session != Some(command.session) {
            let is_free =
                self.session.is_none() || now_nanos - self.heard_nanos > SESSION_END_NANOS;
            if !is_free || !is_stop {
                return Err("another program drives the base, or the first velocity is not zero");
            }
            self.session = Some(command.session);
            self.seq = 0;
        }
        if command.seq <= self.seq {
            return Err("repeated or overtaken");
        }
        self.seq = command.seq;
        self.n_accepted += 1;
        self.heard_nanos = now_nanos;
        if is_stop || self.fault.is_some() {
            self.velocity = BaseVelocity::ZERO;
            return Ok(());
        }
        let expires_nanos = command.expires_nanos.unwrap_or(i64::MIN);
        if expires_nanos <= now_nanos || expires_nanos > now_nanos + MAX_VALID_NANOS {
            self.velocity = BaseVelocity::ZERO;
            return Err("expired, or it would last for more than a second");
        }
        self.velocity = command.velocity;
        self.expires_nanos = expires_nanos;
        Ok(())
    }
}
