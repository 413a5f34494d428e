//! Adds the paths of the MuJoCo and RealSense libraries for this crate's tests. The build scripts
//! of other packages add these paths for their own binaries.

fn main() {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(folder) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
    // If `drivers` is built with RealSense support, this crate's tests also link librealsense2.
    if let Ok(folder) = std::env::var("PKG_CONFIG_PATH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{folder}");
    }
}
