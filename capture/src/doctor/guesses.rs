//! Reports the values of a rig file that are guesses, as the comments of `fieldrig init` say.

use super::Finding;
use crate::init::GUESS;

const CHECK: &str = "guess";

/// The guessed values of a rig file, as warnings: a run with them works, but its poses may be wrong.
///
/// * `text`: the text of the rig file. A comment above a key that begins with `Guess:` marks its
///   value, also above the header of the table that is the value. Keys that were measured since have
///   no such comment, because commands that write rig files drop it.
#[must_use]
pub fn guesses(text: &str) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut table = String::new();
    // The lines of the comment above the next key, from its beginning as a guess.
    let mut about: Vec<&str> = Vec::new();
    for line in text.lines().map(str::trim) {
        if let Some(comment) = line.strip_prefix('#') {
            let comment = comment.trim();
            if comment.starts_with(GUESS) || !about.is_empty() {
                about.push(comment);
            }
            continue;
        }
        let about = std::mem::take(&mut about).join(" ");
        // A comment may follow the header of a table.
        let header = line.strip_prefix('[').and_then(|rest| rest.split_once(']'));
        if let Some((name, _)) = header {
            name.clone_into(&mut table);
            findings.extend(about.strip_prefix(GUESS).map(|about| finding(name, about)));
        } else if let (Some((key, _)), Some(about)) =
            (line.split_once('='), about.strip_prefix(GUESS))
        {
            findings.push(finding(&format!("{table}.{}", key.trim()), about));
        }
    }
    findings
}

/// The finding about a key. The first sentence of its comment describes the value, and the others say
/// how to measure it.
fn finding(key: &str, about: &str) -> Finding {
    let (value, remedy) = about.split_once(". ").unwrap_or((about, ""));
    let value = value.trim_end_matches('.');
    let remedy = match remedy.trim_end_matches('.') {
        "" => "measure it".to_owned(),
        remedy => remedy.to_owned(),
    };
    Finding::warn(
        CHECK,
        format!("{key} is a guess: {value}"),
        format!(
            "{remedy}; then delete the comment that begins with {:?}",
            GUESS.trim_end()
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marked_values_are_guesses_and_others_are_not() {
        let text = "\
[arm]
# The arm is simulated.
driver = \"sim\"
[camera.wrist] # on the arm
# Images per second.
rate_hz = 30
# exposure_micros = 8000
# Guess: a lens with a field of view
# of 65.5 degrees. `fieldrig calibrate intrinsics` measures it.
intrinsics = { focal_px = [1, 1] }
size_px = [640, 480]
# Guess: counts per turn.
counts = 3

# Guess: at the origin. A drawing has it.
[camera.wrist.parent_from_camera]
xyz_m = [0, 0, 0]

# Guess: a comment without a key.

[train]
seed = 1
";
        let found: Vec<String> = guesses(text).iter().map(ToString::to_string).collect();
        assert_eq!(
            found,
            [
                "camera.wrist.intrinsics is a guess: a lens with a field of view of 65.5 degrees; `fieldrig calibrate \
                 intrinsics` measures it; then delete the comment that begins with \"Guess:\"",
                "camera.wrist.counts is a guess: counts per turn; measure it; then delete the comment that begins with \
                 \"Guess:\"",
                "camera.wrist.parent_from_camera is a guess: at the origin; A drawing has it; then delete the comment that \
                 begins with \"Guess:\"",
            ]
        );
        assert_eq!(guesses(""), []);
    }
}
