//! A base that is driven over real UDP sockets, with simulated clocks on both sides.

use super::{EmulatedBase, UdpDrivenBase};
use crate::base_motion::{BaseReport, BaseVelocity, MovableBase};
use kinematics::Stamp;
use std::time::{Duration, Instant};

const CYCLE_SECS: f64 = 0.02;
/// The clock of the base has another zero.
const BASE_CLOCK_NANOS: i64 = 7_777_000_000_000;
const FORWARD: BaseVelocity = BaseVelocity {
    forward_m_s: 0.3,
    left_m_s: 0.0,
    yaw_rad_s: 0.1,
};
/// Maximum time until a datagram arrives, on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(60);

struct Link {
    driver: UdpDrivenBase,
    base: EmulatedBase,
    now: Stamp,
}

impl Link {
    fn new() -> Self {
        let base = EmulatedBase::start().expect("a free port");
        let address = base.address().expect("bound");
        let driver = UdpDrivenBase::open(address, 5).expect("a free port");
        Self {
            driver,
            base,
            now: Stamp(1_000_000_000),
        }
    }

    fn base_nanos(&self) -> i64 {
        BASE_CLOCK_NANOS + self.now.0
    }

    /// One cycle of both sides. The command arrives before the base's cycle, and the reply before
    /// the next cycle of the driver.
    fn cycle(&mut self, velocity: &BaseVelocity) -> BaseReport {
        self.now = self.now.plus_secs(CYCLE_SECS);
        let n_before = self.base.n_accepted();
        let n_sent = self.driver.seq();
        self.driver
            .drive(self.now, velocity)
            .expect("loopback works");
        let is_sent = self.driver.seq() > n_sent;
        let began = Instant::now();
        loop {
            self.base.cycle(self.base_nanos());
            if !is_sent || self.base.n_accepted() > n_before {
                break;
            }
            assert!(began.elapsed() < TIMEOUT, "the command does not arrive");
        }
        loop {
            let report = self.driver.report(self.now);
            let is_answered = report.reported_at == Some(self.now);
            if !is_sent || !self.base.replies || is_answered {
                return report;
            }
            assert!(began.elapsed() < TIMEOUT, "the reply does not arrive");
        }
    }
}

#[test]
fn the_base_moves_after_its_clock_is_known_and_reports_its_velocity() {
    let mut link = Link::new();
    // The first velocity is not sent, because its end cannot be expressed yet.
    let first = link.cycle(&FORWARD);
    assert_eq!(link.base.velocity(), BaseVelocity::ZERO);
    assert!(first.is_stop_confirmed);
    let second = link.cycle(&FORWARD);
    assert_eq!(link.base.velocity(), FORWARD);
    assert_eq!(second.velocity, FORWARD);
    assert!(!second.is_stop_confirmed);
}

#[test]
fn zero_is_repeated_until_it_is_confirmed() {
    let mut link = Link::new();
    link.cycle(&BaseVelocity::ZERO);
    link.cycle(&FORWARD);
    assert_eq!(link.base.velocity(), FORWARD);
    link.base.replies = false;
    for _ in 0..20 {
        let n_before = link.base.n_accepted();
        let report = link.cycle(&BaseVelocity::ZERO);
        assert!(!report.is_stop_confirmed);
        let n_sent = link.base.n_accepted() - n_before;
        assert_eq!(n_sent, 1, "a stop was not repeated");
    }
    link.base.replies = true;
    assert!(link.cycle(&BaseVelocity::ZERO).is_stop_confirmed);
    // From now on, five cycles out of six are silent.
    let before = link.base.n_accepted();
    for _ in 0..50 {
        assert!(link.cycle(&BaseVelocity::ZERO).is_stop_confirmed);
    }
    let n_sent = link.base.n_accepted() - before;
    assert!((8..=11).contains(&n_sent), "{n_sent}");
}

#[test]
fn silence_stops_the_base_and_delayed_velocities_do_not_move_it() {
    let mut link = Link::new();
    link.cycle(&BaseVelocity::ZERO);
    link.cycle(&FORWARD);
    assert_eq!(link.base.velocity(), FORWARD);
    link.base.cycle(link.base_nanos() + 90_000_000);
    assert_eq!(link.base.velocity(), FORWARD);
    link.base.cycle(link.base_nanos() + 110_000_000);
    assert_eq!(link.base.velocity(), BaseVelocity::ZERO);

    // A command that waits in the network for half a second.
    link.now = link.now.plus_secs(CYCLE_SECS);
    link.driver
        .drive(link.now, &FORWARD)
        .expect("loopback works");
    link.now = link.now.plus_secs(0.5);
    let n_before = link.base.n_accepted();
    let began = Instant::now();
    while link.base.n_accepted() == n_before {
        link.base.cycle(link.base_nanos());
        assert!(began.elapsed() < TIMEOUT, "the command does not arrive");
    }
    assert_eq!(link.base.velocity(), BaseVelocity::ZERO);
    let refusal = loop {
        if let Some(refusal) = link.driver.report(link.now).refusal {
            break refusal;
        }
        assert!(began.elapsed() < TIMEOUT, "the reply does not arrive");
    };
    assert!(refusal.contains("expired"), "{refusal}");
}

#[test]
fn a_second_program_cannot_drive_the_base_before_the_first_is_silent() {
    let mut link = Link::new();
    link.cycle(&BaseVelocity::ZERO);
    link.cycle(&FORWARD);
    let address = link.base.address().expect("bound");
    let first = std::mem::replace(
        &mut link.driver,
        UdpDrivenBase::open(address, 6).expect("a free port"),
    );
    link.now = link.now.plus_secs(CYCLE_SECS);
    let began = Instant::now();
    let mut report = BaseReport::default();
    while report.refusal.is_none() {
        assert!(began.elapsed() < TIMEOUT, "no reply");
        link.driver
            .drive(link.now, &BaseVelocity::ZERO)
            .expect("loopback works");
        link.base.cycle(link.base_nanos());
        report = link.driver.report(link.now);
    }
    assert!(!report.is_stop_confirmed, "{report:?}");
    assert_eq!(link.base.velocity(), FORWARD, "the first program drives");
    drop(first);
    link.now = link.now.plus_secs(1.1);
    assert!(link.cycle(&BaseVelocity::ZERO).is_stop_confirmed);
}

#[test]
fn a_fault_of_the_base_is_reported() {
    let mut link = Link::new();
    link.base.fault = Some("emergency stop".to_owned());
    let report = link.cycle(&BaseVelocity::ZERO);
    assert_eq!(report.fault.as_deref(), Some("emergency stop"));
    assert!(link.cycle(&FORWARD).fault.is_some());
    assert_eq!(link.base.velocity(), BaseVelocity::ZERO);
}

#[test]
fn without_a_listener_nothing_fails_and_nothing_is_reported() {
    let address = {
        let base = EmulatedBase::start().expect("a free port");
        base.address().expect("bound")
    };
    let mut driver = UdpDrivenBase::open(address, 5).expect("a free port");
    for step in 0..5 {
        let now = Stamp(step * 20_000_000);
        driver.drive(now, &FORWARD).expect("silence is no error");
        assert_eq!(driver.report(now), BaseReport::default());
    }
}
