//! Checks the dependencies between the crates of the workspace, as reported by `cargo metadata`,
//! against ARCHITECTURE.md.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// Every crate of the workspace, in whatever folder it is, and the other crates of the workspace
/// that it may depend on. A crate may depend only on crates in rows above its own.
const ALLOWED: &str = "
    background    ->
    files         ->
    messages      ->
    numbers       ->
    test-features ->
    kinematics    -> messages numbers
    drivers       -> files kinematics messages numbers
    steering      -> drivers kinematics numbers
    clearance-map -> kinematics steering
    test-support  -> drivers kinematics numbers
    gpu           -> messages test-support
    keyframe      -> files kinematics messages numbers
    model-files   -> files kinematics numbers
    targets       -> kinematics messages numbers
    calibration   -> background keyframe kinematics messages numbers
    sim           -> drivers files kinematics messages numbers targets
    capture       -> background calibration drivers files keyframe kinematics messages numbers sim
    report        -> calibration files kinematics messages numbers
    trainer       -> background calibration files gpu keyframe kinematics messages model-files \
                     numbers
    analytic-scene -> trainer
    viz           -> files keyframe kinematics messages model-files numbers trainer
    session       -> background calibration capture clearance-map drivers files gpu keyframe \
                     kinematics messages model-files numbers report steering trainer viz
    calibrate     -> calibration capture drivers files keyframe kinematics messages numbers report \
                     session targets viz
    bench         -> calibration capture clearance-map drivers files gpu keyframe kinematics \
                     messages model-files numbers report session steering trainer viz
    fieldrig      -> background bench calibrate calibration capture drivers files gpu keyframe \
                     kinematics messages session sim targets trainer viz
";

/// Crates that only `fieldrig` may use, because only it prints and parses command lines.
const BINARY_ONLY: [&str; 4] = ["clap", "ctrlc", "env_logger", "indicatif"];

/// The program, and what its tests use to render the reference of its commands.
const PARSES_FLAGS: [&str; 2] = ["fieldrig", "test-support"];

/// Crates that may add context to errors with `anyhow`. The crates below them have typed errors.
const WITH_ANYHOW: [&str; 6] = [
    "bench",
    "calibrate",
    "capture",
    "fieldrig",
    "report",
    "session",
];

/// The rows of [`ALLOWED`]: a crate, and its allowed dependencies.
fn allowed_rows() -> Vec<(&'static str, Vec<&'static str>)> {
    let rows = ALLOWED.lines().filter(|row| !row.trim().is_empty());
    rows.map(|row| {
        let (name, allowed) = row.split_once("->").expect("a row has an arrow");
        (name.trim(), allowed.split_whitespace().collect())
    })
    .collect()
}

/// Direct dependencies by package, without dev-dependencies.
type Dependencies = BTreeMap<String, BTreeSet<String>>;

fn dependencies() -> Dependencies {
    let output = Command::new(env!("CARGO"))
        .args([
            "metadata",
            "--format-version",
            "1",
            "--no-deps",
            "--offline",
        ])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo runs");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let metadata: serde_json::Value =
        serde_json::from_slice(&output.stdout).expect("cargo prints JSON");
    let text = |value: &serde_json::Value| value.as_str().expect("a string").to_owned();
    metadata["packages"]
        .as_array()
        .expect("packages")
        .iter()
        .map(|package| {
            let direct = package["dependencies"]
                .as_array()
                .expect("dependencies")
                .iter();
            let shipped = direct.filter(|dependency| dependency["kind"] != "dev");
            (
                text(&package["name"]),
                shipped
                    .map(|dependency| text(&dependency["name"]))
                    .collect(),
            )
        })
        .collect()
}

/// Every forbidden dependency, and every crate without a rule.
fn violations(dependencies: &Dependencies) -> Vec<String> {
    let mut violations_found = Vec::new();
    let rows = allowed_rows();
    let workspace_crates: BTreeSet<&str> = dependencies.keys().map(String::as_str).collect();
    for (package, direct) in dependencies {
        let Some((_, allowed)) = rows.iter().find(|(name, _)| name == package) else {
            violations_found.push(format!("{package} has no rule in this test"));
            continue;
        };
        for dependency in direct {
            if workspace_crates.contains(dependency.as_str())
                && !allowed.contains(&dependency.as_str())
            {
                violations_found.push(format!("{package} -> {dependency}"));
            }
            if !PARSES_FLAGS.contains(&package.as_str())
                && BINARY_ONLY.contains(&dependency.as_str())
            {
                violations_found.push(format!(
                    "{package} -> {dependency}, which only fieldrig may use"
                ));
            }
            if dependency == "anyhow" && !WITH_ANYHOW.contains(&package.as_str()) {
                violations_found.push(format!("{package} -> anyhow, but its errors are typed"));
            }
        }
    }
    violations_found
}

#[test]
fn dependencies_follow_architecture() {
    let dependencies = dependencies();
    assert_eq!(
        dependencies.len(),
        allowed_rows().len(),
        "crates: {:?}",
        dependencies.keys()
    );
    assert_eq!(violations(&dependencies), Vec::<String>::new());
}

#[test]
fn rows_name_only_crates_above_them() {
    let mut above = BTreeSet::new();
    for (name, allowed) in allowed_rows() {
        for dependency in allowed {
            assert!(above.contains(dependency), "{name} -> {dependency}");
        }
        above.insert(name);
    }
}

#[test]
fn forbidden_dependency_is_detected() {
    let mut dependencies = dependencies();
    dependencies
        .get_mut("trainer")
        .expect("trainer")
        .extend(["drivers", "anyhow", "clap"].map(str::to_owned));
    dependencies.insert("shortcut".to_owned(), BTreeSet::new());
    let expected = [
        "shortcut has no rule in this test",
        "trainer -> anyhow, but its errors are typed",
        "trainer -> clap, which only fieldrig may use",
        "trainer -> drivers",
    ];
    assert_eq!(violations(&dependencies), expected);
}

/// The crates of this workspace are compiled with overflow checks and debug assertions. Their
/// dependencies are compiled without both.
#[test]
fn every_crate_is_checked_in_development() {
    const CHECKS: [&str; 2] = ["debug-assertions", "overflow-checks"];
    let manifest = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml"))
        .expect("a manifest");
    let manifest: toml::Table = manifest.parse().expect("TOML");
    let profile = manifest["profile"]["dev"].as_table().expect("a table");
    let packages = profile["package"].as_table().expect("a table");
    for check in CHECKS {
        assert!(
            packages["*"].get(check).is_some() && !profile.contains_key(check),
            "{check}"
        );
        for (name, _) in allowed_rows() {
            assert!(
                packages
                    .get(name)
                    .is_none_or(|package| package.get(check).is_none()),
                "{check} of {name}"
            );
        }
    }
}
