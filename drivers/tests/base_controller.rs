//! Tests of the programs in `scripts/senders` that control a base: they follow commands, and stop
//! without them. The packages of ROS 2 are replaced by small fakes in the folder `base_controller`.
#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use drivers::base_motion::{BaseReport, BaseVelocity, MovableBase};
use drivers::clock;
use drivers::udp::UdpDrivenBase;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Maximum time until something happens, on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(60);
const FORWARD: BaseVelocity = BaseVelocity {
    forward_m_s: 0.3,
    left_m_s: 0.0,
    yaw_rad_s: 0.2,
};

/// The program. Dropping this value ends it.
struct Controller {
    child: Child,
    address: SocketAddr,
    /// Receives the poses of the base.
    poses: UdpSocket,
}

impl Drop for Controller {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Controller {
    /// Starts a program; `None` if there is no Python.
    ///
    /// * `name`: of the program.
    /// * `to_poses`: its flag for the address to which it sends poses, if it has one.
    fn start(name: &str, to_poses: Option<&str>) -> Option<Self> {
        let poses = UdpSocket::bind("127.0.0.1:0").unwrap();
        poses.set_read_timeout(Some(TIMEOUT)).unwrap();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        let program = folder.join("../scripts/senders").join(name);
        let to = poses.local_addr().unwrap().to_string();
        let child = Command::new("python3")
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("PYTHONPATH", folder.join("tests/base_controller"))
            .arg(program)
            .args(["--listen", "127.0.0.1:0"])
            .args(
                to_poses
                    .map(|flag| [flag, to.as_str()])
                    .into_iter()
                    .flatten(),
            )
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn();
        let Ok(mut child) = child else {
            test_support::skip("there is no python3");
            return None;
        };
        let mut line = String::new();
        let stdout = child.stdout.take().unwrap();
        BufReader::new(stdout).read_line(&mut line).unwrap();
        let port: u16 = line.trim().rsplit(' ').next().unwrap().parse().unwrap();
        Some(Self {
            child,
            address: SocketAddr::from(([127, 0, 0, 1], port)),
            poses,
        })
    }
}

/// Drives until a report of the base meets a condition.
fn drive_until(
    driver: &mut UdpDrivenBase,
    velocity: &BaseVelocity,
    is_reached: impl Fn(&BaseReport) -> bool,
) -> BaseReport {
    let began = Instant::now();
    loop {
        driver.drive(clock::now(), velocity).unwrap();
        std::thread::sleep(Duration::from_millis(5));
        let report = driver.report(clock::now());
        if is_reached(&report) {
            return report;
        }
        assert!(began.elapsed() < TIMEOUT, "{report:?}");
    }
}

#[test]
fn the_example_in_python_obeys_reports_its_velocity_and_stops() {
    let Some(controller) = Controller::start("base_controller.py", Some("--to")) else {
        return;
    };
    let mut driver = UdpDrivenBase::open(controller.address, 1).unwrap();
    drive_until(&mut driver, &BaseVelocity::ZERO, |report| {
        report.is_stop_confirmed
    });
    let moving = drive_until(&mut driver, &FORWARD, |report| report.velocity == FORWARD);
    assert!(moving.refusal.is_none(), "{moving:?}");
    drive_until(&mut driver, &BaseVelocity::ZERO, |report| {
        report.is_stop_confirmed && report.velocity == BaseVelocity::ZERO
    });

    // It sends poses of a base that has moved.
    let mut bytes = [0; 2048];
    let began = Instant::now();
    loop {
        let n_bytes = controller.poses.recv(&mut bytes).unwrap();
        let pose = drivers::wire::datagram::decode_pose(&bytes[..n_bytes]).unwrap();
        if pose.world_from_base.translation.x > 0.0 {
            break;
        }
        assert!(began.elapsed() < TIMEOUT, "{pose:?}");
    }
}

#[test]
fn the_example_in_python_stops_when_commands_end() {
    let Some(controller) = Controller::start("base_controller.py", Some("--to")) else {
        return;
    };
    let mut driver = UdpDrivenBase::open(controller.address, 1).unwrap();
    drive_until(&mut driver, &BaseVelocity::ZERO, |report| {
        report.is_stop_confirmed
    });
    drive_until(&mut driver, &FORWARD, |report| report.velocity == FORWARD);
    drop(driver);
    // The poses show when it stands still.
    let mut last = None;
    let began = Instant::now();
    let mut bytes = [0; 2048];
    loop {
        let n_bytes = controller.poses.recv(&mut bytes).unwrap();
        let pose = drivers::wire::datagram::decode_pose(&bytes[..n_bytes]).unwrap();
        let is_at_rest = last == Some(pose.world_from_base);
        if is_at_rest && pose.world_from_base.translation.x > 0.0 {
            break;
        }
        last = Some(pose.world_from_base);
        assert!(began.elapsed() < TIMEOUT, "it does not stop: {pose:?}");
    }
}

#[test]
fn the_program_for_ros_2_publishes_velocities_and_reports_the_odometry() {
    let Some(controller) = Controller::start("ros2_drive.py", None) else {
        return;
    };
    let mut driver = UdpDrivenBase::open(controller.address, 1).unwrap();
    drive_until(&mut driver, &BaseVelocity::ZERO, |report| {
        report.is_stop_confirmed
    });
    let moving = drive_until(&mut driver, &FORWARD, |report| report.velocity == FORWARD);
    assert!(moving.fault.is_none(), "{moving:?}");
    drive_until(&mut driver, &BaseVelocity::ZERO, |report| {
        report.is_stop_confirmed && report.velocity == BaseVelocity::ZERO
    });
}
