//! Runs a rig to its end, for the tests in the parent folder.

use drivers::{BasePose, Image, PixelFormat, RangeScan, Sample, Source, TruthImage};
use kinematics::JointState;
use sim::{Config, RigInfo};

/// All samples of a short run.
#[derive(PartialEq)]
pub(crate) struct Run {
    pub(crate) info: RigInfo,
    pub(crate) color: Vec<Image>,
    pub(crate) depth: Vec<Image>,
    pub(crate) truth: Vec<TruthImage>,
    pub(crate) joints: Vec<JointState>,
    pub(crate) reported_base: Vec<BasePose>,
    pub(crate) true_base: Vec<BasePose>,
    pub(crate) scans: Vec<RangeScan>,
}

pub(crate) fn run_rig(config: &Config) -> Run {
    let mut rig = sim::open(config).expect("the rig opens").into_lockstep();
    let mut run = Run {
        info: rig.info().clone(),
        color: vec![],
        depth: vec![],
        truth: vec![],
        joints: vec![],
        reported_base: vec![],
        true_base: vec![],
        scans: vec![],
    };
    while let Some(sample) = rig.next_sample().expect("the rig runs") {
        match sample {
            Sample::Image(image) if image.format == PixelFormat::Rgb8 => run.color.push(image),
            Sample::Image(image) => run.depth.push(image),
            Sample::Truth(truth) => run.truth.push(truth),
            Sample::Joints(state) => run.joints.push(state),
            Sample::Base(pose) => run.reported_base.push(pose),
            Sample::BaseTruth(pose) => run.true_base.push(pose),
            Sample::Range(scan) => run.scans.push(scan),
        }
    }
    run
}
