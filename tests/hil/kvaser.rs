//! Tests of CAN on real drivers, inside a machine emulated by QEMU with two CAN cards on one bus.
//! Bit rates, controller states and bus-off behave as on real interfaces. Errors that QEMU's chips
//! cannot produce are injected from outside (`qemu.rs`).

use super::can::{Bench, damiao};
use super::can_motion::{Motors, movable, wait_until_stopped};
use super::qemu;
use drivers::can::{
    ArmConfig, Bus, BusConfig, BusEvent, CanArm, Link, MovableCanArm, State, WireErrors, emulated,
};
use drivers::motion::{JointTarget, Motion, MovableArm, OnLoss};
use drivers::wire::can::{Frame, Id};
use drivers::{Arm, Error, clock};
use kinematics::Stamp;
use std::fs;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

// Error bits in the status and interrupt registers of the chip (SJA1000 data sheet of 2000, section
// 6.4).
const HAS_ERRORS: u8 = 0x40;
const IS_BUS_OFF: u8 = 0x80;
const STATUS_CHANGED: u8 = 0x04;
const PASSIVE_CHANGED: u8 = 0x20;

/// Command that fixes the configuration of a card in all these tests.
fn fix_command(interface: &str) -> String {
    format!(
        "sudo ip link set {interface} down; sudo ip link set {interface} up type can bitrate 1000000 restart-ms 100"
    )
}

/// Runs a shell command and returns its output.
fn sh(line: &str) -> String {
    let output = Command::new("/bin/sh")
        .args(["-c", line])
        .output()
        .expect("the shell starts");
    let printed = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.success(), "{line}: {printed}");
    printed
}

/// A card that was just bound to its driver.
struct Card {
    interface: &'static str,
    device: PathBuf,
}

impl Card {
    /// A card in its initial state: down, without a bit rate.
    fn new(interface: &'static str) -> Self {
        let device = fs::canonicalize(format!("/sys/class/net/{interface}/device"))
            .expect("the machine has two cards");
        let slot = device
            .file_name()
            .expect("a folder of the bus")
            .as_encoded_bytes();
        for order in ["unbind", "bind"] {
            fs::write(format!("/sys/bus/pci/drivers/kvaser_pci/{order}"), slot)
                .expect("the driver can be (un)bound");
        }
        let card = Self { interface, device };
        // For fault injection, the chip is identified by the interface name in its acceptance
        // registers. These registers are writable only while the interface is down. The chip still
        // accepts all frames.
        for (value, register) in [interface.as_bytes(), &qemu::ACCEPT_ALL]
            .concat()
            .iter()
            .zip(16..)
        {
            card.write(register, *value);
        }
        card
    }

    /// A card configured as in the rig file.
    fn up(interface: &'static str) -> Self {
        let card = Self::new(interface);
        sh(&fix_command(interface));
        card
    }

    /// A card that is up and restarts `restart_millis` after bus-off, or never if that is 0.
    fn up_with_restart(interface: &'static str, restart_millis: u32) -> Self {
        let card = Self::new(interface);
        sh(&format!(
            "sudo ip link set {interface} up type can bitrate 1000000 restart-ms {restart_millis}"
        ));
        card
    }

    fn config(&self) -> BusConfig {
        BusConfig {
            interface: self.interface.to_owned(),
            bitrate_hz: 1_000_000,
            data_bitrate_hz: None,
            accept_no_restart: false,
        }
    }

    fn bus(&self) -> Bus {
        Bus::open(&self.config()).expect("the card is configured")
    }

    fn link(&self) -> Link {
        Link::read(self.interface).expect("the interface exists")
    }

    /// Writes a register of the chip directly, bypassing the driver.
    fn write(&self, register: u64, value: u8) {
        let ports = fs::OpenOptions::new()
            .write(true)
            .open(self.device.join("resource1"))
            .expect("the test runs as root");
        ports
            .write_all_at(&[value], register)
            .expect("the register is writable");
    }

    /// Enables or disables interrupts of the chip.
    fn set_interrupts_enabled(&self, enabled: bool) {
        const CONTROL: u64 = 0x38;
        let ports = fs::OpenOptions::new()
            .write(true)
            .open(self.device.join("resource0"))
            .expect("the test runs as root");
        let control: u32 = if enabled { 0x2000 } else { 0 };
        ports
            .write_all_at(&control.to_le_bytes(), CONTROL)
            .expect("the register is writable");
    }

    /// Injects status and interrupt bits into the chip. The driver reads them at the next
    /// interrupt.
    fn inject(&self, status: u8, interrupts: u8) {
        println!(
            "\n{}{} {status:02x} {interrupts:02x}",
            qemu::INJECT,
            self.interface
        );
        let mut answer = String::new();
        std::io::stdin()
            .read_line(&mut answer)
            .expect("the console can be read");
        assert_eq!(answer.trim(), qemu::INJECTED);
    }

    /// Injects status and interrupt bits and triggers an interrupt.
    fn raise_error(&self, status: u8, interrupts: u8) {
        self.inject(status, interrupts);
        // The command to clear an overrun makes the chip reevaluate its interrupts, even if there
        // is no overrun.
        self.write(1, 0x08);
    }

    fn enter_error_warning(&self) {
        self.raise_error(HAS_ERRORS, STATUS_CHANGED);
    }

    fn enter_error_passive(&self) {
        self.raise_error(HAS_ERRORS, PASSIVE_CHANGED);
    }

    fn enter_bus_off(&self) {
        self.raise_error(HAS_ERRORS | IS_BUS_OFF, STATUS_CHANGED);
    }
}

/// Output of `fieldrig doctor` for the rig.
fn doctor() -> String {
    let output = Command::new("/bin/fieldrig")
        .args(["doctor", "/rigs/kvaser.toml"])
        .output()
        .expect("fieldrig is installed");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Accumulates error frames until the condition holds.
fn errors_until(bus: &Bus, condition: impl Fn(&WireErrors) -> bool) -> WireErrors {
    let mut errors = WireErrors::default();
    let until = clock::now() + Duration::from_secs(10);
    while !condition(&errors) {
        assert!(clock::now() < until, "{errors:?}");
        if let Some((_, BusEvent::Errors(new_errors))) = bus
            .receive(Duration::from_millis(100))
            .expect("the bus is up")
        {
            errors.add(&new_errors);
        }
    }
    errors
}

/// Accumulates error frames while `act` runs, until the bus has restarted. While `act` runs,
/// nothing else reads the bus. On a busy host, frames of the motors would otherwise fill the
/// buffer, and the kernel would drop the error frame.
fn errors_until_restart<R>(bus: &Bus, act: impl FnOnce() -> R) -> (WireErrors, R) {
    std::thread::scope(|scope| {
        let errors = scope.spawn(|| errors_until(bus, |errors| errors.n_restarts > 0));
        let result = act();
        (errors.join().expect("the bus restarts"), result)
    })
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn misconfigured_card_reports_fix_command() {
    let wrong_setups = [
        ("", "no bit rate is set; the rig file requires 1000000"),
        (
            "sudo ip link set can0 up type can bitrate 500000 restart-ms 100",
            "its bit rate is 500000, but the rig file requires 1000000",
        ),
        (
            "sudo ip link set can0 up type can bitrate 1000000",
            "it does not restart after a bus-off",
        ),
        (
            "sudo ip link set can0 type can bitrate 1000000 restart-ms 100",
            "it is down",
        ),
    ];
    for (set_up, what) in wrong_setups {
        let card = Card::new("can0");
        if !set_up.is_empty() {
            sh(set_up);
        }
        let problems = card.link().problems(&card.config());
        let problem_found = problems
            .iter()
            .find(|complaint| complaint.problem.contains(what));
        assert!(
            problem_found.is_some_and(|complaint| complaint.command == fix_command("can0")),
            "{set_up}: {problems:?}"
        );
        let open_error = Bus::open(&card.config())
            .expect_err("the card is not configured")
            .to_string();
        assert!(open_error.contains(&fix_command("can0")), "{open_error}");
        let printed = doctor();
        assert!(
            printed.contains(&format!("can0: {what}")) && printed.contains(&fix_command("can0")),
            "{set_up}: {printed}"
        );

        sh(&problems[0].command);
        assert_eq!(card.link().problems(&card.config()), [], "{set_up}");
        let printed = doctor();
        assert!(
            printed.contains("can0: up, 1000000 bit/s, state active")
                && !printed.contains("sudo ip link set can0"),
            "{printed}"
        );
        println!("kvaser: {what}: fixed by {}", problems[0].command);
    }
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn frames_pass_between_cards_both_ways() {
    let cards = [Card::up("can0"), Card::up("can1")];
    let [a, b] = [cards[0].bus(), cards[1].bus()];
    for (sender, receiver) in [(&a, &b), (&b, &a)] {
        for ix in 0..500_u32 {
            let id = if ix % 2 == 0 {
                Id::standard(ix)
            } else {
                Id::extended(0x0AB0_0000 + ix)
            };
            let bytes = ix.to_le_bytes().repeat(2);
            let sent = Frame::classic(id.expect("in range"), &bytes[..ix as usize % 9])
                .expect("up to eight bytes");
            assert!(sender.send(&sent).expect("the bus is up"));
            let arrived = receiver
                .receive(Duration::from_secs(5))
                .expect("the bus is up");
            assert!(
                matches!(arrived, Some((_, BusEvent::Frame(frame))) if frame == sent),
                "{arrived:?}, expected {sent:?}"
            );
        }
    }
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn arm_reading_survives_bus_off() {
    let cards = [Card::up("can0"), Card::up("can1")];
    let motors = vec![damiao(1), damiao(2)];
    let _bench = Bench::new(cards[1].config(), motors.clone(), vec![]);
    let config = ArmConfig {
        buses: vec![cards[0].config()],
        motors,
        rate_hz: 100.0,
    };
    let mut arm = CanArm::open(&config).expect("both motors answer");
    for _ in 0..50 {
        let state = arm.read(Duration::from_secs(5)).expect("the motors report");
        for (ix, position) in state.position.iter().enumerate() {
            let off = (position - super::can::rest_rad(ix)).abs();
            assert!(off < 1e-3, "joint {ix}: error {off} rad");
        }
    }
    let monitor = cards[0].bus();
    for _ in 0..3 {
        let (errors, ()) = errors_until_restart(&monitor, || cards[0].enter_bus_off());
        assert_eq!((errors.n_bus_off, errors.n_restarts), (1, 1), "{errors:?}");
        let recovered_at = clock::now();
        let state = loop {
            let state = arm.read(Duration::from_secs(1)).expect("reading continues");
            if state.stamp > recovered_at {
                break state;
            }
        };
        println!(
            "kvaser: joints are read {:.0} ms after the bus restarted",
            state.stamp.nanos_since(recovered_at) as f64 / 1e6
        );
    }
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn persistent_bus_off_is_reported_as_cause() {
    let cards = [Card::up_with_restart("can0", 60_000), Card::up("can1")];
    let _bench = Bench::new(cards[1].config(), vec![damiao(1)], vec![]);
    let config = ArmConfig {
        buses: vec![cards[0].config()],
        motors: vec![damiao(1)],
        rate_hz: 100.0,
    };
    let mut arm = CanArm::open(&config).expect("the motor answers");
    arm.read(Duration::from_secs(5)).expect("the motor reports");
    cards[0].enter_bus_off();
    let until = clock::now() + Duration::from_secs(10);
    let error = loop {
        match arm.read(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoJoints { .. }) if clock::now() < until => {}
            other => break other.expect_err("the bus is off").to_string(),
        }
    };
    println!("kvaser: {error}");
    assert!(
        error.contains("no frame from the motor for 1s") && error.contains("1 bus-off, 0 restarts"),
        "{error}"
    );
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn bus_off_stops_moving_arm_until_recovery() {
    let cards = [Card::up("can0"), Card::up("can1")];
    let configs = [damiao(1), damiao(2)];
    let motors = Motors::new(cards[1].config(), configs.to_vec(), false);
    let mut config = movable(cards[0].config(), &configs, OnLoss::Release);
    // This timeout is longer than the stalls of this machine on a busy host.
    config.motion.timeout = Duration::from_secs(2);
    let mut arm = MovableCanArm::open(&config).expect("the motors are enabled");
    let monitor = cards[0].bus();
    for direction_of_motion in [1.0, -1.0] {
        arm.command(&JointTarget {
            position: vec![direction_of_motion; 2],
        })
        .expect("the arm is enabled");
        let (errors, reason) = errors_until_restart(&monitor, || {
            cards[0].enter_bus_off();
            wait_until_stopped(&arm)
        });
        assert!(reason.contains("can0 went bus-off"), "{reason}");
        assert_eq!((errors.n_bus_off, errors.n_restarts), (1, 1), "{errors:?}");
        motors.wait_until("no motor is enabled", |observed| {
            observed
                .iter()
                .all(|observed| observed.state == emulated::State::Free)
        });
        std::thread::sleep(Duration::from_millis(500));
        assert_eq!(
            motors.states(),
            [emulated::State::Free; 2],
            "the bus has restarted"
        );
        let open_error = arm
            .command(&JointTarget {
                position: vec![0.0; 2],
            })
            .expect_err("the arm is not recovered");
        assert!(
            open_error.to_string().contains("not been recovered"),
            "{open_error}"
        );
        arm.recover().expect("the motors answer again");
        assert!(
            !matches!(arm.motion(), Motion::Stopped { .. }),
            "{:?}",
            arm.motion()
        );
        motors.wait_until("all motors are enabled", |observed| {
            observed
                .iter()
                .all(|observed| observed.state == emulated::State::Enabled)
        });
        println!("kvaser: {reason}; restarted with motors released; enabled again on request");
    }
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn controller_state_changes_are_reported() {
    let card = Card::up_with_restart("can0", 3000);
    let bus = card.bus();
    assert_eq!(card.link().state, Some(State::Active));
    assert_eq!(card.link().n_errors, Some([0, 0]));
    card.enter_error_warning();
    let errors = errors_until(&bus, |errors| errors.n_frames > 0);
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 1,
            n_warnings: 1,
            ..WireErrors::default()
        }
    );
    assert_eq!(card.link().state, Some(State::Warning));
    card.enter_error_passive();
    let errors = errors_until(&bus, |errors| errors.n_frames > 0);
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 1,
            n_passive: 1,
            ..WireErrors::default()
        }
    );
    assert_eq!(card.link().state, Some(State::Passive));
    assert_eq!(
        card.link().problems(&card.config()),
        [],
        "the controller still communicates"
    );
    card.enter_bus_off();
    let errors = errors_until(&bus, |errors| errors.n_frames > 0);
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 1,
            n_bus_off: 1,
            ..WireErrors::default()
        }
    );
    let link = card.link();
    assert_eq!(link.state, Some(State::BusOff), "{link}");
    let problems = link.problems(&card.config());
    assert!(
        problems
            .iter()
            .any(|complaint| complaint.problem.starts_with("it is bus-off")),
        "{problems:?}"
    );
    // The kernel needs up to a second to detect that nothing is transmitted. From then on, it
    // accepts frames and drops them.
    let frame = Frame::classic(Id::standard(0x100).expect("11 bits"), &[]).expect("no bytes");
    std::thread::sleep(Duration::from_millis(1200));
    let n_accepted = (0..50)
        .filter(|_| bus.send(&frame).expect("the interface is up"))
        .count();
    assert_eq!(n_accepted, 50);
    let start_time = clock::now();
    let errors = errors_until(&bus, |errors| errors.n_frames > 0);
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 1,
            n_restarts: 1,
            ..WireErrors::default()
        }
    );
    assert_eq!(card.link().state, Some(State::Active));
    println!(
        "kvaser: warning, passive, bus-off, restarted after {:?}",
        clock::now().duration_since(start_time)
    );
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn doctor_reports_bus_off_with_working_fix() {
    let card = Card::up_with_restart("can0", 0);
    card.enter_bus_off();
    let until = clock::now() + Duration::from_secs(5);
    while card.link().state != Some(State::BusOff) {
        assert!(clock::now() < until, "{}", card.link());
    }
    let printed = doctor();
    assert!(
        printed.contains("can0: it is bus-off") && printed.contains(&fix_command("can0")),
        "{printed}"
    );
    // Clear the injected bits, as a chip does when it returns to the bus.
    card.inject(0, 0);
    sh(&fix_command("can0"));
    assert_eq!(card.link().problems(&card.config()), []);
    assert_eq!(card.link().state, Some(State::Active));
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn unacknowledged_frames_are_distinguished_from_silence() {
    let card = Card::up("can0");
    let config = ArmConfig {
        buses: vec![card.config()],
        motors: vec![damiao(1)],
        rate_hz: 100.0,
    };
    let printed = CanArm::open(&config)
        .expect_err("no motor is connected")
        .to_string();
    assert!(printed.contains("no answer to 4 requests"), "{printed}");
    // The chip reports the state error-passive with the first request. This is the only sign of the
    // problem, because the driver of the chip cannot report missing acknowledgments.
    card.inject(HAS_ERRORS, PASSIVE_CHANGED);
    let printed = CanArm::open(&config)
        .expect_err("no motor is connected")
        .to_string();
    assert!(printed.contains("no node acknowledges frames"), "{printed}");
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn receive_overflows_are_counted() {
    let cards = [Card::up("can0"), Card::up("can1")];
    let [receiver, sender] = [cards[0].bus(), cards[1].bus()];
    cards[0].set_interrupts_enabled(false);
    for ix in 0..10_u8 {
        let frame =
            Frame::classic(Id::standard(0x100).expect("11 bits"), &[ix; 8]).expect("eight bytes");
        assert!(sender.send(&frame).expect("the bus is up"));
    }
    let stamp = clock::now();
    cards[0].set_interrupts_enabled(true);
    let (mut n_frames, mut errors) = (0, WireErrors::default());
    while let Some((_, arrived)) = receiver
        .receive(Duration::from_millis(300))
        .expect("the bus is up")
    {
        match arrived {
            BusEvent::Frame(_) => n_frames += 1,
            BusEvent::Errors(new_errors) => errors.add(&new_errors),
        }
    }
    println!(
        "kvaser: {n_frames} of 10 frames fit into the chip, reported after {:?}: {errors}",
        clock::now().duration_since(stamp)
    );
    // The chip stores 64 bytes, and each frame takes eleven.
    assert_eq!(n_frames, 5);
    assert_eq!(
        errors,
        WireErrors {
            n_frames: 1,
            n_overflows: 1,
            ..WireErrors::default()
        }
    );
}

#[test]
#[ignore = "needs the machine with CAN cards"]
fn bus_load_matches_frames_sent() {
    const N_FRAMES: u32 = 5000;
    const PERIOD: Duration = Duration::from_millis(2);
    let cards = [Card::up("can0"), Card::up("can1")];
    let [sender, receiver] = [cards[0].bus(), cards[1].bus()];
    let receiving = std::thread::spawn(move || {
        let mut n = 0;
        while n < N_FRAMES {
            match receiver
                .receive(Duration::from_secs(5))
                .expect("the bus is up")
            {
                Some((_, BusEvent::Frame(_))) => n += 1,
                other => panic!("{n} frames arrived, then {other:?}"),
            }
        }
        receiver.busy()
    });
    let start_time = clock::now();
    let mut n_bits = 0;
    for ix in 0..N_FRAMES {
        let due: Stamp = start_time + PERIOD * ix;
        std::thread::sleep(due.duration_since(clock::now()));
        let n_bytes = ix % 9;
        let (id, n_other_bits) = match ix % 2 {
            0 => (Id::standard(0x123), 47),
            _ => (Id::extended(0x123_4567), 67),
        };
        n_bits += n_other_bits + 8 * n_bytes;
        let frame = Frame::classic(id.expect("in range"), &[0x55; 8][..n_bytes as usize])
            .expect("up to eight bytes");
        assert!(sender.send(&frame).expect("the bus is up"));
    }
    let elapsed_secs = clock::now().secs_since(start_time);
    let busy = [sender.busy(), receiving.join().expect("all frames arrive")];
    let expected_secs = f64::from(n_bits) / 1e6;
    let load = |busy_secs: f64| 100.0 * busy_secs / elapsed_secs;
    println!(
        "kvaser: {N_FRAMES} frames in {elapsed_secs:.1} s: bus load {:.3} % and {:.3} % as counted by the driver, {:.3} % computed from the bits",
        load(busy[0].as_secs_f64()),
        load(busy[1].as_secs_f64()),
        load(expected_secs)
    );
    for busy in busy {
        // Each frame is rounded to whole nanoseconds.
        assert!(
            (busy.as_secs_f64() - expected_secs).abs() < 1e-9 * f64::from(N_FRAMES),
            "{busy:?}"
        );
    }
    for (card, direction) in cards.iter().zip(["tx", "rx"]) {
        let packets = fs::read_to_string(format!(
            "/sys/class/net/{}/statistics/{direction}_packets",
            card.interface
        ));
        assert_eq!(
            packets.expect("the kernel counts").trim(),
            N_FRAMES.to_string()
        );
    }
}
