//! `fieldrig bench memory`: memory use of a long run, and its growth rate once the keyframe store is full.

use crate::bench::memory::{Excluded, Growth, Sample, resident_bytes};
use crate::bench::page::Findings;
use crate::bench::statistics::extent;
use crate::bench::viewer::Viewer;
use crate::commands::run::{self, Running};
use crate::exit::{BadArgument, Exit};
use crate::print;
use anyhow::Context;
use clap::Parser;
use keyframe::counted;
use kinematics::quantile::{Rank, quantile};
use session::Table;
use session::chart::{Axis, Chart, Line, Marker, Point, Scale};
use session::run_folder::CreatedFolders;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum time between two lines on stdout.
const PRINT_PERIOD: Duration = Duration::from_secs(60);
/// Charts and numbers are written this often, so that an interrupted bench leaves results.
const WRITE_PERIOD: Duration = Duration::from_secs(60);
/// Maximum number of points of a line in the chart.
const MAX_POINTS: usize = 60;
/// Labels of GPU buffers that hold images of keyframes.
const IMAGE_BUFFERS: [&str; 3] = ["splat.target_image", "splat.target_depth", "splat.validation"];
/// Number of GPU buffers in the table, the largest first.
const MAX_GPU_BUFFERS: usize = 12;
const BYTES_PER_MB: f64 = 1e6;
const SECS_PER_MINUTE: f64 = 60.0;

/// Flags of `bench memory`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras, arm and training settings (TOML)
    rig_file: PathBuf,
    /// Simulate the devices of the rig file, in real time
    #[arg(long, conflicts_with = "from")]
    sim: bool,
    /// Replay a recording instead of live devices; training continues after its end
    #[arg(long, value_name = "RECORDING")]
    from: Option<PathBuf>,
    /// Length of the run in seconds, counted from the first image
    #[arg(long, value_name = "S", default_value_t = 900.0)]
    seconds: f64,
    /// Time between two samples, seconds
    #[arg(long, value_name = "S", default_value_t = 1.0)]
    every_secs: f64,
    /// Number of connected viewers that request images back to back, 0 to 32
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=32))]
    viewers: u64,
    /// Folder for charts and numbers
    #[arg(long, value_name = "DIR", default_value = "bench-memory")]
    out: PathBuf,
    /// Print JSON, one object per sample
    #[arg(long)]
    json: bool,
    /// More flags for `fieldrig run`
    #[arg(last = true, value_name = "RUN FLAGS")]
    run_flags: Vec<OsString>,
}

/// The flags of `run`, parsed as a command line.
#[derive(Debug, Parser)]
struct RunFlags {
    #[command(flatten)]
    args: run::Args,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.check()?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    // Checkpoints are part of a run, so they are written, and removed afterwards with their folder.
    let run_folder = args.out.join(format!("run-{}", std::process::id()));
    let measured = args.run_flags(&run_folder).and_then(|flags| measure(args, &flags));
    if run_folder.exists()
        && let Err(error) = std::fs::remove_dir_all(&run_folder)
    {
        log::warn!("cannot remove {}: {error}", run_folder.display());
    }
    let mut measured = measured?;
    let findings = findings(args, &measured)?;
    findings.print_summary(&findings.write(&args.out)?, args.json)?;
    match measured.input_error.take() {
        Some(error) => Err(anyhow::Error::new(error).context("the devices failed before the end of the run")),
        None => Ok(Exit::Done),
    }
}

/// The measurements of a run.
#[derive(Debug, Default)]
struct MemoryRun {
    /// Whether GPU memory is host memory.
    is_software: bool,
    samples: Vec<Sample>,
    /// GPU buffers at the last sample, bytes by label.
    gpu_buffers: BTreeMap<Arc<str>, u64>,
    /// Error that ended the devices early.
    input_error: Option<drivers::Error>,
}

fn measure(args: &Args, flags: &run::Args) -> anyhow::Result<MemoryRun> {
    let mut running = run::start(flags, None, &mut CreatedFolders::default())?;
    let address = running.server.address();
    let viewers: Vec<Viewer> = (0..args.viewers).map(|_| Viewer::connect(address)).collect::<anyhow::Result<_>>()?;
    let every = Duration::from_secs_f64(args.every_secs);
    let mut measured = MemoryRun { is_software: running.gpu.is_software(), ..MemoryRun::default() };
    let mut due = Instant::now();
    let (mut last_printed, mut written) = (None, Instant::now());
    while running.run_time_slice()? {
        let now = Instant::now();
        if now < due {
            continue;
        }
        due = now + every;
        measured.gpu_buffers = running.gpu.live_bytes_by_label();
        let sample = sample(&running, &viewers, &measured.gpu_buffers)?;
        measured.samples.push(sample);
        if args.json {
            print::report_json(&serde_json::json!({ "event": "sample", "sample": sample }))?;
        } else if last_printed.is_none_or(|last_printed: Instant| last_printed.elapsed() >= PRINT_PERIOD) {
            print::report(describe(&sample));
            last_printed = Some(now);
        }
        if written.elapsed() >= WRITE_PERIOD {
            findings(args, &measured)?.write(&args.out)?;
            written = Instant::now();
        }
    }
    drop(viewers);
    measured.input_error = running.discard()?;
    Ok(measured)
}

fn sample(running: &Running, viewers: &[Viewer], gpu_buffers: &BTreeMap<Arc<str>, u64>) -> anyhow::Result<Sample> {
    let (live, gpu) = (&running.live, &running.gpu);
    let sessions = live.sessions();
    Ok(Sample {
        seconds: sessions.first().map_or(0.0, |session| session.secs()),
        resident_bytes: resident_bytes()?.0,
        gpu_bytes: gpu.live_bytes(),
        gpu_reserved_bytes: gpu.reserved_bytes(),
        model_bytes: sessions.iter().map(|session| session.progress().bytes).sum(),
        gpu_image_bytes: IMAGE_BUFFERS.iter().filter_map(|label| gpu_buffers.get(*label)).sum(),
        keyframe_bytes: live.keyframes().iter().map(|keyframe| keyframe.bytes()).sum(),
        keyframes: live.keyframes().len(),
        evicted: live.n_evicted(),
        step: sessions.first().map_or(0, |session| session.progress().step),
        viewers: viewers.iter().filter(|viewer| viewer.is_connected()).count(),
        pictures: viewers.iter().map(Viewer::n_pictures).sum(),
    })
}

fn describe(sample: &Sample) -> String {
    let mb = |bytes: u64| bytes as f64 / BYTES_PER_MB;
    format!(
        "{:7.1} s  {:8.1} MB resident  {:8.1} MB on the GPU  {:7.1} MB model  {:8.1} MB in {} keyframes, step {}",
        sample.seconds,
        mb(sample.resident_bytes),
        mb(sample.gpu_bytes),
        mb(sample.model_bytes),
        mb(sample.keyframe_bytes),
        sample.keyframes,
        sample.step,
    )
}

impl Args {
    fn check(&self) -> Result<(), BadArgument> {
        for (flag, value, allowed) in
            [("--seconds", self.seconds, 1.0..=1e6), ("--every-secs", self.every_secs, 0.01..=3600.0)]
        {
            if !allowed.contains(&value) {
                let (from, to) = (allowed.start(), allowed.end());
                return Err(BadArgument(format!("{flag} {value}: must be a number from {from} to {to}")));
            }
        }
        Ok(())
    }

    fn run_flags(&self, folder: &Path) -> anyhow::Result<run::Args> {
        let mut line: Vec<OsString> = vec!["run".into(), self.rig_file.clone().into()];
        if self.sim {
            line.push("--sim".into());
        }
        if let Some(from) = &self.from {
            line.extend(["--from".into(), from.into()]);
        }
        line.extend(["--seconds".into(), self.seconds.to_string().into()]);
        line.extend(["--out".into(), folder.into()]);
        line.extend(["--listen".into(), "127.0.0.1:0".into()]);
        if self.json {
            line.push("--json".into());
        }
        line.extend(self.run_flags.iter().cloned());
        let flags = RunFlags::try_parse_from(line).map_err(|error| {
            let message = error.to_string();
            let first = message.lines().next().unwrap_or_default();
            BadArgument(format!("flags of run: {}", first.strip_prefix("error: ").unwrap_or(first)))
        })?;
        Ok(flags.args)
    }

    fn input(&self) -> String {
        match &self.from {
            Some(recording) => recording.display().to_string(),
            None => format!("{}{}", self.rig_file.display(), if self.sim { ", simulated" } else { "" }),
        }
    }
}

/// One component of memory use.
struct MemoryComponent {
    label: &'static str,
    bytes: fn(&Sample) -> Option<u64>,
}

const COMPONENTS: [MemoryComponent; 6] = [
    MemoryComponent { label: "resident", bytes: |sample| Some(sample.resident_bytes) },
    MemoryComponent { label: "GPU buffers", bytes: |sample| Some(sample.gpu_bytes) },
    MemoryComponent { label: "keyframes on the host", bytes: |sample| Some(sample.keyframe_bytes) },
    MemoryComponent { label: "model", bytes: |sample| Some(sample.model_bytes) },
    MemoryComponent { label: "images on the GPU", bytes: |sample| Some(sample.gpu_image_bytes) },
    MemoryComponent { label: "reserved for GPU buffers", bytes: |sample| sample.gpu_reserved_bytes },
];

/// The median and range of each group of samples.
fn line(component: &MemoryComponent, samples: &[Sample]) -> Line {
    let of_group = |group: &[Sample]| {
        let mut mb: Vec<f64> =
            group.iter().filter_map(component.bytes).map(|bytes| bytes as f64 / BYTES_PER_MB).collect();
        let [low, high] = extent(&mb)?;
        let x = group[group.len() / 2].seconds / SECS_PER_MINUTE;
        Some(Point { x, y: quantile(&mut mb, 0.5, Rank::Upper)?, low, high })
    };
    let n_each = samples.len().div_ceil(MAX_POINTS).max(1);
    Line {
        label: component.label.to_owned(),
        points: samples.chunks(n_each).filter_map(of_group).collect(),
        is_peer: false,
    }
}

fn findings(args: &Args, measured: &MemoryRun) -> anyhow::Result<Findings> {
    let samples = &measured.samples;
    let growths: Vec<(&str, Growth)> = match measured.is_software {
        true => {
            vec![("without the model", Excluded::Model), ("without model and training buffers", Excluded::Training)]
        }
        false => vec![("of the host", Excluded::Nothing)],
    }
    .into_iter()
    .filter_map(|(name, excluded)| Some((name, Growth::of(samples, excluded)?)))
    .collect();
    let rate = growths.first().map_or("too short to measure a growth rate".to_owned(), |(name, growth)| {
        let since = if growth.store_was_full { "with a full keyframe store" } else { "in the second half" };
        format!("{:+.2} % per hour {name} {since}", growth.percent_per_hour)
    });
    let conditions = format!("{}, {}", args.input(), counted(args.viewers, "viewer"));
    let lines: Vec<Line> =
        COMPONENTS.iter().map(|component| line(component, samples)).filter(|line| !line.points.is_empty()).collect();
    let full = samples.iter().find(|sample| sample.evicted > 0);
    let markers = full.map(|sample| Marker {
        x: sample.seconds / SECS_PER_MINUTE,
        label: format!("store full: {} keyframes", sample.keyframes),
        line_ix: 2,
    });
    let mut rows = Vec::new();
    let mut add = |name: &str, value: String| rows.push(vec![name.to_owned(), value]);
    let mb = |bytes: f64| format!("{:.1} MB", bytes / BYTES_PER_MB);
    if let Some(last) = samples.last() {
        for component in &COMPONENTS {
            if let Some(bytes) = (component.bytes)(last) {
                add(&format!("{} at the end", component.label), mb(bytes as f64));
            }
        }
        add("peak of resident memory", mb(resident_bytes()?.1 as f64));
        add("keyframes", format!("{}, {} evicted", last.keyframes, last.evicted));
        add("steps", last.step.to_string());
        add("pictures for viewers", last.pictures.to_string());
    }
    for (name, growth) in &growths {
        let (from, to) = (growth.from_seconds, growth.to_seconds);
        let of = format!("{} per hour, {:+.2} %", mb(growth.bytes_per_hour), growth.percent_per_hour);
        add(&format!("growth {name}, {from:.0} s to {to:.0} s"), of);
    }
    let mut gpu_buffers: Vec<(&Arc<str>, u64)> =
        measured.gpu_buffers.iter().map(|(label, bytes)| (label, *bytes)).collect();
    gpu_buffers.sort_by_key(|(_, bytes)| std::cmp::Reverse(*bytes));
    let gpu_rows =
        gpu_buffers.iter().take(MAX_GPU_BUFFERS).map(|(label, bytes)| vec![label.to_string(), mb(*bytes as f64)]);
    Ok(Findings {
        name: "memory",
        title: "Memory of a long run".to_owned(),
        sentences: vec![
            format!("{conditions}: {rate}."),
            "Growth is that of resident memory from one minute after the keyframe store is full: the median of the slopes between \
             all pairs of samples. On a software adapter, resident memory includes GPU buffers; the model, and the working memory of \
             training, which grows with the model, are subtracted."
                .to_owned(),
        ],
        charts: vec![(
            "",
            Chart {
                title: "Memory of a long run".to_owned(),
                subtitle: format!("{conditions}; {rate}"),
                x: Axis { label: "minutes since the first image".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                y: Axis { label: "MB".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                lines,
                thresholds: Vec::new(),
                markers: markers.into_iter().collect(),
            },
        )],
        tables: vec![
            Table { title: "Memory".to_owned(), head: vec!["quantity".to_owned(), "value".to_owned()], rows },
            Table {
                title: "Largest GPU buffers at the end".to_owned(),
                head: vec!["label".to_owned(), "size".to_owned()],
                rows: gpu_rows.collect(),
            },
        ],
        numbers: serde_json::json!({
            "input": args.input(),
            "viewers": args.viewers,
            "growth": growths.iter().map(|(name, growth)| (*name, growth)).collect::<BTreeMap<_, _>>(),
            "gpu_buffers": gpu_buffers.iter().map(|(label, bytes)| (label.as_ref(), bytes)).collect::<BTreeMap<_, _>>(),
            "peak_resident_bytes": resident_bytes()?.1,
            "samples": samples,
        }),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Parser)]
    struct Flags {
        #[command(flatten)]
        args: Args,
    }

    fn args(flags: &[&str]) -> Args {
        Flags::parse_from(["memory", "rig.toml"].iter().chain(flags)).args
    }

    #[test]
    fn run_flags_are_forwarded_and_invalid_ones_named() {
        let folder = Path::new("some");
        assert!(args(&["--sim", "--", "--method", "tsdf"]).run_flags(folder).is_ok());
        let error_message = args(&["--sim", "--", "--metod", "tsdf"]).run_flags(folder).expect_err("no such flag");
        assert!(error_message.to_string().contains("--metod"), "{error_message}");
        for flags in [["--seconds", "0"], ["--seconds", "NaN"], ["--every-secs", "-1"]] {
            let flags = [format!("{}={}", flags[0], flags[1])];
            let error_message = args(&[flags[0].as_str()]).check().expect_err("out of range").to_string();
            assert!(error_message.starts_with("--"), "{error_message}");
        }
    }

    #[test]
    fn findings_report_memory_growth() {
        let sample = |ix: u64| Sample {
            seconds: ix as f64,
            resident_bytes: 1_000_000_000 + 10_000 * ix,
            gpu_bytes: 400_000_000,
            keyframe_bytes: 300_000_000,
            keyframes: 100,
            evicted: u64::from(ix > 30),
            ..Sample::default()
        };
        let samples: Vec<Sample> = (0..600).map(sample).collect();
        let gpu_buffers = BTreeMap::from([("small".into(), 1), ("large".into(), 2)]);
        let mut measured = MemoryRun { is_software: true, samples, gpu_buffers, input_error: None };
        let of_host =
            MemoryRun { is_software: false, ..MemoryRun { samples: measured.samples.clone(), ..MemoryRun::default() } };
        let of_host = findings(&args(&["--sim"]), &of_host).expect("numbers");
        assert!(
            of_host.sentences[0].contains("+3.59") && of_host.sentences[0].contains("host"),
            "{}",
            of_host.sentences[0]
        );
        measured.samples.iter_mut().for_each(|sample| sample.model_bytes = sample.resident_bytes - 900_000_000);
        let findings = findings(&args(&["--sim"]), &measured).expect("numbers");
        assert!(findings.sentences[0].contains("+0.00 % per hour without the model"), "{}", findings.sentences[0]);
        assert_eq!(findings.tables[1].rows[0][0], "large");
        let chart = &findings.charts[0].1;
        assert_eq!(chart.lines.len(), 5, "the reserved memory is unknown");
        assert!(chart.lines.iter().all(|line| line.points.len() <= MAX_POINTS), "{}", chart.lines[0].points.len());
        assert_eq!(chart.markers[0].label, "store full: 100 keyframes");
        assert_eq!(findings.numbers["samples"].as_array().map(Vec::len), Some(600));
    }
}
