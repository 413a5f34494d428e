//! Times at which the machine stalled, so that tests with time limits do not count them.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Measures when a processor could not run even a thread of high priority, for example because the host ran another
/// virtual machine. Without real-time priority, the load of other programs and of this one counts, too.
pub(crate) struct Stalls {
    start: Instant,
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Vec<u128>>>,
}

impl Stalls {
    /// Starts one thread per processor, which sleeps for 1 ms at a time and records by how many milliseconds it wakes up
    /// late.
    pub(crate) fn start() -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let start = Instant::now();
        let start_on = |cpu| {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                run_first_on(cpu);
                let (mut stalled_ms, mut last) = (Vec::new(), start.elapsed());
                while !is_over.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_millis(1));
                    let now = start.elapsed();
                    let n_late = (((now - last).as_micros() + 500) / 1000).saturating_sub(1);
                    stalled_ms.extend(now.as_millis() - n_late..now.as_millis());
                    last = now;
                }
                stalled_ms
            })
        };
        let n_cpus = std::thread::available_parallelism().expect("the number of processors is known").get();
        Self { start, threads: (0..n_cpus).map(start_on).collect(), is_over }
    }

    /// Stops the threads, and returns when at least one processor was stalled.
    pub(crate) fn stop(mut self) -> StalledTimes {
        self.is_over.store(true, Ordering::Relaxed);
        let threads = self.threads.drain(..);
        let stalled_ms = threads.flat_map(|thread| thread.join().expect("the thread does not panic")).collect();
        StalledTimes { start: self.start, stalled_ms }
    }
}

/// Gives this thread a high priority on one processor. If that is denied, it measures less accurately.
fn run_first_on(cpu: usize) {
    /// Higher than the priority of the Franka driver and the emulated robot, so that their computing time does not count
    /// as a stall.
    #[cfg(target_os = "linux")]
    const PRIORITY: i32 = 90;
    #[cfg(target_os = "linux")]
    let _ = franka::realtime::pin_current_thread_to_cpu(cpu)
        .and_then(|()| franka::realtime::set_current_thread_scheduler_priority(PRIORITY));
    #[cfg(not(target_os = "linux"))]
    let _ = cpu;
}

impl Drop for Stalls {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

/// When at least one processor was stalled.
pub(crate) struct StalledTimes {
    start: Instant,
    /// Since `start`.
    stalled_ms: BTreeSet<u128>,
}

impl StalledTimes {
    /// For how long a processor was stalled between two times.
    pub(crate) fn between(&self, from: Instant, to: Instant) -> Duration {
        let ms = |time: Instant| time.duration_since(self.start).as_millis();
        let n_ms = self.stalled_ms.range(ms(from)..=ms(to)).count();
        Duration::from_millis(n_ms.try_into().expect("shorter than a test"))
    }
}
