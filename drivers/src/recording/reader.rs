//! Reads samples from an MCAP file, one chunk at a time.
//!
//! The file is read sequentially without its index, so a truncated recording yields every sample
//! before the cut.

use super::meshes::{MAX_MESH_BYTES, mesh_file_of};
use super::record::Record;
use super::records::{self, RawRecord, ReadError, Records};
use super::topic::Topic;
use super::{RIG_FILE, URDF_FILE};
use crate::wire::{Malformed, foxglove, joint_state, point_cloud};
use crate::{BasePose, Error, Image, PixelFormat, Sample, Source, TruthImage};
use kinematics::JointState;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Maximum number of unused topics, attachments and metadata that are reported.
const MAX_UNUSED: usize = 50;
/// Maximum length of the names of all mesh files. A robot has at most a few hundred mesh files.
const MAX_MESH_NAME_BYTES: u64 = 1 << 20;
/// Maximum number of unused parts in the error about a recording without samples.
const MAX_UNUSED_IN_ERROR: usize = 5;

/// A recording that is being replayed. It is a [`Source`] of its samples in recorded order.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    records: Records<BufReader<File>>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
    /// Channels of topics of other programs.
    unused_channels: BTreeSet<u16>,
    attachments: BTreeMap<String, Vec<u8>>,
    /// Size of the attached mesh files and of their names, bytes.
    mesh_bytes: u64,
    joint_names: Option<Vec<String>>,
    notes: Notes,
    /// Topics, attachments and metadata of other programs, as messages name them.
    unused: BTreeSet<String>,
    /// Parts of a ground-truth sample that is not complete yet.
    true_color: Option<Image>,
    true_depth_m: Option<Arc<[f32]>>,
    first: Option<Sample>,
    n_samples: u64,
    damage: Option<String>,
    /// Description of the damage, without the name of the file and the number of samples.
    damage_kind: Option<String>,
    ended: bool,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Channel {
    topic: Topic,
    topic_name: String,
    schema_name: String,
    /// Value of [`Topic::metadata_key`].
    metadata: Option<String>,
}

impl Channel {
    /// Numbers of the fields of a message that this version does not know.
    fn unknown_fields(&self, data: &[u8]) -> Vec<String> {
        match &self.topic {
            Topic::Joints => joint_state::unknown_fields(data),
            Topic::Calibration(_) => Vec::new(),
            topic => {
                let schema = topic
                    .schemas()
                    .iter()
                    .find(|schema| schema.name == self.schema_name);
                let numbers = schema
                    .map(|schema| schema.unknown_fields(data))
                    .unwrap_or_default();
                numbers.iter().map(u32::to_string).collect()
            }
        }
    }
}

impl Recording {
    /// Opens a recording.
    ///
    /// # Errors
    /// Fails if the file does not exist, is not an MCAP file, or contains no samples recorded by
    /// this program.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let open = |source| Error::Open {
            path: path.to_owned(),
            source,
        };
        let mut file = files::open(path).map_err(open)?;
        let mut magic = [0; mcap::MAGIC.len()];
        match file.read_exact(&mut magic) {
            Ok(()) if magic == mcap::MAGIC => {}
            Err(e) if e.kind() != std::io::ErrorKind::UnexpectedEof => return Err(open(e)),
            _ => {
                return Err(Error::NotARecording {
                    path: path.to_owned(),
                });
            }
        }
        let mut recording = Self {
            path: path.to_owned(),
            records: Records::new(BufReader::with_capacity(1 << 20, file)),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            unused_channels: BTreeSet::new(),
            attachments: BTreeMap::new(),
            mesh_bytes: 0,
            joint_names: None,
            notes: Notes::default(),
            unused: BTreeSet::new(),
            true_color: None,
            true_depth_m: None,
            first: None,
            n_samples: 0,
            damage: None,
            damage_kind: None,
            ended: false,
        };
        // The first sample is read here. Joint names and attachments precede it, so they are then
        // available. If there is no sample, the file is not a recording of this program.
        recording.first = recording.read_sample()?;
        if recording.first.is_none() {
            return Err(Error::EmptyRecording {
                path: path.to_owned(),
                reason: recording.reason_for_no_samples(),
            });
        }
        if [RIG_FILE, URDF_FILE]
            .iter()
            .any(|name| recording.attachment(name).is_none())
        {
            // The search reads the headers of the whole file, so it runs only if necessary.
            recording.find_attachments().map_err(open)?;
        }
        Ok(recording)
    }

    fn reason_for_no_samples(&self) -> String {
        let unused: Vec<&str> = self
            .unused
            .iter()
            .take(MAX_UNUSED_IN_ERROR)
            .map(String::as_str)
            .collect();
        match &self.damage_kind {
            Some(kind) => format!("; it {kind}"),
            None if unused.is_empty() => String::new(),
            None => format!(
                "; it contains {} (see docs/guide/data-from-elsewhere.md)",
                unused.join(", ")
            ),
        }
    }

    /// The mesh files of the robot, by their names in the robot description: each name with the
    /// compressed contents, which [`super::decompress_mesh`] reads. In alphabetical order.
    pub fn mesh_files(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.attachments
            .iter()
            .filter_map(|(name, data)| Some((mesh_file_of(name)?, data.as_slice())))
    }

    /// Returns the attachment with this name: [`super::RIG_FILE`] or [`super::URDF_FILE`]. Other
    /// attachments are not kept, except those of [`Self::mesh_files`].
    pub fn attachment(&self, name: &str) -> Option<&[u8]> {
        self.attachments.get(name).map(Vec::as_slice)
    }

    /// Names of the joints in the order of the joint states. The names are available from the first
    /// sample on. `None` if the recording contains no joint states.
    pub fn joint_names(&self) -> Option<&[String]> {
        self.joint_names.as_deref()
    }

    /// Describes the damage of the file, and how much of the file could be read. The description is
    /// available after the last sample.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// Finds attachments behind the first sample. `mcap filter`, `mcap merge` and other programs
    /// write attachments at the end of the file.
    fn find_attachments(&mut self) -> std::io::Result<()> {
        let mut file = BufReader::new(files::open(&self.path)?);
        file.seek_relative(i64::try_from(mcap::MAGIC.len()).unwrap_or_default())?;
        for RawRecord { opcode, bytes } in records::attachments(file) {
            match Record::decode(opcode, &bytes) {
                Ok(Record::Attachment { name, data }) => self.attach(name, data),
                Ok(_) => {}
                Err(error) => {
                    let place = self.path.display().to_string();
                    self.notes.add_at(place, "attachment", || {
                        format!("an attachment is not used, because {error}")
                    });
                }
            }
        }
        Ok(())
    }

    fn attach(&mut self, name: &str, data: &[u8]) {
        if ![RIG_FILE, URDF_FILE].contains(&name) && !self.takes_mesh(name, data) {
            return self.report_unused(format!("attachment {name:?}"));
        }
        match self.attachments.get(name) {
            None => drop(self.attachments.insert(name.to_owned(), data.to_vec())),
            Some(first) if first == data => {}
            // This happens when recordings are merged.
            Some(_) => self.notes.add_at(format!("attachment {name:?}"), "attachment", || {
                format!(
                    "{} contains another one of this name with other contents; the first is used, unless a rig file is given",
                    self.path.display()
                )
            }),
        }
    }

    /// Whether an attachment is a mesh file, and fits into the limit of all mesh files. Counts it.
    fn takes_mesh(&mut self, name: &str, data: &[u8]) -> bool {
        if mesh_file_of(name).is_none() {
            return false;
        }
        if self.attachments.contains_key(name) {
            return true;
        }
        // Names count, too, so that files without contents cannot fill the memory.
        let n_bytes = self
            .mesh_bytes
            .saturating_add((name.len() + data.len()) as u64);
        let has_room = n_bytes <= MAX_MESH_BYTES + MAX_MESH_NAME_BYTES;
        if has_room {
            self.mesh_bytes = n_bytes;
        }
        has_room
    }

    /// Logs that a part of the file has no effect.
    fn report_unused(&mut self, what: String) {
        // Files of other programs may have thousands of topics.
        if self.unused.len() > MAX_UNUSED || self.unused.contains(&what) {
            return;
        }
        let path = self.path.display();
        if self.unused.len() < MAX_UNUSED {
            log::info!("{what} of {path} is not used");
        } else {
            log::info!("more topics, attachments or metadata of {path} are not used");
        }
        self.unused.insert(what);
    }

    fn read_sample(&mut self) -> Result<Option<Sample>, Error> {
        while !self.ended {
            match self.records.next() {
                Ok(None) => self.ended = true,
                Ok(Some(RawRecord { opcode, bytes })) => match Record::decode(opcode, &bytes) {
                    Ok(record) => {
                        // Most records, such as schemas, channels and the parts of a ground-truth
                        // sample, do not complete a sample.
                        if let Some(sample) = self.take(record)? {
                            self.n_samples += 1;
                            return Ok(Some(sample));
                        }
                    }
                    Err(error) => self.end_damaged(&format!("is damaged ({error})")),
                },
                Err(ReadError::Read(source)) => {
                    return Err(Error::Replay {
                        path: self.path.clone(),
                        source,
                    });
                }
                Err(read_error) => self.end_damaged(&read_error.to_string()),
            }
        }
        Ok(None)
    }

    fn end_damaged(&mut self, description: &str) {
        self.ended = true;
        self.damage_kind = Some(description.to_owned());
        self.damage = Some(format!(
            "the recording {:?} {description} after {} readable samples",
            self.path, self.n_samples
        ));
    }

    /// Processes one record. If the record completes a sample, returns the sample.
    fn take(&mut self, record: Record<'_>) -> Result<Option<Sample>, Error> {
        match record {
            Record::Schema { id, name } => {
                self.schemas.insert(id, name.to_owned());
            }
            Record::Channel {
                id,
                schema_id,
                topic: topic_name,
                encoding,
                metadata,
            } => {
                let schema_name = self.schemas.get(&schema_id).cloned().unwrap_or_default();
                self.announce(id, topic_name, schema_name, encoding, &metadata)
                    .map_err(|reason| Error::BrokenTopic {
                        path: self.path.clone(),
                        topic: topic_name.to_owned(),
                        reason,
                    })?;
            }
            Record::Attachment { name, data } => self.attach(name, data),
            Record::Metadata { name } => self.report_unused(format!("metadata {name:?}")),
            Record::Message { channel_id, data } => match self.channels.get(&channel_id).cloned() {
                Some(channel) => {
                    return self
                        .decode(&channel, data)
                        .map_err(|source| Error::BrokenMessage {
                            path: self.path.clone(),
                            topic: channel.topic_name,
                            source,
                        });
                }
                // Messages of other programs are skipped without decoding.
                None if self.unused_channels.contains(&channel_id) => {}
                None => self.end_damaged(&format!(
                    "is damaged (a message on channel {channel_id}, which is not announced)"
                )),
            },
            Record::Other => {}
        }
        Ok(None)
    }

    /// Registers an announced channel. The error describes what its topic contains instead of the
    /// expected messages.
    fn announce(
        &mut self,
        id: u16,
        topic_name: &str,
        schema_name: String,
        encoding: &str,
        metadata: &BTreeMap<&str, &str>,
    ) -> Result<(), String> {
        let Some(topic) = Topic::from_name(topic_name) else {
            self.report_unused(format!("topic {topic_name:?}"));
            self.unused_channels.insert(id);
            return if self.channels.contains_key(&id) {
                Err(other_channel(id))
            } else {
                Ok(())
            };
        };
        // A topic with a name of this program but with messages of another type is an error. If the
        // topic were skipped, a camera or the joints would be missing without a message.
        let (readable, readable_encoding) = topic.readable();
        // Calibrations are not read.
        let is_read = !matches!(topic, Topic::Calibration(_));
        if is_read && !(readable.contains(&schema_name.as_str()) && encoding == readable_encoding) {
            return Err(format!(
                "its messages are {schema_name:?} in {encoding:?}, expected {} in {readable_encoding:?}; rename or remove the topic if another program wrote it",
                readable.join(" or ")
            ));
        }
        let used_key = topic.metadata_key();
        // Other keys are reported, because the program that wrote them expected an effect.
        let value = used_key
            .and_then(|key| metadata.get(key))
            .map(|value| (*value).to_owned());
        for key in metadata.keys().filter(|key| Some(**key) != used_key) {
            self.report_unused(format!("metadata {key:?} of topic {topic_name:?}"));
        }
        let channel = Channel {
            topic,
            topic_name: topic_name.to_owned(),
            schema_name,
            metadata: value,
        };
        if self.unused_channels.contains(&id)
            || self
                .channels
                .get(&id)
                .is_some_and(|known| *known != channel)
        {
            return Err(other_channel(id));
        }
        if channel.topic == Topic::Joints {
            self.take_joint_names(topic_name, channel.metadata.as_deref().unwrap_or_default())?;
        }
        self.channels.insert(id, channel);
        Ok(())
    }

    /// Stores the joint names of a channel. All channels must list the same names, because a rig
    /// has one arm.
    fn take_joint_names(&mut self, topic_name: &str, names: &str) -> Result<(), String> {
        if names.is_empty() {
            self.notes.add(topic_name, "joint_names", || {
                "its channel does not list joint_names; the order of arm.joints in the rig file is assumed".to_owned()
            });
            return Ok(());
        }
        let listed: Vec<String> = names.split(',').map(str::to_owned).collect();
        let known = self.joint_names.get_or_insert_with(|| listed.clone());
        if *known == listed {
            return Ok(());
        }
        Err(format!(
            "a channel has the joint_names {names}, expected those of the first one, {}; if recordings of two robots were merged, use them separately",
            known.join(",")
        ))
    }

    fn decode(&mut self, channel: &Channel, data: &[u8]) -> Result<Option<Sample>, Malformed> {
        let sample = self.sample_of(channel, data)?;
        let unknown = channel.unknown_fields(data);
        if !unknown.is_empty() {
            self.notes.add(&channel.topic_name, "fields", || {
                format!(
                    "unknown fields of its messages are not used: {}; a newer version of fieldrig may use them",
                    unknown.join(", ")
                )
            });
        }
        Ok(sample)
    }

    fn sample_of(&mut self, channel: &Channel, data: &[u8]) -> Result<Option<Sample>, Malformed> {
        let topic_name = &channel.topic_name;
        Ok(Some(match &channel.topic {
            Topic::Color(camera) => Sample::Image(self.image(channel, camera, data)?),
            Topic::Depth(camera) => {
                let image = self.image(channel, camera, data)?;
                self.notes.check_depth_scale(channel, &image);
                Sample::Image(image)
            }
            Topic::Joints => {
                let state = joint_state::decode(data)?;
                self.notes.check_joints(
                    topic_name,
                    self.joint_names.as_ref().map(Vec::len),
                    &state,
                );
                Sample::Joints(state)
            }
            Topic::Base => Sample::Base(self.base_pose(topic_name, "base", data)?),
            Topic::TrueBase => Sample::BaseTruth(self.base_pose(topic_name, "base_truth", data)?),
            Topic::Range(scanner) => {
                let mut scan = point_cloud::decode(data)?;
                self.notes.agree(topic_name, scanner, &mut scan.scanner);
                Sample::Range(scan)
            }
            Topic::Calibration(_) => return Ok(None),
            Topic::TrueColor(camera) => {
                self.true_color = Some(self.image(channel, camera, data)?);
                return Ok(None);
            }
            Topic::TrueDepth(_) => {
                self.true_depth_m = Some(foxglove::decode_depth_m(data)?);
                return Ok(None);
            }
            Topic::TruePose(camera) => Sample::Truth(self.truth(topic_name, camera, data)?),
        }))
    }

    /// A reported pose of the base. With the frame `base_truth`, it is the true pose.
    fn base_pose(
        &mut self,
        topic_name: &str,
        frame: &str,
        data: &[u8],
    ) -> Result<BasePose, Malformed> {
        self.notes
            .agree_frames(topic_name, ["world", frame], data)?;
        let (stamp, world_from_base) = foxglove::decode_transform(data)?;
        Ok(BasePose {
            stamp,
            world_from_base,
        })
    }

    /// Completes a ground-truth sample with its pose, which follows its images in the file.
    fn truth(
        &mut self,
        topic_name: &str,
        camera: &str,
        data: &[u8],
    ) -> Result<TruthImage, Malformed> {
        self.notes
            .agree_frames(topic_name, ["world", camera], data)?;
        let (stamp, world_from_camera, psnr_ceiling) = foxglove::decode_true_pose(data)?;
        let depth_m = self.true_depth_m.take().unwrap_or_else(|| Arc::from([]));
        let color = self.true_color.take();
        // If the images came from another camera or time, scores would be computed against the
        // wrong ground truth.
        let image = color
            .filter(|image| *image.camera == *camera && image.stamp == stamp)
            .ok_or(Malformed::Missing {
                name: "true color of this pose",
            })?;
        let n_px = image.size_px[0] as usize * image.size_px[1] as usize;
        if !depth_m.is_empty() && depth_m.len() != n_px {
            return Err(Malformed::Missing {
                name: "true depth of this pose",
            });
        }
        Ok(TruthImage {
            image,
            depth_m,
            world_from_camera,
            psnr_ceiling,
        })
    }

    /// Decodes an image of the kind that its topic requires.
    fn image(&mut self, channel: &Channel, camera: &str, data: &[u8]) -> Result<Image, Malformed> {
        let mut image = foxglove::decode_image(&channel.schema_name, data)?;
        let color = "a color format";
        let depth = "16UC1 (depth)";
        let (found, expected) = match (&channel.topic, image.is_depth()) {
            (Topic::Depth(_), false) => (color, depth),
            (Topic::Color(_) | Topic::TrueColor(_), true) => (depth, color),
            _ => {
                self.notes
                    .agree(&channel.topic_name, camera, &mut image.camera);
                return Ok(image);
            }
        };
        Err(Malformed::Unsupported {
            name: "encoding",
            found: found.to_owned(),
            expected: expected.to_owned(),
        })
    }
}

fn other_channel(id: u16) -> String {
    format!("another channel of the file has the same number, {id}")
}

/// Notes about differences from recordings of this program that do not prevent reading.
#[derive(Debug, Default)]
struct Notes(BTreeMap<(String, &'static str), String>);

impl Notes {
    /// Logs a difference in a topic. For each subject, only the first difference is logged.
    fn add(&mut self, topic: &str, subject: &'static str, difference: impl FnOnce() -> String) {
        self.add_at(format!("topic {topic:?}"), subject, difference);
    }

    fn add_at(
        &mut self,
        place: String,
        subject: &'static str,
        difference: impl FnOnce() -> String,
    ) {
        // Millions of messages may have the same difference.
        if let Entry::Vacant(entry) = self.0.entry((place, subject)) {
            let place = entry.key().0.clone();
            let difference = entry.insert(difference());
            log::warn!("{place}: {difference}");
        }
    }

    /// Replaces the name in a message with the name in its topic.
    fn agree(&mut self, topic: &str, in_topic: &str, in_message: &mut Arc<str>) {
        if **in_message == *in_topic {
            return;
        }
        self.add(topic, "frame_id", || {
            format!(
                "its messages have the frame_id {in_message:?}, expected {in_topic:?}; the name in the topic is used"
            )
        });
        *in_message = in_topic.into();
    }

    /// Compares the frames of a pose with the frames of its topic.
    fn agree_frames(
        &mut self,
        topic: &str,
        expected: [&str; 2],
        data: &[u8],
    ) -> Result<(), Malformed> {
        let found @ [parent, child] = foxglove::decode_frames(data)?;
        if found == expected {
            return Ok(());
        }
        let [expected_parent, expected_child] = expected;
        // The inverse of a pose is also a valid pose, so later code could not detect the mistake.
        // The robot would move backwards.
        if [child, parent] == expected {
            let expected = format!("{expected_parent:?}: the pose is inverted");
            return Err(Malformed::Unsupported {
                name: "parent_frame_id",
                found: format!("{parent:?}"),
                expected,
            });
        }
        self.add(topic, "frames", || {
            format!(
                "its messages are poses of {child:?} in {parent:?}, expected {expected_child:?} in {expected_parent:?}; they are used as such"
            )
        });
        Ok(())
    }

    /// Compares the scale of a depth image with the scale in the metadata of its channel.
    fn check_depth_scale(&mut self, channel: &Channel, image: &Image) {
        if let (PixelFormat::DepthU16 { meters_per_count }, Some(listed)) =
            (image.format, &channel.metadata)
            && listed.parse::<f64>() != Ok(meters_per_count)
        {
            self.add(&channel.topic_name, "meters_per_count", || {
                format!(
                    "meters_per_count is {listed} in the metadata of the channel, but {meters_per_count} in messages, which is used"
                )
            });
        }
    }

    /// Compares the lengths of the lists of a joint state.
    fn check_joints(&mut self, topic: &str, n_names: Option<usize>, state: &JointState) {
        let n = state.position.len();
        if let Some(n_names) = n_names
            && n_names != n
        {
            self.add(topic, "position", || {
                format!(
                    "position has {n} numbers, expected one for each of the {n_names} joint_names"
                )
            });
        }
        for (name, list) in [("velocity", &state.velocity), ("effort", &state.effort)] {
            if !list.is_empty() && list.len() != n {
                let n_list = list.len();
                self.add(topic, name, || {
                    format!("{name} has {n_list} numbers, expected none or {n}; it is not used")
                });
            }
        }
    }
}

impl Source for Recording {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        match self.first.take() {
            Some(sample) => Ok(Some(sample)),
            None => self.read_sample(),
        }
    }
}

#[cfg(test)]
mod tests;
