//! The experiments of `fieldrig bench`. They train many models, or measure a part of the program.
//! They draw charts of the results.
//!
//! [`curve`], [`budget`], [`ablation`] and [`stability`] train models. They save each finished run
//! to a file, so that a bench restarted in the same folder does not repeat it. [`kernels`] and
//! [`field`] measure training speed. [`stamps`] measures the errors of image stamps, and
//! [`calibration`] measures the accuracy of calibration. [`live`] measures a live run with viewers,
//! [`memory`] measures the memory of a long run, and
//! [`steering`] measures how fast steered arms brake and how well they follow. The results are [`Findings`], which contain
//! JSON with every number, charts, and a page.
//!
//! The caller opens the GPU, requests stops and receives reports ([`Host`], [`BenchObserver`]).
//!
//! ```
//! use bench::stamps::{StampsOptions, measure};
//!
//! let options = StampsOptions {
//!     rates_hz: vec![30.0],
//!     fixed_millis: 5.0,
//!     jitter_millis: 75.0,
//!     drift_ppm: 50.0,
//!     seconds: 60.0,
//!     settle_seconds: 10.0,
//!     seeds: 2,
//!     out: "bench-stamps".into(),
//! };
//! let errors = measure(&options)?;
//! let [calibrated, uncalibrated] = &errors[..] else { panic!("one camera rate, calibrated and not") };
//! assert!(calibrated.within_1_ms_frac > 0.99);
//! // A fixed latency cannot be detected from stamps.
//! assert!((uncalibrated.median_millis - 5.0).abs() < 0.5);
//! # Ok::<(), anyhow::Error>(())
//! ```

pub mod ablation;
pub mod budget;
pub mod calibration;
pub mod curve;
mod disturb;
pub mod field;
mod findings;
mod growth;
pub mod kernels;
pub mod live;
mod live_disturbance;
mod measured_run;
pub mod memory;
mod over_time;
mod peer;
mod runs;
pub mod stability;
pub mod stamps;
mod statistics;
pub mod steering;
mod variant;
mod viewer;
mod websocket;

pub use disturb::Disturbance;
pub use findings::{BenchResult, Findings};
pub use growth::{Excluded, Growth, Sample, resident_bytes};
pub use live_disturbance::LiveDisturbance;
pub use measured_run::{MeasuredRun, RequestedRun, StartRun};
pub use over_time::{Bucket, OverTime, Timeline, Trend};
pub use runs::{
    BenchObserver, Disturbed, Host, Run, RunReport, RunScores, RunSettings, RunsOptions,
};
pub use viewer::{ReceivedPicture, Viewer, ViewerOptions};
