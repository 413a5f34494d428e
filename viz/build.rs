//! Finds and compresses the bundled web page. Without the bundle, the server shows a page with the
//! command `make web`.

use flate2::Compression;
use flate2::write::GzEncoder;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Files written by `scripts/build-web.sh`.
const BUNDLE: [&str; 11] = [
    "web/dist/index.html",
    "web/dist/app.js",
    "web/dist/splat_worker.js",
    "web/dist/video_worker.js",
    "web/dist/mesh_loaders.js",
    "web/dist/coverage.js",
    "web/dist/study_page.js",
    "web/dist/workspace_page.js",
    "web/dist/steering.js",
    "web/dist/headset.js",
    "web/dist/app.css",
];
/// The page of binaries built without Node.js.
const WITHOUT_BUNDLE: [&str; 2] = [
    "src/server/without_bundle.html",
    "src/server/without_bundle.css",
];

fn main() -> std::io::Result<()> {
    println!("cargo::rustc-check-cfg=cfg(web_bundle)");
    // The bundler touches this file, so that Cargo notices the first bundle. Listing bundle files
    // that do not exist would make Cargo rerun this script in every build.
    println!("cargo::rerun-if-changed=build.rs");
    let has_bundle = BUNDLE.iter().all(|file| Path::new(file).is_file());
    if has_bundle {
        println!("cargo::rustc-cfg=web_bundle");
    }
    let files: &[&str] = if has_bundle { &BUNDLE } else { &WITHOUT_BUNDLE };
    for file in files {
        println!("cargo::rerun-if-changed={file}");
        compress(Path::new(file))?;
    }
    Ok(())
}

/// Writes `OUT_DIR/<name>.gz`.
fn compress(file: &Path) -> std::io::Result<()> {
    let folder = PathBuf::from(std::env::var_os("OUT_DIR").expect("Cargo sets OUT_DIR"));
    let name = file
        .file_name()
        .expect("the path of a file")
        .to_string_lossy();
    let mut encoder = GzEncoder::new(
        std::fs::File::create(folder.join(format!("{name}.gz")))?,
        Compression::best(),
    );
    encoder.write_all(&std::fs::read(file)?)?;
    encoder.finish()?;
    Ok(())
}
