//! Adds the paths of the MuJoCo and RealSense libraries to binaries and tests with the features
//! `sim` and `realsense`. Also determines what `fieldrig --version` prints about the build.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rustc-env=FIELDRIG_COMMIT={}", commit());
    println!("cargo::rustc-env=FIELDRIG_BUILD={}", profile_and_features());
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if std::env::var_os("CARGO_FEATURE_REALSENSE").is_some() {
        // librealsense contains its own LZ4, which the program must not replace by one of its own:
        // see `drivers/build.rs`.
        println!("cargo::rustc-link-arg=-Wl,--exclude-libs,ALL");
        // Paths to the library from `scripts/fetch-realsense.sh`; an installed one is found without
        // them.
        for folder in [
            "$ORIGIN",
            "$ORIGIN/../../.deps/realsense",
            "$ORIGIN/../../../.deps/realsense",
        ] {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
        if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
    }
    if std::env::var_os("CARGO_FEATURE_SIM").is_none() {
        return;
    }
    // Next to the executable, and in the checkout, relative to binaries and tests, so that the
    // checkout can be moved.
    for folder in [
        "$ORIGIN",
        "$ORIGIN/../../.deps/mujoco",
        "$ORIGIN/../../../.deps/mujoco",
    ] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}

/// Hash and date of the commit that is checked out. `FIELDRIG_COMMIT` replaces them, for packages
/// that are built from an archive. Without both, the commit is `unknown`.
fn commit() -> String {
    println!("cargo::rerun-if-env-changed=FIELDRIG_COMMIT");
    let given = std::env::var("FIELDRIG_COMMIT").ok();
    given
        .filter(|given| !given.is_empty())
        .or_else(commit_of_checkout)
        .unwrap_or_else(|| "unknown".to_owned())
}

fn commit_of_checkout() -> Option<String> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    // An archive may be unpacked inside another repository, whose commits mean something else.
    let top = git(&["rev-parse", "--show-toplevel"])?;
    if Path::new(&top).canonicalize().ok()? != here.canonicalize().ok()? {
        return None;
    }
    // This log grows with each commit and each checkout of another one.
    let log = git(&["rev-parse", "--git-path", "logs/HEAD"])?;
    if here.join(&log).exists() {
        println!("cargo::rerun-if-changed={log}");
    }
    git(&[
        "show",
        "--no-patch",
        "--format=%h %cs",
        "--abbrev=10",
        "HEAD",
    ])
}

/// What a git command prints; `None` if it fails, for example because git is not installed.
fn git(args: &[&str]) -> Option<String> {
    // The build may run as another user than the owner of the checkout, as in a container.
    let output = Command::new("git")
        .args(["-c", "safe.directory=*"])
        .args(args)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .ok()?;
    let printed = String::from_utf8(output.stdout).ok()?;
    let line = printed.trim();
    (output.status.success() && !line.is_empty()).then(|| line.to_owned())
}

/// Such as `release build with lpips, sim`.
fn profile_and_features() -> String {
    const PREFIX: &str = "CARGO_FEATURE_";
    let profile = std::env::var("PROFILE").unwrap_or_default();
    // Not `vars`, which panics if any variable is not valid UTF-8.
    let mut features: Vec<String> = std::env::vars_os()
        .filter_map(|(name, _)| Some(name.to_str()?.strip_prefix(PREFIX)?.to_lowercase()))
        .map(|feature| feature.replace('_', "-"))
        .filter(|feature| feature != "default")
        .collect();
    features.sort();
    if features.is_empty() {
        return format!("{profile} build without features");
    }
    format!("{profile} build with {}", features.join(", "))
}
