//! Training state on disk, in a self-describing file that is either complete or absent.
//!
//! `docs/reference/files.md` describes the layout.

use crate::edits::Edits;
use crate::{Error, RunHistory};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

const MAGIC: [u8; 8] = *b"FRIGCKPT";
/// Version of the layout and of the states of all methods. There is only one number, because only
/// the program that wrote a checkpoint can continue it.
const VERSION: u32 = 6;
/// Length of magic, version and header length together.
const PREAMBLE_BYTES: usize = 16;
/// Length of a SHA-256.
const CHECKSUM_BYTES: usize = 32;

/// Everything needed to continue training a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Name of the method.
    pub method: String,
    /// Training time so far, seconds.
    pub seconds: f64,
    /// SHA-256 of the model that rendered depth for keyframes without depth, if one was used.
    pub depth_from: Option<String>,
    /// Flags of the run by name, needed to continue it. They include the training limit.
    pub flags: BTreeMap<String, String>,
    /// Whether training had reached its limit.
    pub is_finished: bool,
    /// Erased space.
    pub edits: Edits,
    /// Scores and rejected images so far, for the page.
    pub history: RunHistory,
    /// The method's state without its arrays.
    pub state: serde_json::Value,
    /// Large arrays, little endian.
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

/// The JSON header between preamble and arrays.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    method: String,
    seconds: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    depth_from: Option<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    flags: BTreeMap<String, String>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    is_finished: bool,
    #[serde(default, skip_serializing_if = "Edits::is_empty")]
    edits: Edits,
    #[serde(default, skip_serializing_if = "RunHistory::is_empty")]
    history: RunHistory,
    state: serde_json::Value,
    arrays: Vec<ArrayHeader>,
}

#[derive(Serialize, Deserialize)]
struct ArrayHeader {
    name: String,
    bytes: u64,
}

impl Checkpoint {
    /// A checkpoint of a method's state. The caller fills in the remaining fields.
    pub fn new(method: &str, state: serde_json::Value, arrays: Vec<Array>) -> Self {
        Self {
            method: method.to_owned(),
            seconds: 0.0,
            depth_from: None,
            flags: BTreeMap::new(),
            is_finished: false,
            edits: Edits::default(),
            history: RunHistory::default(),
            state,
            arrays,
        }
    }

    /// Writes the file under a temporary name, syncs it and renames it. The final name therefore
    /// always refers to a complete file, which is the previous file or the new file.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        files::replace(path, |file| self.write_to(file)).map_err(|source| Error::Write {
            path: path.to_owned(),
            source,
        })
    }

    /// Reads a file and verifies its checksum.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let bytes = files::read(path, files::Budget::PLAIN).map_err(|source| Error::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::from_bytes(&bytes).map_err(|reason| Error::Checkpoint {
            path: path.to_owned(),
            reason,
        })
    }

    /// Returns the array with this name, which must have `n_bytes` bytes.
    pub fn array(&self, name: &str, n_bytes: u64) -> Result<&[u8], Error> {
        let array = self.arrays.iter().find(|array| array.name == name);
        let bytes =
            array
                .map(|array| array.bytes.as_slice())
                .ok_or_else(|| Error::CheckpointState {
                    reason: format!("array {name:?} is missing"),
                })?;
        if bytes.len() as u64 != n_bytes {
            let reason = format!(
                "array {name:?} has {} bytes, expected {n_bytes}",
                bytes.len()
            );
            return Err(Error::CheckpointState { reason });
        }
        Ok(bytes)
    }

    fn write_to(&self, file: &mut impl Write) -> std::io::Result<()> {
        let lengths = self.arrays.iter().map(|array| ArrayHeader {
            name: array.name.clone(),
            bytes: array.bytes.len() as u64,
        });
        let header = serde_json::to_vec(&Header {
            method: self.method.clone(),
            seconds: self.seconds,
            depth_from: self.depth_from.clone(),
            flags: self.flags.clone(),
            is_finished: self.is_finished,
            edits: self.edits.clone(),
            history: self.history.clone(),
            state: self.state.clone(),
            arrays: lengths.collect(),
        })?;
        // The preamble is binary and has a fixed length, so that a reader of any version can find
        // out what the file is, and how much JSON follows.
        let n_bytes = u32::try_from(header.len()).map_err(std::io::Error::other)?;
        let preamble = [&MAGIC[..], &VERSION.to_le_bytes(), &n_bytes.to_le_bytes()].concat();
        // The checksum is computed while writing, because arrays take gigabytes and must not be
        // copied into one buffer.
        let mut checksum = Sha256::new();
        let chunks = [&preamble, &header]
            .into_iter()
            .chain(self.arrays.iter().map(|array| &array.bytes));
        for chunk in chunks {
            checksum.update(chunk);
            file.write_all(chunk)?;
        }
        file.write_all(&checksum.finalize())
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let n_header_bytes = n_header_bytes(bytes)?;

        // The checksum is computed first but reported last. A truncated file also fails the
        // checksum, but `truncated` is the more useful reason.
        let whole = bytes
            .len()
            .checked_sub(CHECKSUM_BYTES)
            .filter(|n| *n >= PREAMBLE_BYTES)
            .ok_or("truncated")?;
        let (body, checksum) = bytes.split_at(whole);
        let checksum_matches = Sha256::digest(body)[..] == *checksum;
        let rest = &body[PREAMBLE_BYTES..];
        let header = rest.get(..n_header_bytes).ok_or("truncated")?;
        let rest = &rest[header.len()..];
        // Invalid JSON in an intact file is an error of the program that wrote it. In a damaged
        // file, the message of the JSON parser would mislead.
        let header: Header = match serde_json::from_slice(header) {
            Ok(header) => header,
            Err(error) if checksum_matches => return Err(format!("invalid header: {error}")),
            Err(_) => return Err("damaged: the checksum does not match".to_owned()),
        };

        // Lengths come from the file, so their sum may overflow. Such a file is also too short.
        let expected = header
            .arrays
            .iter()
            .try_fold(0_u64, |total, array| total.checked_add(array.bytes));
        match expected.unwrap_or(u64::MAX) {
            expected if expected > rest.len() as u64 => return Err("truncated".to_owned()),
            expected if expected < rest.len() as u64 => {
                return Err("unexpected bytes after the end".to_owned());
            }
            _ if !checksum_matches => return Err("damaged: the checksum does not match".to_owned()),
            _ => {}
        }
        let arrays = arrays_in(header.arrays, rest);
        let Header {
            method,
            seconds,
            depth_from,
            flags,
            is_finished,
            edits,
            history,
            state,
            ..
        } = header;
        Ok(Self {
            method,
            seconds,
            depth_from,
            flags,
            is_finished,
            edits,
            history,
            state,
            arrays,
        })
    }
}

/// Checks magic and version of a file. Returns the length of its JSON header.
fn n_header_bytes(bytes: &[u8]) -> Result<usize, String> {
    let preamble = bytes.get(..PREAMBLE_BYTES).ok_or("truncated")?;
    if preamble[..8] != MAGIC {
        return Err("not a checkpoint file".to_owned());
    }
    let version = word_at(preamble, 8);
    if version != VERSION {
        return Err(format!(
            "format version {version}, this program reads version {VERSION}"
        ));
    }
    Ok(word_at(preamble, 12) as usize)
}

/// The little-endian number that begins at byte `at` of a preamble.
fn word_at(preamble: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([
        preamble[at],
        preamble[at + 1],
        preamble[at + 2],
        preamble[at + 3],
    ])
}

/// Divides the bytes after the header into arrays. The lengths of the arrays must add up to the
/// length of `bytes`.
fn arrays_in(headers: Vec<ArrayHeader>, bytes: &[u8]) -> Vec<Array> {
    let mut rest = bytes;
    let mut arrays = Vec::new();
    for ArrayHeader { name, bytes } in headers {
        let n_bytes = usize::try_from(bytes).expect("not longer than the file, which is in memory");
        let (array, after) = rest.split_at(n_bytes);
        arrays.push(Array {
            name,
            bytes: array.to_vec(),
        });
        rest = after;
    }
    arrays
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Aabb;
    use crate::edits::Edit;

    fn edits() -> Edits {
        let mut edits = Edits::default();
        let world_from_box = kinematics::Transform::translation(0.1, -2.0, 0.3);
        edits
            .push(Edit::Box(Aabb {
                world_from_box,
                min_m: [-0.1; 3],
                max_m: [0.7; 3],
            }))
            .unwrap();
        edits
    }

    fn checkpoint() -> Checkpoint {
        let arrays = [
            ("means", vec![1, 2, 3]),
            ("nothing", vec![]),
            ("more", vec![9; 100]),
        ];
        Checkpoint {
            method: "splat".into(),
            seconds: 0.1 + 0.2,
            depth_from: Some("5ad1".into()),
            flags: BTreeMap::from([("scale".into(), "0.5".into())]),
            is_finished: true,
            edits: edits(),
            // A perfect picture has an infinite PSNR, which JSON cannot express.
            history: RunHistory::new(
                &[(0.5, 20.25), (1.0, f64::INFINITY), (2.0, 1.0 / 3.0)],
                BTreeMap::from([("blurred".into(), 3)]),
            ),
            state: serde_json::json!({ "step": u64::MAX, "size_m": 1.0 / 3.0 }),
            arrays: arrays
                .map(|(name, bytes)| Array {
                    name: name.into(),
                    bytes,
                })
                .into(),
        }
    }

    fn bytes_of(checkpoint: &Checkpoint) -> Vec<u8> {
        let mut bytes = Vec::new();
        checkpoint.write_to(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn written_file_round_trips_and_replaces_the_previous() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("training.ckpt");
        std::fs::write(files::partial::path_of(&path), b"of a run that was killed").unwrap();
        for seconds in [0.0, 1.5] {
            let written = Checkpoint {
                seconds,
                ..checkpoint()
            };
            written.write(&path).unwrap();
            assert_eq!(Checkpoint::read(&path).unwrap(), written);
        }
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            1,
            "no partial file remains"
        );
        assert!(matches!(
            checkpoint().write(&folder.path().join("none/x")),
            Err(Error::Write { .. })
        ));
    }

    #[test]
    fn layout_matches_the_documentation() {
        let empty = Checkpoint::new("m", 7.into(), Vec::new());
        let bytes = bytes_of(&empty);
        let json = r#"{"method":"m","seconds":0.0,"state":7,"arrays":[]}"#;
        assert_eq!(bytes[..16], *b"FRIGCKPT\x06\0\0\0\x32\0\0\0");
        assert_eq!(bytes[16..66], *json.as_bytes());
        assert_eq!(bytes[66..], Sha256::digest(&bytes[..66])[..]);
    }

    #[test]
    fn broken_files_are_rejected_with_the_reason() {
        let whole = bytes_of(&checkpoint());
        let error_of = |bytes: &[u8]| Checkpoint::from_bytes(bytes).unwrap_err();
        for length in 0..whole.len() {
            assert_eq!(
                error_of(&whole[..length]),
                "truncated",
                "{length} of {} bytes",
                whole.len()
            );
        }
        assert_eq!(error_of(b"ply\nformat binary"), "not a checkpoint file");
        assert_eq!(
            error_of(&[&whole[..], &[0; 5]].concat()),
            "unexpected bytes after the end"
        );
        let error_with_byte = |at: usize, to: u8| {
            let mut bytes = whole.clone();
            bytes[at] = to;
            error_of(&bytes)
        };
        assert_eq!(
            error_with_byte(8, 1),
            "format version 1, this program reads version 6"
        );
        assert_eq!(error_with_byte(15, 255), "truncated");
        for at in [20, whole.len() - 40, whole.len() - 1] {
            assert_eq!(
                error_with_byte(at, 0xff),
                "damaged: the checksum does not match",
                "byte {at}"
            );
        }
        let mut other = whole[..16].to_vec();
        other[12..16].copy_from_slice(&2_u32.to_le_bytes());
        other.extend(b"{}");
        let checksum = Sha256::digest(&other);
        other.extend(checksum);
        assert!(error_of(&other).contains("missing field"));
    }

    #[test]
    fn array_checks_the_requested_length() {
        let checkpoint = checkpoint();
        assert_eq!(checkpoint.array("means", 3).unwrap(), [1, 2, 3]);
        let error_of = |name, n| checkpoint.array(name, n).unwrap_err().to_string();
        assert!(error_of("means", 4).contains("\"means\" has 3 bytes, expected 4"));
        assert!(error_of("rotations", 4).contains("\"rotations\" is missing"));
    }
}
