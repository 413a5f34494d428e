//! A serial port in raw mode, used by one program at a time.

use crate::Error;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fd::OwnedFd;
use rustix::fs::{FlockOperation, Mode, OFlags, flock};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, OptionalActions, QueueSelector, SpecialCodeIndex, ioctl_tiocexcl, ioctl_tiocnxcl,
    isatty, tcflush, tcgetattr, tcsetattr,
};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum time for the operating system to accept a packet. A packet has at most a few hundred
/// bytes, so a longer wait means that the adapter no longer works.
const MAX_SENDING: Duration = Duration::from_millis(500);
/// Largest difference between the requested and the actual baud rate. A receiver samples the tenth
/// bit of a byte wrongly if the rates differ by more than 5 %, and both sides may deviate.
const MAX_BAUD_ERROR_FRAC: f64 = 0.02;

/// Configuration of a serial port from the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct PortConfig {
    /// Path of the device, such as `/dev/serial/by-id/usb-1a86_USB_Single_Serial_5A46-if00`.
    pub device: PathBuf,
    /// Baud rate, bit/s.
    pub baud_hz: u32,
    /// How long the driver tries to reconnect after the adapter or the servos were disconnected.
    pub reconnect_for: Duration,
    /// Time that an answer may take in addition to its transmission.
    pub max_answer_delay: Duration,
}

impl PortConfig {
    /// The usual [`max_answer_delay`](Self::max_answer_delay). FTDI adapters hold received bytes for
    /// up to 16 ms by default. The rest is for a busy computer. With a longer wait, a servo that
    /// misses an instruction would delay the commands of the others.
    pub const MAX_ANSWER_DELAY: Duration = Duration::from_millis(40);
}

/// An open serial port: 8 data bits, no parity, 1 stop bit, no flow control. Dropping it releases
/// the port.
#[derive(Debug)]
pub(super) struct SerialPort {
    fd: OwnedFd,
    device: PathBuf,
}

impl SerialPort {
    /// Opens the port for exclusive use.
    ///
    /// # Errors
    /// If the port does not exist, may not be opened, is in use, or does not support the baud rate.
    pub(super) fn open(config: &PortConfig) -> Result<Self, Error> {
        let device = config.device.clone();
        let problem = |reason: String| Error::SerialPort {
            device: device.clone(),
            reason,
        };
        // Without `NONBLOCK`, opening a port could wait for a modem. Without `NOCTTY`, the port
        // could become the terminal that controls this process.
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let fd = rustix::fs::open(&config.device, flags, Mode::empty())
            .map_err(|errno| problem(open_problem(errno)))?;
        if !isatty(&fd) {
            return Err(problem("it is not a serial port".to_owned()));
        }
        // `flock` is the lock of pyserial and of many terminal programs. `TIOCEXCL` also keeps out
        // the programs that do not lock.
        flock(&fd, FlockOperation::NonBlockingLockExclusive)
            .map_err(|_| problem(in_use(&config.device)))?;
        let port = Self { fd, device };
        port.configure(config.baud_hz)?;
        Ok(port)
    }

    /// Path of the device as configured.
    pub(super) fn device(&self) -> &Path {
        &self.device
    }

    fn configure(&self, baud_hz: u32) -> Result<(), Error> {
        let unsupported = |error: Errno| {
            self.problem(format!(
                "cannot set it to {baud_hz} baud: {}",
                error_text(error)
            ))
        };
        ioctl_tiocexcl(&self.fd).map_err(unsupported)?;
        let mut settings = tcgetattr(&self.fd).map_err(unsupported)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
        settings.control_modes -= ControlModes::CSTOPB | ControlModes::CRTSCTS;
        // A read then returns an error if there is no data. The value 0 would hide a hangup.
        settings.special_codes[SpecialCodeIndex::VMIN] = 1;
        settings.special_codes[SpecialCodeIndex::VTIME] = 0;
        settings.set_speed(baud_hz).map_err(unsupported)?;
        tcsetattr(&self.fd, OptionalActions::Now, &settings).map_err(unsupported)?;
        // The kernel accepts any rate and sets the nearest one that the adapter supports.
        let actual_hz = tcgetattr(&self.fd).map_err(unsupported)?.output_speed();
        let error_frac = (f64::from(actual_hz) / f64::from(baud_hz) - 1.0).abs();
        if error_frac > MAX_BAUD_ERROR_FRAC {
            return Err(self.problem(format!(
                "it cannot be set to {baud_hz} baud; the nearest rate of the adapter is {actual_hz}"
            )));
        }
        tcflush(&self.fd, QueueSelector::IOFlush).map_err(unsupported)
    }

    /// Sends all bytes.
    ///
    /// # Errors
    /// If the port was disconnected or accepts no bytes.
    pub(super) fn write_all(&self, mut bytes: &[u8]) -> Result<(), Error> {
        let deadline = Instant::now() + MAX_SENDING;
        while !bytes.is_empty() {
            match rustix::io::write(&self.fd, bytes) {
                Ok(n) => bytes = &bytes[n..],
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => {
                    if !self.wait_for(PollFlags::OUT, deadline)? {
                        return Err(self.problem("it does not send".to_owned()));
                    }
                }
                Err(errno) => return Err(self.disconnected(errno)),
            }
        }
        Ok(())
    }

    /// Waits for bytes until the deadline, and appends them. Returns whether any arrived.
    ///
    /// # Errors
    /// If the port was disconnected.
    pub(super) fn read_into(&self, bytes: &mut Vec<u8>, deadline: Instant) -> Result<bool, Error> {
        let mut buffer = [0; 1024];
        loop {
            match rustix::io::read(&self.fd, &mut buffer) {
                // A port in raw mode reports its end only after a hangup.
                Ok(0) => return Err(self.disconnected(Errno::IO)),
                Ok(n) => {
                    bytes.extend_from_slice(&buffer[..n]);
                    return Ok(true);
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => {
                    if !self.wait_for(PollFlags::IN, deadline)? {
                        return Ok(false);
                    }
                }
                Err(errno) => return Err(self.disconnected(errno)),
            }
        }
    }

    /// Waits until the port is ready. Returns false after the deadline.
    fn wait_for(&self, flags: PollFlags, deadline: Instant) -> Result<bool, Error> {
        loop {
            let remaining = deadline.saturating_duration_since(Instant::now());
            let timeout = Timespec::try_from(remaining).unwrap_or_default();
            let mut ready = [PollFd::new(&self.fd, flags)];
            match poll(&mut ready, Some(&timeout)) {
                Ok(0) => return Ok(false),
                Ok(_) if ready[0].revents().intersects(flags) => return Ok(true),
                Ok(_) => return Err(self.disconnected(Errno::IO)),
                Err(Errno::INTR) => {}
                Err(errno) => return Err(self.disconnected(errno)),
            }
        }
    }

    fn disconnected(&self, errno: Errno) -> Error {
        self.problem(format!("it was disconnected ({})", error_text(errno)))
    }

    pub(super) fn problem(&self, reason: String) -> Error {
        Error::SerialPort {
            device: self.device.clone(),
            reason,
        }
    }
}

impl Drop for SerialPort {
    fn drop(&mut self) {
        // The flag belongs to the port and not to this program, so it would outlast it as long as
        // any program has the port open. If the port is gone, so is its flag.
        let _ = ioctl_tiocnxcl(&self.fd);
    }
}

fn error_text(errno: Errno) -> String {
    std::io::Error::from(errno).to_string()
}

fn in_use(device: &Path) -> String {
    format!(
        "another program uses it: end that program first; `fuser -v {}` names it",
        device.display()
    )
}

/// Why a port cannot be opened, and what to do.
fn open_problem(errno: Errno) -> String {
    let remedy = match errno {
        Errno::NOENT | Errno::NODEV | Errno::NXIO => {
            "connect the adapter; `fieldrig devices` lists serial ports"
        }
        Errno::ACCESS => {
            "add yourself to its group with `sudo usermod -aG dialout $USER`, then log in again"
        }
        Errno::BUSY => "another program uses it: end that program first",
        _ => "check the adapter and its cable",
    };
    format!("cannot open it ({}): {remedy}", error_text(errno))
}
