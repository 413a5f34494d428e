//! Reads samples from an MCAP file, one chunk at a time.
//!
//! The file is read sequentially without its index, so a truncated recording yields every sample before the cut.

use super::RIG_FILE;
use super::record::Record;
use super::records::{self, RawRecord, ReadError, Records};
use super::topic::{JOINT_NAMES, Topic};
use crate::wire::{Malformed, foxglove, joint_state, point_cloud};
use crate::{BasePose, Error, Image, Sample, Source, TruthImage};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Maximum number of unused topics that are reported.
const MAX_UNUSED_TOPICS: usize = 50;

/// A recording that is being replayed: a [`Source`] of its samples in recorded order.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    records: Records<BufReader<File>>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
    attachments: BTreeMap<String, Vec<u8>>,
    joint_names: Option<Vec<String>>,
    names: Names,
    /// Topics of other programs.
    unused_topics: BTreeSet<String>,
    /// Parts of a ground-truth sample that is not complete yet.
    true_color: Option<Image>,
    true_depth_m: Option<Arc<[f32]>>,
    first: Option<Sample>,
    n_samples: u64,
    damage: Option<String>,
    ended: bool,
}

#[derive(Clone, Debug)]
struct Channel {
    topic: Topic,
    topic_name: String,
    schema_name: String,
}

impl Recording {
    /// Opens a recording.
    ///
    /// # Errors
    /// If the file does not exist, is not an MCAP file, or contains no samples recorded by this program.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let open = |source| Error::Open { path: path.to_owned(), source };
        let mut file = files::open(path).map_err(open)?;
        let mut magic = [0; mcap::MAGIC.len()];
        match file.read_exact(&mut magic) {
            Ok(()) if magic == mcap::MAGIC => {}
            Err(e) if e.kind() != std::io::ErrorKind::UnexpectedEof => return Err(open(e)),
            _ => return Err(Error::NotARecording { path: path.to_owned() }),
        }
        let mut recording = Self {
            path: path.to_owned(),
            records: Records::new(BufReader::with_capacity(1 << 20, file)),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            attachments: BTreeMap::new(),
            joint_names: None,
            names: Names::default(),
            unused_topics: BTreeSet::new(),
            true_color: None,
            true_depth_m: None,
            first: None,
            n_samples: 0,
            damage: None,
            ended: false,
        };
        recording.first = recording.read_sample()?;
        if recording.attachment(RIG_FILE).is_none() {
            recording.find_attachments().map_err(open)?;
        }
        if recording.first.is_none() {
            return Err(Error::EmptyRecording { path: path.to_owned() });
        }
        Ok(recording)
    }

    /// Returns an attached file, such as [`super::RIG_FILE`].
    pub fn attachment(&self, name: &str) -> Option<&[u8]> {
        self.attachments.get(name).map(Vec::as_slice)
    }

    /// Names of the joints in the order of the joint states, if the recording contains joint states. Available from the
    /// first sample on.
    pub fn joint_names(&self) -> Option<&[String]> {
        self.joint_names.as_deref()
    }

    /// Describes the damage of the file and how much could be read. Available after the last sample.
    pub fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// Finds attachments behind the first sample. `mcap filter`, `merge` and others write them at the end of the file.
    fn find_attachments(&mut self) -> std::io::Result<()> {
        let mut file = BufReader::new(files::open(&self.path)?);
        file.seek_relative(i64::try_from(mcap::MAGIC.len()).unwrap_or_default())?;
        for RawRecord { opcode, bytes } in records::attachments(file) {
            if let Ok(Record::Attachment { name, data }) = Record::decode(opcode, &bytes) {
                self.attachments.insert(name.to_owned(), data.to_vec());
            }
        }
        Ok(())
    }

    fn read_sample(&mut self) -> Result<Option<Sample>, Error> {
        while !self.ended {
            match self.records.next() {
                Ok(None) => self.ended = true,
                Ok(Some(RawRecord { opcode, bytes })) => match Record::decode(opcode, &bytes) {
                    Ok(record) => {
                        if let Some(sample) = self.take(record)? {
                            self.n_samples += 1;
                            return Ok(Some(sample));
                        }
                    }
                    Err(error) => self.end_damaged(&format!("is damaged ({error})")),
                },
                Err(ReadError::Read(source)) => return Err(Error::Replay { path: self.path.clone(), source }),
                Err(read_error) => self.end_damaged(&read_error.to_string()),
            }
        }
        Ok(None)
    }

    fn end_damaged(&mut self, description: &str) {
        self.ended = true;
        self.damage =
            Some(format!("the recording {:?} {description} after {} readable samples", self.path, self.n_samples));
    }

    /// Processes one record and returns a sample if it completes one.
    fn take(&mut self, record: Record<'_>) -> Result<Option<Sample>, Error> {
        match record {
            Record::Schema { id, name } => {
                self.schemas.insert(id, name.to_owned());
            }
            Record::Channel { id, schema_id, topic: topic_name, metadata } => {
                if let Some(topic) = Topic::from_name(topic_name) {
                    if let (Topic::Joints, Some(names)) = (&topic, metadata.get(JOINT_NAMES)) {
                        self.joint_names = Some(names.split(',').map(str::to_owned).collect());
                    }
                    let schema_name = self.schemas.get(&schema_id).cloned().unwrap_or_default();
                    self.channels.insert(id, Channel { topic, topic_name: topic_name.to_owned(), schema_name });
                } else if self.unused_topics.len() < MAX_UNUSED_TOPICS
                    && self.unused_topics.insert(topic_name.to_owned())
                {
                    log::info!("topic {topic_name:?} of {} is not used", self.path.display());
                }
            }
            Record::Attachment { name, data } => {
                self.attachments.insert(name.to_owned(), data.to_vec());
            }
            Record::Message { channel_id, data } => {
                if let Some(channel) = self.channels.get(&channel_id).cloned() {
                    return self.decode(&channel, data).map_err(|source| Error::BrokenMessage {
                        path: self.path.clone(),
                        topic: channel.topic_name,
                        source,
                    });
                }
            }
            Record::Other => {}
        }
        Ok(None)
    }

    fn decode(&mut self, channel: &Channel, data: &[u8]) -> Result<Option<Sample>, Malformed> {
        let mut image = |camera: &str| {
            let mut image = foxglove::decode_image(&channel.schema_name, data)?;
            self.names.agree(&channel.topic_name, camera, &mut image.camera);
            Ok::<_, Malformed>(image)
        };
        Ok(Some(match &channel.topic {
            Topic::Color(camera) | Topic::Depth(camera) => Sample::Image(image(camera)?),
            Topic::Joints => Sample::Joints(joint_state::decode(data)?),
            Topic::Base => {
                let (stamp, world_from_base) = foxglove::decode_transform(data)?;
                Sample::Base(BasePose { stamp, world_from_base })
            }
            Topic::TrueBase => {
                let (stamp, world_from_base) = foxglove::decode_transform(data)?;
                Sample::BaseTruth(BasePose { stamp, world_from_base })
            }
            Topic::Range(scanner) => {
                let mut scan = point_cloud::decode(data)?;
                self.names.agree(&channel.topic_name, scanner, &mut scan.scanner);
                Sample::Range(scan)
            }
            Topic::Calibration(_) => return Ok(None),
            Topic::TrueColor(camera) => {
                self.true_color = Some(image(camera)?);
                return Ok(None);
            }
            Topic::TrueDepth(_) => {
                self.true_depth_m = Some(foxglove::decode_depth_m(data)?);
                return Ok(None);
            }
            Topic::TruePose(_) => {
                let (world_from_camera, psnr_ceiling) = foxglove::decode_true_pose(data)?;
                let image = self.true_color.take().ok_or(Malformed::Missing { name: "true color of this pose" })?;
                let depth_m = self.true_depth_m.take().unwrap_or_else(|| Arc::from([]));
                Sample::Truth(TruthImage { image, depth_m, world_from_camera, psnr_ceiling })
            }
        }))
    }
}

/// Names of devices in topics and in the messages of these topics.
#[derive(Debug, Default)]
struct Names {
    /// Topics of which a difference was reported.
    reported: BTreeSet<String>,
}

impl Names {
    /// Replaces the name in a message with the name in its topic. Logs the first difference of each topic.
    fn agree(&mut self, topic: &str, in_topic: &str, in_message: &mut Arc<str>) {
        if **in_message == *in_topic {
            return;
        }
        if self.reported.insert(topic.to_owned()) {
            log::warn!(
                "topic {topic:?}: its messages have the frame_id {in_message:?}, expected {in_topic:?}; the name in the topic is used"
            );
        }
        *in_message = in_topic.into();
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
mod tests {
    use super::Names;
    use std::sync::Arc;

    #[test]
    fn name_in_the_topic_counts() {
        let mut names = Names::default();
        for in_message in ["wrist", "left", ""] {
            let mut name: Arc<str> = in_message.into();
            names.agree("/camera/left/color", "left", &mut name);
            assert_eq!(&*name, "left");
        }
        assert_eq!(names.reported.len(), 1, "each topic is reported once");
    }
}
