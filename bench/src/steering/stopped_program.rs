//! What an arm or a base does if the program that moves it is stopped or killed.
//!
//! The device is emulated here, and the driver, the decisions and the server run in another process.
//! Nothing in that process brakes any more, so the rules of the device count: its watchdog, or the
//! expiry of its last command.

use super::arms::{self, ArmKind, Emulated, Patience};
use super::braking::braking;
use super::client::SteeringClient;
use super::faults::Fault;
use super::matrix::FaultRow;
use super::operator::{Hand, SAMPLE_PERIOD, intent_of};
use super::rig::SteeredRig;
use super::trial::Outcome;
use anyhow::{Context, Result, bail};
use drivers::clock;
use nalgebra::Vector3;
use numbers::random::Random;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Speed of the hand, and of a base, m/s.
const HAND_M_S: f64 = 0.1;
const BASE_M_S: f64 = 0.25;
/// Speed of the joints or of the base above which it moves.
const MOVING: f64 = 0.05;
/// Time for which it moves before the event, seconds.
const MOVING_SECS: [f64; 2] = [0.5, 0.8];
/// Maximum time until it moves.
const MAX_START: Duration = Duration::from_secs(20);
/// Time after the event for which its motion is recorded.
const RECORDED: Duration = Duration::from_millis(1500);
/// Number of samples with an open switch before the grip.
const N_OPEN_SAMPLES: u32 = 5;
/// How often a trial is repeated in which it did not move, per trial that counts.
const MAX_REPEATS: u32 = 3;

/// Steers a robot whose emulated device is in another process, until `wait` returns.
///
/// * `address`: of the device.
/// * `wait`: called with the address of the server.
///
/// # Errors
///
/// If the device cannot be reached or steered.
pub fn serve_robot(
    kind: ArmKind,
    address: &str,
    wait: impl FnOnce(SocketAddr) -> Result<()>,
) -> Result<()> {
    let robot = arms::connect(kind, address, Patience::Little)?;
    let rig = SteeredRig::start(robot)?;
    wait(rig.server.address())
}

/// Stops or kills the program many times while it moves a robot.
///
/// * `program`: this program, whose hidden flag calls [`serve_robot`].
///
/// # Errors
///
/// If the program cannot be started, or the robot cannot be steered.
pub(super) fn measure(
    kind: ArmKind,
    fault: Fault,
    n_trials: u32,
    serve: Serve,
) -> Result<FaultRow> {
    let mut random = Random::new(u64::from(n_trials));
    let mut outcomes = Vec::new();
    let mut n_repeated = 0;
    while outcomes.len() < n_trials as usize && n_repeated <= MAX_REPEATS * n_trials {
        match try_once(kind, fault, serve, &mut random)? {
            Some(outcome) => outcomes.push(outcome),
            None => n_repeated += 1,
        }
    }
    Ok(FaultRow::of(kind, fault, n_repeated, &outcomes))
}

/// One trial, with a new device and a new process. `None` if the robot did not move.
fn try_once(
    kind: ArmKind,
    fault: Fault,
    serve: Serve,
    random: &mut Random,
) -> Result<Option<Outcome>> {
    let emulated = arms::emulate(kind, Patience::Little)?;
    let mut running = RunningProgram::start(serve, kind, &emulated)?;
    let mut client = SteeringClient::connect(running.server, 0)?;
    client.lease("take")?;
    let number = client.number();
    client.wait_for_state("control", |state| state.holder == Some(number))?;
    let moving_secs = random.uniform(MOVING_SECS[0], MOVING_SECS[1]);
    if !start_moving(kind, &mut client, &emulated, moving_secs)? {
        return Ok(None);
    }
    let event_at = clock::now();
    match fault {
        Fault::ProgramKilled => running.kill()?,
        _ => running.stop()?,
    }
    std::thread::sleep(RECORDED);
    let samples = emulated.recorder.take();
    // The device brakes by its own rules, so the limits of braking predict nothing.
    let braking = braking(&samples, event_at, None, &[]).ok();
    Ok(Some(Outcome {
        braking: braking.map(|braking| braking.without_prediction()),
        excess: None,
        stopped: None,
        n_own_brakes: 0,
    }))
}

/// Grips, and moves the hand until the robot has followed for a time.
fn start_moving(
    kind: ArmKind,
    client: &mut SteeringClient,
    emulated: &Emulated,
    moving_secs: f64,
) -> Result<bool> {
    for _ in 0..N_OPEN_SAMPLES {
        let open = client.command(None, &serde_json::Value::Null);
        client.send(&open)?;
        std::thread::sleep(SAMPLE_PERIOD);
    }
    let speed_m_s = if kind.is_base() { BASE_M_S } else { HAND_M_S };
    let velocity_m_s = speed_m_s * Vector3::x();
    let began = Instant::now();
    let mut moving_since = None;
    while began.elapsed() < MAX_START {
        let hand = Hand {
            at_m: velocity_m_s * began.elapsed().as_secs_f64(),
            velocity_m_s,
        };
        let sample = client.command(Some(1), &intent_of(kind, &hand));
        client.send(&sample)?;
        std::thread::sleep(SAMPLE_PERIOD);
        let newest = emulated.recorder.newest();
        if newest.is_some_and(|sample| sample.speed() > MOVING) {
            let since = *moving_since.get_or_insert_with(Instant::now);
            if since.elapsed().as_secs_f64() > moving_secs {
                return Ok(true);
            }
        } else if moving_since.is_some() {
            // It has braked, for example because this computer was busy.
            return Ok(false);
        }
    }
    Ok(false)
}

/// Command of the process, see [`Processes::serve`](super::Processes::serve).
type Serve = fn(ArmKind, &str) -> Result<Command>;

/// The process that moves the robot. Dropping it kills it.
struct RunningProgram {
    child: Child,
    server: SocketAddr,
}

impl RunningProgram {
    fn start(serve: Serve, kind: ArmKind, emulated: &Emulated) -> Result<Self> {
        let mut child = serve(kind, &emulated.address)?
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .context("cannot start the program that is stopped")?;
        let stdout = child.stdout.take().context("the process has no output")?;
        let mut line = String::new();
        let read = BufReader::new(stdout).read_line(&mut line);
        let mut running = Self {
            child,
            server: SocketAddr::from(([127, 0, 0, 1], 0)),
        };
        read.context("the process that moves the robot printed nothing")?;
        running.server = line
            .trim()
            .parse()
            .with_context(|| format!("the process that moves the robot printed {line:?}"))?;
        Ok(running)
    }

    fn kill(&mut self) -> Result<()> {
        self.child.kill().context("cannot kill the process")
    }

    fn stop(&self) -> Result<()> {
        let status = Command::new("kill")
            .args(["-STOP", &self.child.id().to_string()])
            .status()
            .context("cannot start `kill`")?;
        if !status.success() {
            bail!("`kill -STOP` failed");
        }
        Ok(())
    }
}

impl Drop for RunningProgram {
    fn drop(&mut self) {
        // A process that is stopped is killed, too.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
