use super::{Inbox, MAX_DEVICES, MAX_WAITING, NotAccepted};
use crate::steering::request::{
    PreviewGoal, PreviewRequest, SteeringCommand, SteeringIntent, SteeringRequest,
};
use std::time::Instant;

const A: u64 = 4;
const B: u64 = 9;

fn inbox() -> Inbox {
    let mut inbox = Inbox::default();
    inbox.join(A);
    inbox.join(B);
    inbox
}

fn command(device: u64, sequence: u64, grip: Option<u64>) -> SteeringRequest {
    SteeringRequest::Command(SteeringCommand {
        device,
        sequence,
        captured_at: Instant::now(),
        grip,
        intent: grip.map(|_| SteeringIntent::JointVelocity {
            velocity: vec![0.1],
        }),
    })
}

fn preview(id: u64) -> SteeringRequest {
    let position = vec![0.0];
    let goal = PreviewGoal::Joints { position };
    SteeringRequest::Preview(PreviewRequest { id, goal })
}

fn push(inbox: &mut Inbox, client: u64, request: SteeringRequest) {
    inbox
        .push(client, Instant::now(), request)
        .expect("accepted");
}

/// Client, device, sequence and grip of the commands, or the name of the request.
fn taken(inbox: &mut Inbox) -> Vec<String> {
    let requests = inbox.take().into_iter();
    let text = |client: u64, request: SteeringRequest| match request {
        SteeringRequest::Command(command) => format!(
            "{client}: {} {} {:?}",
            command.device, command.sequence, command.grip
        ),
        SteeringRequest::Preview(request) => format!("{client}: preview {}", request.id),
        other => format!("{client}: {other:?}"),
    };
    requests
        .map(|received| text(received.client, received.request))
        .collect()
}

#[test]
fn newest_command_of_each_device_wins() {
    let mut inbox = inbox();
    for sequence in 1..=1000 {
        push(&mut inbox, A, command(1, sequence, Some(3)));
        push(&mut inbox, A, command(2, sequence, None));
        push(&mut inbox, B, command(1, 5000 + sequence, Some(3)));
    }
    assert_eq!(
        taken(&mut inbox),
        ["4: 1 1000 Some(3)", "4: 2 1000 None", "9: 1 6000 Some(3)"]
    );
    assert!(inbox.is_empty());
}

#[test]
fn each_opening_and_closing_stays_in_order() {
    let mut inbox = inbox();
    let grips = [
        None,
        None,
        Some(1),
        Some(1),
        None,
        Some(2),
        Some(2),
        Some(3),
    ];
    for (sequence, grip) in (1..).zip(grips) {
        push(&mut inbox, A, command(1, sequence, grip));
    }
    let expected = [
        "4: 1 2 None",
        "4: 1 4 Some(1)",
        "4: 1 5 None",
        "4: 1 7 Some(2)",
        "4: 1 8 Some(3)",
    ];
    assert_eq!(taken(&mut inbox), expected);
}

#[test]
fn only_the_newest_view_of_a_client_waits() {
    let mut inbox = inbox();
    let view = |x| SteeringRequest::View {
        world_from_camera: [x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    };
    let newest = command(1, 2, Some(1));
    push(&mut inbox, A, command(1, 1, Some(1)));
    push(&mut inbox, A, view(1.0));
    push(&mut inbox, B, view(2.0));
    push(&mut inbox, A, newest.clone());
    push(&mut inbox, A, view(3.0));
    let requests: Vec<_> = inbox
        .take()
        .into_iter()
        .map(|waiting| (waiting.client, waiting.request))
        .collect();
    let expected = [(A, newest), (A, view(3.0)), (B, view(2.0))];
    assert_eq!(requests, expected);
}

#[test]
fn commands_do_not_overtake_other_requests() {
    let mut inbox = inbox();
    push(&mut inbox, A, command(1, 1, Some(1)));
    push(&mut inbox, A, command(1, 2, Some(1)));
    // The switch was closed before motion was permitted, so this grip may not move the arm.
    push(&mut inbox, A, SteeringRequest::Rearm { stop: 1 });
    push(&mut inbox, A, command(1, 3, Some(1)));
    push(&mut inbox, A, command(1, 4, Some(1)));
    push(&mut inbox, B, SteeringRequest::Stop);
    push(&mut inbox, A, command(1, 5, Some(1)));
    let expected = [
        "4: 1 2 Some(1)",
        "4: Rearm { stop: 1 }",
        "4: 1 4 Some(1)",
        "9: Stop",
        "4: 1 5 Some(1)",
    ];
    assert_eq!(taken(&mut inbox), expected);
}

#[test]
fn leases_and_permissions_are_neither_lost_nor_reordered() {
    let mut inbox = inbox();
    let requests = [
        (A, SteeringRequest::TakeLease),
        (A, SteeringRequest::OfferLease { to: B }),
        (B, SteeringRequest::TakeLease),
        (A, SteeringRequest::ReleaseLease),
        (A, SteeringRequest::TakeLease),
        (B, SteeringRequest::Stop),
        (B, SteeringRequest::Rearm { stop: 1 }),
        (A, SteeringRequest::Stop),
    ];
    for (client, request) in requests.clone() {
        push(&mut inbox, client, request);
    }
    let waiting: Vec<_> = inbox
        .take()
        .into_iter()
        .map(|received| (received.client, received.request))
        .collect();
    assert_eq!(waiting, requests);
}

#[test]
fn requests_that_change_nothing_are_merged() {
    let mut inbox = inbox();
    for sequence in 1..=1000 {
        push(&mut inbox, A, SteeringRequest::Stop);
        push(&mut inbox, B, SteeringRequest::Stop);
        push(&mut inbox, B, SteeringRequest::RenewLease);
        push(&mut inbox, B, command(1, sequence, Some(1)));
        push(&mut inbox, B, preview(sequence));
    }
    let expected = [
        "4: Stop",
        "9: RenewLease",
        "9: 1 1000 Some(1)",
        "9: preview 1000",
    ];
    assert_eq!(taken(&mut inbox), expected);
}

#[test]
fn repeated_and_overtaken_commands_are_refused_even_after_they_were_taken() {
    let mut inbox = inbox();
    push(&mut inbox, A, command(1, 7, Some(1)));
    inbox.take();
    for sequence in [0, 6, 7] {
        let refused = inbox.push(A, Instant::now(), command(1, sequence, Some(1)));
        let newest = 7;
        assert_eq!(refused, Err(NotAccepted::OutOfOrder { sequence, newest }));
    }
    assert!(inbox.is_empty());
    // An open switch is obeyed whatever its number is, and does not lower the number.
    push(&mut inbox, A, command(1, 2, None));
    assert!(
        inbox
            .push(A, Instant::now(), command(1, 3, Some(1)))
            .is_err()
    );
    // Other devices and clients count from the beginning.
    push(&mut inbox, A, command(2, 0, Some(1)));
    push(&mut inbox, B, command(1, 0, Some(1)));
}

#[test]
fn a_flood_is_limited_and_does_not_hold_back_what_ends_motion() {
    let mut inbox = inbox();
    let mut n_refused = 0;
    for ix in 0..100_000_u64 {
        let request = match ix % 5 {
            0 => SteeringRequest::TakeLease,
            1 => command(ix % 3, ix, Some(ix)),
            2 => command(ix % 3, ix, None),
            3 => SteeringRequest::Rearm { stop: 1 },
            _ => SteeringRequest::ReleaseLease,
        };
        let is_urgent = matches!(ix % 5, 2 | 4);
        let result = inbox.push(A, Instant::now(), request);
        if result.is_err() {
            assert!(!is_urgent, "an urgent request was refused: {result:?}");
            n_refused += 1;
        }
    }
    assert!(n_refused > 50_000);
    push(&mut inbox, A, SteeringRequest::Stop);
    // Other clients are not affected.
    push(&mut inbox, B, SteeringRequest::TakeLease);
    let waiting = taken(&mut inbox);
    assert!(waiting.len() < 4 * MAX_WAITING, "{}", waiting.len());
    let end = ["4: Stop", "9: TakeLease"];
    assert!(waiting.ends_with(&end.map(str::to_owned)), "{waiting:?}");
}

#[test]
fn number_of_devices_is_limited() {
    let mut inbox = inbox();
    for device in 0..MAX_DEVICES as u64 {
        push(&mut inbox, A, command(device, 1, None));
    }
    let refused = inbox.push(A, Instant::now(), command(1000, 1, None));
    assert_eq!(refused, Err(NotAccepted::Devices));
    push(&mut inbox, A, command(0, 2, None));
}

#[test]
fn a_client_that_leaves_releases_and_its_stop_stays() {
    let mut inbox = inbox();
    push(&mut inbox, A, SteeringRequest::TakeLease);
    inbox.take();
    push(&mut inbox, A, command(1, 1, Some(1)));
    push(&mut inbox, A, SteeringRequest::Stop);
    push(&mut inbox, A, SteeringRequest::Rearm { stop: 1 });
    inbox.leave(A, Instant::now());
    assert_eq!(taken(&mut inbox), ["4: Stop", "4: Disconnected"]);
    let gone = inbox.push(A, Instant::now(), SteeringRequest::TakeLease);
    assert_eq!(gone, Err(NotAccepted::Gone));
    inbox.leave(A, Instant::now());
    assert!(inbox.is_empty());
}

#[test]
fn a_silent_client_releases_once_until_it_speaks_again() {
    let mut inbox = inbox();
    push(&mut inbox, A, SteeringRequest::TakeLease);
    inbox.take();
    inbox.silence(A, Instant::now());
    inbox.silence(A, Instant::now());
    assert_eq!(taken(&mut inbox), ["4: Disconnected"]);
    push(&mut inbox, A, SteeringRequest::TakeLease);
    assert_eq!(taken(&mut inbox), ["4: TakeLease"]);
    inbox.leave(A, Instant::now());
    assert_eq!(taken(&mut inbox), ["4: Disconnected"]);
}

#[test]
fn a_second_silence_does_not_hide_the_first() {
    let mut inbox = inbox();
    push(&mut inbox, A, SteeringRequest::TakeLease);
    inbox.take();
    inbox.silence(A, Instant::now());
    // The loop is held up: it has not seen the silence when the client speaks and leaves.
    push(&mut inbox, A, SteeringRequest::TakeLease);
    inbox.leave(A, Instant::now());
    assert_eq!(taken(&mut inbox), ["4: Disconnected"]);
}

#[test]
fn clients_that_come_and_go_leave_nothing_behind() {
    let mut inbox = Inbox::default();
    for client in 0..10_000 {
        inbox.join(client);
        push(&mut inbox, client, SteeringRequest::TakeLease);
        push(&mut inbox, client, SteeringRequest::Stop);
        inbox.leave(client, Instant::now());
    }
    // The loop knows none of the clients, so it needs to know only the stop.
    assert_eq!(taken(&mut inbox), ["0: Stop"]);
}
