use super::GuardedStream;
use crate::server::admission::{Admission, Limits};
use std::future::poll_fn;
use std::io::ErrorKind;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;

const LIMITS: Limits = Limits {
    connections: 4,
    clients: 2,
    steering_clients: 1,
};
/// The timeout is shorter than the timeout of a server.
const WRITE_TIMEOUT: Duration = Duration::from_millis(200);
/// No test waits longer than this.
const TIMEOUT: Duration = Duration::from_secs(30);

/// An admission and a listening port that creates both ends of connections.
struct Port {
    admission: Arc<Admission>,
    listener: std::net::TcpListener,
}

impl Port {
    fn open() -> Self {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port exists");
        Self {
            admission: Admission::new(LIMITS),
            listener,
        }
    }

    /// Both ends of a new connection.
    fn connect(&self) -> (GuardedStream, TcpStream) {
        let address = self.listener.local_addr().expect("bound");
        let peer = std::net::TcpStream::connect(address).expect("it listens");
        let (stream, _) = self.listener.accept().expect("a peer waits");
        for stream in [&peer, &stream] {
            stream.set_nonblocking(true).expect("a socket");
        }
        let stream = TcpStream::from_std(stream).expect("a runtime");
        (
            GuardedStream::new(stream, Arc::clone(&self.admission)),
            TcpStream::from_std(peer).expect("a runtime"),
        )
    }
}

fn run(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.expect("a runtime").block_on(test);
}

#[test]
fn downloads_are_not_idle() {
    run(async {
        let port = Port::open();
        let (mut downloading, mut peer) = port.connect();
        let (idle, _b) = port.connect();
        downloading.connection().record_request();
        idle.connection().record_request();
        downloading
            .write_all(b"the next bytes of a mesh")
            .await
            .expect("the peer reads");
        assert_eq!(peer.read_u8().await.expect("a byte"), b't');
        port.admission.evict();
        assert!(
            idle.connection().is_closed() && !downloading.connection().is_closed(),
            "the connection in use stays"
        );
    });
}

#[test]
fn dropped_streams_make_room() {
    run(async {
        let port = Port::open();
        let (kept, _a) = port.connect();
        for _ in 0..2 * LIMITS.connections {
            drop(port.connect());
        }
        assert!(!kept.connection().is_closed());
    });
}

#[test]
fn peers_that_do_not_read_time_out() {
    run(async {
        let port = Port::open();
        let (mut stuck, _a) = port.connect();
        stuck.write_timeout = WRITE_TIMEOUT;
        let began = Instant::now();
        let filling = async {
            loop {
                if let Err(error) = stuck.write_all(&[0; 65536]).await {
                    break error.kind();
                }
            }
        };
        let error = tokio::time::timeout(TIMEOUT, filling).await;
        assert_eq!(error, Ok(ErrorKind::TimedOut), "the peer never reads");
        // Only the lower limit is checked, because a busy machine may close the connection later.
        assert!(began.elapsed() >= WRITE_TIMEOUT);
        assert!(stuck.connection().is_closed());
    });
}

/// Writes until the kernel holds no more.
async fn fill(stream: &mut GuardedStream) {
    let bytes = vec![0; 1 << 20];
    let mut is_blocked = |context: &mut Context<'_>| {
        let written = Pin::new(&mut *stream).poll_write(context, &bytes);
        Poll::Ready(written.is_pending())
    };
    while !poll_fn(&mut is_blocked).await {}
}

#[test]
fn slow_peers_do_not_time_out() {
    run(async {
        let port = Port::open();
        let (mut stream, mut peer) = port.connect();
        stream.write_timeout = TIMEOUT;
        fill(&mut stream).await;
        assert!(stream.write_timer.is_some(), "the peer does not read yet");
        let mut bytes = vec![0; 1 << 20];
        let reading = async { while peer.read(&mut bytes).await.expect("sent") > 0 {} };
        tokio::select! {
            sent = stream.write_all(b"more") => sent.expect("the peer reads again"),
            () = reading => panic!("the stream is open"),
        }
        assert!(stream.write_timer.is_none(), "the time starts anew");
    });
}
