//! The state of training on disk: a file that is whole or not there, and says what it is.
//!
//! `docs/reference/files.md` describes the layout.

use crate::{Error, whole_file};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::{Debug, Formatter};
use std::io::Write;
use std::path::Path;

const MAGIC: [u8; 8] = *b"FRIGCKPT";
/// Of the layout and of what the states of all methods mean.
const VERSION: u32 = 2;
/// Magic, version, and the length of the description.
const FRONT_BYTES: usize = 16;
const SUM_BYTES: usize = 32;

/// Everything that a model in training needs to go on.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Name of the method.
    pub method: String,
    /// Seconds it had been trained for.
    pub seconds: f64,
    /// SHA-256 of the model that keyframes without depth had theirs drawn from, where there was one.
    pub depth_from: Option<String>,
    /// Flags of the run by name, for its caller to continue with them. They include the limit of training.
    pub flags: BTreeMap<String, String>,
    /// Whether training had reached its limit.
    pub is_finished: bool,
    /// The method's state but for its arrays.
    pub state: serde_json::Value,
    /// What is too large for a description, little endian.
    pub arrays: Vec<Array>,
}

/// One array of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Array {
    /// Its name.
    pub name: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// A state that was taken and is on its way from the GPU; training may go on meanwhile.
pub struct PendingCheckpoint(Box<dyn FnOnce() -> Result<Checkpoint, Error> + Send>);

/// What stands between the front and the arrays, as JSON.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    method: String,
    seconds: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    depth_from: Option<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    flags: BTreeMap<String, String>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    is_finished: bool,
    state: serde_json::Value,
    arrays: Vec<Length>,
}

#[derive(Serialize, Deserialize)]
struct Length {
    name: String,
    bytes: u64,
}

impl PendingCheckpoint {
    /// A state that `finish` waits for.
    pub fn new(finish: impl FnOnce() -> Result<Checkpoint, Error> + Send + 'static) -> Self {
        Self(Box::new(finish))
    }

    /// Waits for the state.
    pub fn finish(self) -> Result<Checkpoint, Error> {
        (self.0)()
    }
}

impl Debug for PendingCheckpoint {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("PendingCheckpoint")
    }
}

impl Checkpoint {
    /// What a method tells of itself; how long it had been trained for, and on what, is for its caller to say.
    pub(crate) fn new(method: &str, state: serde_json::Value, arrays: Vec<Array>) -> Self {
        Self {
            method: method.to_owned(),
            seconds: 0.0,
            depth_from: None,
            flags: BTreeMap::new(),
            is_finished: false,
            state,
            arrays,
        }
    }

    /// Writes the file beside its place, waits until the disk has it, and moves it there: whatever happens, either the
    /// previous file or this one is under the name, whole.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        whole_file::write(path, |file| self.write_to(file))
    }

    /// Reads a whole file and checks every byte of it.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes).map_err(|reason| Error::Checkpoint { path: path.to_owned(), reason })
    }

    /// Takes out the array of this name, which has to have so many bytes.
    pub(crate) fn array(&self, name: &str, n_bytes: u64) -> Result<&[u8], Error> {
        let array = self.arrays.iter().find(|array| array.name == name);
        let bytes = array
            .map(|array| array.bytes.as_slice())
            .ok_or_else(|| Error::CheckpointState { reason: format!("array {name:?} is missing") })?;
        if bytes.len() as u64 != n_bytes {
            let reason = format!("array {name:?} has {} bytes, expected {n_bytes}", bytes.len());
            return Err(Error::CheckpointState { reason });
        }
        Ok(bytes)
    }

    fn write_to(&self, file: &mut impl Write) -> std::io::Result<()> {
        let lengths =
            self.arrays.iter().map(|array| Length { name: array.name.clone(), bytes: array.bytes.len() as u64 });
        let description = serde_json::to_vec(&Description {
            method: self.method.clone(),
            seconds: self.seconds,
            depth_from: self.depth_from.clone(),
            flags: self.flags.clone(),
            is_finished: self.is_finished,
            state: self.state.clone(),
            arrays: lengths.collect(),
        })?;
        let n_bytes = u32::try_from(description.len()).map_err(std::io::Error::other)?;
        let front = [&MAGIC[..], &VERSION.to_le_bytes(), &n_bytes.to_le_bytes()].concat();
        let mut sum = Sha256::new();
        let pieces = [&front, &description].into_iter().chain(self.arrays.iter().map(|array| &array.bytes));
        for piece in pieces {
            sum.update(piece);
            file.write_all(piece)?;
        }
        file.write_all(&sum.finalize())
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let front = bytes.get(..FRONT_BYTES).ok_or("cut off")?;
        if front[..8] != MAGIC {
            return Err("it does not begin as a checkpoint".to_owned());
        }
        let word = |at: usize| u32::from_le_bytes([front[at], front[at + 1], front[at + 2], front[at + 3]]);
        if word(8) != VERSION {
            return Err(format!("version {} of the format, this program reads {VERSION}", word(8)));
        }
        let whole = bytes.len().checked_sub(SUM_BYTES).filter(|n| *n >= FRONT_BYTES).ok_or("cut off")?;
        let (body, sum) = bytes.split_at(whole);
        let sum_is_right = Sha256::digest(body)[..] == *sum;
        let rest = &body[FRONT_BYTES..];
        let description = rest.get(..word(12) as usize).ok_or("cut off")?;
        let mut rest = &rest[description.len()..];
        let description: Description = match serde_json::from_slice(description) {
            Ok(description) => description,
            Err(error) if sum_is_right => return Err(format!("its description is not understood: {error}")),
            Err(_) => return Err("damaged: its checksum does not match".to_owned()),
        };
        let expected = description.arrays.iter().try_fold(0_u64, |sum, array| sum.checked_add(array.bytes));
        match expected.unwrap_or(u64::MAX) {
            expected if expected > rest.len() as u64 => return Err("cut off".to_owned()),
            expected if expected < rest.len() as u64 => return Err("bytes follow its end".to_owned()),
            _ if !sum_is_right => return Err("damaged: its checksum does not match".to_owned()),
            _ => {}
        }
        let mut arrays = Vec::new();
        for Length { name, bytes } in description.arrays {
            let n_bytes = usize::try_from(bytes).expect("not longer than the file, which is in memory");
            let (array, after) = rest.split_at(n_bytes);
            arrays.push(Array { name, bytes: array.to_vec() });
            rest = after;
        }
        let Description { method, seconds, depth_from, flags, is_finished, state, .. } = description;
        Ok(Self { method, seconds, depth_from, flags, is_finished, state, arrays })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checkpoint() -> Checkpoint {
        let arrays = [("means", vec![1, 2, 3]), ("nothing", vec![]), ("more", vec![9; 100])];
        Checkpoint {
            method: "splat".into(),
            seconds: 0.1 + 0.2,
            depth_from: Some("5ad1".into()),
            flags: BTreeMap::from([("scale".into(), "0.5".into())]),
            is_finished: true,
            state: serde_json::json!({ "step": u64::MAX, "size_m": 1.0 / 3.0 }),
            arrays: arrays.map(|(name, bytes)| Array { name: name.into(), bytes }).into(),
        }
    }

    fn bytes_of(checkpoint: &Checkpoint) -> Vec<u8> {
        let mut bytes = Vec::new();
        checkpoint.write_to(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_file_gives_back_what_was_written_and_replaces_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("training.ckpt");
        std::fs::write(folder.path().join("training.ckpt.part"), b"of a run that was killed").unwrap();
        for seconds in [0.0, 1.5] {
            let written = Checkpoint { seconds, ..checkpoint() };
            written.write(&path).unwrap();
            assert_eq!(Checkpoint::read(&path).unwrap(), written);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no partial file stays");
        assert!(matches!(checkpoint().write(&folder.path().join("none/x")), Err(Error::Write { .. })));
    }

    #[test]
    fn the_layout_is_the_documented_one() {
        let empty = Checkpoint::new("m", 7.into(), Vec::new());
        let bytes = bytes_of(&empty);
        let json = r#"{"method":"m","seconds":0.0,"state":7,"arrays":[]}"#;
        assert_eq!(bytes[..16], *b"FRIGCKPT\x02\0\0\0\x32\0\0\0");
        assert_eq!(bytes[16..66], *json.as_bytes());
        assert_eq!(bytes[66..], Sha256::digest(&bytes[..66])[..]);
    }

    #[test]
    fn broken_files_are_refused_with_the_reason() {
        let whole = bytes_of(&checkpoint());
        let complaint = |bytes: &[u8]| Checkpoint::from_bytes(bytes).unwrap_err();
        for length in 0..whole.len() {
            assert_eq!(complaint(&whole[..length]), "cut off", "{length} of {} bytes", whole.len());
        }
        assert_eq!(complaint(b"ply\nformat binary"), "it does not begin as a checkpoint");
        assert_eq!(complaint(&[&whole[..], &[0; 5]].concat()), "bytes follow its end");
        let changed = |at: usize, to: u8| {
            let mut bytes = whole.clone();
            bytes[at] = to;
            complaint(&bytes)
        };
        assert_eq!(changed(8, 1), "version 1 of the format, this program reads 2");
        assert_eq!(changed(15, 255), "cut off");
        for at in [20, whole.len() - 40, whole.len() - 1] {
            assert_eq!(changed(at, 0xff), "damaged: its checksum does not match", "byte {at}");
        }
        let mut other = whole[..16].to_vec();
        other[12..16].copy_from_slice(&2_u32.to_le_bytes());
        other.extend(b"{}");
        let sum = Sha256::digest(&other);
        other.extend(sum);
        assert!(complaint(&other).contains("missing field"));
    }

    #[test]
    fn arrays_have_the_lengths_that_are_asked_for() {
        let checkpoint = checkpoint();
        assert_eq!(checkpoint.array("means", 3).unwrap(), [1, 2, 3]);
        let complaint = |name, n| checkpoint.array(name, n).unwrap_err().to_string();
        assert!(complaint("means", 4).contains("\"means\" has 3 bytes, expected 4"));
        assert!(complaint("rotations", 4).contains("\"rotations\" is missing"));
    }
}
