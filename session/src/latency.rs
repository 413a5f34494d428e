//! Quantiles of durations.

use numbers::quantile::{Rank, quantile};
use serde::Serialize;

/// Median and 99th percentile of durations, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Number of durations.
    pub n: usize,
}

impl Latency {
    /// `None` if there are no durations.
    pub fn of(millis: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut millis: Vec<f64> = millis.into_iter().collect();
        let p50 = quantile(&mut millis, 0.5, Rank::Lower)?;
        Some(Self {
            p50,
            p99: quantile(&mut millis, 0.99, Rank::Lower)?,
            n: millis.len(),
        })
    }
}
