//! Adds the paths of the MuJoCo and RealSense libraries to binaries and tests with the features
//! `sim` and `realsense`.

fn main() {
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
