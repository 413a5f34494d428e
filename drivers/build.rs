//! Tells this crate's tests where a fetched RealSense library lies; binaries of other packages say it in their own build script.

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
