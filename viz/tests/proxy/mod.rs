//! A TCP proxy whose link can be cut, or is slow: connections stay open, but nothing passes until the link is restored.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Its threads end with the process or their connections.
pub(crate) struct Proxy {
    address: SocketAddr,
    is_cut: Arc<AtomicBool>,
}

impl Proxy {
    /// Forwards connections to `server`.
    pub(crate) fn start(server: SocketAddr) -> Self {
        Self::with_rate(server, f64::INFINITY)
    }

    /// Forwards connections to `server` at this rate in each direction.
    pub(crate) fn with_rate(server: SocketAddr, bytes_per_sec: f64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
        let address = listener.local_addr().expect("bound");
        let is_cut: Arc<AtomicBool> = Arc::default();
        let is_cut_here = Arc::clone(&is_cut);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = TcpStream::connect(server) else { continue };
                if bytes_per_sec.is_finite() {
                    // Twice the largest segment on loopback; with less, the kernel waits for timers.
                    rustix::net::sockopt::set_socket_recv_buffer_size(&server, 65_536).expect("a small buffer");
                }
                let ends = [&client, &server].map(|stream| stream.try_clone().expect("a descriptor"));
                let [client_too, server_too] = ends;
                for (from, to) in [(client, server_too), (server, client_too)] {
                    let is_cut = Arc::clone(&is_cut_here);
                    std::thread::spawn(move || pump(from, to, &is_cut, bytes_per_sec));
                }
            }
        });
        Self { address, is_cut }
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    pub(crate) fn cut(&self) {
        self.is_cut.store(true, Ordering::Relaxed);
    }

    pub(crate) fn restore(&self) {
        self.is_cut.store(false, Ordering::Relaxed);
    }
}

fn pump(mut from: TcpStream, mut to: TcpStream, is_cut: &AtomicBool, bytes_per_sec: f64) {
    let mut bytes = [0; 16 * 1024];
    let mut free_at = Instant::now();
    loop {
        let n = from.read(&mut bytes).unwrap_or(0);
        while is_cut.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(5));
        }
        free_at = free_at.max(Instant::now()) + Duration::from_secs_f64(n as f64 / bytes_per_sec);
        std::thread::sleep(free_at.saturating_duration_since(Instant::now()));
        if n == 0 || to.write_all(&bytes[..n]).is_err() {
            // Fails if the other side has already closed this end, which is harmless.
            let _ = to.shutdown(Shutdown::Both);
            return;
        }
    }
}
