//! A base that is driven over UDP: velocities out, replies with the measured velocity back.

use crate::Error;
use crate::base_motion::{BaseReport, BaseVelocity, MovableBase};
use crate::wire::base_drive::{
    DriveCommand, DriveReply, MAX_INTEGER, decode_reply, encode_command,
};
use kinematics::Stamp;
use std::io::ErrorKind;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};

/// How long a velocity lasts without a newer one. At 50 Hz, three commands in a row may be lost.
const VALID_SECS: f64 = 0.1;
/// Time between two repetitions of a stop that the base has confirmed. They keep its replies
/// coming.
const CONFIRMED_PERIOD_SECS: f64 = 0.09;
/// Maximum number of replies that are read at once.
const MAX_REPLIES: usize = 64;
/// Maximum length of a reply, bytes.
const MAX_REPLY_BYTES: usize = 2048;

/// A base that is driven over UDP. `docs/reference/udp.md` describes the datagrams.
#[derive(Debug)]
pub struct UdpDrivenBase {
    socket: UdpSocket,
    address: SocketAddr,
    session: u64,
    seq: u64,
    sent_at: Option<Stamp>,
    /// Number of the command with which the latest stop began: the first zero velocity after the
    /// last other velocity.
    stop_seq: Option<u64>,
    /// The newest reply, and when it arrived.
    reply: Option<(DriveReply, Stamp)>,
}

impl UdpDrivenBase {
    /// Opens a socket for a base at an address.
    ///
    /// * `session`: a number that no earlier program has used.
    ///
    /// # Errors
    /// If no socket can be opened.
    pub fn open(address: SocketAddr, session: u64) -> Result<Self, Error> {
        let own = match address {
            SocketAddr::V4(_) => SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
            SocketAddr::V6(_) => SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0)),
        };
        let opened = UdpSocket::bind(own).and_then(|socket| {
            // Datagrams of other senders are not read.
            socket.connect(address)?;
            socket.set_nonblocking(true)?;
            Ok(socket)
        });
        let socket = opened.map_err(|error| Error::BaseMotion {
            reason: format!("no datagrams can be sent to {address}: {error}"),
        })?;
        Ok(Self {
            socket,
            address,
            session: session & MAX_INTEGER,
            seq: 0,
            sent_at: None,
            stop_seq: None,
            reply: None,
        })
    }

    /// Number of the newest command.
    #[cfg(test)]
    pub(super) fn seq(&self) -> u64 {
        self.seq
    }

    fn is_stop_confirmed(&self) -> bool {
        let Some((reply, _)) = &self.reply else {
            return false;
        };
        reply.refusal.is_none() && self.stop_seq.is_some_and(|stop| reply.seq >= stop)
    }

    /// End of a velocity that is sent now, on the clock of the base. The time that the newest reply
    /// took is ignored, so the end is early by this time. A velocity therefore never lasts longer
    /// because of a delay.
    fn expires_nanos(&self, now: Stamp) -> Option<i64> {
        let (reply, received_at) = self.reply.as_ref()?;
        let base_now = Stamp(
            reply
                .stamp_nanos
                .saturating_add(now.nanos_since(*received_at)),
        );
        Some(base_now.plus_secs(VALID_SECS).0)
    }

    fn receive(&mut self, now: Stamp) {
        let mut bytes = [0; MAX_REPLY_BYTES];
        for _ in 0..MAX_REPLIES {
            // An error belongs to an earlier command, for example if no program listens on the
            // port. The chain of decisions detects that replies are missing.
            let Ok(n_bytes) = self.socket.recv(&mut bytes) else {
                return;
            };
            match decode_reply(&bytes[..n_bytes]) {
                Ok(reply) => self.take(reply, now),
                Err(error) => log::debug!("base at {}: {error}", self.address),
            }
        }
    }

    fn take(&mut self, reply: DriveReply, now: Stamp) {
        let is_own = reply.session == self.session && reply.seq <= self.seq;
        let is_newer = |(newest, _): &(DriveReply, Stamp)| reply.seq > newest.seq;
        if is_own && self.reply.as_ref().is_none_or(is_newer) {
            self.reply = Some((reply, now));
        }
    }
}

impl MovableBase for UdpDrivenBase {
    fn drive(&mut self, now: Stamp, velocity: &BaseVelocity) -> Result<(), Error> {
        // Without a reply, the clock of the base is not known, so no velocity could end.
        let expires_nanos = self.expires_nanos(now);
        let is_stop = *velocity == BaseVelocity::ZERO || expires_nanos.is_none();
        let is_due = |last: Stamp| now.secs_since(last).abs() >= CONFIRMED_PERIOD_SECS;
        if is_stop && self.is_stop_confirmed() && !self.sent_at.is_none_or(is_due) {
            return Ok(());
        }
        self.seq += 1;
        self.sent_at = Some(now);
        if is_stop {
            self.stop_seq.get_or_insert(self.seq);
        } else {
            self.stop_seq = None;
        }
        let command = DriveCommand {
            session: self.session,
            seq: self.seq,
            velocity: if is_stop {
                BaseVelocity::ZERO
            } else {
                *velocity
            },
            expires_nanos: expires_nanos.filter(|_| !is_stop),
        };
        match self.socket.send(&encode_command(&command)) {
            Ok(_) => Ok(()),
            // No program listens yet, or the queue is full. This needs no error, because the
            // missing replies of the base are noticed.
            Err(error)
                if matches!(
                    error.kind(),
                    ErrorKind::ConnectionRefused | ErrorKind::WouldBlock | ErrorKind::Interrupted
                ) =>
            {
                Ok(())
            }
            Err(error) => Err(Error::BaseMotion {
                reason: format!("{} cannot be reached: {error}", self.address),
            }),
        }
    }

    fn report(&mut self, now: Stamp) -> BaseReport {
        self.receive(now);
        let Some((reply, received_at)) = &self.reply else {
            return BaseReport::default();
        };
        BaseReport {
            reported_at: Some(*received_at),
            velocity: reply.velocity,
            is_stop_confirmed: self.is_stop_confirmed(),
            is_on_tour: false,
            fault: reply.fault.clone(),
            refusal: reply.refusal.clone(),
        }
    }
}
