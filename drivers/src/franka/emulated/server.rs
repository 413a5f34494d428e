//! The sockets of an emulated robot, and the thread that serves them a thousand times per second.

#[cfg(any(test, fuzzing))]
pub(crate) mod fuzz;

use super::super::{N_JOINTS, realtime};
use super::message::{Command, Reply, Request};
use super::robot::Robot;
use super::{CommandedJoints, JointSimulator, RobotConfig};
use crate::{Error, clock};
use franka::FciVersion;
use franka::wire::robot::ConnectStatus;
use franka::wire::{HeaderLayout, ROBOT_HEADER_LEN};
use kinematics::Stamp;
use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Interval between states.
const STEP: Duration = Duration::from_millis(1);
/// Maximum lag of the thread. States with a smaller lag are sent late; states with a larger lag are
/// skipped. The receive buffer of a client holds about 40 states. For each late state of a motion,
/// the motion is extrapolated, which a real robot does for 20 states at most.
const MAX_LAG: Duration = Duration::from_millis(20);
/// Maximum message size. Real clients stay far below it.
const MAX_MESSAGE_BYTES: usize = 1 << 16;
/// Maximum command size; longer datagrams are not commands.
const MAX_COMMAND_BYTES: usize = 512;

/// An emulated robot that serves clients, one at a time, until it is dropped.
#[derive(Debug)]
pub struct EmulatedRobot {
    address: SocketAddr,
    n_states_sent: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl EmulatedRobot {
    /// Starts listening. From then on, `joint_simulator` is called for the joint states.
    pub fn start(config: RobotConfig, joint_simulator: JointSimulator) -> Result<Self, Error> {
        Self::start_waiting(config, Duration::ZERO, joint_simulator)
    }

    /// Like [`start`](Self::start), but a motion waits up to `answer_wait` for the answer to each
    /// state. On a real robot, an answer must arrive within a millisecond. Tests wait longer, so
    /// that their motions do not depend on the load of the machine.
    pub fn start_waiting(
        config: RobotConfig,
        answer_wait: Duration,
        mut joint_simulator: JointSimulator,
    ) -> Result<Self, Error> {
        let device = "emulated robot".to_owned();
        let n = config.chain.n_joints();
        if n != N_JOINTS {
            let reason = format!("its chain has {n} joints, but a Franka arm has {N_JOINTS}");
            return Err(Error::Fci {
                address: config.address.to_string(),
                reason,
            });
        }
        let (address, listener, states) = bind(config.address).map_err(|source| Error::Listen {
            device: device.clone(),
            address: config.address,
            source,
        })?;
        let joints = joint_simulator(clock::now(), &CommandedJoints::default());
        let n_states_sent: Arc<AtomicU64> = Arc::default();
        let stop = Arc::new(AtomicBool::new(false));
        let mut server = Server {
            listener,
            states,
            robot: Robot::new(config, joints),
            joint_simulator,
            answer_wait,
            client: None,
            n_states_sent: Arc::clone(&n_states_sent),
            stop: Arc::clone(&stop),
        };
        let thread = std::thread::Builder::new()
            .name(device.clone())
            .spawn(move || server.run());
        let thread = thread.map_err(|source| Error::Thread { device, source })?;
        Ok(Self {
            address,
            n_states_sent,
            stop,
            thread: Some(thread),
        })
    }

    /// Address on which it accepts clients.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Number of states that it has sent to its clients. A state that was due while its thread
    /// stalled is not sent.
    pub fn n_states_sent(&self) -> u64 {
        self.n_states_sent.load(Ordering::Relaxed)
    }
}

impl Drop for EmulatedRobot {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}

/// Opens the sockets for clients and for states. Returns them with the address for clients.
fn bind(address: SocketAddr) -> std::io::Result<(SocketAddr, TcpListener, UdpSocket)> {
    let listener = TcpListener::bind(address)?;
    // One thread serves both sockets in every millisecond, so neither may block it.
    listener.set_nonblocking(true)?;
    let states = UdpSocket::bind((address.ip(), 0))?;
    states.set_nonblocking(true)?;
    Ok((listener.local_addr()?, listener, states))
}

struct Server {
    listener: TcpListener,
    states: UdpSocket,
    robot: Robot,
    joint_simulator: JointSimulator,
    /// Maximum time by which an answer may be late during a motion.
    answer_wait: Duration,
    client: Option<Client>,
    n_states_sent: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
}

struct Client {
    stream: TcpStream,
    ip: IpAddr,
    /// Destination of the states, once the client has sent it.
    states_to: Option<SocketAddr>,
    /// Received bytes of an incomplete message.
    buffer_in: Vec<u8>,
}

/// The client must be dropped: it disconnected, or sent an invalid message.
struct Disconnected;

impl Server {
    fn run(&mut self) {
        realtime::request_realtime("emulated robot");
        let start_time = clock::now();
        let mut n_steps: u32 = 0;
        // The numbers start as if the robot had been on for a while.
        let mut number = 1_000_000;
        while !self.stop.load(Ordering::Relaxed) {
            // The due time is computed from the start time, so that late steps do not delay all
            // later steps.
            let due = start_time + STEP * n_steps;
            let now = clock::now();
            let lag = now.duration_since(due);
            let max_lag = if self.robot.commanded.is_moving && !self.answer_wait.is_zero() {
                // The robot also waits for the answers to late states.
                Duration::MAX
            } else {
                MAX_LAG
            };
            if lag > max_lag {
                let n_skipped = u32::try_from(lag.as_millis()).unwrap_or(u32::MAX);
                // The numbers of skipped states are skipped, too. Clients thus count them as lost,
                // and the clock of the robot stays correct.
                n_steps = n_steps.saturating_add(n_skipped);
                number += u64::from(n_skipped);
                continue;
            }
            std::thread::sleep(due.duration_since(now));
            self.step(due, number, lag >= STEP);
            n_steps = n_steps.saturating_add(1);
            number += 1;
        }
    }

    /// Simulates one millisecond: handles requests, advances the motion, sends the state.
    fn step(&mut self, due: Stamp, number: u64, is_late: bool) {
        let wait = if self.robot.commanded.is_moving {
            self.answer_wait
        } else {
            Duration::ZERO
        };
        if let Some(mut client) = self.client.take() {
            match client.read_requests(&mut self.robot) {
                Ok(()) => self.client = Some(client),
                Err(Disconnected) => self.robot.abandon(),
            }
        }
        self.accept_client();
        // First, the answer to the last state moves the joints. Only then is the next state sent.
        let command = self.command(number - 1, wait);
        // If several states are overdue, only the last one can have been answered.
        let could_answer = !is_late || !wait.is_zero();
        let finished = self.robot.follow(command.as_ref(), could_answer);
        let joints = (self.joint_simulator)(due, &self.robot.commanded);
        // The simulator gets the new commanded positions before the robot reads the joints, as a
        // real arm follows its commands.
        let contact = self.robot.observe(joints);
        if let Some(client) = &mut self.client {
            let sent = finished
                .iter()
                .chain(&contact)
                .try_for_each(|reply| client.send(reply));
            if sent.is_err() {
                self.client = None;
                self.robot.abandon();
                return;
            }
            if let Some(states_to) = client.states_to {
                // If a state cannot be sent, the client notices the gap in the numbers.
                let sent = self.states.send_to(&self.robot.state(number), states_to);
                self.n_states_sent
                    .fetch_add(u64::from(sent.is_ok()), Ordering::Relaxed);
            }
        }
    }

    /// Accepts a client if there is none; rejects others.
    fn accept_client(&mut self) {
        while let Ok((stream, peer)) = self.listener.accept() {
            if self.client.is_some() {
                log::info!("emulated robot: rejected {peer}, another client is connected");
                continue;
            }
            if stream
                .set_nonblocking(true)
                // Small replies must not wait for more data.
                .and_then(|()| stream.set_nodelay(true))
                .is_ok()
            {
                self.client = Some(Client {
                    stream,
                    ip: peer.ip(),
                    states_to: None,
                    buffer_in: Vec::new(),
                });
            }
        }
    }

    /// The client's answer to the state with this number, if it arrives within `wait`. A datagram
    /// that is not a command ends the wait.
    fn command(&self, number: u64, wait: Duration) -> Option<Command> {
        const POLL: Duration = Duration::from_micros(100);
        let deadline = clock::now() + wait;
        let mut received = self.receive(number);
        while received.is_none() && clock::now() < deadline && !self.stop.load(Ordering::Relaxed) {
            std::thread::sleep(POLL);
            received = self.receive(number);
        }
        received.flatten()
    }

    /// Reads the datagrams that have arrived. Returns the client's answer to the state with this
    /// number, `Some(None)` if there is only a datagram that is not a command, and `None` if there
    /// is neither.
    fn receive(&self, number: u64) -> Option<Option<Command>> {
        let mut received = None;
        let mut buffer = [0; MAX_COMMAND_BYTES];
        loop {
            match self.states.recv_from(&mut buffer) {
                Ok((n, from)) => {
                    let is_from_client = self
                        .client
                        .as_ref()
                        .is_some_and(|client| client.ip == from.ip());
                    // Answers to earlier states are too late. The last one with the right number
                    // counts.
                    match Command::decode(self.robot.config.version, &buffer[..n]) {
                        Some(command) if is_from_client && command.number == number => {
                            received = Some(Some(command))
                        }
                        Some(_) => {}
                        None => received = received.or(Some(None)),
                    }
                }
                // If a client has closed its port, the error of an earlier send is reported here.
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                Err(_) => return received,
            }
        }
    }
}

impl Client {
    /// Reads and answers the available requests.
    fn read_requests(&mut self, robot: &mut Robot) -> Result<(), Disconnected> {
        let mut buffer = [0; 4096];
        loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(Disconnected),
                Ok(n) => self.buffer_in.extend(&buffer[..n]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return Err(Disconnected),
            }
            while let Some((command, command_id, size)) =
                HeaderLayout::Robot.decode_header(&self.buffer_in)
            {
                let size = usize::try_from(size).unwrap_or(usize::MAX);
                // The size comes from the client, so it is checked before anything waits for that
                // many bytes.
                if !(ROBOT_HEADER_LEN..=MAX_MESSAGE_BYTES).contains(&size) {
                    return Err(Disconnected);
                }
                // TCP may deliver a message in parts. The rest comes with a later step.
                if self.buffer_in.len() < size {
                    break;
                }
                let message: Vec<u8> = self.buffer_in.drain(..size).collect();
                self.answer(robot, command, command_id, &message[ROBOT_HEADER_LEN..])?;
            }
        }
    }

    fn answer(
        &mut self,
        robot: &mut Robot,
        command: u32,
        command_id: u32,
        payload: &[u8],
    ) -> Result<(), Disconnected> {
        match Request::from_number(robot.config.version, command) {
            Some(Request::Connect) => {
                self.connect(robot.config.version, command, command_id, payload)
            }
            // Other requests are only allowed after the versions were compared.
            Some(request) if self.states_to.is_some() => robot
                .answer(request, command, command_id, payload)
                .iter()
                .try_for_each(|reply| self.send(reply)),
            _ => Err(Disconnected),
        }
    }

    fn connect(
        &mut self,
        version: FciVersion,
        command: u32,
        command_id: u32,
        payload: &[u8],
    ) -> Result<(), Disconnected> {
        let [low, high, port_low, port_high] = *payload else {
            return Err(Disconnected);
        };
        let supported_version: u16 = match version {
            FciVersion::V5 => 5,
            FciVersion::V10 => 10,
        };
        let status = if u16::from_le_bytes([low, high]) == supported_version {
            self.states_to = Some(SocketAddr::new(
                self.ip,
                u16::from_le_bytes([port_low, port_high]),
            ));
            ConnectStatus::Success
        } else {
            ConnectStatus::IncompatibleLibraryVersion
        };
        let payload = [&[status.to_u8()][..], &supported_version.to_le_bytes()].concat();
        self.send(&Reply {
            command,
            command_id,
            payload,
        })
    }

    fn send(&mut self, reply: &Reply) -> Result<(), Disconnected> {
        self.stream
            .write_all(&reply.bytes())
            .map_err(|_| Disconnected)
    }
}
