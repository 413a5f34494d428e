//! Words of commands in messages.

/// The calibration target that `fieldrig calibrate target` draws by default, for commands in
/// messages. It fits on A4 and letter paper, and can be identified if parts of it are hidden.
pub const EXAMPLE_TARGET: &str = "charuco:5x7:34mm:26mm:5X5_100";

/// A word, quoted for a shell.
#[must_use]
pub fn quoted_for_shell(word: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "_-./:=@%+,".contains(letter);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::quoted_for_shell;

    #[test]
    fn quoted_words_round_trip_through_the_shell() {
        for word in [
            "plain/path-1.spz",
            "two words",
            "it's",
            "$HOME `x` \"y\" \\ *",
            "",
            "naïve",
            "a\nb",
        ] {
            let output = std::process::Command::new("sh")
                .args(["-c", &format!("printf %s {}", quoted_for_shell(word))])
                .output();
            assert_eq!(
                String::from_utf8_lossy(&output.expect("sh starts").stdout),
                word
            );
        }
        assert_eq!(
            quoted_for_shell("runs/20261123-170000"),
            "runs/20261123-170000"
        );
    }
}
