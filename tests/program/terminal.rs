//! Tests what a live run prints for operators, and its report: no silence at the start, short
//! lines, a verdict at the end, and a report in words.

use crate::small_rig;
use std::process::Command;

/// Terminals of operators have at least this many columns.
const N_COLUMNS: usize = 110;

#[test]
fn live_run_is_described_from_its_start_to_its_verdict() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::Lockstep);
    let args = [
        "run",
        "rig.toml",
        "--sim",
        "--steps",
        "60",
        "--max-splats",
        "2000",
        "--out",
        "out",
        "--listen",
        "127.0.0.1:0",
    ];
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(args)
        .env_remove("RUST_LOG")
        .current_dir(folder)
        .output()
        .expect("fieldrig starts");
    let log = String::from_utf8_lossy(&output.stderr);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{log}");

    // Everything that is opened is named before it is opened.
    let places = [
        "reading rig.toml",
        "rig rig: 1 camera (wrist) and an arm, simulated",
        "opening the GPU",
        "compiling kernels for ",
        "opening the devices",
    ]
    .map(|words| {
        log.find(words)
            .unwrap_or_else(|| panic!("{words:?} is missing in {log}"))
    });
    assert!(places.is_sorted(), "{log}");
    assert!(log.matches("growth ").count() <= 2, "{log}");

    // Scores during training fit into one line, and the last line says how good the model is.
    for line in printed.lines().filter(|line| line.contains(" ms/step  ")) {
        assert!(line.chars().count() <= N_COLUMNS, "{line}");
        assert!(
            !line.contains("ceiling") && !line.contains("limit"),
            "{line}"
        );
    }
    let last = printed.lines().last().expect("a line");
    let grade = last.split(':').next().expect("a word");
    assert!(["Good", "Fair", "Poor"].contains(&grade), "{last}");
    assert!(
        last.contains(" dB on ") && last.contains(". Next: ") && last.ends_with(" view out"),
        "{last}"
    );

    let page = std::fs::read_to_string(folder.join("out/report.html")).expect("a report");
    let title = page
        .split("<title>")
        .nth(1)
        .and_then(|rest| rest.split("</title>").next())
        .expect("a title");
    assert!(
        title.starts_with("rig, 20") && title.ends_with(" UTC: splat"),
        "{title}"
    );
    for words in [
        grade,
        "alt=\"The model seen obliquely from above\" src=\"data:image/jpeg",
        "<svg class=\"coverage\"",
        "<polygon ",
        "wrist at 0:",
        "and the depth of the render",
        "<td>keyframes at the end</td>",
        " mm</td>",
    ] {
        assert!(page.contains(words), "{words} is missing in the page");
    }
    for raw in [
        "wrist/",
        "max position error",
        "device skipped",
        "range scans",
    ] {
        assert!(!page.contains(raw), "{raw} is in the page");
    }
}
