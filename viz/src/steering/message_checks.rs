//! Checks the messages of clients that steer. Whatever arrives, a command that is passed on must
//! have finite numbers, the right number of joints and a time close to the server's clock, and the
//! inbox must stay small. The fuzz target `steer` calls this check.

use crate::clock::ServerClock;
use crate::server::access::Role;
use crate::steering::client_message::{ClientRequest, MessageContext, read_message};
use crate::steering::inbox::Inbox;
use crate::steering::request::{PreviewGoal, SteeringCommand, SteeringIntent, SteeringRequest};
use std::time::{Duration, Instant};

/// The seeds are for an arm with this number of joints.
const N_JOINTS: usize = 2;
/// Greatest absolute value of a number in `docs/reference/protocol.md`.
const MAX_NUMBER: f64 = 1e6;
/// Greatest integer in `docs/reference/protocol.md`.
const MAX_INTEGER: u64 = (1 << 53) - 1;
/// Greatest difference between times in `docs/reference/protocol.md`.
const MAX_DIFFERENCE: Duration = Duration::from_secs(10);
/// More requests of a client never wait, whatever it sends: 64 that can be refused, and between them
/// the openings of 8 switches, a stop and a released lease.
const MAX_WAITING: usize = 64 + 65 * (8 + 2);

/// Handles the messages of a client, one per line, and panics if a result is inconsistent.
pub(crate) fn check_messages(messages: &str) {
    let clock = ServerClock::start();
    let now = clock.instant(60_000.0).expect("a minute is representable");
    let context = |role| MessageContext {
        role,
        clock,
        n_joints: N_JOINTS,
    };
    let mut inbox = Inbox::default();
    inbox.join(1);
    for text in messages.lines() {
        check_viewer(text, now, context(Role::Viewer));
        match read_message(text, now, context(Role::Operator)) {
            Ok(ClientRequest::Steering(request)) => {
                check_request(&request, now);
                let ends_motion = matches!(
                    request,
                    SteeringRequest::Stop | SteeringRequest::ReleaseLease
                );
                let result = inbox.push(1, now, request);
                assert!(result.is_ok() || !ends_motion, "{result:?}");
            }
            Ok(ClientRequest::Ping { id }) => assert!(id <= MAX_INTEGER),
            Err(refusal) => {
                assert!(!refusal.text.is_empty() && refusal.text.lines().count() == 1);
            }
        }
    }
    let waiting = inbox.take();
    assert!(waiting.len() <= MAX_WAITING, "{} requests", waiting.len());
}

fn check_viewer(text: &str, now: Instant, context: MessageContext) {
    if let Ok(ClientRequest::Steering(request)) = read_message(text, now, context) {
        assert_eq!(request, SteeringRequest::Stop, "viewers may only stop");
    }
}

fn check_request(request: &SteeringRequest, now: Instant) {
    match request {
        SteeringRequest::Command(command) => check_command(command, now),
        SteeringRequest::Preview(preview) => {
            assert!(preview.id <= MAX_INTEGER);
            match &preview.goal {
                PreviewGoal::Pose { base_from_tip } => check_pose(base_from_tip),
                PreviewGoal::Joints { position } => check_joints(position),
            }
        }
        SteeringRequest::View { world_from_camera } => check_pose(world_from_camera),
        SteeringRequest::OfferLease { to } => assert!(*to <= MAX_INTEGER),
        SteeringRequest::Rearm { stop } => assert!(*stop <= MAX_INTEGER),
        SteeringRequest::Disconnected => panic!("no message says this"),
        _ => {}
    }
}

fn check_command(command: &SteeringCommand, now: Instant) {
    let integers = [
        command.device,
        command.sequence,
        command.grip.unwrap_or_default(),
    ];
    assert!(integers.iter().all(|integer| *integer <= MAX_INTEGER));
    assert!(command.grip.is_none() || command.intent.is_some());
    let late = command.captured_at.saturating_duration_since(now);
    let early = now.saturating_duration_since(command.captured_at);
    assert!(late.max(early) <= MAX_DIFFERENCE);
    match &command.intent {
        None => {}
        Some(
            SteeringIntent::Hand {
                base_from_hand: pose,
            }
            | SteeringIntent::Pose {
                base_from_tip: pose,
            },
        ) => check_pose(pose),
        Some(
            SteeringIntent::Joints { position: values }
            | SteeringIntent::JointVelocity { velocity: values },
        ) => check_joints(values),
        Some(SteeringIntent::TipVelocity {
            linear_m_s,
            angular_rad_s,
        }) => {
            check_numbers(linear_m_s);
            check_numbers(angular_rad_s);
        }
        Some(SteeringIntent::BaseVelocity {
            forward_m_s,
            left_m_s,
            yaw_rad_s,
        }) => check_numbers(&[*forward_m_s, *left_m_s, *yaw_rad_s]),
        Some(SteeringIntent::BaseGoal {
            x_m,
            y_m,
            heading_rad,
        }) => check_numbers(&[*x_m, *y_m, *heading_rad]),
    }
}

fn check_pose(pose: &[f64; 7]) {
    check_numbers(pose);
    let squares = pose[3..].iter().map(|number| number * number);
    let length = squares.sum::<f64>().sqrt();
    assert!((length - 1.0).abs() < 0.002, "{pose:?} is no pose");
}

fn check_joints(values: &[f64]) {
    assert_eq!(values.len(), N_JOINTS);
    check_numbers(values);
}

fn check_numbers(numbers: &[f64]) {
    let is_small = |number: &f64| number.abs() <= MAX_NUMBER;
    assert!(numbers.iter().all(is_small), "{numbers:?}");
}

#[cfg(test)]
mod tests {
    use super::check_messages;
    use numbers::random::Random;
    use std::path::Path;

    /// The seeds of the fuzz target, unchanged and with changed, removed and repeated bytes.
    #[test]
    fn corrupted_messages_are_refused_or_safe() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/seeds/steer");
        let mut random = Random::new(23);
        let mut n_seeds = 0;
        for entry in std::fs::read_dir(folder).expect("the seeds") {
            let seed = std::fs::read_to_string(entry.expect("a file").path()).expect("text");
            check_messages(&seed);
            for _ in 0..2000 {
                check_messages(&corrupted(&seed, &mut random));
            }
            n_seeds += 1;
        }
        assert!(n_seeds >= 2, "only {n_seeds} seeds");
    }

    fn corrupted(seed: &str, random: &mut Random) -> String {
        let mut bytes = seed.as_bytes().to_vec();
        for _ in 0..=random.below(3) {
            let at = random.below(bytes.len());
            match random.below(4) {
                0 => bytes[at] = u8::try_from(32 + random.below(95)).expect("ASCII"),
                1 => drop(bytes.remove(at)),
                2 => bytes.insert(at, b"0123456789e-.,[]{}\"\n"[random.below(20)]),
                _ => {
                    let end = (at + random.below(400)).min(bytes.len());
                    let section = bytes[at..end].to_vec();
                    bytes.splice(at..at, section);
                }
            }
        }
        String::from_utf8_lossy(&bytes).into_owned()
    }
}
