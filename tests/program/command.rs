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

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
