//! Writes samples to an MCAP file as they arrive.
//!
//! Chunks are closed at least once per second of sample time, so a crash loses at most one second.

use super::reader::Recording;
use super::topic::{Encoding, JOINT_NAMES, METERS_PER_COUNT, Topic};
use crate::wire::{descriptor, foxglove, joint_state, point_cloud};
use crate::{Error, Image, PixelFormat, RecordedSpan, Sample, Source, TruthImage};
use files::{Kept, Place};
use kinematics::{Intrinsics, Stamp};
use mcap::McapError;
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, ErrorKind, Seek, Write};
use std::path::{Path, PathBuf};

/// Size at which a chunk is closed. Viewers read whole chunks, and the index has one entry per
/// chunk. Smaller chunks make the index longer, and larger chunks make seeking slower.
const CHUNK_BYTES: u64 = 4 << 20;
/// Maximum time span of the samples in an open chunk. A crash loses these samples. With a shorter
/// time span, the file is written more often.
const FLUSH_NANOS: i64 = 1_000_000_000;

/// Description of the rig, written before the first sample.
#[derive(Clone, Copy, Debug, Default)]
pub struct RecordingMetadata<'a> {
    /// Files to attach, by name. They are the complete rig file, the robot description, and its
    /// mesh files.
    pub files: &'a [(&'a str, &'a [u8])],
    /// Cameras and their lens parameters.
    pub cameras: &'a [(&'a str, &'a Intrinsics)],
    /// Names of the joints, in the order of the joint states.
    pub joint_names: &'a [String],
}

/// A recording being written. After an error, nothing more can be written, but earlier samples
/// remain readable. Dropping this value completes the file. If no sample was written, the file is
/// removed.
pub struct Recorder {
    path: PathBuf,
    /// The file, which another program may remove or rename while it is written. `None` if it
    /// cannot be watched.
    kept: Option<Kept>,
    /// Location of the file at the last check.
    place: Place,
    /// `None` after a failure.
    mcap: Option<mcap::Writer<Box<dyn Sink>>>,
    channels: BTreeMap<(Topic, &'static str), u16>,
    cameras: Vec<(String, Intrinsics)>,
    joint_names: String,
    n_messages: u32,
    /// Number of samples written, including the samples in the open chunk. The next fields are the
    /// range of their stamps.
    n_samples: u64,
    stamps: Option<[Stamp; 2]>,
    /// Span of the samples in closed chunks.
    recorded: RecordedSpan,
    open_bytes: u64,
    open_since: Option<Stamp>,
}

trait Sink: Write + Seek + Send {}
impl<W: Write + Seek + Send> Sink for W {}

impl Recorder {
    /// Starts a recording in a new file.
    ///
    /// # Errors
    /// Fails if the file cannot be created. Also fails if it already exists, because it may be the
    /// recording that is being replayed.
    pub fn create(path: &Path, recording_metadata: &RecordingMetadata<'_>) -> Result<Self, Error> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => Error::Exists {
                path: path.to_owned(),
            },
            _ => Error::Open {
                path: path.to_owned(),
                source,
            },
        })?;
        let recorder = Self::to(Box::new(BufWriter::new(file)), path, recording_metadata);
        // A file with only a header looks like a recording, and would block the name for the next
        // attempt.
        if recorder.is_err() {
            remove_stub(path);
        }
        recorder
    }

    fn to(
        sink: Box<dyn Sink>,
        path: &Path,
        recording_metadata: &RecordingMetadata<'_>,
    ) -> Result<Self, Error> {
        let recorder = |error| Error::Record {
            path: path.to_owned(),
            recorded: RecordedSpan::default(),
            source: io_error(error),
        };
        let options = mcap::WriteOptions::new()
            .profile("fieldrig")
            // Noisy images hardly compress (docs/benchmarks/2026-11-23-reference-figures.md). In
            // uncompressed chunks, all complete records remain readable after a crash.
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES))
            // The writer never changes earlier parts of the file, so that everything already
            // written is readable after a crash.
            .disable_seeking(true);
        let mut mcap = options.create(sink).map_err(recorder)?;
        for (name, data) in recording_metadata.files {
            let attachment = mcap::Attachment {
                log_time: 0,
                create_time: 0,
                name: (*name).to_owned(),
                media_type: media_type_of(name).to_owned(),
                data: (*data).into(),
            };
            mcap.attach(&attachment).map_err(recorder)?;
        }
        // The rig file must survive a crash before the first chunk is full.
        mcap.flush().map_err(recorder)?;
        Ok(Self {
            path: path.to_owned(),
            kept: Kept::open(path).ok(),
            place: Place::Here,
            mcap: Some(mcap),
            channels: BTreeMap::new(),
            cameras: recording_metadata
                .cameras
                .iter()
                .map(|(name, intrinsics)| ((*name).to_owned(), (*intrinsics).clone()))
                .collect(),
            joint_names: recording_metadata.joint_names.join(","),
            n_messages: 0,
            n_samples: 0,
            stamps: None,
            recorded: RecordedSpan::default(),
            open_bytes: 0,
            open_since: None,
        })
    }

    /// Appends one sample.
    pub fn write(&mut self, sample: &Sample) -> Result<(), Error> {
        self.try_write(sample).map_err(|error| self.fail(error))
    }

    /// Writes the index for viewers, completes the file, and returns the recorded span.
    ///
    /// # Errors
    /// Fails if some data could not be written.
    pub fn finish(mut self) -> Result<RecordedSpan, Error> {
        let closed = self
            .close_chunk()
            .and_then(|()| self.mcap()?.finish().map(drop));
        closed.map_err(|error| self.fail(error))?;
        let flushed = self
            .mcap
            .take()
            .map_or(Ok(()), |mcap| mcap.into_inner().flush());
        flushed.map_err(|error| self.fail(McapError::Io(error)))?;
        self.check_place();
        if self.recorded.n_samples == 0 {
            self.remove_stub();
        } else if self.place == Place::Removed {
            let restored = self.kept.as_ref().map_or(Ok(()), Kept::restore);
            restored.map_err(|error| self.fail(McapError::Io(error)))?;
            log::info!("the recording {} was written again", self.path.display());
        }
        Ok(self.recorded)
    }

    /// Warns if the file was removed or renamed since the last check.
    fn check_place(&mut self) {
        let Some(kept) = &self.kept else { return };
        let place = kept.place();
        if place == self.place {
            return;
        }
        let shown = self.path.display();
        match &place {
            Place::Here => log::info!("the recording {shown} is at its path again"),
            Place::MovedTo(to) => {
                log::warn!(
                    "the recording {shown} was moved to {}, and continues there",
                    to.display()
                )
            }
            Place::Removed => {
                log::warn!("the recording {shown} was removed: it is written again at the end")
            }
        }
        self.place = place;
    }

    /// Removes the file, which has no samples.
    fn remove_stub(&self) {
        if self.place == Place::Here {
            remove_stub(&self.path);
        }
    }

    fn mcap(&mut self) -> mcap::McapResult<&mut mcap::Writer<Box<dyn Sink>>> {
        self.mcap
            .as_mut()
            .ok_or_else(|| McapError::Io(std::io::Error::other("an earlier write failed")))
    }

    /// Closes the file after a failure. The error reports how much of the file is readable. A file
    /// without samples is removed.
    fn fail(&mut self, error: McapError) -> Error {
        if self.mcap.take().is_some() {
            // The truncated chunk also contains readable samples, so they are counted by reading
            // the file.
            self.recorded = readable(&self.path);
            if self.recorded.n_samples == 0 {
                self.remove_stub();
            }
        }
        Error::Record {
            path: self.path.clone(),
            recorded: self.recorded,
            source: io_error(error),
        }
    }

    /// Closes the open chunk, which writes all samples to the file.
    fn close_chunk(&mut self) -> mcap::McapResult<()> {
        self.mcap()?.flush()?;
        // A removed file is detected at each flush, because the file system has just been accessed
        // anyway.
        self.check_place();
        self.recorded = RecordedSpan {
            n_samples: self.n_samples,
            seconds: duration_secs(self.stamps),
        };
        self.open_bytes = 0;
        Ok(())
    }

    fn try_write(&mut self, sample: &Sample) -> mcap::McapResult<()> {
        let stamp = sample.stamp();
        self.announce_rig(stamp)?;
        self.write_sample(sample)?;
        self.n_samples += 1;
        self.stamps = Some(with_stamp(self.stamps, stamp));
        // The times of the samples are used instead of a clock, so that the same samples give the
        // same file, byte for byte.
        let open_since = *self.open_since.get_or_insert(stamp);
        if self.open_bytes >= CHUNK_BYTES || stamp.0.saturating_sub(open_since.0) >= FLUSH_NANOS {
            self.close_chunk()?;
            self.open_since = Some(stamp);
        }
        Ok(())
    }

    /// Writes the joint names and the lens parameters, which readers and viewers need before the
    /// first sample. The lens parameters have the stamp of this sample. Later calls write nothing.
    fn announce_rig(&mut self, stamp: Stamp) -> mcap::McapResult<()> {
        if self.n_messages == 0 && !self.joint_names.is_empty() {
            // The channel is announced before all samples, so that readers know the joints
            // immediately.
            self.joints_channel()?;
        }
        for (camera, intrinsics) in std::mem::take(&mut self.cameras) {
            let message = foxglove::encode_calibration(&camera, stamp, &intrinsics);
            self.write_message(
                Topic::Calibration(camera),
                descriptor::CAMERA_CALIBRATION,
                stamp,
                &message,
            )?;
        }
        Ok(())
    }

    fn write_sample(&mut self, sample: &Sample) -> mcap::McapResult<()> {
        let stamp = sample.stamp();
        match sample {
            Sample::Image(image) => {
                let camera = image.camera.to_string();
                let topic = if image.is_depth() {
                    Topic::Depth(camera)
                } else {
                    Topic::Color(camera)
                };
                self.write_image(topic, image)?;
            }
            Sample::Joints(state) => {
                let channel = self.joints_channel()?;
                self.append(channel, stamp, &joint_state::encode(state))?;
            }
            Sample::Base(pose) => {
                let message =
                    foxglove::encode_transform("world", "base", stamp, &pose.world_from_base);
                self.write_message(Topic::Base, descriptor::FRAME_TRANSFORM, stamp, &message)?;
            }
            Sample::BaseTruth(pose) => {
                let message =
                    foxglove::encode_transform("world", "base_truth", stamp, &pose.world_from_base);
                self.write_message(
                    Topic::TrueBase,
                    descriptor::FRAME_TRANSFORM,
                    stamp,
                    &message,
                )?;
            }
            Sample::Range(scan) => {
                let message = point_cloud::encode(scan);
                self.write_message(
                    Topic::Range(scan.scanner.to_string()),
                    descriptor::POINT_CLOUD,
                    stamp,
                    &message,
                )?;
            }
            Sample::Truth(truth) => self.write_truth(truth)?,
        }
        Ok(())
    }

    fn write_truth(&mut self, truth: &TruthImage) -> mcap::McapResult<()> {
        let camera = || truth.image.camera.to_string();
        let stamp = truth.image.stamp;
        // The pose is written last. It completes the sample for the reader, which drops an
        // incomplete sample at the end of a truncated file.
        self.write_image(Topic::TrueColor(camera()), &truth.image)?;
        if !truth.depth_m.is_empty() {
            let message =
                foxglove::encode_depth_m(&camera(), stamp, truth.image.size_px, &truth.depth_m);
            self.write_message(
                Topic::TrueDepth(camera()),
                descriptor::RAW_IMAGE,
                stamp,
                &message,
            )?;
        }
        let message = foxglove::encode_true_pose(
            &camera(),
            stamp,
            &truth.world_from_camera,
            truth.psnr_ceiling,
        );
        self.write_message(
            Topic::TruePose(camera()),
            descriptor::FRAME_TRANSFORM,
            stamp,
            &message,
        )
    }

    fn write_image(&mut self, topic: Topic, image: &Image) -> mcap::McapResult<()> {
        let encoding = Encoding::protobuf(foxglove::schema_of(image.format));
        let channel = match image.format {
            PixelFormat::DepthU16 { meters_per_count } => self.channel(
                topic,
                encoding,
                METERS_PER_COUNT,
                &meters_per_count.to_string(),
            )?,
            _ => self.channel(topic, encoding, "", "")?,
        };
        self.append(channel, image.stamp, &foxglove::encode_image(image))
    }

    fn write_message(
        &mut self,
        topic: Topic,
        schema: descriptor::Schema,
        stamp: Stamp,
        message: &[u8],
    ) -> mcap::McapResult<()> {
        let channel = self.channel(topic, Encoding::protobuf(schema), "", "")?;
        self.append(channel, stamp, message)
    }

    fn joints_channel(&mut self) -> mcap::McapResult<u16> {
        let names = self.joint_names.clone();
        self.channel(Topic::Joints, Encoding::joint_state(), JOINT_NAMES, &names)
    }

    /// Returns the channel of a topic and announces it in the file if it is new. `key` and `value`
    /// are added to its metadata.
    fn channel(
        &mut self,
        topic: Topic,
        encoding: Encoding,
        key: &str,
        value: &str,
    ) -> mcap::McapResult<u16> {
        let known = (topic, encoding.schema_name);
        if let Some(channel) = self.channels.get(&known) {
            return Ok(*channel);
        }
        let schema = self.mcap()?.add_schema(
            encoding.schema_name,
            encoding.schema_encoding,
            &encoding.schema,
        )?;
        let metadata = if key.is_empty() {
            BTreeMap::new()
        } else {
            BTreeMap::from([(key.to_owned(), value.to_owned())])
        };
        let channel = self.mcap()?.add_channel(
            schema,
            &known.0.name(),
            encoding.message_encoding,
            &metadata,
        )?;
        self.channels.insert(known, channel);
        Ok(channel)
    }

    fn append(&mut self, channel_id: u16, stamp: Stamp, message: &[u8]) -> mcap::McapResult<()> {
        // Viewers sort by this time. The exact stamp, which may be negative, is in the message.
        let log_time = u64::try_from(stamp.0).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence: self.n_messages,
            log_time,
            publish_time: log_time,
        };
        self.n_messages = self.n_messages.wrapping_add(1);
        self.open_bytes += message.len() as u64;
        self.mcap()?.write_to_known_channel(&header, message)
    }
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder")
            .field("path", &self.path)
            .field("n_messages", &self.n_messages)
            .finish_non_exhaustive()
    }
}

/// Counts the readable samples of a truncated recording.
fn readable(path: &Path) -> RecordedSpan {
    let mut n_samples = 0;
    let mut stamps = None;
    if let Ok(mut recording) = Recording::open(path) {
        while let Ok(Some(sample)) = recording.next_sample() {
            n_samples += 1;
            stamps = Some(with_stamp(stamps, sample.stamp()));
        }
    }
    RecordedSpan {
        n_samples,
        seconds: duration_secs(stamps),
    }
}

/// Extends a range of stamps by one stamp.
fn with_stamp(range: Option<[Stamp; 2]>, stamp: Stamp) -> [Stamp; 2] {
    let [first, last] = range.unwrap_or([stamp; 2]);
    [first.min(stamp), last.max(stamp)]
}

fn duration_secs(range: Option<[Stamp; 2]>) -> f64 {
    range.map_or(0.0, |[first, last]| {
        last.0.saturating_sub(first.0) as f64 * 1e-9
    })
}

/// Unwraps an I/O error, which is more informative than the error of the format.
fn io_error(error: McapError) -> std::io::Error {
    match error {
        McapError::Io(io) => io,
        other => std::io::Error::other(other),
    }
}

/// Removes a file without samples.
fn remove_stub(path: &Path) {
    if let Err(error) = std::fs::remove_file(path)
        && error.kind() != ErrorKind::NotFound
    {
        log::warn!("cannot remove the empty recording {path:?}: {error}");
    }
}

fn media_type_of(name: &str) -> &'static str {
    match name.rsplit_once('.').map(|(_, ending)| ending) {
        Some("toml") => "application/toml",
        Some("urdf" | "xml") => "application/xml",
        Some("json") => "application/json",
        Some("gz") => "application/gzip",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::JointState;
    use std::io::{Error as IoError, SeekFrom};

    /// A file on a disk that is full after the given number of bytes.
    struct FullDisk {
        file: File,
        remaining: usize,
    }

    impl Write for FullDisk {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            let n_bytes = bytes.len().min(self.remaining);
            if n_bytes == 0 && !bytes.is_empty() {
                return Err(IoError::from(ErrorKind::StorageFull));
            }
            self.remaining -= n_bytes;
            self.file.write(&bytes[..n_bytes])
        }

        fn flush(&mut self) -> std::io::Result<()> {
            self.file.flush()
        }
    }

    impl Seek for FullDisk {
        fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
            self.file.seek(to)
        }
    }

    /// A reading of the joints at this time in milliseconds.
    fn reading_at(millis: i64) -> Sample {
        Sample::Joints(JointState {
            stamp: Stamp(millis * 1_000_000),
            position: vec![0.25; 7],
            velocity: vec![],
            effort: vec![],
        })
    }

    #[test]
    fn full_disk_is_error_and_written_samples_stay_readable() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let file = File::create(&path).expect("a new file");
        let sink = Box::new(BufWriter::new(FullDisk {
            file,
            remaining: 300_000,
        }));
        let mut recorder = Recorder::to(sink, &path, &RecordingMetadata::default())
            .expect("the header fits on the disk");
        let error = (0..20_000)
            .map(|ix| recorder.write(&reading_at(ix)))
            .find_map(Result::err)
            .expect("the disk is full");
        let Error::Record { recorded, .. } = error else {
            panic!("{error}")
        };
        let expected_end = format!(
            "run.mcap\": the first {:.1} s ({} samples) are saved",
            recorded.seconds, recorded.n_samples
        );
        assert!(error.to_string().ends_with(&expected_end), "{error}");
        let io_error = std::error::Error::source(&error).map(ToString::to_string);
        assert!(
            io_error.is_some_and(|io_error| io_error.contains("no storage space")),
            "{error:?}"
        );
        assert!(
            recorder.write(&reading_at(0)).is_err(),
            "writing after a failure fails"
        );
        drop(recorder);
        let mut recording = Recording::open(&path).expect("a recording");
        let mut n_samples = 0_i64;
        while let Some(sample) = recording.next_sample().expect("readable") {
            assert_eq!(sample, reading_at(n_samples));
            n_samples += 1;
        }
        // Samples of the truncated chunk count, too, because the error reports how many samples can
        // be read.
        assert!(
            recorded.n_samples > 1000 && n_samples.unsigned_abs() == recorded.n_samples,
            "{n_samples} of {recorded:?}"
        );
        assert!(
            (recorded.seconds - 1e-3 * (recorded.n_samples - 1) as f64).abs() < 1e-9,
            "{recorded:?}"
        );
        assert!(recording.damage().is_some());
    }

    #[test]
    fn a_recording_without_samples_leaves_no_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let recorder = Recorder::create(&path, &RecordingMetadata::default()).expect("a new file");
        assert_eq!(
            recorder.finish().expect("finishing succeeds"),
            RecordedSpan::default()
        );
        assert!(!path.exists());
        let sink = Box::new(FullDisk {
            file: File::create(&path).expect("a new file"),
            remaining: 1000,
        });
        let mut recorder = Recorder::to(sink, &path, &RecordingMetadata::default())
            .expect("the header fits on the disk");
        let error = (0..2000)
            .map(|ix| recorder.write(&reading_at(ix)))
            .find_map(Result::err)
            .expect("the disk is full");
        assert!(
            error.to_string().ends_with("no samples were saved") && !path.exists(),
            "{error}"
        );
    }
}
