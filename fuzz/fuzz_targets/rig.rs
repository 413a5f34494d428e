//! Fuzz target for rig files, with a fixed robot description. The effective rig file (with all
//! defaults) of an accepted rig file must be accepted, too.
#![no_main]

use capture::Rig;

const URDF: &str = include_str!("../../kinematics/tests/data/panda.urdf");

libfuzzer_sys::fuzz_target!(|text: &str| {
    match Rig::parse("rig.toml", text, URDF, &[]) {
        Ok(rig) => {
            let settled = rig.to_toml();
            let reread = Rig::parse("rig.toml", &settled, &rig.arm.urdf_text, &[]);
            if let Err(error) = reread {
                panic!("{error}\n{settled}");
            }
        }
        Err(error) => drop(error.to_string()),
    }
});
