//! The sockets of a played robot, and the thread that moves bytes between them and the robot a thousand times a second.

#[cfg(any(test, fuzzing))]
pub(crate) mod hostile;

use super::super::{N_JOINTS, realtime};
use super::message::{Command, Reply, Request};
use super::robot::Robot;
use super::{Owner, RobotConfig, Wanted};
use crate::{Error, clock};
use franka::FciVersion;
use franka::wire::robot::ConnectStatus;
use franka::wire::{HeaderLayout, ROBOT_HEADER_LEN};
use kinematics::Stamp;
use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// From state to state.
const STEP: Duration = Duration::from_millis(1);
/// States that are sent later rather than not at all where the player was not woken in time; longer gaps stay.
const MAX_BEHIND: Duration = Duration::from_millis(100);
/// No client asks for more in one message.
const MAX_MESSAGE_BYTES: usize = 1 << 16;
/// No command is longer; what is longer is none.
const MAX_COMMAND_BYTES: usize = 512;

/// A robot that takes clients, one at a time, until it is dropped.
#[derive(Debug)]
pub struct PlayedRobot {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PlayedRobot {
    /// Listens, and asks the owner where the joints are from now on.
    pub fn start(config: RobotConfig, mut owner: Owner) -> Result<Self, Error> {
        let device = "played robot".to_owned();
        let n = config.chain.n_joints();
        if n != N_JOINTS {
            let reason = format!("its chain has {n} joints, a Franka arm has {N_JOINTS}");
            return Err(Error::Fci { address: config.address.to_string(), reason });
        }
        let bind = || {
            let listener = TcpListener::bind(config.address)?;
            listener.set_nonblocking(true)?;
            let states = UdpSocket::bind((config.address.ip(), 0))?;
            states.set_nonblocking(true)?;
            Ok((listener.local_addr()?, listener, states))
        };
        let listen = |source| Error::Listen { device: device.clone(), address: config.address, source };
        let (address, listener, states) = bind().map_err(listen)?;
        let joints = owner(clock::now(), &Wanted::default());
        let stop = Arc::new(AtomicBool::new(false));
        let mut server = Server {
            listener,
            states,
            robot: Robot::new(config, joints),
            owner,
            client: None,
            stop: Arc::clone(&stop),
        };
        let thread = std::thread::Builder::new().name(device.clone()).spawn(move || server.run());
        let thread = thread.map_err(|source| Error::Thread { device, source })?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// Where it takes clients.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for PlayedRobot {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}

struct Server {
    listener: TcpListener,
    states: UdpSocket,
    robot: Robot,
    owner: Owner,
    client: Option<Client>,
    stop: Arc<AtomicBool>,
}

struct Client {
    stream: TcpStream,
    ip: IpAddr,
    /// Where states go, once it has said so.
    states_to: Option<SocketAddr>,
    /// What came of a message that is not complete.
    inbox: Vec<u8>,
}

/// The client has to go: it hung up, or talks nonsense.
struct Gone;

impl Server {
    fn run(&mut self) {
        realtime::claim("played robot");
        let began = clock::now();
        let mut n_steps: u32 = 0;
        // The robot has been on for a while.
        let mut number = 1_000_000;
        while !self.stop.load(Ordering::Relaxed) {
            let due = began + STEP * n_steps;
            let now = clock::now();
            let behind = now.duration_since(due);
            if behind > MAX_BEHIND {
                let n_skipped = u32::try_from(behind.as_millis()).unwrap_or(u32::MAX);
                (n_steps, number) = (n_steps.saturating_add(n_skipped), number + u64::from(n_skipped));
                continue;
            }
            std::thread::sleep(due.duration_since(now));
            // Before the last of several overdue states nobody can have answered.
            self.step(due, number, behind < STEP);
            (n_steps, number) = (n_steps.saturating_add(1), number + 1);
        }
    }

    /// One millisecond: hears what clients want, moves on, tells the state.
    fn step(&mut self, due: Stamp, number: u64, had_time: bool) {
        if let Some(mut client) = self.client.take() {
            match client.hear(&mut self.robot) {
                Ok(()) => self.client = Some(client),
                Err(Gone) => self.robot.abandon(),
            }
        }
        self.welcome();
        let command = self.newest_command(number - 1);
        let ended = self.robot.follow(command.as_ref(), had_time);
        let joints = (self.owner)(due, &self.robot.wanted);
        let hit = self.robot.observe(joints);
        if let Some(client) = &mut self.client {
            let told = ended.iter().chain(&hit).try_for_each(|reply| client.tell(reply));
            if told.is_err() {
                self.client = None;
                self.robot.abandon();
                return;
            }
            if let Some(states_to) = client.states_to {
                // A state that does not go out is a lost one.
                let _ = self.states.send_to(&self.robot.state(number), states_to);
            }
        }
    }

    /// Takes a client where there is none; others are sent away.
    fn welcome(&mut self) {
        while let Ok((stream, peer)) = self.listener.accept() {
            if self.client.is_some() {
                log::info!("played robot: {peer} is sent away, another client is there");
                continue;
            }
            if stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true)).is_ok() {
                self.client = Some(Client { stream, ip: peer.ip(), states_to: None, inbox: Vec::new() });
            }
        }
    }

    /// The client's answer to the state with that number, if it has come.
    fn newest_command(&self, number: u64) -> Option<Command> {
        let mut answer = None;
        let mut buffer = [0; MAX_COMMAND_BYTES];
        loop {
            match self.states.recv_from(&mut buffer) {
                Ok((n, from)) => {
                    let is_its = self.client.as_ref().is_some_and(|client| client.ip == from.ip());
                    let command = Command::decode(self.robot.config.version, &buffer[..n]);
                    answer = command.filter(|command| is_its && command.number == number).or(answer);
                }
                // Where a client closed its port a send before this one is told here.
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                Err(_) => return answer,
            }
        }
    }
}

impl Client {
    /// Reads what has come and answers.
    fn hear(&mut self, robot: &mut Robot) -> Result<(), Gone> {
        let mut buffer = [0; 4096];
        loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(Gone),
                Ok(n) => self.inbox.extend(&buffer[..n]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return Err(Gone),
            }
            while let Some((command, command_id, size)) = HeaderLayout::Robot.decode_header(&self.inbox) {
                let size = usize::try_from(size).unwrap_or(usize::MAX);
                if !(ROBOT_HEADER_LEN..=MAX_MESSAGE_BYTES).contains(&size) {
                    return Err(Gone);
                }
                if self.inbox.len() < size {
                    break;
                }
                let message: Vec<u8> = self.inbox.drain(..size).collect();
                self.answer(robot, command, command_id, &message[ROBOT_HEADER_LEN..])?;
            }
        }
    }

    fn answer(&mut self, robot: &mut Robot, command: u32, command_id: u32, payload: &[u8]) -> Result<(), Gone> {
        match Request::from_number(robot.config.version, command) {
            Some(Request::Connect) => self.connect(robot.config.version, command, command_id, payload),
            Some(request) if self.states_to.is_some() => {
                robot.answer(request, command, command_id, payload).iter().try_for_each(|reply| self.tell(reply))
            }
            _ => Err(Gone),
        }
    }

    fn connect(&mut self, version: FciVersion, command: u32, command_id: u32, payload: &[u8]) -> Result<(), Gone> {
        let [low, high, port_low, port_high] = *payload else { return Err(Gone) };
        let ours: u16 = match version {
            FciVersion::V5 => 5,
            FciVersion::V10 => 10,
        };
        let status = if u16::from_le_bytes([low, high]) == ours {
            self.states_to = Some(SocketAddr::new(self.ip, u16::from_le_bytes([port_low, port_high])));
            ConnectStatus::Success
        } else {
            ConnectStatus::IncompatibleLibraryVersion
        };
        let payload = [&[status.to_u8()][..], &ours.to_le_bytes()].concat();
        self.tell(&Reply { command, command_id, payload })
    }

    fn tell(&mut self, reply: &Reply) -> Result<(), Gone> {
        self.stream.write_all(&reply.bytes()).map_err(|_| Gone)
    }
}
