//! The thread that reads commands and sends states.
//!
//! The thread of the server also encodes and sends pictures, lists and chunks of models. Steering
//! has its own thread, so that none of them can delay a command or a state.

use crate::Error;
use crate::steering::socket::SteeringSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::sync::watch;

/// Maximum time that a stopping server waits until clients have received the reason. A client that
/// does not read must not delay the end of the program for longer.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);

/// The thread of a server on which all clients of `/steer` are served.
#[derive(Debug)]
pub(crate) struct SteeringThread {
    spawner: SteeringSpawner,
    thread: Option<JoinHandle<()>>,
}

/// Starts tasks on the thread.
#[derive(Clone, Debug)]
pub(crate) struct SteeringSpawner {
    runtime: Handle,
    n_clients: Arc<AtomicUsize>,
}

impl SteeringThread {
    /// Starts the thread. It ends after `stopped` has become true.
    pub(crate) fn start(mut stopped: watch::Receiver<bool>) -> Result<Self, Error> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| Error::Thread { source })?;
        let spawner = SteeringSpawner {
            runtime: runtime.handle().clone(),
            n_clients: Arc::default(),
        };
        let n_clients = Arc::clone(&spawner.n_clients);
        let thread = std::thread::Builder::new()
            .name("viz-steering".to_owned())
            .spawn(move || {
                runtime.block_on(async {
                    // An error means that the server is gone.
                    let _ = stopped.wait_for(|is_stopped| *is_stopped).await;
                    let _ = tokio::time::timeout(CLOSE_TIMEOUT, all_left(&n_clients)).await;
                });
                runtime.shutdown_background();
            })
            .map_err(|source| Error::Thread { source })?;
        Ok(Self {
            spawner,
            thread: Some(thread),
        })
    }

    /// Starts tasks on this thread.
    pub(crate) fn spawner(&self) -> SteeringSpawner {
        self.spawner.clone()
    }

    /// The runtime of the thread.
    pub(crate) fn runtime(&self) -> &Handle {
        &self.spawner.runtime
    }

    /// Waits until the thread has ended. Returns false if it panicked.
    pub(crate) fn join(&mut self) -> bool {
        self.thread
            .take()
            .is_none_or(|thread| thread.join().is_ok())
    }
}

impl SteeringSpawner {
    /// Serves a client on this thread.
    pub(crate) fn serve(&self, socket: SteeringSocket) {
        let counted = CountedClient::new(&self.n_clients);
        self.runtime.spawn(async move {
            socket.serve().await;
            drop(counted);
        });
    }
}

async fn all_left(n_clients: &AtomicUsize) {
    while n_clients.load(Ordering::Relaxed) > 0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Counts a client until it is dropped.
struct CountedClient(Arc<AtomicUsize>);

impl CountedClient {
    fn new(n_clients: &Arc<AtomicUsize>) -> Self {
        n_clients.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(n_clients))
    }
}

impl Drop for CountedClient {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}
