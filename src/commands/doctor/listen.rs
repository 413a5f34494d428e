//! What a rig's devices truly deliver: each is read for a while with the drivers of `run`, nothing is moved.

use super::Finding;
use crate::bench::statistics::quantile;
use crate::config::{BaseDriver, Rig};
use crate::join::{Join, JoinEvent, Refusal};
use crate::open::{self, Devices, Opened};
use crate::stop::Stop;
use drivers::{Sample, clock};
use kinematics::Stamp;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// A device that comes this much more slowly than the rig file says is told.
const MIN_RATE_FRAC: f64 = 0.95;

/// Of a device, or of what the join makes of it.
#[derive(Debug, PartialEq, Serialize)]
pub(super) struct DeviceStatistics {
    device: String,
    samples: u64,
    rate_hz: f64,
    /// What the rig file says; `None` where it does not.
    expected_hz: Option<f64>,
    /// Images that the device or the driver lost.
    dropped: u64,
    /// Of devices that are not simulated.
    #[serde(flatten)]
    latency: Option<Latency>,
    /// 99 of 100 follow within this on the one before.
    gap_p99_millis: f64,
}

/// From mid-exposure, or from the stamp of a state, to when it can be used here.
#[derive(Debug, PartialEq, Serialize)]
struct Latency {
    /// Half of all, 99 of 100, and all take no longer.
    latency_p50_millis: f64,
    latency_p99_millis: f64,
    latency_max_millis: f64,
}

/// The whole of what was heard.
#[derive(Debug)]
pub(super) struct ListenResult {
    pub(super) devices: Vec<DeviceStatistics>,
    pub(super) findings: Vec<Finding>,
}

/// What is noted of each sample.
#[derive(Debug, Default)]
struct Track {
    stamps: Vec<Stamp>,
    latency_millis: Vec<f64>,
    dropped: u64,
}

impl Track {
    fn note(&mut self, stamp: Stamp, now: Stamp) {
        self.stamps.push(stamp);
        self.latency_millis.push(now.secs_since(stamp) * 1e3);
    }

    fn summarize(mut self, device: String, expected_hz: Option<f64>, is_simulated: bool) -> DeviceStatistics {
        let mut gaps: Vec<f64> = self.stamps.windows(2).map(|pair| pair[1].secs_since(pair[0]) * 1e3).collect();
        gaps.sort_by(f64::total_cmp);
        self.latency_millis.sort_by(f64::total_cmp);
        let span_secs = match (self.stamps.first(), self.stamps.last()) {
            (Some(first), Some(last)) => last.secs_since(*first),
            _ => 0.0,
        };
        let quantile_of = |sorted: &[f64], frac| quantile(sorted, frac).unwrap_or(0.0);
        let n_gaps = self.stamps.len().saturating_sub(1);
        DeviceStatistics {
            device,
            samples: self.stamps.len() as u64,
            rate_hz: if span_secs > 0.0 { n_gaps as f64 / span_secs } else { 0.0 },
            expected_hz,
            dropped: self.dropped,
            latency: (!is_simulated).then(|| Latency {
                latency_p50_millis: quantile_of(&self.latency_millis, 0.5),
                latency_p99_millis: quantile_of(&self.latency_millis, 0.99),
                latency_max_millis: quantile_of(&self.latency_millis, 1.0),
            }),
            gap_p99_millis: quantile_of(&gaps, 0.99),
        }
    }
}

/// Reads the rig's devices for so many seconds, or until Ctrl-C.
pub(super) fn listen(rig: &Rig, secs: f64, stop: &Stop) -> anyhow::Result<ListenResult> {
    let Opened { rig, mut source, .. } = open::rig(rig.clone(), Devices::Real)?;
    let mut join = Join::new(&rig)?;
    let mut tracks: BTreeMap<String, Track> = BTreeMap::new();
    let mut findings = Vec::new();
    let (began, cpu_before) = (Instant::now(), clock::process_cpu_time());
    while !stop.requested() && began.elapsed().as_secs_f64() < secs {
        let sample = match source.next_sample() {
            Ok(Some(sample)) => sample,
            Ok(None) => break,
            Err(error) => {
                findings.push(Finding::fail("devices", format!("{error}"), "look at the device and its cable"));
                break;
            }
        };
        let now = clock::now();
        let (device, dropped) = match &sample {
            Sample::Image(image) if image.is_depth() => (format!("camera {:?} depth", image.camera), image.n_skipped),
            Sample::Image(image) => (format!("camera {:?}", image.camera), image.n_skipped),
            Sample::Joints(_) => ("arm".to_owned(), 0),
            Sample::Base(_) => ("base".to_owned(), 0),
            Sample::Range(scan) => (format!("range scanner {:?}", scan.scanner), 0),
            Sample::Truth(_) | Sample::BaseTruth(_) => continue,
        };
        let track = tracks.entry(device).or_default();
        track.note(sample.stamp(), now);
        track.dropped += dropped;
        for event in join.push(sample) {
            if let JoinEvent::Accepted(keyframe) = event {
                let track = tracks.entry(format!("keyframes of {:?}", keyframe.camera)).or_default();
                track.note(keyframe.stamp, clock::now());
            }
        }
    }
    if let (Some(cpu_before), Some(cpu)) = (cpu_before, clock::process_cpu_time()) {
        findings.push(Finding::ok("processor", cpu_message(cpu - cpu_before, began.elapsed())));
    }
    // A simulation has a clock of its own.
    let is_simulated = open::is_any_simulated(&rig);
    let expected = expected(&rig);
    findings.extend(missing(&rig, &expected, &tracks));
    let devices: Vec<_> = tracks
        .into_iter()
        .map(|(device, track)| {
            let expected_hz = expected.get(&device).copied().flatten();
            track.summarize(device, expected_hz, is_simulated)
        })
        .collect();
    findings.extend(devices.iter().filter_map(problem));
    let refused: Vec<_> = join.counts().refused.iter().map(|(why, n)| format!("{n} {}", why.name())).collect();
    let n_posed = join.counts().images - join.counts().refused.get(&Refusal::NoPose).copied().unwrap_or(0);
    if !refused.is_empty() {
        let message = format!("images that became no keyframe: {}", refused.join(", "));
        findings.push(if 2 * n_posed < join.counts().images {
            let remedy = "joint states, and poses of the base where it moves, have to be there around each image: look at who tells them";
            Finding::warn("join", message, remedy)
        } else {
            Finding::ok("join", message)
        });
    }
    Ok(ListenResult { devices, findings })
}

/// The devices of a rig, and how often each is to say something where the rig file tells that.
fn expected(rig: &Rig) -> BTreeMap<String, Option<f64>> {
    use crate::config::ArmDriver;
    let mut expected = BTreeMap::new();
    for camera in &rig.cameras {
        expected.insert(format!("camera {:?}", camera.name), Some(camera.rate_hz));
        if camera.depth.is_some() {
            expected.insert(format!("camera {:?} depth", camera.name), Some(camera.rate_hz));
        }
    }
    match rig.arm.driver {
        ArmDriver::None => {}
        ArmDriver::Franka => drop(expected.insert("arm".to_owned(), Some(1000.0))),
        // Motors that report by themselves have rates of their own.
        _ => drop(expected.insert("arm".to_owned(), None)),
    }
    if rig.base.driver != BaseDriver::Fixed {
        expected.insert("base".to_owned(), None);
    }
    for scanner in &rig.scanners {
        expected.insert(format!("range scanner {:?}", scanner.name), Some(scanner.rate_hz));
    }
    expected
}

fn missing(rig: &Rig, expected: &BTreeMap<String, Option<f64>>, tracks: &BTreeMap<String, Track>) -> Vec<Finding> {
    let silent = expected.keys().filter(|device| !tracks.contains_key(*device));
    let remedy = |device: &str| match rig.base.driver {
        BaseDriver::Tags if device == "base" => {
            "no image told where it is: look at base.tag_family, and at sizes and places of the tags"
        }
        _ => "look at it and its cable",
    };
    silent.map(|device| Finding::fail("silent", format!("{device} said nothing"), remedy(device))).collect()
}

/// What is wrong with how a device delivers.
fn problem(statistics: &DeviceStatistics) -> Option<Finding> {
    let DeviceStatistics { device, rate_hz, expected_hz, dropped, .. } = statistics;
    let slow = expected_hz.filter(|expected| *rate_hz < MIN_RATE_FRAC * expected);
    let message = match (slow, dropped) {
        (None, 0) => return None,
        (Some(expected), 0) => format!("{device} comes {rate_hz:.1} times a second, the rig file says {expected:.1}"),
        (None, dropped) => format!("{device} lost {dropped} images"),
        (Some(expected), dropped) => {
            format!(
                "{device} comes {rate_hz:.1} times a second, the rig file says {expected:.1}; {dropped} images were lost"
            )
        }
    };
    Some(Finding::warn(
        "rate",
        message,
        "usual causes: bad light with automatic exposure, a slow bus, a busy processor",
    ))
}

impl std::fmt::Display for DeviceStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { device, samples, rate_hz, latency, gap_p99_millis, dropped, .. } = self;
        write!(f, "{device}: {samples}, {rate_hz:.1} a second, ")?;
        if let Some(Latency { latency_p50_millis: p50, latency_p99_millis: p99, .. }) = latency {
            write!(f, "{p50:.1} ms old (99 %: {p99:.1}) when they are here, ")?;
        }
        write!(f, "at most {gap_p99_millis:.1} ms apart (99 %), {dropped} lost")
    }
}

fn cpu_message(busy: Duration, spent: Duration) -> String {
    let quantile_of = busy.as_secs_f64() / spent.as_secs_f64().max(1e-9);
    format!("{:.1} % of one core was busy with reading and joining", 100.0 * quantile_of)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(n: i64, period_millis: i64, dropped: u64) -> Track {
        let mut track = Track { dropped, ..Track::default() };
        for ix in 0..n {
            let stamp = Stamp(ix * period_millis * 1_000_000);
            // One in a hundred comes late.
            track.note(stamp, stamp.plus_secs(if ix % 100 == 50 { 0.5 } else { 0.01 }));
        }
        track
    }

    #[test]
    fn doctor_reports_rates_latencies_and_losses() {
        let summarize = track(301, 100, 0).summarize("camera \"wrist\"".into(), Some(10.0), false);
        assert!((summarize.rate_hz - 10.0).abs() < 1e-9);
        let latency = summarize.latency.as_ref().expect("it is no simulation");
        assert!((latency.latency_p50_millis - 10.0).abs() < 1e-6 && (latency.latency_p99_millis - 10.0).abs() < 1e-6);
        assert!((latency.latency_max_millis - 500.0).abs() < 1e-6);
        assert_eq!(problem(&summarize), None);
        assert!(summarize.to_string().contains("301, 10.0 a second, 10.0 ms old"), "{summarize}");
        let slow = track(301, 100, 0).summarize("camera \"wrist\"".into(), Some(15.0), false);
        assert!(problem(&slow).is_some_and(|finding| finding.message.contains("the rig file says 15.0")));
        let lossy = track(301, 100, 4).summarize("camera \"wrist\"".into(), Some(10.0), false);
        assert!(problem(&lossy).is_some_and(|finding| finding.message.contains("lost 4 images")));
        let nothing = Track::default().summarize("arm".into(), None, true);
        assert_eq!((nothing.rate_hz, &nothing.latency), (0.0, &None));
        assert!(!nothing.to_string().contains("old"), "{nothing}");
    }
}
