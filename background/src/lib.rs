//! Background tasks. If a limit on threads or memory prevents a new thread during a run, the
//! calling thread does the work, so that keyframes and models are still saved.
//!
//! ```
//! let task = background::Task::start("sum", || (1..=100).sum::<u32>());
//! assert_eq!(task.join().expect("no panic"), 5050);
//! ```

pub mod output_thread;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};

/// Work that runs on its own thread, or that was done at once because no thread could be started.
#[derive(Debug)]
pub struct Task<T>(State<T>);

#[derive(Debug)]
enum State<T> {
    Running(JoinHandle<T>),
    Done(T),
}

impl<T: Send + 'static> Task<T> {
    /// Starts `work` on a thread with this name. If none can be started, does the work before it
    /// returns, and warns once.
    pub fn start(name: &str, work: impl FnOnce() -> T + Send + 'static) -> Self {
        Self::start_on(Builder::new().name(name.to_owned()), work)
    }

    fn start_on(builder: Builder, work: impl FnOnce() -> T + Send + 'static) -> Self {
        // A failed start drops its closure, so the work is kept here. The mutex is never contended,
        // because only one side takes the work. This is the thread or, after a failure, the caller.
        let kept = Arc::new(Mutex::new(Some(work)));
        // A panic cannot happen while the lock is held, so a poisoned lock holds valid work.
        let take =
            |kept: &Mutex<Option<_>>| kept.lock().unwrap_or_else(PoisonError::into_inner).take();
        let for_thread = Arc::clone(&kept);
        let started = builder.spawn(move || take(&for_thread).expect("the work is taken once")());
        Self(match started {
            Ok(thread) => State::Running(thread),
            Err(error) => {
                warn_once(&error);
                // The caller does the work here: a slow run that saves its results is better than
                // one that ends because a limit was reached in its last minutes.
                State::Done(take(&kept).expect("the work was not started")())
            }
        })
    }

    /// Whether [`Self::join`] returns at once.
    pub fn is_finished(&self) -> bool {
        match &self.0 {
            State::Running(thread) => thread.is_finished(),
            State::Done(_) => true,
        }
    }

    /// Waits for the result; the error is the panic of the work.
    pub fn join(self) -> std::thread::Result<T> {
        match self.0 {
            State::Running(thread) => thread.join(),
            State::Done(result) => Ok(result),
        }
    }
}

/// Starts the global thread pool, one thread per processor, so that a limit on threads is found
/// before data are captured.
///
/// # Errors
///
/// Fails if a thread cannot be started, or if the pool exists already.
pub fn start_threads() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    Ok(rayon::ThreadPoolBuilder::new().build_global()?)
}

/// Runs `work` in a separate thread pool, on three quarters of the processors. Training downscales
/// images in the global pool on all processors. If `work` ran in the global pool, training would
/// wait for it.
pub fn run_in_background_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    // One thread in four stays free for training and for the drivers, whose queues drop samples if
    // they wait for a processor.
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    match rayon::ThreadPoolBuilder::new()
        .num_threads((3 * n_processors).div_ceil(4))
        .build()
    {
        Ok(pool) => pool.install(work),
        Err(error) => {
            warn_once(&error);
            work()
        }
    }
}

fn warn_once(error: &dyn std::error::Error) {
    static HAS_WARNED: AtomicBool = AtomicBool::new(false);
    // A limit affects every later task, too. Repeated warnings would hide other messages.
    if !HAS_WARNED.swap(true, Ordering::Relaxed) {
        log::warn!(
            "cannot start a thread: {error}; the calling thread does the work, which slows the run down; raise the limits on \
             threads (ulimit -u, TasksMax) and on memory"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::Task;
    use std::thread::{Builder, current};

    #[test]
    fn work_is_done_on_its_own_thread() {
        let task = Task::start("worker", || current().name().map(str::to_owned));
        assert_eq!(task.join().expect("no panic").as_deref(), Some("worker"));
        let task = Task::start("worker", || panic!("requested by the test"));
        assert!(task.join().is_err());
    }

    #[test]
    fn work_is_done_although_no_thread_can_be_started() {
        // No machine has the address space for this stack.
        let builder = Builder::new().stack_size(1 << 60);
        let task = Task::start_on(builder, || current().id());
        assert!(task.is_finished());
        assert_eq!(task.join().expect("no panic"), current().id());
    }
}
