//! Report of an estimate of a time offset.

use super::Heading;
use super::page::{self, Page};
use super::{number, with_sigma};
use crate::chart::{Axis, Chart, Line, Marker, Point, Scale};
use calibration::time_offset::{MotionProfile, TimeOffset};

/// Contents of the report.
#[derive(Clone, Copy, Debug)]
pub struct TimeOffsetReport<'a> {
    /// Input, verdict and warnings.
    pub heading: &'a Heading,
    /// Rotation rates and their correlation.
    pub profile: Option<&'a MotionProfile>,
    /// The result. `None` if it was refused.
    pub offset: Option<&'a TimeOffset>,
}

/// Maximum number of points of a curve, which is about one per pixel of its width. More points
/// would enlarge the page without a visible difference.
const MAX_POINTS: usize = 800;

impl TimeOffsetReport<'_> {
    /// The page.
    pub fn html(&self) -> String {
        let figures = self.offset.map_or(Vec::new(), figures);
        let verdict = self.offset.map_or(String::new(), |offset| {
            format!(
                "Add {} s to stamps of B to get stamps of A.",
                with_sigma(offset.offset_secs, offset.sigma_secs, 6)
            )
        });
        let mut page = Page::new("Time offset", self.heading, &verdict, &figures);
        if let Some(offset) = self.offset {
            page.table(
                "Result",
                &["parameter", "value ± standard deviation"],
                parameters(offset),
            );
        }
        if let Some(profile) = self.profile {
            let legend = "Correlation of the rotation rates at each offset. One high, narrow peak determines the offset; several peaks of equal height mean that the motion repeats.";
            page.section("Correlation", legend, &correlation(profile, self.offset));
            let legend = "The rotation rate of rigidly joined bodies is the same, so the curves of A (blue) and B (orange) must coincide after the correction. Rates above the 95 % quantile of a stream are clipped, as in the correlation, so that single wrong poses do not dominate. Shown are the 15 seconds with the most motion.";
            page.section("Rotation rates", legend, &self.rates(profile));
        }
        if let Some(offset) = self.offset {
            let legend = "Angle between the orientations of both bodies after the correction.";
            page.section("Residual", legend, &residual(offset));
        }
        page.finish()
    }

    /// The rates in the part of the recording with the most motion.
    fn rates(&self, profile: &MotionProfile) -> String {
        let [a, b] = &profile.rates;
        let (Some(start_a), Some(start_b)) = (a.first(), b.first()) else {
            return String::new();
        };
        let shown = ShownPart {
            secs: liveliest(a),
            start_secs: start_a[0],
        };
        let rates_a = shown.degrees(a, |secs| secs);
        // The clocks may have different epochs. Before the correction, both streams begin at the
        // same time.
        let from_first = |secs: f64| secs - start_b[0] + start_a[0];
        let before = rates_chart(
            "Before: both streams from their first stamps",
            [rates_a.clone(), shown.degrees(b, from_first)],
        );
        let Some(offset) = self.offset else {
            return before;
        };
        // With drift, the estimated offset is the offset at `mid_secs`, and it changes linearly
        // with time.
        let drift = offset.drift_ppm.map_or(0.0, |[drift, _]| 1e-6 * drift);
        let on_a = |secs: f64| secs + offset.offset_secs + drift * (secs - offset.mid_secs);
        before
            + &rates_chart(
                "After: both streams on the clock of A",
                [rates_a, shown.degrees(b, on_a)],
            )
    }
}

/// The part of the recording that is shown.
struct ShownPart {
    /// Interval on the clock of A, seconds.
    secs: std::ops::RangeInclusive<f64>,
    /// Time that is shown as 0.
    start_secs: f64,
}

impl ShownPart {
    /// The part of a curve, in degrees per second. `secs_on_a` converts times to the clock of A.
    fn degrees(&self, curve: &[[f64; 2]], secs_on_a: impl Fn(f64) -> f64) -> Vec<[f64; 2]> {
        let moved = curve
            .iter()
            .map(|[secs, rate]| [secs_on_a(*secs), rate.to_degrees()]);
        let shown = moved
            .filter(|[secs, _]| self.secs.contains(secs))
            .map(|[secs, rate]| [secs - self.start_secs, rate]);
        interrupted(&shown.collect::<Vec<_>>())
    }
}

/// The interval of a curve in which its values vary most.
fn liveliest(curve: &[[f64; 2]]) -> std::ops::RangeInclusive<f64> {
    /// The interval is long enough for several movements, and short enough to see an offset of tens
    /// of milliseconds.
    const SHOWN_SECS: f64 = 15.0;
    let (Some([first, _]), Some([last, _])) = (curve.first(), curve.last()) else {
        return 0.0..=0.0;
    };
    let mut best = (0.0, *first);
    let mut at = *first;
    // Intervals overlap by half, so that a movement is not cut by the borders of all of them. At
    // least one interval is tried, even in a short recording.
    while at < (last - SHOWN_SECS).max(first + 0.5 * SHOWN_SECS) {
        let found = variation(curve, at..=at + SHOWN_SECS);
        if found > best.0 {
            best = (found, at);
        }
        at += 0.5 * SHOWN_SECS;
    }
    best.1..=best.1 + SHOWN_SECS
}

/// Sum of the squared differences from the mean, over the points of a curve in an interval.
fn variation(curve: &[[f64; 2]], interval: std::ops::RangeInclusive<f64>) -> f64 {
    let values: Vec<f64> = curve
        .iter()
        .filter(|[secs, _]| interval.contains(secs))
        .map(|[_, value]| *value)
        .collect();
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>()
}

fn figures(offset: &TimeOffset) -> Vec<page::Figure> {
    let mut figures = vec![
        ("offset", number(Some(offset.offset_secs), 6), "s"),
        (
            "standard deviation",
            number(Some(1e3 * offset.sigma_secs), 3),
            "ms",
        ),
        ("residual", number(Some(offset.rms_deg), 3), "°"),
    ];
    if let Some([drift, _]) = offset.drift_ppm {
        figures.push(("drift", number(Some(drift), 1), "ppm"));
    }
    figures
}

fn parameters(offset: &TimeOffset) -> Vec<Vec<String>> {
    let mut rows = vec![
        vec![
            "offset to add to stamps of B, s".to_owned(),
            with_sigma(offset.offset_secs, offset.sigma_secs, 6),
        ],
        vec![
            "RMS difference of the orientations, degrees".to_owned(),
            number(Some(offset.rms_deg), 3),
        ],
    ];
    let drift = offset
        .drift_ppm
        .map_or("not significant".to_owned(), |[drift, sigma]| {
            format!(
                "{}, offset valid at {:.3} s on the clock of B",
                with_sigma(drift, sigma, 1),
                offset.mid_secs
            )
        });
    rows.push(vec!["drift of A relative to B, ppm".to_owned(), drift]);
    match &offset.hand_eye {
        Some(Ok(bodies)) => {
            let position: [f64; 3] = (1e3 * bodies.a_body_from_b_body.translation.vector).into();
            let three = |values: [f64; 3], digits: usize| {
                values.map(|value| format!("{value:.digits$}")).join(", ")
            };
            rows.push(vec![
                "position of body B in body A, mm".to_owned(),
                three(position, 2),
            ]);
            rows.push(vec![
                "standard deviation, mm".to_owned(),
                three(bodies.sigma_mm, 2),
            ]);
            rows.push(vec![
                "standard deviation, degrees".to_owned(),
                three(bodies.sigma_deg, 3),
            ]);
        }
        Some(Err(refusal)) => rows.push(vec![
            "transform between the bodies".to_owned(),
            format!("refused: {refusal}"),
        ]),
        None => (),
    }
    rows
}

fn correlation(profile: &MotionProfile, offset: Option<&TimeOffset>) -> String {
    let peak = profile
        .correlation
        .iter()
        .max_by(|a, b| a[1].total_cmp(&b[1]));
    let Some(peak) = peak else {
        return String::new();
    };
    // Without a limit, the offset may be the difference between two clock epochs. Labels are then
    // relative to the peak.
    const MAX_ABSOLUTE_SECS: f64 = 1e5;
    let base_secs = if peak[0].abs() > MAX_ABSOLUTE_SECS {
        peak[0].round()
    } else {
        0.0
    };
    let label = if base_secs == 0.0 {
        "offset, s".to_owned()
    } else {
        format!("offset relative to {base_secs:.0} s (s)")
    };
    let curve = profile
        .correlation
        .iter()
        .map(|[secs, value]| [secs - base_secs, *value])
        .collect::<Vec<_>>();
    // The result is refined with the orientations, so it may differ from the peak.
    let (at, what) = match offset {
        Some(offset) => (offset.offset_secs - base_secs, "result"),
        None => (peak[0] - base_secs, "highest correlation"),
    };
    page::chart(&Chart {
        title: format!("Highest correlation: {:.2}", peak[1]),
        subtitle: String::new(),
        x: linear(&label),
        y: linear("correlation"),
        lines: vec![line("correlation", &with_peaks(&curve))],
        thresholds: Vec::new(),
        markers: vec![Marker {
            x: at,
            label: format!("{what}: {at:.3} s"),
            line_ix: 0,
        }],
    })
}

fn rates_chart(title: &str, [a, b]: [Vec<[f64; 2]>; 2]) -> String {
    page::chart(&Chart {
        title: title.to_owned(),
        subtitle: String::new(),
        x: linear("time, s"),
        y: linear("rotation rate, °/s"),
        lines: vec![line("A", &with_peaks(&a)), line("B", &with_peaks(&b))],
        thresholds: Vec::new(),
        markers: Vec::new(),
    })
}

fn residual(offset: &TimeOffset) -> String {
    let Some(first) = offset.residuals.first() else {
        return String::new();
    };
    let curve: Vec<[f64; 2]> = offset
        .residuals
        .iter()
        .map(|[secs, deg]| [secs - first[0], *deg])
        .collect();
    page::chart(&Chart {
        title: format!("RMS {:.3}°", offset.rms_deg),
        subtitle: String::new(),
        x: linear("time, s"),
        y: linear("angle, °"),
        lines: vec![line("residual", &with_peaks(&curve))],
        thresholds: Vec::new(),
        markers: Vec::new(),
    })
}

/// Inserts a NaN point into each gap, so that the line is interrupted.
fn interrupted(curve: &[[f64; 2]]) -> Vec<[f64; 2]> {
    // Minimum length of a gap, relative to the smallest step. One missing sample doubles the step
    // and does not count as a gap. Two missing samples count as a gap.
    const GAP: f64 = 2.5;
    let step = curve
        .windows(2)
        .map(|pair| pair[1][0] - pair[0][0])
        .fold(f64::INFINITY, f64::min);
    let mut parts = Vec::with_capacity(curve.len());
    for (ix, point) in curve.iter().enumerate() {
        if ix > 0 && point[0] - curve[ix - 1][0] > GAP * step {
            parts.push([point[0], f64::NAN]);
        }
        parts.push(*point);
    }
    parts
}

fn linear(label: &str) -> Axis {
    Axis {
        label: label.to_owned(),
        scale: Scale::Linear,
        ticks: Vec::new(),
    }
}

fn line(label: &str, curve: &[[f64; 2]]) -> Line {
    let points = curve
        .iter()
        .map(|[x, y]| Point {
            x: *x,
            y: *y,
            low: *y,
            high: *y,
        })
        .collect();
    Line {
        label: label.to_owned(),
        points,
        is_peer: false,
    }
}

/// A curve with fewer points. It keeps the lowest and the highest point of each interval, so that
/// no peak is lost.
fn with_peaks(curve: &[[f64; 2]]) -> Vec<[f64; 2]> {
    if curve.len() <= MAX_POINTS {
        return curve.to_vec();
    }
    curve
        .chunks(curve.len().div_ceil(MAX_POINTS / 2))
        .flat_map(extremes)
        .collect()
}

/// The lowest and the highest point of a part, in order of time.
fn extremes(part: &[[f64; 2]]) -> [[f64; 2]; 2] {
    let by_value = |a: &&[f64; 2], b: &&[f64; 2]| a[1].total_cmp(&b[1]);
    let mut two = [part.iter().min_by(by_value), part.iter().max_by(by_value)]
        .map(|point| point.copied().unwrap_or_default());
    two.sort_by(|a, b| a[0].total_cmp(&b[0]));
    two
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peaks_are_kept() {
        let mut curve: Vec<[f64; 2]> = (0..10_000).map(|ix| [f64::from(ix), 0.5]).collect();
        curve[6789][1] = 0.9;
        let reduced = with_peaks(&curve);
        assert!(
            reduced.len() <= MAX_POINTS && reduced.contains(&[6789.0, 0.9]),
            "{}",
            reduced.len()
        );
        assert!(reduced.is_sorted_by(|a, b| a[0] <= b[0]));
        assert_eq!(with_peaks(&curve[..5]), curve[..5]);
        let parts = interrupted(&[[0.0, 1.0], [1.0, 2.0], [5.0, 3.0]]);
        assert!(
            parts.len() == 4 && parts[2][1].is_nan() && parts[3] == [5.0, 3.0],
            "{parts:?}"
        );
        let motion: Vec<[f64; 2]> = (0..1000)
            .map(|ix| [0.1 * f64::from(ix), if ix == 605 { 1.0 } else { 0.0 }])
            .collect();
        assert!(liveliest(&motion).contains(&60.5) && !liveliest(&motion).contains(&30.0));
    }
}
