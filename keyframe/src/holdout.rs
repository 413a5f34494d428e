//! Selects the photos of a dataset that are used for testing and validation.

use crate::{Error, Split};
use std::collections::HashMap;
use std::ffi::OsStr;
use std::path::Path;

/// How test photos are chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Holdout {
    /// Every n-th photo, starting with the first photo. The number n is at least 1.
    Every(usize),
    /// The photos with these names.
    Named(Vec<String>),
}

impl Default for Holdout {
    fn default() -> Self {
        Self::Every(8)
    }
}

impl Holdout {
    /// Reads the names of test photos from a file with one name per line.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read or contains no name.
    pub fn from_list(path: &Path) -> Result<Self, Error> {
        let text = files::read_text(path).map_err(|error| Error::Read {
            path: path.to_owned(),
            reason: error.to_string(),
        })?;
        let names: Vec<_> = text
            .lines()
            .map(str::trim)
            .filter(|name| !name.is_empty())
            .map(str::to_owned)
            .collect();
        if names.is_empty() {
            return Err(Error::Holdout {
                request: path.display().to_string(),
                reason: "the file lists no photo".into(),
            });
        }
        Ok(Self::Named(names))
    }

    /// The split of each photo, in the order of `names`.
    ///
    /// Validation photos lie halfway between test photos. If the test photos are named, every 8th
    /// of the other photos, starting with the 5th, is for validation. A name matches with or
    /// without its folder and its extension.
    ///
    /// # Errors
    ///
    /// Fails if a name matches no photo.
    pub fn splits(&self, names: &[&str]) -> Result<Vec<Split>, Error> {
        match self {
            Self::Every(every) => Ok((0..names.len()).map(|ix| every_nth(ix, *every)).collect()),
            Self::Named(test_names) => splits_by_name(test_names, names),
        }
    }
}

fn every_nth(ix: usize, every: usize) -> Split {
    match ix % every {
        0 => Split::Test,
        // With two or fewer photos between two test photos, validation would take at least half of
        // these photos from training.
        offset if every >= 4 && offset == every / 2 => Split::Validation,
        _ => Split::Train,
    }
}

fn splits_by_name(test_names: &[String], names: &[&str]) -> Result<Vec<Split>, Error> {
    // Whether each name has matched a photo.
    let mut requested: HashMap<&str, bool> = test_names
        .iter()
        .map(|name| (name.as_str(), false))
        .collect();
    let mut n_remaining = 0;
    let mut splits = Vec::with_capacity(names.len());
    for name in names {
        let mut is_test = false;
        for form in forms(name) {
            if let Some(is_matched) = requested.get_mut(form) {
                *is_matched = true;
                is_test = true;
            }
        }
        n_remaining += usize::from(!is_test);
        // The position of a validation photo is counted among the photos that are not for testing.
        // Validation photos are therefore spread evenly, wherever the test photos are.
        splits.push(if is_test {
            Split::Test
        } else if n_remaining % 8 == 5 {
            Split::Validation
        } else {
            Split::Train
        });
    }
    // A name without a photo is probably a typing error. If it were ignored, scores on the other
    // listed photos would look like scores on the whole list.
    match test_names.iter().find(|name| !requested[name.as_str()]) {
        Some(name) => Err(Error::Holdout {
            request: format!("{name:?}"),
            reason: "no photo has this name".into(),
        }),
        None => Ok(splits),
    }
}

/// The names by which a photo may be requested: its path in the folder, its file name, and its file
/// name without extension.
fn forms(name: &str) -> impl Iterator<Item = &str> {
    let path = Path::new(name);
    let parts = [path.file_name(), path.file_stem()];
    std::iter::once(name).chain(parts.into_iter().flatten().filter_map(OsStr::to_str))
}

#[cfg(test)]
mod tests {
    use super::*;
    use Split::{Test, Train, Validation};

    #[test]
    fn default_holdout_matches_keyframe_splits() {
        let names = vec!["photo"; 20];
        let expected: Vec<_> = (0..20).map(Split::of).collect();
        assert_eq!(Holdout::default().splits(&names).unwrap(), expected);
        assert_eq!(
            Holdout::Every(2).splits(&names[..4]).unwrap(),
            [Test, Train, Test, Train]
        );
        assert_eq!(
            Holdout::Every(4).splits(&names[..5]).unwrap(),
            [Test, Train, Validation, Train, Test]
        );
    }

    #[test]
    fn photos_match_with_or_without_folder_and_extension() {
        let names = [
            "images/a.jpg",
            "images/b.jpg",
            "images/c.jpg",
            "images/d.jpg",
        ];
        let splits_by_name = |test: &[&str]| {
            Holdout::Named(test.iter().map(|name| (*name).to_owned()).collect()).splits(&names)
        };
        assert_eq!(
            splits_by_name(&["images/a.jpg", "b.jpg", "c"]).unwrap(),
            [Test, Test, Test, Train]
        );
        assert!(
            splits_by_name(&["e"])
                .unwrap_err()
                .to_string()
                .contains("\"e\": no photo has this name")
        );
        assert_eq!(
            splits_by_name(&["a", "b", "c", "d"]).unwrap(),
            [Test; 4],
            "all photos may be scored"
        );
    }

    #[test]
    fn list_has_one_name_per_line() {
        assert!(Holdout::from_list(Path::new("no/such/file")).is_err());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("test.txt");
        std::fs::write(&file, "a.jpg\n\n b.jpg \n").unwrap();
        let names = vec!["a.jpg".to_owned(), "b.jpg".to_owned()];
        assert_eq!(Holdout::from_list(&file).unwrap(), Holdout::Named(names));
        std::fs::write(&file, "\n").unwrap();
        let empty = Holdout::from_list(&file).unwrap_err().to_string();
        assert!(empty.ends_with("the file lists no photo"), "{empty}");
    }
}
