//! Adds the paths of the MuJoCo and RealSense libraries to binaries and tests with the features `sim` and `realsense`.

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if std::env::var_os("CARGO_FEATURE_REALSENSE").is_some() {
        // Next to the executable, and where `scripts/fetch-realsense.sh` puts the library. An installed RealSense SDK
        // needs no path.
        for folder in ["$ORIGIN", "$ORIGIN/../../.deps/realsense", "$ORIGIN/../../../.deps/realsense"] {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
        if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
    }
    if std::env::var_os("CARGO_FEATURE_SIM").is_none() {
        return;
    }
    // Next to the executable, and in the checkout, relative to binaries and tests, so that the checkout can be moved.
    for folder in ["$ORIGIN", "$ORIGIN/../../.deps/mujoco", "$ORIGIN/../../../.deps/mujoco"] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
