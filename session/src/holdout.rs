//! Parses the selection of test images.

use keyframe::{Error, Holdout};
use std::path::Path;

/// Parses a selection of test images: a number n for every n-th image, or the path of a file with
/// one name per line.
///
/// # Errors
///
/// If the text is neither a number of at least 1 nor the path of a readable file with at least one
/// name.
pub(crate) fn parse_holdout(text: &str) -> Result<Holdout, Error> {
    let invalid = |reason: String| Error::Holdout {
        request: text.to_owned(),
        reason,
    };
    // The number is parsed as signed, so that a negative number is reported as an invalid number
    // and not as a missing file.
    if let Ok(every) = text.parse::<i64>() {
        return usize::try_from(every)
            .ok()
            .filter(|every| *every >= 1)
            .map(Holdout::Every)
            .ok_or_else(|| invalid("must be at least 1, or a file that lists photos".to_owned()));
    }
    Holdout::from_list(Path::new(text)).map_err(|error| match error {
        Error::Read { reason, .. } => invalid(format!(
            "neither a whole number nor a readable file ({reason})"
        )),
        error => error,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use keyframe::Split;

    #[test]
    fn selection_is_a_number_or_a_file() {
        assert_eq!(parse_holdout("10").expect("a number"), Holdout::Every(10));
        assert_eq!(
            parse_holdout("1")
                .expect("a number")
                .splits(&["a", "b"])
                .expect("every photo"),
            [Split::Test, Split::Test]
        );
        let message = |text: &str| parse_holdout(text).expect_err("invalid").to_string();
        for invalid in ["0", "-3"] {
            assert!(message(invalid).contains("at least 1"), "{invalid}");
        }
        let missing = message("no/such/file");
        assert!(
            missing
                .starts_with("holdout no/such/file: neither a whole number nor a readable file ("),
            "{missing}"
        );
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("test.txt");
        std::fs::write(&file, "a.jpg\n\n b.jpg \n").expect("written");
        let names = vec!["a.jpg".to_owned(), "b.jpg".to_owned()];
        assert_eq!(
            parse_holdout(file.to_str().expect("UTF-8")).expect("a list"),
            Holdout::Named(names)
        );
    }
}
