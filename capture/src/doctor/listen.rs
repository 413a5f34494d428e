//! Measures rates, latencies and losses of a rig's devices, with the drivers of `run`. Nothing is
//! moved.

use super::{Finding, datagrams, flange, remedies, robot_masks};
use crate::config::{ArmDriver, BaseDriver, Need, Rig};
use crate::open::{self, DeviceFailure, Listening};
use crate::{Join, JoinEvent, Rejection, Stop};
use drivers::udp::DatagramMonitor;
use drivers::{Error, Sample, clock, device_names};
use kinematics::Stamp;
use numbers::quantile::{Rank, quantile};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

/// A device is reported if its rate is below this fraction of the rate in the rig file. The margin
/// allows for one missing sample in a short measurement.
const MIN_RATE_FRAC: f64 = 0.95;

/// Minimum time between the first and the last sample. If the time is shorter, the stamps are not
/// compared with the clock of this computer, because the latencies vary too much in comparison.
const MIN_RECEIVED_SECS: f64 = 0.5;

/// Measurements of one device, or of the keyframes made from its images.
#[derive(Debug, PartialEq, Serialize)]
pub struct DeviceStatistics {
    /// Name with the kind of device, for example `camera "wrist"`.
    pub device: String,
    /// Number of samples.
    pub samples: u64,
    /// Mean rate.
    pub rate_hz: f64,
    /// Rate in the rig file; `None` if it has none.
    pub expected_hz: Option<f64>,
    /// Images dropped by the device or the driver.
    pub dropped: u64,
    /// `None` for simulated devices.
    #[serde(flatten)]
    pub latency: Option<Latency>,
    /// 99th percentile of the intervals between samples.
    pub gap_p99_millis: f64,
    /// Seconds by which the stamps advance per second of this computer's clock. The normal value is
    /// 1. `None` for simulated devices, and if the samples arrived within less than 0.5 s.
    pub stamp_secs_per_sec: Option<f64>,
}

/// Time from the stamp of a sample until the program receives it.
#[derive(Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median.
    pub latency_p50_millis: f64,
    /// 99th percentile.
    pub latency_p99_millis: f64,
    /// Maximum.
    pub latency_max_millis: f64,
}

/// Result of listening to all devices.
#[derive(Debug)]
pub struct ListenResult {
    /// Measurements of each device.
    pub devices: Vec<DeviceStatistics>,
    /// Problems in the measurements.
    pub findings: Vec<Finding>,
}

/// Raw measurements of one device.
#[derive(Debug, Default)]
struct Track {
    stamps: Vec<Stamp>,
    latency_millis: Vec<f64>,
    /// When the first and the last sample arrived.
    received: Option<[Stamp; 2]>,
    dropped: u64,
}

impl Track {
    fn note(&mut self, stamp: Stamp, now: Stamp) {
        self.stamps.push(stamp);
        self.latency_millis.push(now.secs_since(stamp) * 1e3);
        self.received = Some([self.received.map_or(now, |[first, _]| first), now]);
    }

    fn summarize(
        mut self,
        device: String,
        expected_hz: Option<f64>,
        is_simulated: bool,
    ) -> DeviceStatistics {
        let mut gaps: Vec<f64> = self
            .stamps
            .windows(2)
            .map(|pair| pair[1].secs_since(pair[0]) * 1e3)
            .collect();
        let span_secs = match (self.stamps.first(), self.stamps.last()) {
            (Some(first), Some(last)) => last.secs_since(*first),
            _ => 0.0,
        };
        let quantile_of =
            |values: &mut [f64], frac| quantile(values, frac, Rank::Lower).unwrap_or(0.0);
        let n_gaps = self.stamps.len().saturating_sub(1);
        DeviceStatistics {
            device,
            samples: self.stamps.len() as u64,
            rate_hz: if span_secs > 0.0 {
                n_gaps as f64 / span_secs
            } else {
                0.0
            },
            expected_hz,
            dropped: self.dropped,
            latency: (!is_simulated).then(|| Latency {
                latency_p50_millis: quantile_of(&mut self.latency_millis, 0.5),
                latency_p99_millis: quantile_of(&mut self.latency_millis, 0.99),
                latency_max_millis: quantile_of(&mut self.latency_millis, 1.0),
            }),
            gap_p99_millis: quantile_of(&mut gaps, 0.99),
            stamp_secs_per_sec: self
                .received
                .map(|[first, last]| last.secs_since(first))
                .filter(|received_secs| !is_simulated && *received_secs >= MIN_RECEIVED_SECS)
                .map(|received_secs| span_secs / received_secs),
        }
    }
}

/// Reads the rig's devices with the drivers of a run for `secs` seconds, or until `stop` is
/// requested. Devices that cannot be opened are findings, and the others are read.
///
/// # Errors
/// The simulation of a simulated device cannot be started.
pub fn listen(rig: &Rig, secs: f64, stop: &Stop) -> anyhow::Result<ListenResult> {
    let Listening {
        rig,
        mut source,
        monitors,
        failures,
        flange_difference,
    } = open::for_listening(rig.clone())?;
    let mut join = join_of(&rig, &failures)?;
    let mut tracks: BTreeMap<String, Track> = BTreeMap::new();
    let mut findings: Vec<Finding> = failures
        .iter()
        .map(|failure| not_opened(failure, &rig))
        .chain(flange_difference.as_ref().map(flange::of_controller))
        .collect();
    // Devices whose problem is reported.
    let mut reported: BTreeSet<String> =
        failures.into_iter().map(|failure| failure.device).collect();
    let began = Instant::now();
    let cpu_before = clock::process_cpu_time();
    while !stop.requested() && began.elapsed().as_secs_f64() < secs {
        let sample = match source.next_sample() {
            Ok(Some(sample)) => sample,
            Ok(None) => break,
            Err(error) => {
                let finding = Finding::fail(
                    "devices",
                    error.to_string(),
                    remedy(&error, &rig, &monitors),
                );
                reported.extend(silent_device(&error));
                // Silent devices are reported again and again.
                if !findings.contains(&finding) {
                    findings.push(finding);
                }
                continue;
            }
        };
        // The time of arrival is taken before any work on the sample, so that the latency is that
        // of the device.
        let now = clock::now();
        let Some((device, dropped)) = device_of(&sample) else {
            continue;
        };
        let track = tracks.entry(device).or_default();
        track.note(sample.stamp(), now);
        track.dropped += dropped;
        // The samples are joined as in a run, because missing poses are found only in the join.
        let events = join
            .as_mut()
            .map_or_else(Vec::new, |join| join.push(sample));
        for event in events {
            if let JoinEvent::Accepted(keyframe) = event {
                let track = tracks
                    .entry(format!("keyframes of {:?}", keyframe.camera))
                    .or_default();
                track.note(keyframe.stamp, clock::now());
            }
        }
    }
    if let (Some(cpu_before), Some(cpu)) = (cpu_before, clock::process_cpu_time()) {
        findings.push(Finding::ok(
            "CPU",
            cpu_message(cpu - cpu_before, began.elapsed()),
        ));
    }
    // A simulation has its own clock.
    let is_simulated = open::is_any_simulated(&rig);
    let mut expected = expected(&rig);
    expected.retain(|device, _| !reported.contains(device));
    findings.extend(missing(&rig, &expected, &tracks, &monitors));
    let of_datagrams = |monitor: &DatagramMonitor| {
        datagrams::received(monitor, tracks.contains_key(monitor.device()))
    };
    findings.extend(monitors.iter().filter_map(of_datagrams));
    let devices: Vec<_> = tracks
        .into_iter()
        .map(|(device, track)| {
            let expected_hz = expected.get(&device).copied().flatten();
            track.summarize(device, expected_hz, is_simulated)
        })
        .collect();
    findings.extend(devices.iter().filter_map(problem));
    findings.extend(devices.iter().filter_map(wrong_unit));
    findings.extend(join.as_ref().and_then(join_finding));
    let counts = join.as_ref().map(Join::counts);
    findings.extend(counts.into_iter().flat_map(robot_masks::cover));
    Ok(ListenResult { devices, findings })
}

/// The join of a run. `None` if images cannot get poses, because calibration or a device is
/// missing. This is reported elsewhere.
fn join_of(rig: &Rig, failures: &[DeviceFailure]) -> anyhow::Result<Option<Join>> {
    let can_join = failures.is_empty() && rig.require(Need::PosedImages).is_ok();
    can_join.then(|| Join::new(rig)).transpose()
}

/// The finding about a device that could not be opened.
fn not_opened(failure: &DeviceFailure, rig: &Rig) -> Finding {
    let DeviceFailure { device, error } = failure;
    let message = format!("{device} cannot be opened: {error:#}");
    Finding::fail("devices", message, remedies::not_opened(device, rig))
}

/// Name of the device that delivered a sample, and the number of its images that were dropped
/// before the sample. `None` for ground truth, which no device delivers.
fn device_of(sample: &Sample) -> Option<(String, u64)> {
    let n_dropped = match sample {
        Sample::Image(image) => image.n_skipped,
        _ => 0,
    };
    Some((device_names::of_sample(sample)?, n_dropped))
}

/// Lists the reasons why images did not become keyframes. Rejected images are normal, for example
/// while the robot stands still. It is a problem only if most images have no pose.
fn join_finding(join: &Join) -> Option<Finding> {
    let counts = join.counts();
    let rejected: Vec<_> = counts
        .rejected
        .iter()
        .map(|(why, n)| format!("{n} {}", why.name()))
        .collect();
    if rejected.is_empty() {
        return None;
    }
    let n_without_pose = counts
        .rejected
        .get(&Rejection::NoPose)
        .copied()
        .unwrap_or(0);
    let n_posed = counts.images - n_without_pose;
    let message = format!(
        "images that did not become keyframes: {}",
        rejected.join(", ")
    );
    Some(if 2 * n_posed < counts.images {
        let remedy = "each image needs joint states, and base poses if the base moves, around its time: check their source";
        Finding::warn("join", message, remedy)
    } else {
        Finding::ok("join", message)
    })
}

/// The devices of a rig with their expected rates. A rate is `None` if the rig file does not set
/// it.
fn expected(rig: &Rig) -> BTreeMap<String, Option<f64>> {
    let mut expected = BTreeMap::new();
    for camera in &rig.cameras {
        expected.insert(device_names::camera(&camera.name), Some(camera.rate_hz));
        if camera.depth.is_some() {
            expected.insert(
                device_names::camera_depth(&camera.name),
                Some(camera.rate_hz),
            );
        }
    }
    match rig.arm.driver {
        ArmDriver::None => {}
        // A robot without joints by design, such as a base with a fixed mast, sends none.
        _ if rig.arm.joints.is_empty() => {}
        ArmDriver::Franka => drop(expected.insert(device_names::ARM.to_owned(), Some(1000.0))),
        // Motors that report without polling choose their own rates.
        _ => drop(expected.insert(device_names::ARM.to_owned(), None)),
    }
    if rig.base.driver != BaseDriver::Fixed {
        expected.insert(device_names::BASE.to_owned(), None);
    }
    for scanner in &rig.scanners {
        expected.insert(
            device_names::range_scanner(&scanner.name),
            Some(scanner.rate_hz),
        );
    }
    expected
}

/// The device that sent no data, if the error is about such a device.
fn silent_device(error: &Error) -> Option<String> {
    match error {
        Error::NoImage { camera, .. } => Some(device_names::camera(camera)),
        Error::NoJoints { .. } => Some(device_names::ARM.to_owned()),
        Error::NoBasePose { .. } => Some(device_names::BASE.to_owned()),
        Error::NoScan { scanner, .. } => Some(device_names::range_scanner(scanner)),
        _ => None,
    }
}

/// What to do about an error of a device.
fn remedy(error: &Error, rig: &Rig, monitors: &[DatagramMonitor]) -> String {
    let Some(device) = silent_device(error) else {
        return "check the device and its cable".to_owned();
    };
    match monitors.iter().find(|monitor| monitor.device() == device) {
        Some(monitor) if monitor.counts().n_received > 0 => {
            "correct its sender: docs/reference/udp.md describes the format".to_owned()
        }
        Some(monitor) => start_sender(monitor),
        None => remedies::silent(&device, rig).to_owned(),
    }
}

fn start_sender(monitor: &DatagramMonitor) -> String {
    format!("start its sender, and let it send to {}", monitor.address())
}

/// A finding for each device that sent nothing. Devices whose datagrams cannot be used get a
/// different finding.
fn missing(
    rig: &Rig,
    expected: &BTreeMap<String, Option<f64>>,
    tracks: &BTreeMap<String, Track>,
    monitors: &[DatagramMonitor],
) -> Vec<Finding> {
    let mut findings = Vec::new();
    for device in expected
        .keys()
        .filter(|device| !tracks.contains_key(*device))
    {
        let remedy = match monitors.iter().find(|monitor| monitor.device() == device) {
            Some(monitor) if monitor.counts().n_received > 0 => continue,
            Some(monitor) => start_sender(monitor),
            None if rig.base.driver == BaseDriver::Tags && device == device_names::BASE => {
                "no image gave its pose: check base.tag_family, and the sizes and poses of the tags"
                    .to_owned()
            }
            None => remedies::silent(device, rig).to_owned(),
        };
        findings.push(Finding::fail(
            "silent",
            format!("no data from {device}"),
            remedy,
        ));
    }
    findings
}

/// Checks rate and losses of a device. Returns a finding if there is a problem.
fn problem(statistics: &DeviceStatistics) -> Option<Finding> {
    let DeviceStatistics {
        device,
        rate_hz,
        expected_hz,
        dropped,
        ..
    } = statistics;
    let slow = expected_hz.filter(|expected| *rate_hz < MIN_RATE_FRAC * expected);
    let message = match (slow, dropped) {
        (None, 0) => return None,
        (Some(expected), 0) => {
            format!("{device}: {rate_hz:.1} Hz, expected {expected:.1} Hz by the rig file")
        }
        (None, dropped) => format!("{device} dropped {dropped} images"),
        (Some(expected), dropped) => {
            format!(
                "{device}: {rate_hz:.1} Hz, expected {expected:.1} Hz by the rig file; {dropped} images were dropped"
            )
        }
    };
    Some(Finding::warn("rate", message, remedies::slow(device)))
}

/// Reports stamps that advance faster or slower than the clock of this computer. Usually, such
/// stamps are in another unit.
fn wrong_unit(statistics: &DeviceStatistics) -> Option<Finding> {
    let rate = statistics
        .stamp_secs_per_sec
        .filter(|rate| !(0.5..2.0).contains(rate))?;
    let units = [
        ("microseconds", 1e-3),
        ("milliseconds", 1e-6),
        ("seconds", 1e-9),
    ];
    let unit = units
        .into_iter()
        .find(|(_, of_unit)| (0.5..2.0).contains(&(rate / of_unit)));
    let guess = unit.map_or(String::new(), |(unit, _)| {
        format!(", as if they were in {unit}")
    });
    let message = format!(
        "{}: its stamps advance by {rate:.1e} s per second{guess}",
        statistics.device
    );
    Some(Finding::fail(
        "stamps",
        message,
        "send stamps in nanoseconds from a single clock",
    ))
}

impl std::fmt::Display for DeviceStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            device,
            samples,
            rate_hz,
            latency,
            gap_p99_millis,
            dropped,
            ..
        } = self;
        write!(f, "{device}: {samples} samples, {rate_hz:.1} Hz, ")?;
        if let Some(Latency {
            latency_p50_millis: p50,
            latency_p99_millis: p99,
            ..
        }) = latency
        {
            write!(f, "latency {p50:.1} ms (99 %: {p99:.1} ms), ")?;
        }
        write!(
            f,
            "interval at most {gap_p99_millis:.1} ms (99 %), {dropped} dropped"
        )
    }
}

fn cpu_message(busy: Duration, spent: Duration) -> String {
    let busy_frac = busy.as_secs_f64() / spent.as_secs_f64().max(1e-9);
    format!(
        "{:.1} % of one core was busy with reading and joining",
        100.0 * busy_frac
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(n: i64, period_millis: i64, dropped: u64) -> Track {
        let mut track = Track {
            dropped,
            ..Track::default()
        };
        for ix in 0..n {
            let stamp = Stamp(ix * period_millis * 1_000_000);
            // One sample in a hundred arrives late.
            track.note(
                stamp,
                stamp.plus_secs(if ix % 100 == 50 { 0.5 } else { 0.01 }),
            );
        }
        track
    }

    #[test]
    fn devices_that_open_are_read_although_others_do_not() {
        const URDF: &str = r#"<robot name="one"><link name="base"/><link name="tool"/>
            <joint name="j" type="revolute"><parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>
            <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#;
        let camera = "[camera.wrist]\ndriver = \"v4l2\"\ndevice = \"no such camera\"\nsize_px = [640, 480]\n\
                      rate_hz = 30\nparent = \"flange\"\n";
        let scanner = "[range.lidar]\ndriver = \"udp\"\naddress = \"127.0.0.1:0\"\n";
        let occupied = std::net::UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let base = format!(
            "[base]\ndriver = \"udp\"\naddress = \"{}\"\n",
            occupied.local_addr().expect("bound")
        );
        // The arm listens on a port that was free a moment ago.
        let address = std::net::UdpSocket::bind("127.0.0.1:0")
            .and_then(|socket| socket.local_addr())
            .expect("a free port");
        let text = format!(
            "[arm]\ndriver = \"udp\"\naddress = \"{address}\"\nurdf = \"one.urdf\"\nflange_link = \"tool\"\n\
             {base}{camera}{scanner}"
        );
        let rig = Rig::parse("rig.toml", &text, URDF, &[]).expect("a valid rig");
        let sender = std::net::UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let is_done = std::sync::atomic::AtomicBool::new(false);
        let result = std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut seq = 0;
                while !is_done.load(std::sync::atomic::Ordering::Relaxed) {
                    let stamp = clock::now().0;
                    let state = format!(
                        r#"{{"kind":"joints","version":1,"seq":{seq},"clock":"monotonic","stamp_nanos":{stamp},"names":["j"],"position":[0.1]}}"#
                    );
                    seq += 1;
                    sender
                        .send_to(state.as_bytes(), address)
                        .expect("a local socket");
                    std::thread::sleep(Duration::from_millis(5));
                }
            });
            let result = listen(&rig, 2.0, &Stop::default());
            is_done.store(true, std::sync::atomic::Ordering::Relaxed);
            result.expect("some devices open")
        });
        let arm = result.devices.iter().find(|device| device.device == "arm");
        assert!(arm.is_some_and(|arm| arm.samples > 0), "{result:?}");
        let finding_of = |words: &str| {
            let found = result
                .findings
                .iter()
                .find(|finding| finding.message.contains(words));
            found.unwrap_or_else(|| panic!("{words}: {result:?}"))
        };
        let camera = finding_of("camera \"wrist\" cannot be opened: ");
        assert!(
            camera.verdict == crate::doctor::Verdict::Fail
                && camera.to_string().contains("fieldrig devices"),
            "{camera}"
        );
        let base = finding_of("base cannot be opened: ");
        assert!(base.to_string().contains("another program"), "{base}");
        // A device with a problem is reported once.
        let n_base = result
            .findings
            .iter()
            .filter(|finding| finding.message.contains("base"))
            .count();
        assert_eq!(n_base, 1, "{result:?}");
    }

    #[test]
    fn a_robot_without_joints_by_design_is_expected_to_send_none() {
        let rig = crate::doctor::testing::bundled_rig::<&str>("mobile-base-small.toml", &[]);
        assert!(!expected(&rig).contains_key(device_names::ARM));
        let arm = crate::doctor::testing::bundled_rig::<&str>("static-arm.toml", &[]);
        assert!(expected(&arm).contains_key(device_names::ARM));
    }

    #[test]
    fn doctor_reports_rates_latencies_and_losses() {
        let summarize = track(301, 100, 0).summarize("camera \"wrist\"".into(), Some(10.0), false);
        assert!((summarize.rate_hz - 10.0).abs() < 1e-9);
        let latency = summarize.latency.as_ref().expect("not simulated");
        assert!(
            (latency.latency_p50_millis - 10.0).abs() < 1e-6
                && (latency.latency_p99_millis - 10.0).abs() < 1e-6
        );
        assert!((latency.latency_max_millis - 500.0).abs() < 1e-6);
        assert_eq!(problem(&summarize), None);
        assert!(
            summarize
                .to_string()
                .contains("301 samples, 10.0 Hz, latency 10.0 ms"),
            "{summarize}"
        );
        let slow = track(301, 100, 0).summarize("camera \"wrist\"".into(), Some(15.0), false);
        assert!(problem(&slow).is_some_and(|finding| finding.message.contains("expected 15.0 Hz")));
        let lossy = track(301, 100, 4).summarize("camera \"wrist\"".into(), Some(10.0), false);
        assert!(
            problem(&lossy).is_some_and(|finding| finding.message.contains("dropped 4 images"))
        );
        for (nanos_per_sample, expected) in [
            (100_000, "microseconds"),
            (100, "milliseconds"),
            (30_000_000, "3.0e-1 s per second"),
        ] {
            let mut track = Track::default();
            for ix in 0..21_i64 {
                track.note(Stamp(ix * nanos_per_sample), Stamp(ix * 100_000_000));
            }
            let finding =
                wrong_unit(&track.summarize("arm".into(), None, false)).expect("not nanoseconds");
            assert!(finding.message.contains(expected), "{}", finding.message);
        }
        assert_eq!(wrong_unit(&lossy), None);
        let lidar = track(301, 100, 0).summarize("range scanner \"top\"".into(), Some(15.0), false);
        let finding = problem(&lidar).expect("slow");
        assert!(!finding.to_string().contains("light"), "{finding}");
        let nothing = Track::default().summarize("arm".into(), None, true);
        assert_eq!((nothing.rate_hz, &nothing.latency), (0.0, &None));
        assert!(!nothing.to_string().contains("latency"), "{nothing}");
    }
}
