//! Reports of tests that cannot run on this machine.

use std::fmt::Display;
use std::fs::OpenOptions;
use std::io::Write;

/// File to which skipped tests are appended, one per line: name, tab, reason.
/// `scripts/run-tests.py` sets this variable.
const SKIPPED_TESTS_VARIABLE: &str = "FIELDRIG_SKIPPED_TESTS";
/// If set to `demand`, tests fail instead of being skipped if this machine could run them after an
/// installation.
const DEMAND_VARIABLE: &str = "FIELDRIG_HIL";

/// Whether tests must not be skipped because software is missing, as in continuous integration.
pub fn is_demanded() -> bool {
    std::env::var(DEMAND_VARIABLE).is_ok_and(|value| value == "demand")
}

/// Reports that the calling test is skipped. `reason` completes the sentence "skipped, because".
/// The test harness counts a test that returns as passed, so the caller must return at once.
pub fn skip(reason: impl Display) {
    let reason = reason.to_string().replace(['\t', '\n'], " ");
    // The test harness gives each thread the name of its test.
    let thread = std::thread::current();
    let test = thread.name().unwrap_or("unknown test");
    if let Some(path) = std::env::var_os(SKIPPED_TESTS_VARIABLE) {
        let mut file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(&path)
            .expect("the file can be created");
        file.write_all(format!("{test}\t{reason}\n").as_bytes())
            .expect("the file can be written");
    }
    // `eprintln` is not used, because the test harness hides its output if a test passes.
    let _ = std::io::stderr().write_all(format!("{test}: skipped, because {reason}\n").as_bytes());
}
