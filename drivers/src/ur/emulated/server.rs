//! The sockets of an emulated controller, and the thread that serves them once per cycle.

use super::client::{Client, SentState};
use super::variables::{N_REGISTERS, Values};
use super::{ControllerConfig, JointSimulator, Modes};
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
/// Value of `runtime_state` without a program.
const STOPPED: u32 = 1;

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
    modes: Modes,
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
        let device = "emulated controller".to_owned();
        let listen = |source| Error::Listen {
            device: device.clone(),
            address: config.address,
            source,
        };
        let listener = TcpListener::bind(config.address).map_err(listen)?;
        // One thread serves all sockets in every cycle, so none may block it.
        listener.set_nonblocking(true).map_err(listen)?;
        let address = listener.local_addr().map_err(listen)?;
        let controls: Arc<Mutex<Controls>> = Arc::default();
        let mut server = Server {
            values: first_values(&config),
            config,
            joint_simulator,
            listener,
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
        self.controls.lock().modes = modes;
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

/// State of the thread.
struct Server {
    config: ControllerConfig,
    joint_simulator: JointSimulator,
    listener: TcpListener,
    clients: Vec<Client>,
    values: Values,
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
            if lag <= MAX_LAG {
                std::thread::sleep(due.duration_since(clock::now()));
                self.values.timestamp_secs = FIRST_TIMESTAMP_SECS + cycle as f64 * step_secs;
                self.cycle(cycle, due);
            }
            cycle += 1;
        }
    }

    /// Runs one cycle: accepts and answers clients, moves the joints, and sends the state.
    fn cycle(&mut self, cycle: u64, due: Stamp) {
        while let Ok((stream, _)) = self.listener.accept() {
            if stream.set_nonblocking(true).is_ok() && stream.set_nodelay(true).is_ok() {
                self.clients.push(Client::new(stream));
            }
        }
        let (injected, is_silent) = {
            let mut controls = self.controls.lock();
            if std::mem::take(&mut controls.disconnects) {
                self.clients.clear();
            }
            self.values.modes = controls.modes;
            (std::mem::take(&mut controls.injected), controls.is_silent)
        };
        self.clients
            .retain_mut(|client| client.serve(&self.config, &self.values));
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
            let sent = client.send_state(cycle, &self.values);
            n_sent += u64::from(sent == SentState::Sent);
            sent != SentState::Disconnected
        });
        self.controls.lock().n_states_sent += n_sent;
    }

    fn move_joints(&mut self, due: Stamp) {
        let joints = (self.joint_simulator)(due);
        self.values.joints = joints;
        self.values.target_rad = joints.position_rad;
        // A chain of six joints takes six angles.
        if let Ok(base_from_flange) = self.config.chain.forward(&joints.position_rad) {
            self.values.base_from_tool = base_from_flange * self.config.flange_from_tool;
        }
    }
}

fn first_values(config: &ControllerConfig) -> Values {
    Values {
        timestamp_secs: FIRST_TIMESTAMP_SECS,
        joints: super::Joints::default(),
        target_rad: [0.0; super::N_JOINTS],
        base_from_tool: config.flange_from_tool,
        flange_from_tool: config.flange_from_tool,
        modes: Modes::default(),
        runtime_state: STOPPED,
        output_ints: [0; N_REGISTERS],
    }
}
