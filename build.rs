//! Tells the linker where the MuJoCo library lies, for binaries and tests of the `sim` feature.

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if std::env::var_os("CARGO_FEATURE_SIM").is_none() {
        return;
    }
    // Beside the executable; in a checkout that was moved with its target folder; where it was built.
    for folder in ["$ORIGIN", "$ORIGIN/../../.deps/mujoco", "$ORIGIN/../../../.deps/mujoco"] {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
