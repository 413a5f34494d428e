//! Emulated servos behind a pseudo terminal, which programs open like a serial port.

use super::instruction::{self, ReceivedInstruction};
use super::servo::{EmulatedServo, ServoKind};
use crate::servos::packet::BROADCAST;
use crate::{Error, clock};
use kinematics::Stamp;
use parking_lot::{Mutex, MutexGuard};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Time without a client or without instructions after which the thread checks whether it should
/// end.
const POLL: Duration = Duration::from_millis(5);

/// Disturbances of the answers. Each count is the number of answers from one disturbance to the
/// next; 0 means never.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disturbance {
    /// Bytes of noise before the answer.
    pub noise_every: u64,
    /// One damaged byte in the answer.
    pub damaged_every: u64,
    /// No answer.
    pub missing_every: u64,
}

/// The servos on a bus, and how their answers are disturbed.
#[derive(Debug)]
pub struct ServoLine {
    /// The servos.
    pub servos: Vec<EmulatedServo>,
    /// How answers are disturbed.
    pub disturbance: Disturbance,
    /// Whether Dynamixel servos answer fast sync reads. Older firmware does not.
    pub has_fast_reads: bool,
    kind: ServoKind,
    n_answers: u64,
    n_fast_reads: u64,
}

/// Servos on a pseudo terminal. Dropping it unplugs the adapter.
#[derive(Debug)]
pub struct EmulatedServoBus {
    line: Arc<Mutex<ServoLine>>,
    link: PathBuf,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl EmulatedServoBus {
    /// Emulates servos at the path `link`, which becomes a symbolic link to a pseudo terminal.
    ///
    /// * `script`: called before each instruction, with the current time. It may move the servos.
    ///
    /// # Errors
    /// If no pseudo terminal is left, or the link cannot be created.
    pub fn start(
        kind: ServoKind,
        servos: Vec<EmulatedServo>,
        link: &Path,
        script: impl FnMut(Stamp, &mut [EmulatedServo]) + Send + 'static,
    ) -> Result<Self, Error> {
        let line = ServoLine {
            servos,
            disturbance: Disturbance::default(),
            has_fast_reads: true,
            kind,
            n_answers: 0,
            n_fast_reads: 0,
        };
        let problem = |error: std::io::Error| Error::SerialPort {
            device: link.to_owned(),
            reason: format!("cannot emulate it: {error}"),
        };
        let (master, name) = open_terminal().map_err(|errno| problem(errno.into()))?;
        // The link may remain from an emulation that was killed.
        if link.is_symlink() {
            std::fs::remove_file(link).map_err(problem)?;
        }
        std::os::unix::fs::symlink(name, link).map_err(problem)?;
        let line = Arc::new(Mutex::new(line));
        let stop = Arc::new(AtomicBool::new(false));
        let server = Server {
            master,
            line: Arc::clone(&line),
            stop: Arc::clone(&stop),
            script,
        };
        let device = format!("emulated servos at {}", link.display());
        let thread = std::thread::Builder::new()
            .name("emulated servos".to_owned())
            .spawn(move || server.run())
            .map_err(|source| Error::Thread { device, source })?;
        Ok(Self {
            line,
            link: link.to_owned(),
            stop,
            thread: Some(thread),
        })
    }

    /// The servos, simulated up to now.
    pub fn line(&self) -> MutexGuard<'_, ServoLine> {
        let mut line = self.line.lock();
        let now = clock::now();
        line.servos.iter_mut().for_each(|servo| servo.advance(now));
        line
    }

    /// Unplugs the adapter, and returns its servos.
    pub fn unplug(self) -> Vec<EmulatedServo> {
        self.line().servos.clone()
    }
}

impl Drop for EmulatedServoBus {
    fn drop(&mut self) {
        // The link is removed first, so that a client does not find a port that just ended.
        let _ = std::fs::remove_file(&self.link);
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}

/// Opens a pseudo terminal. Returns its controlling side, and the path of the other side.
fn open_terminal() -> rustix::io::Result<(OwnedFd, PathBuf)> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    let name = ptsname(&master, Vec::new())?;
    let name = std::ffi::OsString::from_vec(name.into_bytes());
    // A client that does not read must not block the servos: its bytes are lost, as on a wire.
    rustix::io::ioctl_fionbio(&master, true)?;
    Ok((master, name.into()))
}

struct Server<F> {
    master: OwnedFd,
    line: Arc<Mutex<ServoLine>>,
    stop: Arc<AtomicBool>,
    script: F,
}

impl<F: FnMut(Stamp, &mut [EmulatedServo])> Server<F> {
    fn run(mut self) {
        let mut received = Vec::new();
        let mut buffer = [0; 1024];
        while !self.stop.load(Ordering::Relaxed) {
            let timeout = Timespec::try_from(POLL).unwrap_or_default();
            let mut ready = [PollFd::new(&self.master, PollFlags::IN)];
            let _ = poll(&mut ready, Some(&timeout));
            match rustix::io::read(&self.master, &mut buffer) {
                Ok(n) if n > 0 => received.extend_from_slice(&buffer[..n]),
                // Without a client, reading fails at once.
                _ => {
                    received.clear();
                    std::thread::sleep(Duration::from_millis(1));
                    continue;
                }
            }
            let mut line = self.line.lock();
            let kind = line.kind;
            while let Some(instruction) = instruction::take(kind, &mut received) {
                let now = clock::now();
                (self.script)(now, &mut line.servos);
                line.servos.iter_mut().for_each(|servo| servo.advance(now));
                for packet in line.answers(&instruction, now) {
                    let _ = rustix::io::write(&self.master, &packet);
                }
            }
        }
    }
}

impl ServoLine {
    /// Number of fast sync reads that were answered.
    pub fn n_fast_reads(&self) -> u64 {
        self.n_fast_reads
    }

    /// The packets that answer an instruction.
    fn answers(&mut self, instruction: &ReceivedInstruction, now: Stamp) -> Vec<Vec<u8>> {
        let packets = self.undisturbed_answers(instruction, now);
        packets
            .into_iter()
            .filter_map(|packet| self.disturbed(packet))
            .collect()
    }

    fn undisturbed_answers(
        &mut self,
        instruction: &ReceivedInstruction,
        now: Stamp,
    ) -> Vec<Vec<u8>> {
        let kind = self.kind;
        let ReceivedInstruction {
            id,
            code,
            parameters,
        } = instruction;
        let id = *id;
        match code {
            0x82 | 0x8A => self.sync_read(*code == 0x8A, parameters, now),
            0x83 => {
                self.sync_write(parameters, now);
                Vec::new()
            }
            _ => self
                .servos
                .iter_mut()
                .filter(|servo| servo.is_powered() && (id == servo.id() || id == BROADCAST))
                .filter_map(|servo| {
                    servo.reset_watchdog(now);
                    let (error, data) = single(kind, servo, *code, parameters)?;
                    // Only pings are answered if they are for all servos.
                    (id != BROADCAST || *code == 1)
                        .then(|| instruction::answer(kind, servo.id(), error, &data))
                })
                .collect(),
        }
    }

    fn sync_read(&mut self, is_fast: bool, parameters: &[u8], now: Stamp) -> Vec<Vec<u8>> {
        let Some((address, len, ids)) = range(self.kind, parameters) else {
            return Vec::new();
        };
        if is_fast && !(self.has_fast_reads && self.kind == ServoKind::Dynamixel) {
            return Vec::new();
        }
        let mut answers = Vec::new();
        for id in ids {
            let mut powered = self.servos.iter_mut().filter(|servo| servo.is_powered());
            if let Some(servo) = powered.find(|servo| servo.id() == *id) {
                servo.reset_watchdog(now);
                answers.push((servo.error(), *id, servo.read(address, len)));
            }
        }
        if !is_fast {
            let packet = |(error, id, data): (u8, u8, Vec<u8>)| {
                instruction::answer(self.kind, id, error, &data)
            };
            return answers.into_iter().map(packet).collect();
        }
        // Each servo adds its part to a packet whose length is known in advance, so one missing
        // servo spoils the packet.
        if answers.len() < ids.len() {
            return Vec::new();
        }
        self.n_fast_reads += 1;
        vec![instruction::fast_answer(&answers)]
    }

    fn sync_write(&mut self, parameters: &[u8], now: Stamp) {
        let Some((address, len, values)) = range(self.kind, parameters) else {
            return;
        };
        for value in values.chunks_exact(usize::from(len) + 1) {
            let mut powered = self.servos.iter_mut().filter(|servo| servo.is_powered());
            if let Some(servo) = powered.find(|servo| servo.id() == value[0]) {
                servo.reset_watchdog(now);
                servo.write(address, &value[1..]);
            }
        }
    }

    /// Disturbs an answer; `None` if it is lost.
    fn disturbed(&mut self, mut packet: Vec<u8>) -> Option<Vec<u8>> {
        self.n_answers += 1;
        let is_due = |every: u64| every > 0 && self.n_answers.is_multiple_of(every);
        let Disturbance {
            noise_every,
            damaged_every,
            missing_every,
        } = self.disturbance;
        if is_due(missing_every) {
            return None;
        }
        if is_due(damaged_every) {
            let middle = packet.len() / 2;
            packet[middle] ^= 0x24;
        }
        if is_due(noise_every) {
            // The noise contains headers, so that it looks like packets.
            let noise = [0x00, 0xFF, 0xFF, 0x07, 0x9A, 0xFF, 0xFF, 0xFD, 0x00, 0x31];
            packet.splice(0..0, noise);
        }
        Some(packet)
    }
}

/// Executes an instruction to one servo. Returns the error byte and the data of its answer; `None`
/// for an unknown instruction.
fn single(
    kind: ServoKind,
    servo: &mut EmulatedServo,
    code: u8,
    parameters: &[u8],
) -> Option<(u8, Vec<u8>)> {
    let n_address = match kind {
        ServoKind::Feetech => 1,
        ServoKind::Dynamixel => 2,
    };
    match code {
        1 if kind == ServoKind::Feetech => Some((servo.error(), Vec::new())),
        1 => {
            let version = [servo.read(0, 2), servo.read(6, 1)].concat();
            Some((servo.error(), version))
        }
        2 => {
            let (address, len, _) = range(kind, parameters)?;
            Some((servo.error(), servo.read(address, len)))
        }
        3 => {
            let (address, data) = parameters.split_at_checked(n_address)?;
            Some((servo.write(number(address), data), Vec::new()))
        }
        _ => None,
    }
}

/// Address and number of bytes at the start of the parameters, and the rest.
fn range(kind: ServoKind, parameters: &[u8]) -> Option<(u16, u16, &[u8])> {
    let n = match kind {
        ServoKind::Feetech => 1,
        ServoKind::Dynamixel => 2,
    };
    let (address, rest) = parameters.split_at_checked(n)?;
    let (len, rest) = rest.split_at_checked(n)?;
    Some((number(address), number(len), rest))
}

/// A little-endian number of one or two bytes.
fn number(bytes: &[u8]) -> u16 {
    let byte = |ix: usize| bytes.get(ix).copied().unwrap_or(0);
    u16::from_le_bytes([byte(0), byte(1)])
}
