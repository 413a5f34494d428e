//! Looks for the bundled web page; without it the server shows a page that names `make web`.

use std::path::Path;

/// What `scripts/build-web.sh` writes.
const BUNDLE: [&str; 3] = ["web/dist/index.html", "web/dist/app.js", "web/dist/app.css"];

fn main() {
    println!("cargo::rustc-check-cfg=cfg(web_bundle)");
    // The bundler touches this file, so that a first bundle is noticed. Naming bundle files that do not
    // exist would make every build a full one.
    println!("cargo::rerun-if-changed=build.rs");
    if BUNDLE.iter().all(|file| Path::new(file).is_file()) {
        println!("cargo::rustc-cfg=web_bundle");
        for file in BUNDLE {
            println!("cargo::rerun-if-changed={file}");
        }
    }
}
