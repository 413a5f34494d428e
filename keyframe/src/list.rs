//! Lists of keyframes, one per line: camera, stamp in nanoseconds, split.

use crate::{Error, Keyframe, Split};
use kinematics::Stamp;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

const SPLITS: [(Split, &str); 3] = [
    (Split::Train, "train"),
    (Split::Validation, "validation"),
    (Split::Test, "test"),
];

/// The selected keyframes and their splits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct KeyframeList(BTreeMap<(String, i64), SplitIx>);

/// Index of a split in [`SPLITS`].
type SplitIx = usize;

impl KeyframeList {
    /// Reads a `keyframes.txt`.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read, lists no keyframe, or has an invalid line.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let read = files::read_text(path);
        let text = read.map_err(|error| Error::Read {
            path: path.to_owned(),
            reason: error.to_string(),
        })?;
        Self::parse(&text).map_err(|reason| Error::List {
            path: path.to_owned(),
            reason,
        })
    }

    /// Number of listed keyframes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether no keyframe is listed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Checks the list against the cameras and stamps of the data. Returns a message if some listed
    /// keyframes are missing.
    ///
    /// `example_image`: an image of the data, listed or not, for the error message.
    ///
    /// # Errors
    ///
    /// Fails if no listed keyframe is in the data.
    pub fn check_found<'a>(
        &self,
        found: impl Iterator<Item = (&'a str, Stamp)>,
        example_image: Option<(&str, Stamp)>,
    ) -> Result<Option<String>, Error> {
        let found: BTreeSet<(&str, i64)> = found.map(|(camera, stamp)| (camera, stamp.0)).collect();
        let mut missing = self
            .0
            .keys()
            .filter(|(camera, stamp)| !found.contains(&(camera.as_str(), *stamp)));
        let Some((camera, stamp)) = missing.next() else {
            return Ok(None);
        };
        let n_missing = 1 + missing.count();
        // Some keyframes may be missing because a recording was cut or images were deleted. If no
        // listed keyframe is found, the list belongs to other data.
        if n_missing < self.len() {
            return Ok(Some(format!(
                "{n_missing} of {} listed keyframes are not in the data; the first is {camera} {stamp}",
                self.len()
            )));
        }
        let found = example_image.map_or("no image".to_owned(), |(camera, stamp)| {
            format!("{camera} {}", stamp.0)
        });
        Err(Error::NoListedKeyframe {
            listed: format!("{camera} {stamp}"),
            found,
        })
    }

    /// The split of a listed keyframe.
    #[must_use]
    pub fn split_of(&self, camera: &str, stamp: Stamp) -> Option<Split> {
        self.0
            .get(&(camera.to_owned(), stamp.0))
            .map(|split| SPLITS[*split].0)
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut list = BTreeMap::new();
        for (line_ix, line) in text
            .lines()
            .enumerate()
            .filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'))
        {
            let Some((key, split)) = parse_line(line) else {
                return Err(format!(
                    "line {}: expected a camera, a stamp in nanoseconds and train, validation or test; found {line:?}",
                    line_ix + 1
                ));
            };
            // A second line for the same keyframe is an error, because it may name another split.
            // One of the two lines would then be ignored.
            if list.insert(key, split).is_some() {
                return Err(format!("line {}: {line:?} is listed twice", line_ix + 1));
            }
        }
        if list.is_empty() {
            return Err("it lists no keyframe".to_owned());
        }
        Ok(Self(list))
    }
}

/// The camera and stamp of a line, and its split.
fn parse_line(line: &str) -> Option<((String, i64), SplitIx)> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [camera, stamp, split] = words[..] else {
        return None;
    };
    let stamp = stamp.parse().ok()?;
    let split = SPLITS.iter().position(|(_, name)| *name == split)?;
    Some(((camera.to_owned(), stamp), split))
}

impl FromIterator<(String, Stamp, Split)> for KeyframeList {
    fn from_iter<T: IntoIterator<Item = (String, Stamp, Split)>>(keyframes: T) -> Self {
        Self(
            keyframes
                .into_iter()
                .map(|(camera, stamp, split)| ((camera, stamp.0), index_of(split)))
                .collect(),
        )
    }
}

/// The index of a split in [`SPLITS`], which lists all of them.
fn index_of(split: Split) -> SplitIx {
    SPLITS
        .iter()
        .position(|(known, _)| *known == split)
        .unwrap_or_default()
}

/// The name of a split in files.
#[must_use]
pub fn split_name(split: Split) -> &'static str {
    SPLITS
        .iter()
        .find(|(known, _)| *known == split)
        .map_or("train", |(_, name)| name)
}

/// The split with this name in files.
#[must_use]
pub fn split_from_name(name: &str) -> Option<Split> {
    SPLITS
        .iter()
        .find(|(_, known)| *known == name)
        .map(|(split, _)| *split)
}

/// The text of a `keyframes.txt`.
#[must_use]
pub fn list_text<'a>(keyframes: impl Iterator<Item = &'a Arc<Keyframe>>) -> String {
    let mut text = String::from("# camera stamp_nanos split\n");
    for keyframe in keyframes {
        let split = split_name(keyframe.split);
        writeln!(text, "{} {} {split}", keyframe.camera, keyframe.stamp.0)
            .expect("writing to a String cannot fail");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_listed_keyframes_are_reported() {
        let list = KeyframeList::parse("wrist 17 test\nwrist 18 train\n").expect("a list");
        let check = |found: &[(&'static str, i64)]| {
            let found = found.iter().map(|(camera, nanos)| (*camera, Stamp(*nanos)));
            list.check_found(found, Some(("front", Stamp(5))))
        };
        assert_eq!(check(&[("wrist", 17), ("wrist", 18)]).expect("all"), None);
        let partial = check(&[("wrist", 18)]).expect("one").expect("a loss");
        assert!(
            partial.starts_with("1 of 2 listed") && partial.ends_with("wrist 17"),
            "{partial}"
        );
        let disjoint = check(&[("wrist", 16)]).expect_err("nothing").to_string();
        assert!(
            disjoint.contains("wrist 17") && disjoint.contains("the data has front 5"),
            "{disjoint}"
        );
    }

    #[test]
    fn list_is_parsed_and_errors_give_the_line() {
        let list = KeyframeList::parse(
            "# camera stamp split\nwrist 17 test\n\nwrist -3 train\nside 17 validation\n",
        )
        .expect("a list");
        assert_eq!(list.len(), 3);
        assert_eq!(list.split_of("wrist", Stamp(17)), Some(Split::Test));
        assert_eq!(list.split_of("wrist", Stamp(-3)), Some(Split::Train));
        assert_eq!(list.split_of("side", Stamp(17)), Some(Split::Validation));
        assert_eq!(list.split_of("side", Stamp(18)), None);
        for (text, expected) in [
            ("wrist 17\n", "line 1"),
            ("wrist 1 train\nwrist x train\n", "line 2"),
            ("wrist 1 taste\n", "line 1"),
            ("wrist 1 train\nwrist 1 test\n", "twice"),
            ("# nothing\n", "no keyframe"),
        ] {
            let message = KeyframeList::parse(text).expect_err(text);
            assert!(message.contains(expected), "{message}");
        }
    }
}
