//! Sets the search path of a downloaded RealSense library for tests of this crate. Binaries of
//! other packages do the same in their build scripts.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var_os("CARGO_FEATURE_REALSENSE").is_some() {
        // librealsense contains its own LZ4. Without this flag, it would call the functions of the
        // same names in the C library that tests of compressed recordings link.
        println!("cargo::rustc-link-arg=-Wl,--exclude-libs,ALL");
        for up in ["../..", "../../.."] {
            println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/{up}/.deps/realsense");
        }
        if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
            println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
        }
    }
}
