//! Times at which the machine stalled, so that tests with time limits do not count them.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Measures when a processor could not run even a thread of high priority, for example because the
/// host ran another virtual machine. Without real-time priority, the load of other programs and of
/// this program counts, too.
pub struct Stalls {
    start: Instant,
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Vec<u128>>>,
}

impl Stalls {
    /// Starts one thread per processor, which sleeps for 1 ms at a time and records by how many
    /// milliseconds it wakes up late.
    pub fn start() -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let start = Instant::now();
        let start_on = |cpu| {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                pin_with_high_priority(cpu);
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
        let n_cpus = std::thread::available_parallelism()
            .expect("the number of processors is known")
            .get();
        Self {
            start,
            threads: (0..n_cpus).map(start_on).collect(),
            is_over,
        }
    }

    /// Stops the threads, and returns the times at which at least one processor was stalled.
    pub fn stop(mut self) -> StalledTimes {
        self.is_over.store(true, Ordering::Relaxed);
        let threads = self.threads.drain(..);
        let stalled_ms = threads
            .flat_map(|thread| thread.join().expect("the thread does not panic"))
            .collect();
        StalledTimes {
            start: self.start,
            stalled_ms,
        }
    }
}

/// Gives this thread a high priority on one processor. If the priority is denied, the thread
/// measures less accurately.
fn pin_with_high_priority(cpu: usize) {
    /// This priority is higher than the priorities of the Franka driver and the emulated robot, so
    /// that their computing time does not count as a stall.
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

/// The times at which at least one processor was stalled.
pub struct StalledTimes {
    start: Instant,
    /// Milliseconds since `start`.
    stalled_ms: BTreeSet<u128>,
}

impl StalledTimes {
    /// Fraction of the time between two instants in which a processor was stalled. It is at most 20
    /// %, so that a stalled machine does not excuse every failure.
    pub fn frac(&self, from: Instant, to: Instant) -> f64 {
        const MAX_FRAC: f64 = 0.2;
        let ms = |time: Instant| time.duration_since(self.start).as_millis();
        let n_ms = self.stalled_ms.range(ms(from)..ms(to)).count();
        (n_ms as f64 * 1e-3 / (to - from).as_secs_f64()).min(MAX_FRAC)
    }
}

#[test]
fn only_stalls_within_the_time_count() {
    let start = Instant::now();
    let at = |ms| start + Duration::from_millis(ms);
    let stalled_ms = (100..150).chain(5000..9000).collect();
    let stalled = StalledTimes { start, stalled_ms };
    let close = |frac: f64, expected: f64| (frac - expected).abs() < 1e-9;
    assert!(
        close(stalled.frac(at(0), at(1000)), 0.05) && close(stalled.frac(at(300), at(500)), 0.0)
    );
    assert!(close(stalled.frac(at(4000), at(9000)), 0.2), "at most");
}
