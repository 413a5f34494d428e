use super::{
    Admission, Connection, IDLE_CLIENT_AFTER, Importance, Limits, PONG_TIMEOUT, UNRESPONSIVE_AFTER,
};
use std::sync::Arc;
use std::time::{Duration, Instant};

const LIMITS: Limits = Limits {
    connections: 4,
    clients: 2,
    steering_clients: 1,
};

/// An admission, and as many connections as it allows.
fn full_admission() -> (Arc<Admission>, [Arc<Connection>; 4]) {
    let admission = Admission::new(LIMITS);
    let connections = std::array::from_fn(|_| admission.admit(None));
    (admission, connections)
}

fn run(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.expect("a runtime").block_on(test);
}

/// Records the first message of a page, and its answer to a ping.
fn act_like_page(connection: &Connection) {
    connection.record_message();
    assert!(connection.start_ping());
    connection.record_pong();
}

/// The present importance of a client.
fn importance(connection: &Connection) -> Importance {
    connection.importance(Instant::now()).expect("a client")
}

#[test]
fn connections_leave_descriptors_for_files() {
    for (n_descriptors, connections, clients, steering_clients) in [
        (1024, 256, 32, 16),
        (1_000_000, 256, 32, 16),
        (128, 32, 16, 8),
        (16, 8, 4, 2),
    ] {
        let expected = Limits {
            connections,
            clients,
            steering_clients,
        };
        assert_eq!(Limits::of_descriptors(n_descriptors), expected);
    }
}

#[test]
fn oldest_half_open_request_is_evicted() {
    run(async {
        let (admission, [served, half_open, newer, newest]) = full_admission();
        served.record_request();
        let one_more = admission.admit(None);
        // The serving task sees the end.
        half_open.closed().await;
        for connection in [served, newer, newest, one_more] {
            assert!(!connection.is_closed());
        }
        admission.remove(&half_open);
        assert_eq!(admission.connections.lock().len(), 4);
    });
}

#[test]
fn oldest_idle_connection_is_evicted() {
    let (admission, [a, b, c, d]) = full_admission();
    for connection in [&a, &b, &c, &d] {
        connection.record_request();
    }
    // A download.
    a.record_progress();
    assert!(admission.admit_client(&b, false));
    admission.evict();
    assert!(c.is_closed(), "connections in use and clients stay");
    admission.evict();
    assert!(d.is_closed(), "closed connections are not counted");
    admission.evict();
    assert!(a.is_closed() && !b.is_closed());
}

#[test]
fn client_slots_are_counted_and_released() {
    let (admission, [a, b, c, _]) = full_admission();
    for connection in [&a, &b] {
        assert!(admission.admit_client(connection, false));
        act_like_page(connection);
    }
    assert!(
        !admission.admit_client(&c, false),
        "both clients are in use"
    );
    admission.remove(&a);
    assert!(admission.admit_client(&c, false));
    assert!(!b.is_closed());
}

#[test]
fn viewers_make_room_for_operators() {
    let (admission, [a, b, c, d]) = full_admission();
    let e = admission.admit(None);
    // The oldest connection made room for it.
    assert!(a.is_closed());
    for viewer in [&b, &c] {
        assert!(admission.admit_client(viewer, false));
        act_like_page(viewer);
    }
    assert!(
        admission.admit_client(&d, true),
        "the last viewer makes room"
    );
    act_like_page(&d);
    assert!(c.is_closed() && !b.is_closed());
    assert!(
        admission.admit_client(&e, true),
        "the other viewer makes room"
    );
    act_like_page(&e);
    assert!(b.is_closed());
    let newcomer = admission.admit(None);
    assert!(
        !admission.admit_client(&newcomer, true),
        "operators in use stay"
    );
    assert!(!admission.admit_client(&newcomer, false));
    assert!(!d.is_closed() && !e.is_closed());
}

#[test]
fn clients_that_steer_have_their_own_places() {
    let (admission, [page, other_page, operator, newcomer]) = full_admission();
    for client in [&page, &other_page] {
        assert!(admission.admit_client(client, true));
        act_like_page(client);
    }
    assert!(admission.admit_steering_client(&operator, true));
    // The operator has never answered a ping, so anybody could replace it on `/ws`.
    assert!(
        !admission.admit_steering_client(&newcomer, false),
        "a viewer replaces no operator"
    );
    assert!(!operator.is_closed());
    assert!(admission.admit_steering_client(&newcomer, true));
    assert!(operator.is_closed());
    assert!(!page.is_closed() && !other_page.is_closed());
}

#[test]
fn least_important_client_is_replaced() {
    let (admission, [speaking, other, newcomer, _]) = full_admission();
    assert!(admission.admit_client(&speaking, false) && admission.admit_client(&other, false));
    act_like_page(&speaking);
    other.record_message(); // It does not read.
    assert!(
        admission.admit_client(&newcomer, false),
        "the other client never answered a ping"
    );
    assert!(other.is_closed() && !speaking.is_closed());

    let in_use = importance(&speaking);
    assert!(matches!(in_use, Importance::Viewer(_)));
    let idle = speaking
        .importance(Instant::now() + IDLE_CLIENT_AFTER)
        .expect("a client");
    assert!(matches!(idle, Importance::Idle(_)));
    let silent = importance(&newcomer);
    assert!(
        speaking.start_ping() && !speaking.start_ping(),
        "one ping at a time"
    );
    let unresponsive = speaking
        .importance(Instant::now() + UNRESPONSIVE_AFTER)
        .expect("a client");
    assert!(unresponsive < silent && silent < idle && idle < in_use);
    assert!(in_use < Importance::Operator);
    speaking.record_pong();
    assert_eq!(importance(&speaking), in_use);
}

#[test]
fn unanswered_pings_have_a_deadline() {
    run(async {
        let (admission, [client, ..]) = full_admission();
        assert!(admission.admit_client(&client, false) && client.start_ping());
        let pinged = Instant::now();
        assert!(client.pong_due() <= pinged + PONG_TIMEOUT);
        client.record_pong();
        assert!(
            client.pong_due() >= pinged + PONG_TIMEOUT,
            "a quiet client may stay"
        );
        client.activity.lock().pinged = pinged.checked_sub(PONG_TIMEOUT);
        let closed = tokio::time::timeout(Duration::from_secs(10), client.closed());
        assert!(closed.await.is_ok(), "the ping was not answered in time");
    });
}
