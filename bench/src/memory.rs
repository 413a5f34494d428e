//! Memory use of a long run by component, and its growth rate once the keyframe store is full.

use crate::findings::{BenchResult, Findings};
use crate::growth::{Excluded, Growth, Sample, resident_bytes};
use crate::measured_run::{MeasuredRun, RequestedRun, StartRun};
use crate::statistics::extent;
use crate::viewer::{Viewer, ViewerOptions};
use anyhow::{Context, Result};
use gpu::Gpu;
use messages::counted;
use numbers::quantile::{Rank, quantile};
use report::Table;
use report::chart::{Axis, Chart, Line, Marker, Point, Scale};
use session::{LiveLoop, RunInput};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Charts and numbers are written with this period, so that an interrupted bench leaves results.
const WRITE_PERIOD: Duration = Duration::from_secs(60);
/// Maximum number of points of a line in the chart.
const MAX_POINTS: usize = 60;
/// Labels of GPU buffers that hold images of keyframes.
const IMAGE_BUFFERS: [&str; 3] = [
    "splat.target_image",
    "splat.target_depth",
    "splat.validation",
];
/// Number of GPU buffers in the table, the largest first.
const MAX_GPU_BUFFERS: usize = 12;
const BYTES_PER_MB: f64 = 1e6;
const SECS_PER_MINUTE: f64 = 60.0;

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct MemoryOptions {
    /// The rig file.
    pub rig_file: PathBuf,
    /// The devices, or a recording of them. Training continues after the end of a recording.
    pub input: RunInput,
    /// Length of the run from the first image, seconds.
    pub seconds: f64,
    /// Time between two samples.
    pub sample_period: Duration,
    /// Number of viewers that request pictures back to back.
    pub n_viewers: u64,
    /// Folder for charts and numbers.
    pub out: PathBuf,
}

/// Result of [`run`].
pub struct MemoryResult {
    /// Charts and numbers of the part of the run that was measured.
    pub result: BenchResult,
    /// The error of a device that ended the run early, if any.
    pub input_error: Option<drivers::Error>,
}

/// Measures the memory of a run until it ends, and writes charts and numbers.
///
/// * `start`: starts the run.
/// * `on_sample`: receives each sample. If it returns an error, the bench ends.
///
/// # Errors
///
/// Fails if the run fails, or if the system does not report the memory of this process.
pub fn run(
    options: &MemoryOptions,
    start: StartRun<'_>,
    on_sample: impl FnMut(&Sample) -> Result<()>,
) -> Result<MemoryResult> {
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot create {}", options.out.display()))?;
    // Checkpoints are part of a run, so this bench also writes them. Their folder is removed at the
    // end.
    let run_folder = options.out.join(format!("run-{}", std::process::id()));
    let requested = RequestedRun {
        rig_file: options.rig_file.clone(),
        input: options.input.clone(),
        seconds: options.seconds,
        out: run_folder.clone(),
    };
    let measured = start(&requested).and_then(|started| options.measure(started, on_sample));
    if run_folder.exists()
        && let Err(error) = std::fs::remove_dir_all(&run_folder)
    {
        log::warn!("cannot remove {}: {error}", run_folder.display());
    }
    let (measured, input_error) = measured?;
    let findings = measured.findings()?;
    let page = findings.write(&options.out)?;
    Ok(MemoryResult {
        result: BenchResult {
            findings,
            page,
            data_losses: Vec::new(),
        },
        input_error,
    })
}

impl MemoryOptions {
    /// Returns the measurements of a run, and the device error that ended it early, if any.
    fn measure(
        &self,
        started: MeasuredRun,
        mut on_sample: impl FnMut(&Sample) -> Result<()>,
    ) -> Result<(MemoryRun, Option<drivers::Error>)> {
        let viewers = started.connect(self.n_viewers, ViewerOptions::default())?;
        let MeasuredRun {
            mut run,
            page: _page,
        } = started;
        let mut measured = MemoryRun {
            input: self.input_text(),
            n_viewers: self.n_viewers,
            is_software: run.gpu.is_software(),
            ..MemoryRun::default()
        };
        let mut due = Instant::now();
        let mut written = Instant::now();
        while run.run_time_slice()? {
            let now = Instant::now();
            if now < due {
                continue;
            }
            // The period starts now and not at the last due time, so that a long step is not
            // followed by several samples at once.
            due = now + self.sample_period;
            on_sample(&measured.add_sample(&run.live, &run.gpu, &viewers)?)?;
            // The results are written during the run, so that they survive if the run is killed
            // after hours, for example for lack of memory.
            if written.elapsed() >= WRITE_PERIOD {
                measured.findings()?.write(&self.out)?;
                written = Instant::now();
            }
        }
        drop(viewers);
        Ok((measured, run.discard()?.input_result.input_error))
    }

    /// The devices or the recording, for the page.
    fn input_text(&self) -> String {
        let rig_file = self.rig_file.display();
        match &self.input {
            RunInput::Recording { path, .. } => path.display().to_string(),
            RunInput::Devices {
                is_simulated: true, ..
            } => format!("{rig_file}, simulated"),
            RunInput::Devices { .. } => rig_file.to_string(),
        }
    }
}

/// The measurements of a run.
#[derive(Clone, Debug, Default)]
struct MemoryRun {
    /// The devices or the recording, for the page.
    input: String,
    /// Number of viewers that were connected.
    n_viewers: u64,
    /// Whether GPU memory is host memory.
    is_software: bool,
    /// Memory over time.
    samples: Vec<Sample>,
    /// GPU buffers at the last sample, bytes by label.
    gpu_buffers: BTreeMap<Arc<str>, u64>,
}

impl MemoryRun {
    /// Samples the memory of a run in progress, adds the sample, and returns it.
    ///
    /// # Errors
    ///
    /// Fails if the system does not report the memory of this process.
    fn add_sample(&mut self, live: &LiveLoop, gpu: &Gpu, viewers: &[Viewer]) -> Result<Sample> {
        let (sample, gpu_buffers) = sample(live, gpu, viewers)?;
        self.gpu_buffers = gpu_buffers;
        self.samples.push(sample);
        Ok(sample)
    }

    /// Growth rates, a chart of the components, and the largest GPU buffers.
    ///
    /// # Errors
    ///
    /// Fails if the system does not report the memory of this process.
    fn findings(&self) -> Result<Findings> {
        let samples = &self.samples;
        let growths = self.growths();
        let rate = growths.first().map_or(
            "too short to measure a growth rate".to_owned(),
            |(name, growth)| {
                let since = if growth.store_was_full {
                    "with a full keyframe store"
                } else {
                    "in the second half"
                };
                format!(
                    "memory growth {name} {since}: {:+.2} % per hour",
                    growth.percent_per_hour
                )
            },
        );
        let conditions = format!("{}, {}", self.input, counted(self.n_viewers, "viewer"));
        let lines: Vec<Line> = COMPONENTS
            .iter()
            .map(|component| line(component, samples))
            .filter(|line| !line.points.is_empty())
            .collect();
        let full = samples.iter().find(|sample| sample.evicted > 0);
        // Until the store is full, keyframes are the part that grows. The marker therefore has the
        // color of the line of the keyframes.
        let markers = full.map(|sample| Marker {
            x: sample.seconds / SECS_PER_MINUTE,
            label: format!("store full: {} keyframes", sample.keyframes),
            line_ix: 2,
        });
        let rows = self.rows(&growths)?;
        let mut gpu_buffers: Vec<(&Arc<str>, u64)> = self
            .gpu_buffers
            .iter()
            .map(|(label, bytes)| (label, *bytes))
            .collect();
        // The largest buffers are the candidates for savings.
        gpu_buffers.sort_by_key(|(_, bytes)| std::cmp::Reverse(*bytes));
        let gpu_rows = gpu_buffers
            .iter()
            .take(MAX_GPU_BUFFERS)
            .map(|(label, bytes)| vec![label.to_string(), mb(*bytes as f64)]);
        Ok(Findings {
            name: "memory",
            title: "Memory of a long run".to_owned(),
            sentences: vec![
                format!("{conditions}: {rate}."),
                "Growth is the median rate of change of resident memory between all pairs of samples, starting one minute after the keyframe \
                 store is full. On a software adapter, resident memory includes GPU buffers. The model and the working memory of training, \
                 which grows with the model, are then subtracted."
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
                "input": self.input,
                "viewers": self.n_viewers,
                "growth": growths.iter().map(|(name, growth)| (*name, growth)).collect::<BTreeMap<_, _>>(),
                "gpu_buffers": gpu_buffers.iter().map(|(label, bytes)| (label.as_ref(), bytes)).collect::<BTreeMap<_, _>>(),
                "peak_resident_bytes": resident_bytes()?.1,
                "samples": samples,
            }),
        })
    }

    /// The growth rates of this run, each with the name of the memory that it describes.
    fn growths(&self) -> Vec<(&'static str, Growth)> {
        // On a CPU, the GPU buffers are in the memory of the process. They grow with the model, and
        // this growth would hide a leak.
        let kinds = if self.is_software {
            vec![
                ("without the model", Excluded::Model),
                ("without model and training buffers", Excluded::Training),
            ]
        } else {
            vec![("of the host", Excluded::Nothing)]
        };
        kinds
            .into_iter()
            .filter_map(|(name, excluded)| Some((name, Growth::of(&self.samples, excluded)?)))
            .collect()
    }

    /// The rows of the table, which are the memory at the end, the counts, and the growth rates.
    fn rows(&self, growths: &[(&str, Growth)]) -> Result<Vec<Vec<String>>> {
        let mut rows = Vec::new();
        let mut add = |name: &str, value: String| rows.push(vec![name.to_owned(), value]);
        if let Some(last) = self.samples.last() {
            for component in &COMPONENTS {
                if let Some(bytes) = (component.bytes)(last) {
                    add(&format!("{} at the end", component.label), mb(bytes as f64));
                }
            }
            add("peak of resident memory", mb(resident_bytes()?.1 as f64));
            add(
                "keyframes",
                format!("{}, {} evicted", last.keyframes, last.evicted),
            );
            add("steps", last.step.to_string());
            add("pictures for viewers", last.pictures.to_string());
        }
        for (name, growth) in growths {
            let from = growth.from_seconds;
            let to = growth.to_seconds;
            let of = format!(
                "{} per hour, {:+.2} %",
                mb(growth.bytes_per_hour),
                growth.percent_per_hour
            );
            add(&format!("growth {name}, {from:.0} s to {to:.0} s"), of);
        }
        Ok(rows)
    }
}

/// A size as text.
fn mb(bytes: f64) -> String {
    format!("{:.1} MB", bytes / BYTES_PER_MB)
}

/// Memory of a run in progress, and its GPU buffers, bytes by label.
pub(crate) fn sample(
    live: &LiveLoop,
    gpu: &Gpu,
    viewers: &[Viewer],
) -> Result<(Sample, BTreeMap<Arc<str>, u64>)> {
    let gpu_buffers = gpu.live_bytes_by_label();
    let sessions = live.sessions();
    let sample = Sample {
        seconds: sessions
            .first()
            .map_or(0.0, |session| session.time().secs()),
        resident_bytes: resident_bytes()?.0,
        gpu_bytes: gpu.live_bytes(),
        gpu_reserved_bytes: gpu.reserved_bytes(),
        model_bytes: sessions
            .iter()
            .map(|session| session.progress().bytes)
            .sum(),
        gpu_image_bytes: IMAGE_BUFFERS
            .iter()
            .filter_map(|label| gpu_buffers.get(*label))
            .sum(),
        keyframe_bytes: live
            .keyframes()
            .iter()
            .map(|keyframe| keyframe.bytes())
            .sum(),
        keyframes: live.keyframes().len(),
        evicted: live.n_evicted(),
        step: sessions
            .first()
            .map_or(0, |session| session.progress().step),
        viewers: viewers
            .iter()
            .filter(|viewer| viewer.is_connected())
            .count(),
        pictures: viewers.iter().map(Viewer::n_pictures).sum(),
    };
    Ok((sample, gpu_buffers))
}

/// One component of memory use.
struct MemoryComponent {
    label: &'static str,
    bytes: fn(&Sample) -> Option<u64>,
}

const COMPONENTS: [MemoryComponent; 6] = [
    MemoryComponent {
        label: "resident",
        bytes: |sample| Some(sample.resident_bytes),
    },
    MemoryComponent {
        label: "GPU buffers",
        bytes: |sample| Some(sample.gpu_bytes),
    },
    MemoryComponent {
        label: "keyframes on the host",
        bytes: |sample| Some(sample.keyframe_bytes),
    },
    MemoryComponent {
        label: "model",
        bytes: |sample| Some(sample.model_bytes),
    },
    MemoryComponent {
        label: "images on the GPU",
        bytes: |sample| Some(sample.gpu_image_bytes),
    },
    MemoryComponent {
        label: "reserved for GPU buffers",
        bytes: |sample| sample.gpu_reserved_bytes,
    },
];

/// The line of one component, with the median and range of each group of samples.
fn line(component: &MemoryComponent, samples: &[Sample]) -> Line {
    let n_each = samples.len().div_ceil(MAX_POINTS).max(1);
    Line {
        label: component.label.to_owned(),
        points: samples
            .chunks(n_each)
            .filter_map(|group| component.point(group))
            .collect(),
        is_peer: false,
    }
}

impl MemoryComponent {
    /// Median and range of a group of samples. `None` if the backend does not report this memory.
    fn point(&self, group: &[Sample]) -> Option<Point> {
        let mut mb: Vec<f64> = group
            .iter()
            .filter_map(self.bytes)
            .map(|bytes| bytes as f64 / BYTES_PER_MB)
            .collect();
        let [low, high] = extent(&mb)?;
        Some(Point {
            x: group[group.len() / 2].seconds / SECS_PER_MINUTE,
            y: quantile(&mut mb, 0.5, Rank::Upper)?,
            low,
            high,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let mut measured = MemoryRun {
            is_software: true,
            samples,
            gpu_buffers,
            ..MemoryRun::default()
        };
        let of_host = MemoryRun {
            is_software: false,
            ..MemoryRun {
                samples: measured.samples.clone(),
                ..MemoryRun::default()
            }
        };
        let of_host = of_host.findings().expect("numbers");
        assert!(
            of_host.sentences[0].contains("+3.59") && of_host.sentences[0].contains("host"),
            "{}",
            of_host.sentences[0]
        );
        measured
            .samples
            .iter_mut()
            .for_each(|sample| sample.model_bytes = sample.resident_bytes - 900_000_000);
        let findings = measured.findings().expect("numbers");
        assert!(
            findings.sentences[0].contains("without the model with a full"),
            "{}",
            findings.sentences[0]
        );
        assert!(
            findings.sentences[0].contains("+0.00 % per hour"),
            "{}",
            findings.sentences[0]
        );
        assert_eq!(findings.tables[1].rows[0][0], "large");
        let chart = &findings.charts[0].1;
        assert_eq!(
            chart.lines.len(),
            5,
            "no line for the unknown reserved memory"
        );
        assert!(
            chart
                .lines
                .iter()
                .all(|line| line.points.len() <= MAX_POINTS),
            "{}",
            chart.lines[0].points.len()
        );
        assert_eq!(chart.markers[0].label, "store full: 100 keyframes");
        assert_eq!(
            findings.numbers["samples"].as_array().map(Vec::len),
            Some(600)
        );
    }
}
