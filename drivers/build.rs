//! Sets the search path of a downloaded RealSense library for tests of this crate. Binaries of other packages do the
//! same in their build scripts.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var_os("CARGO_FEATURE_REALSENSE").is_some() {
        for up in ["../..", "../../.."] {
            println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/{up}/.deps/realsense");
        }
        if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
    }
}
