//! Tells this crate's tests where the MuJoCo and RealSense libraries lie; binaries of other packages say it in their own build script.

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    // Where drivers are built with RealSense cameras, their library is linked here, too.
    if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
