//! Flags shared by all commands that train. They override the keys of the same name in a rig file.

use crate::config::{self, MAX_BYTES_RANGE, MAX_SPLATS_RANGE, Override, SEED_RANGE};
use crate::exit::BadArgument;
use crate::method::{self, ModelKind};
use calibration::candidates;
use calibration::{CameraRefinement, ParamSet};
use clap::{ValueEnum, value_parser};
use trainer::splat::CountPolicy;

/// The rig file key that `--refine` sets.
pub(crate) const REALIGN: &str = "base.realign";

/// Which models to train, and their limits.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct TrainingArgs {
    /// Scene model: splat (Gaussian splats), nerf (neural radiance field), tsdf (signed distance field with a mesh), or
    /// several separated by commas. `train` and `run` train several at once, `bench curve` one after the other
    /// [default: train.method of the rig file, else splat]
    #[arg(long, value_name = "METHOD", value_parser = methods)]
    pub(crate) method: Option<Methods>,
    /// Random seed, 0 to 2^63 - 1. With the same number of steps, the same seed gives the same result
    /// [default: the rig file's, else 1]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(SEED_RANGE))]
    pub(crate) seed: Option<u64>,
    /// Maximum GPU memory of each model in bytes, at least 1000000 and enough for the smallest model of the method
    /// [default: the rig file's, else no limit]
    #[arg(long, value_name = "BYTES", value_parser = value_parser!(u64).range(MAX_BYTES_RANGE))]
    pub(crate) max_bytes: Option<u64>,
    /// Maximum number of splats, 1 to 100000000 [default: the rig file's, else 400000]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(MAX_SPLATS_RANGE))]
    pub(crate) max_splats: Option<u64>,
    /// Calibration parameters to estimate: auto (those that improve validation images), none, or a list of base,
    /// extrinsics, time-offset, joints, depth-pose, lens, depth-scale, readout, image-poses and image-gains, separated
    /// by commas. Images with depth are registered before training; without depth, the parameters are optimized with
    /// the scene. base estimates the pose of a mobile base at every station [default: base; for data on disk with a
    /// GPU: auto]
    #[arg(long, value_name = "PARAMS", value_delimiter = ',', hide_possible_values = true)]
    pub(crate) refine: Vec<Refine>,
    /// How the number of splats is chosen: to-cap (grow to --max-splats) or tested (grow to --max-splats, then halve as
    /// long as that costs less than 0.1 dB on validation images) [default: to-cap; for data on disk with a GPU: tested]
    #[arg(long, value_name = "HOW", hide_possible_values = true)]
    pub(crate) count: Option<CountArg>,
}

/// Distinct scene models, at least one.
#[derive(Clone, Debug)]
pub(crate) struct Methods(Vec<ModelKind>);

fn methods(text: &str) -> Result<Methods, String> {
    let mut kinds = Vec::new();
    for name in text.split(',') {
        let kind = ModelKind::from_name(name)
            .ok_or_else(|| format!("unknown method {name:?}, expected {}", method::describe(&ModelKind::ALL)))?;
        if kinds.contains(&kind) {
            return Err(format!("{name} is listed twice"));
        }
        kinds.push(kind);
    }
    Ok(Methods(kinds))
}

/// Values of `--count`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum CountArg {
    Tested,
    ToCap,
}

/// Values of `--refine`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Refine {
    Auto,
    None,
    /// The rig file's `base.realign`; not a camera parameter.
    Base,
    Extrinsics,
    TimeOffset,
    Joints,
    DepthPose,
    Lens,
    DepthScale,
    Readout,
    ImagePoses,
    ImageGains,
}

impl Refine {
    /// The name on the command line.
    fn name(&self) -> String {
        self.to_possible_value().map_or(String::new(), |name| name.get_name().to_owned())
    }
}

/// Which calibration parameters are estimated, and how.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct RefineSettings {
    /// By registering keyframes with depth.
    pub(crate) align: CameraRefinement,
    /// Jointly with the scene.
    pub(crate) with_scene: CameraRefinement,
}

/// Properties of the data that limit which calibration parameters can be estimated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct AvailableData {
    /// Poses come from the joints of a recording, so their errors are systematic and shared by all images.
    pub(crate) joints: bool,
    /// Poses come from a SLAM system or a base that uses one, so they drift from image to image.
    pub(crate) drifts: bool,
    /// The keyframes are known before training and have depth.
    pub(crate) depth: bool,
}

impl TrainingArgs {
    /// The requested scene models; `None` if the flag is not given.
    pub(crate) fn methods(&self) -> Option<&[ModelKind]> {
        self.method.as_ref().map(|Methods(kinds)| kinds.as_slice())
    }

    /// Rejects flags that need splats if no scene model is splats.
    pub(crate) fn check_for(&self, kinds: &[ModelKind]) -> Result<(), BadArgument> {
        let of_splats = [(self.max_splats.is_some(), "--max-splats"), (self.count.is_some(), "--count")];
        match of_splats.into_iter().find(|(is_given, _)| *is_given && !kinds.contains(&ModelKind::Splat)) {
            Some((_, flag)) => Err(BadArgument(format!(
                "{flag}: needs the method splat, but the method is {}",
                method::describe(kinds)
            ))),
            None => Ok(()),
        }
    }

    /// Rejects flags that are invalid for any data, before the data is read.
    pub(crate) fn check_before_data(&self, kinds: &[ModelKind], joints: bool) -> Result<(), BadArgument> {
        let all_available = AvailableData { joints, drifts: true, depth: true };
        self.check_for(kinds)?;
        self.refining(all_available, Refine::None)?;
        self.check_learned(kinds, all_available)
    }

    /// Rejects requested parameters that no scene model can estimate; the error lists the valid ones.
    pub(crate) fn check_learned(&self, kinds: &[ModelKind], available: AvailableData) -> Result<(), BadArgument> {
        let can_align = |param: &Refine| available.depth && *param != Refine::ImageGains;
        let can_learn = |param: &Refine| {
            kinds.contains(&ModelKind::Nerf) && matches!(param, Refine::ImagePoses | Refine::ImageGains)
        };
        let is_other = |param: &Refine| matches!(param, Refine::Auto | Refine::None | Refine::Base);
        let is_known = |param: &Refine| is_other(param) || can_align(param) || can_learn(param);
        if kinds.contains(&ModelKind::Splat) {
            return Ok(());
        }
        let Some(unknown) = self.refine.iter().find(|param| !is_known(param)) else { return Ok(()) };
        let known: Vec<String> =
            Refine::value_variants().iter().filter(|param| is_known(param)).map(Refine::name).collect();
        let without = if available.depth { "" } else { " without depth at the start" };
        Err(BadArgument(format!(
            "--refine {}: the method {} cannot estimate this{without}; it supports {}",
            unknown.name(),
            method::describe(kinds),
            known.join(", ")
        )))
    }

    /// Which calibration parameters to estimate; `default_value` applies if the flag is not given.
    pub(crate) fn refining(
        &self,
        available: AvailableData,
        default_value: Refine,
    ) -> Result<RefineSettings, BadArgument> {
        let requested = if self.refine.is_empty() { std::slice::from_ref(&default_value) } else { &self.refine };
        let has = |param| requested.contains(&param);
        if (has(Refine::Auto) || has(Refine::None)) && requested.len() > 1 {
            return Err(BadArgument("--refine: auto and none cannot be combined with other values".into()));
        }
        if has(Refine::Auto) {
            return Ok(available.auto_settings());
        }
        let needs_depth = [Refine::Joints, Refine::DepthPose, Refine::DepthScale, Refine::Readout];
        if let (Some(param), false) = (needs_depth.into_iter().find(|param| has(*param)), available.depth) {
            let message = "needs depth images that are all available before training";
            return Err(BadArgument(format!("--refine {}: {message}", param.name())));
        }
        if has(Refine::Joints) && !available.joints {
            return Err(BadArgument("--refine joints: needs a recording of an arm".into()));
        }
        let params = [
            (Refine::Extrinsics, ParamSet::EXTRINSICS),
            (Refine::TimeOffset, ParamSet::TIME_OFFSET),
            (Refine::Lens, ParamSet::LENS),
            (Refine::ImagePoses, ParamSet::IMAGE_POSES),
            (Refine::ImageGains, ParamSet::IMAGE_GAINS),
            (Refine::Joints, ParamSet::JOINTS),
            (Refine::DepthPose, ParamSet::DEPTH_POSE),
            (Refine::DepthScale, ParamSet::DEPTH_SCALE),
            (Refine::Readout, ParamSet::READOUT),
        ];
        let set: ParamSet = params.into_iter().filter(|(param, _)| has(*param)).map(|(_, param)| param).collect();
        if !available.depth {
            return Ok(RefineSettings {
                align: CameraRefinement::default(),
                with_scene: CameraRefinement::Always(set),
            });
        }
        Ok(RefineSettings {
            align: CameraRefinement::Always(set - ParamSet::IMAGE_GAINS),
            with_scene: CameraRefinement::Always(set & (ParamSet::IMAGE_POSES | ParamSet::IMAGE_GAINS)),
        })
    }

    /// How the number of splats is chosen; `default_value` applies if the flag is not given.
    pub(crate) fn count(&self, default_value: CountArg) -> CountPolicy {
        match self.count.unwrap_or(default_value) {
            CountArg::Tested => CountPolicy::Tested,
            CountArg::ToCap => CountPolicy::ToCap,
        }
    }

    /// The rig file keys that the flags override.
    pub(crate) fn overrides(&self) -> Vec<Override> {
        let mut overrides = Vec::new();
        if let Some(kinds) = self.methods() {
            overrides.push(Override::new("train.method", config::methods(kinds)));
        }
        if let Some(seed) = self.seed {
            overrides.push(Override::new("train.seed", seed.cast_signed()));
        }
        if let Some(bytes) = self.max_bytes {
            overrides.push(Override::new("train.max_bytes", bytes.cast_signed()));
        }
        if let Some(n) = self.max_splats {
            overrides.push(Override::new("train.max_splats", n.cast_signed()));
        }
        overrides.extend(self.realign().map(|is_on| Override::new(REALIGN, is_on)));
        overrides
    }

    /// Whether the pose of a mobile base is re-estimated at each station; `None` if `--refine` is not given.
    pub(crate) fn realign(&self) -> Option<bool> {
        let is_on = || self.refine.iter().any(|param| matches!(param, Refine::Auto | Refine::Base));
        (!self.refine.is_empty()).then(is_on)
    }
}

impl AvailableData {
    /// The candidates to try, most promising first: by registration where possible, otherwise jointly with the scene.
    fn auto_settings(self) -> RefineSettings {
        let gains = ParamSet::IMAGE_GAINS;
        let poses = ParamSet::IMAGE_POSES;
        let with_scene = match self {
            Self { drifts: true, .. } => vec![gains, poses],
            Self { depth: true, .. } => vec![gains],
            Self { depth: false, .. } => {
                vec![gains, ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET]
            }
        };
        RefineSettings {
            align: CameraRefinement::Try(if self.depth { candidates() } else { Vec::new() }),
            with_scene: CameraRefinement::Try(with_scene),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn no_flags() -> TrainingArgs {
        TrainingArgs { method: None, seed: None, max_bytes: None, max_splats: None, refine: Vec::new(), count: None }
    }

    fn refining(requested: &[Refine], joints: bool, depth: bool) -> Result<RefineSettings, String> {
        let args = TrainingArgs { refine: requested.to_vec(), ..no_flags() };
        args.refining(AvailableData { joints, drifts: !joints, depth }, Refine::None).map_err(|error| error.to_string())
    }

    #[test]
    fn params_visible_in_depth_are_not_learned_with_scene() {
        let extrinsics = ParamSet::EXTRINSICS;
        let by_depth = refining(&[Refine::Extrinsics, Refine::ImageGains], true, true).unwrap();
        assert_eq!(by_depth.align, CameraRefinement::Always(extrinsics));
        assert_eq!(by_depth.with_scene, CameraRefinement::Always(ParamSet::IMAGE_GAINS));
        let without = refining(&[Refine::Extrinsics], true, false).unwrap();
        assert_eq!(
            without,
            RefineSettings { align: CameraRefinement::default(), with_scene: CameraRefinement::Always(extrinsics) }
        );

        let candidates = |choice: CameraRefinement| match choice {
            CameraRefinement::Try(candidates) => candidates.len(),
            CameraRefinement::Always(_) => panic!("auto tries"),
        };
        for (joints, depth, aligned, learned) in
            [(true, true, 8, 1), (true, false, 0, 2), (false, true, 8, 2), (false, false, 0, 2)]
        {
            let RefineSettings { align, with_scene } = refining(&[Refine::Auto], joints, depth).unwrap();
            assert_eq!(
                (candidates(align), candidates(with_scene)),
                (aligned, learned),
                "joints {joints}, depth {depth}"
            );
        }
        assert_eq!(refining(&[], true, true), Ok(RefineSettings::default()));
    }

    #[test]
    fn methods_are_unique_and_splat_flags_need_splats() {
        assert_eq!(methods("tsdf,splat").map(|Methods(kinds)| kinds), Ok(vec![ModelKind::Tsdf, ModelKind::Splat]));
        for (text, message) in [("mesh", "\"mesh\""), ("splat,splat", "listed twice"), ("splat,", "\"\""), ("", "\"\"")]
        {
            assert!(methods(text).is_err_and(|error| error.contains(message)), "{text}");
        }
        let args = TrainingArgs { max_splats: Some(5), refine: vec![Refine::ImageGains], ..no_flags() };
        let available = AvailableData { joints: true, drifts: false, depth: true };
        let both = [ModelKind::Tsdf, ModelKind::Splat];
        assert!(args.check_for(&both).is_ok() && args.check_learned(&both, available).is_ok());
        let message = args.check_for(&[ModelKind::Tsdf, ModelKind::Nerf]).unwrap_err().0;
        assert!(message.contains("--max-splats") && message.contains("tsdf and nerf"), "{message}");
        let message = args.check_learned(&[ModelKind::Tsdf], available).unwrap_err().0;
        assert!(
            message.starts_with(
                "--refine image-gains: the method tsdf cannot estimate this; it supports auto, none, base, extrinsics,"
            ),
            "{message}"
        );
        assert!(message.ends_with("readout, image-poses"), "{message}");
        assert!(args.check_learned(&[ModelKind::Nerf], available).is_ok());
        let args = TrainingArgs { refine: vec![Refine::Extrinsics], ..no_flags() };
        assert!(args.check_before_data(&[ModelKind::Nerf], false).is_ok());
        let message =
            args.check_learned(&[ModelKind::Nerf], AvailableData { depth: false, ..available }).unwrap_err().0;
        assert!(message.ends_with("supports auto, none, base, image-poses, image-gains"), "{message}");
        let args = TrainingArgs { refine: vec![Refine::Joints], ..no_flags() };
        assert!(args.check_before_data(&[ModelKind::Splat], true).is_ok());
        assert!(args.check_before_data(&[ModelKind::Splat], false).is_err());
    }

    #[test]
    fn unsupported_refine_params_are_rejected() {
        let message = |requested: &[Refine], joints, depth| refining(requested, joints, depth).unwrap_err();
        assert!(message(&[Refine::DepthPose], true, false).contains("depth-pose: needs depth images"));
        assert!(message(&[Refine::Readout], false, false).contains("readout: needs"));
        assert!(message(&[Refine::Joints], false, true).contains("needs a recording of an arm"));
        assert!(message(&[Refine::Auto, Refine::Extrinsics], true, true).contains("cannot be combined"));
    }
}
