//! Runs `fieldrig` and reads what it prints.

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

pub(crate) fn fieldrig(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(args)
        .current_dir(folder)
        .output()
        .expect("fieldrig starts")
}

pub(crate) fn json_of(output: &Output) -> Value {
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}{}", stderr(output)))
}

/// Asserts the exit code and one error message on stderr that contains all `words`.
pub(crate) fn assert_one_error(args: &[&str], output: &Output, code: i32, words: &[&str]) {
    let printed = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {printed}");
    assert!(!printed.contains("panicked"), "{args:?}: {printed}");
    for word in words {
        assert!(
            printed.contains(word),
            "{args:?} does not mention {word:?}: {printed}"
        );
    }
    let errors = printed.lines().filter(|line| line.starts_with("error: "));
    assert_eq!(errors.count(), 1, "{args:?}: {printed}");
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
