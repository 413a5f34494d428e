//! Fuzz target for COLLADA meshes.
#![no_main]

libfuzzer_sys::fuzz_target!(|text: &str| {
    let Ok(triangles) = kinematics::collada::triangles(text) else { return };
    assert!(triangles.as_flattened().as_flattened().iter().all(|coordinate| coordinate.is_finite()));
});
