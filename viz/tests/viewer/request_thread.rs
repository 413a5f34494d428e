//! A thread that answers requests for pictures, like the loop of a run.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use viz::{Hub, PendingRender};

/// Answers requests until it is dropped.
pub(crate) struct RequestThread {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl RequestThread {
    pub(crate) fn start(hub: Hub, mut answer: impl FnMut(PendingRender) + Send + 'static) -> Self {
        let stop: Arc<AtomicBool> = Arc::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                hub.pictures().wait_for_request(Duration::from_millis(50));
                if let Some(pending) = hub.pictures().next_request() {
                    answer(pending);
                }
            }
        });
        Self {
            stop,
            thread: Some(thread),
        }
    }
}

impl Drop for RequestThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            assert!(
                thread.join().is_ok() || std::thread::panicking(),
                "the thread panicked"
            );
        }
    }
}
