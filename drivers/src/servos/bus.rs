//! A bus of servos: sends instructions, waits for the answers, and counts what was lost.

use super::packet::{Instruction, PacketFormat, Scan, Status};
use super::serial::{PortConfig, SerialPort};
use crate::{Error, clock};
use kinematics::Stamp;
use std::path::Path;
use std::time::{Duration, Instant};

/// Start bit, eight data bits and stop bit.
const BITS_PER_BYTE: f64 = 10.0;
/// Default time between an instruction and the answer of a servo (registers "Return Delay Time").
const RETURN_DELAY: Duration = Duration::from_micros(500);
/// Number of attempts for reading or writing a register outside the cycle. A disturbed packet is
/// rare, so three in a row mean that the servo does not answer.
const N_ATTEMPTS: usize = 3;
/// Maximum number of reads that discard old bytes. Each reads up to 1024 bytes, and the buffer of a
/// terminal device in Linux holds 4096.
const MAX_FLUSHES: usize = 8;

/// What was lost on a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusCounts {
    /// Packets with a wrong checksum or CRC.
    pub n_corrupt: u64,
    /// Bytes that belong to no packet.
    pub n_garbage_bytes: u64,
    /// Answers that did not arrive in time.
    pub n_missing: u64,
}

impl std::fmt::Display for BusCounts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            n_corrupt,
            n_garbage_bytes,
            n_missing,
        } = self;
        write!(
            f,
            "{n_missing} missing answers, {n_corrupt} packets with a wrong checksum, {n_garbage_bytes} bytes of noise"
        )
    }
}

/// The answers to a sync read.
#[derive(Debug)]
pub struct SyncAnswers {
    /// Middle of the time between sending the instruction and receiving the last answer. The
    /// servos measured their values at about this time.
    pub stamp: Stamp,
    /// One answer per requested servo, in the order of the request; `None` if it is missing.
    pub statuses: Vec<Option<Status>>,
}

/// A bus of servos. Dropping it releases the port.
#[derive(Debug)]
pub struct ServoBus {
    port: SerialPort,
    format: &'static dyn PacketFormat,
    baud_hz: u32,
    max_answer_delay: Duration,
    /// Received bytes that were not decoded yet.
    received: Vec<u8>,
    counts: BusCounts,
    /// Whether all servos support the fast sync read.
    is_fast: bool,
}

impl ServoBus {
    /// Opens the port. Nothing is sent.
    ///
    /// # Errors
    /// If the port cannot be opened or is in use.
    pub fn open(config: &PortConfig, format: &'static dyn PacketFormat) -> Result<Self, Error> {
        Ok(Self {
            port: SerialPort::open(config)?,
            format,
            baud_hz: config.baud_hz,
            max_answer_delay: config.max_answer_delay,
            received: Vec::new(),
            counts: BusCounts::default(),
            is_fast: false,
        })
    }

    /// Path of the port.
    pub fn device(&self) -> &Path {
        self.port.device()
    }

    /// What was lost so far.
    pub fn counts(&self) -> BusCounts {
        self.counts
    }

    /// Uses fast sync reads from now on if all of these servos support them.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub(super) fn probe_fast_reads(
        &mut self,
        address: u16,
        len: u16,
        ids: &[u8],
    ) -> Result<(), Error> {
        let counts = self.counts;
        self.is_fast = true;
        let answers = self.sync_read(address, len, ids)?;
        self.is_fast = !answers.statuses.contains(&None);
        // Servos with older firmware do not answer, which is not a loss.
        self.counts = counts;
        Ok(())
    }

    /// Asks a servo for its presence, once. `None` if it does not answer.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub fn ping(&mut self, id: u8) -> Result<Option<Status>, Error> {
        let mut statuses = self.exchange(id, &Instruction::Ping, &[id])?;
        Ok(statuses.pop().flatten())
    }

    /// Reads registers of a servo. `None` if it does not answer.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub fn read(&mut self, id: u8, address: u16, len: u16) -> Result<Option<Status>, Error> {
        for _ in 0..N_ATTEMPTS {
            let status = self.read_once(id, address, len)?;
            if status.is_some() {
                return Ok(status);
            }
        }
        Ok(None)
    }

    /// Reads registers of a servo, without another attempt. `None` if it does not answer.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub(super) fn read_once(
        &mut self,
        id: u8,
        address: u16,
        len: u16,
    ) -> Result<Option<Status>, Error> {
        let instruction = Instruction::Read { address, len };
        let status = self.exchange(id, &instruction, &[id])?.pop().flatten();
        Ok(status.filter(|status| status.data.len() == usize::from(len)))
    }

    /// Writes registers of a servo and reads them back. Returns the contents; `None` if the servo
    /// does not answer.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub fn write(&mut self, id: u8, address: u16, data: &[u8]) -> Result<Option<Vec<u8>>, Error> {
        let len = u16::try_from(data.len()).unwrap_or(u16::MAX);
        let mut contents = None;
        for _ in 0..N_ATTEMPTS {
            // A servo may be configured to answer only reads, so a missing answer does not matter.
            self.exchange(id, &Instruction::Write { address, data }, &[id])?;
            contents = self.read(id, address, len)?.map(|status| status.data);
            if contents.as_deref() == Some(data) {
                break;
            }
        }
        Ok(contents)
    }

    /// Reads the same registers of several servos.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub fn sync_read(&mut self, address: u16, len: u16, ids: &[u8]) -> Result<SyncAnswers, Error> {
        let instruction = if self.is_fast {
            Instruction::FastSyncRead { address, len, ids }
        } else {
            Instruction::SyncRead { address, len, ids }
        };
        let sent = clock::now();
        let mut statuses = self.exchange(0, &instruction, ids)?;
        let received = clock::now();
        for status in &mut statuses {
            // An answer of another length belongs to an earlier instruction.
            if status
                .as_ref()
                .is_some_and(|status| status.data.len() != usize::from(len))
            {
                *status = None;
            }
        }
        let stamp = Stamp(sent.0 + received.0.saturating_sub(sent.0) / 2);
        Ok(SyncAnswers { stamp, statuses })
    }

    /// Writes the same registers of several servos, which do not answer.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub fn sync_write(&mut self, address: u16, values: &[(u8, Vec<u8>)]) -> Result<(), Error> {
        self.send(0, &Instruction::SyncWrite { address, values })
    }

    /// Time that instructions and their answers take on the bus, without delays of the computer.
    pub(super) fn duration(&self, instructions: &[Instruction<'_>]) -> Duration {
        let duration = |instruction: &Instruction<'_>| {
            let n_sent = self.format.encode(1, instruction).len();
            let n_answers = match instruction {
                Instruction::SyncRead { ids, .. } | Instruction::FastSyncRead { ids, .. } => {
                    ids.len()
                }
                Instruction::SyncWrite { .. } => 0,
                _ => 1,
            };
            self.transmission(n_sent + self.format.answer_bytes(instruction))
                + RETURN_DELAY * u32::try_from(n_answers).unwrap_or(u32::MAX)
        };
        instructions.iter().map(duration).sum()
    }

    fn transmission(&self, n_bytes: usize) -> Duration {
        Duration::from_secs_f64(BITS_PER_BYTE * n_bytes as f64 / f64::from(self.baud_hz))
    }

    /// Sends an instruction and waits for an answer of each of `ids`.
    fn exchange(
        &mut self,
        id: u8,
        instruction: &Instruction<'_>,
        ids: &[u8],
    ) -> Result<Vec<Option<Status>>, Error> {
        self.send(id, instruction)?;
        let deadline = Instant::now() + self.duration(&[*instruction]) + self.max_answer_delay;
        let len = match instruction {
            Instruction::Read { len, .. }
            | Instruction::SyncRead { len, .. }
            | Instruction::FastSyncRead { len, .. } => *len,
            _ => 0,
        };
        let mut statuses = vec![None; ids.len()];
        while statuses.contains(&None) {
            match self.format.decode(&self.received, len) {
                Scan::Packet {
                    statuses: answers,
                    n_bytes,
                } => {
                    self.received.drain(..n_bytes);
                    for answer in answers {
                        // Other servos do not answer, but a late answer may still arrive.
                        if let Some(ix) = ids.iter().position(|id| *id == answer.id) {
                            statuses[ix] = Some(answer);
                        }
                    }
                }
                Scan::Corrupt { n_bytes } => {
                    self.received.drain(..n_bytes);
                    self.counts.n_corrupt += 1;
                }
                Scan::Garbage { n_bytes } => {
                    self.received.drain(..n_bytes);
                    self.counts.n_garbage_bytes += n_bytes as u64;
                }
                // After the deadline, the rest of this packet no longer arrives. Its header may
                // have been noise in front of an answer, so the search continues in the other
                // bytes. The time is checked here, because noise that never ends must not delay the
                // caller.
                Scan::Incomplete if Instant::now() >= deadline => {
                    if self.received.is_empty() {
                        break;
                    }
                    self.received.remove(0);
                    self.counts.n_garbage_bytes += 1;
                }
                Scan::Incomplete => {
                    self.port.read_into(&mut self.received, deadline)?;
                }
            }
        }
        self.counts.n_missing += statuses.iter().filter(|status| status.is_none()).count() as u64;
        Ok(statuses)
    }

    fn send(&mut self, id: u8, instruction: &Instruction<'_>) -> Result<(), Error> {
        // Bytes that arrive before the instruction cannot be its answer. They come from a late
        // answer or from noise. Noise that never ends must not delay the instruction.
        for _ in 0..MAX_FLUSHES {
            if !self.port.read_into(&mut self.received, Instant::now())? {
                break;
            }
        }
        self.counts.n_garbage_bytes += self.received.len() as u64;
        self.received.clear();
        self.port.write_all(&self.format.encode(id, instruction))
    }
}
