//! The sockets of an emulated controller, and the thread that serves them once per cycle.

use super::super::address::Interface;
use super::client::{Client, SentState};
use super::lines::{LineServer, take_line, take_program};
use super::robot::Robot;
use super::{CommandedJoints, ControllerConfig, JointSimulator, Modes, N_JOINTS};
use crate::{Error, clock};
use kinematics::Stamp;
use parking_lot::Mutex;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum lag of the thread. States with a smaller lag are sent late; those with a larger lag are
/// skipped, as on a controller that lacks computation time.
const MAX_LAG: Duration = Duration::from_millis(100);
/// Time since the start of the controller at its first cycle. It is not zero, because a client
/// always meets a controller that has been running.
const FIRST_TIMESTAMP_SECS: f64 = 100.0;
/// First line of a dashboard server.
const GREETING: &str = "Connected: Universal Robots Dashboard Server\n";

/// An emulated controller that serves clients until it is dropped.
#[derive(Debug)]
pub struct EmulatedController {
    address: SocketAddr,
    controls: Arc<Mutex<Controls>>,
    thread: Option<JoinHandle<()>>,
}

/// What the owner of the controller changes and reads.
#[derive(Debug, Default)]
struct Controls {
    /// Modes to set.
    modes: Option<Modes>,
    commanded: CommandedJoints,
    /// Bytes to send to all clients, between two states.
    injected: Vec<u8>,
    /// Whether to close the connections of all clients.
    disconnects: bool,
    /// Whether the controller sends no states.
    is_silent: bool,
    n_states_sent: u64,
    stop: bool,
}

impl EmulatedController {
    /// Starts listening. From then on, `joint_simulator` is called for the joint states.
    pub fn start(config: ControllerConfig, joint_simulator: JointSimulator) -> Result<Self, Error> {
        Self::start_waiting(config, Duration::ZERO, joint_simulator)
    }

    /// Like [`start`](Self::start), but a program that follows setpoints waits up to `answer_wait`
    /// for the setpoint after each state, and follows one setpoint per cycle. A real controller
    /// does not wait. Tests wait, so that their motions do not depend on the load of the machine.
    pub fn start_waiting(
        config: ControllerConfig,
        answer_wait: Duration,
        mut joint_simulator: JointSimulator,
    ) -> Result<Self, Error> {
        let device = "emulated controller".to_owned();
        let address = config.address;
        let n = config.chain.n_joints();
        if n != N_JOINTS {
            return Err(Error::Rtde {
                address: address.to_string(),
                reason: format!("its chain has {n} joints, but an arm has {N_JOINTS}"),
            });
        }
        let listen = |interface| {
            let address = interface_address(address, interface);
            bind(address).map_err(|source| Error::Listen {
                device: device.clone(),
                address,
                source,
            })
        };
        let rtde = listen(Interface::Rtde)?;
        let scripts = LineServer::new(listen(Interface::Script)?, "");
        let dashboard = LineServer::new(listen(Interface::Dashboard)?, GREETING);
        let start = joint_simulator(clock::now(), &CommandedJoints::default());
        let controls: Arc<Mutex<Controls>> = Arc::default();
        let mut server = Server {
            robot: Robot::new(&config, start, FIRST_TIMESTAMP_SECS),
            config,
            answer_wait,
            joint_simulator,
            rtde,
            scripts,
            dashboard,
            clients: Vec::new(),
            controls: Arc::clone(&controls),
        };
        let thread = std::thread::Builder::new()
            .name(device.clone())
            .spawn(move || server.run());
        let thread = thread.map_err(|source| Error::Thread { device, source })?;
        Ok(Self {
            address,
            controls,
            thread: Some(thread),
        })
    }

    /// Address of RTDE.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Number of states that were sent to clients.
    pub fn n_states_sent(&self) -> u64 {
        self.controls.lock().n_states_sent
    }

    /// Changes the modes of the robot.
    pub fn set_modes(&self, modes: Modes) {
        self.controls.lock().modes = Some(modes);
    }

    /// Joint states that the controller commanded in its newest cycle.
    pub fn commanded(&self) -> CommandedJoints {
        self.controls.lock().commanded
    }

    /// Closes the connections of all clients. They may connect again.
    pub fn disconnect(&self) {
        self.controls.lock().disconnects = true;
    }

    /// Stops or continues to send states. The connections stay open.
    pub fn set_silent(&self, is_silent: bool) {
        self.controls.lock().is_silent = is_silent;
    }

    /// Sends bytes to all clients, between two states.
    pub fn inject(&self, bytes: &[u8]) {
        self.controls.lock().injected.extend_from_slice(bytes);
    }
}

impl Drop for EmulatedController {
    fn drop(&mut self) {
        self.controls.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}

/// Address of an interface beside RTDE.
fn interface_address(rtde: SocketAddr, interface: Interface) -> SocketAddr {
    let offset = Interface::Rtde.port() - interface.port();
    SocketAddr::new(rtde.ip(), rtde.port().saturating_sub(offset))
}

/// One thread serves all sockets in every cycle, so none may block it.
fn bind(address: SocketAddr) -> std::io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// State of the thread.
struct Server {
    config: ControllerConfig,
    /// Maximum time by which a setpoint may be late.
    answer_wait: Duration,
    joint_simulator: JointSimulator,
    rtde: TcpListener,
    scripts: LineServer,
    dashboard: LineServer,
    clients: Vec<Client>,
    robot: Robot,
    controls: Arc<Mutex<Controls>>,
}

impl Server {
    fn run(&mut self) {
        let step_secs = 1.0 / self.config.rate_hz();
        let start = clock::now();
        let mut cycle: u64 = 0;
        while !self.controls.lock().stop {
            let due = start.plus_secs(cycle as f64 * step_secs);
            let lag = clock::now().duration_since(due);
            // A program that waits for setpoints also waits for those to late states.
            if lag <= MAX_LAG || self.waits_for_setpoints() {
                std::thread::sleep(due.duration_since(clock::now()));
                self.robot.values.timestamp_secs = FIRST_TIMESTAMP_SECS + cycle as f64 * step_secs;
                self.cycle(cycle, due);
            }
            cycle += 1;
        }
    }

    /// Runs one cycle: serves all clients, moves the joints, and sends the state.
    fn cycle(&mut self, cycle: u64, due: Stamp) {
        let (injected, is_silent) = self.take_controls();
        self.serve_clients();
        if !is_silent {
            self.wait_for_setpoint();
        }
        self.serve_lines();
        self.robot.advance();
        self.move_joints(due);
        if !injected.is_empty() {
            self.clients
                .retain_mut(|client| client.send_or_skip(&injected) != SentState::Disconnected);
        }
        if is_silent {
            return;
        }
        let mut n_sent = 0;
        self.clients.retain_mut(|client| {
            let sent = client.send_state(cycle, &self.robot.values);
            n_sent += u64::from(sent == SentState::Sent);
            sent != SentState::Disconnected
        });
        self.controls.lock().n_states_sent += n_sent;
    }

    /// Applies the changes of the owner. Returns the bytes to send, and whether no states are sent.
    fn take_controls(&mut self) -> (Vec<u8>, bool) {
        let mut controls = self.controls.lock();
        if std::mem::take(&mut controls.disconnects) {
            self.clients.clear();
        }
        if let Some(modes) = controls.modes.take() {
            self.robot.set_modes(modes);
        }
        controls.commanded = self.robot.commanded();
        (std::mem::take(&mut controls.injected), controls.is_silent)
    }

    fn serve_clients(&mut self) {
        while let Ok((stream, _)) = self.rtde.accept() {
            if stream.set_nonblocking(true).is_ok() && stream.set_nodelay(true).is_ok() {
                self.clients.push(Client::new(stream));
            }
        }
        // Setpoints that arrive together are followed one by one, as if none had been late.
        let takes_one = self.waits_for_setpoints();
        let mut ix = 0;
        while ix < self.clients.len() {
            let mut client = self.clients.swap_remove(ix);
            let others = self.clients.iter();
            let held: Vec<String> = others.flat_map(Client::held_inputs).cloned().collect();
            if client.serve(&self.config, &mut self.robot, &held, takes_one) {
                // The last client has taken the place of this one, so they change places again.
                self.clients.push(client);
                let last = self.clients.len() - 1;
                self.clients.swap(ix, last);
                ix += 1;
            }
        }
    }

    /// Whether a program follows the setpoints of a client, and waits for late ones.
    fn waits_for_setpoints(&self) -> bool {
        let has_sender = || {
            let mut clients = self.clients.iter();
            clients.any(|client| client.held_inputs().next().is_some())
        };
        !self.answer_wait.is_zero() && self.robot.follows_setpoints() && has_sender()
    }

    /// Waits for the setpoint after the last state.
    fn wait_for_setpoint(&mut self) {
        const POLL: Duration = Duration::from_micros(100);
        let deadline = clock::now() + self.answer_wait;
        while self.waits_for_setpoints()
            && !self.robot.has_new_setpoint()
            && clock::now() < deadline
            && !self.controls.lock().stop
        {
            std::thread::sleep(POLL);
            self.serve_clients();
        }
    }

    fn serve_lines(&mut self) {
        let robot = &mut self.robot;
        self.scripts.serve(|received| {
            if let Some(program) = take_program(received) {
                robot.start_program(&program);
            }
            String::new()
        });
        self.dashboard.serve(|received| {
            let mut answers = String::new();
            while let Some(command) = take_line(received) {
                answers += &robot.dashboard(command.trim());
                answers += "\n";
            }
            answers
        });
    }

    fn move_joints(&mut self, due: Stamp) {
        let joints = (self.joint_simulator)(due, &self.robot.commanded());
        self.robot.measure(joints);
        // A chain of six joints takes six angles.
        if let Ok(base_from_flange) = self.config.chain.forward(&joints.position_rad) {
            self.robot.values.base_from_tool = base_from_flange * self.config.flange_from_tool;
        }
    }
}
