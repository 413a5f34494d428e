//! Options shared by all commands that train. They override the keys of the same name in a rig
//! file.

use crate::methods::describe;
use calibration::{CameraRefinement, ParamSet, candidates};
use messages::{BadInput, Setting};
use trainer::ModelKind;
use trainer::splat::CountPolicy;

/// The rig file key that `--refine` sets.
pub const REALIGN: &str = "base.realign";

/// Which models to train, and their limits. `None` means the value of the rig file or the default.
#[derive(Clone, Debug, Default)]
pub struct TrainingOptions {
    /// Scene models, without duplicates.
    pub methods: Option<Vec<ModelKind>>,
    /// Random seed.
    pub seed: Option<u64>,
    /// Maximum GPU memory of each model, bytes.
    pub max_bytes: Option<u64>,
    /// Maximum number of splats.
    pub max_splats: Option<u64>,
    /// Calibration parameters to estimate; the default if empty.
    pub refine: Vec<Refine>,
    /// How the number of splats is chosen.
    pub count: Option<CountPolicy>,
}

/// Values of `--refine`: calibration parameters, and ways to choose them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refine {
    /// All parameters that improve the scores of validation images.
    Auto,
    /// No parameters.
    None,
    /// Pose of a mobile base at each station (`base.realign` in the rig file); not a camera
    /// parameter.
    Base,
    /// Pose of each camera relative to its parent.
    Extrinsics,
    /// Time offset of each camera.
    TimeOffset,
    /// Offset of each joint that carries a camera.
    Joints,
    /// Pose of each depth camera relative to its color camera.
    DepthPose,
    /// Focal length and principal point of each camera.
    Lens,
    /// Scale factor of each depth camera's readings.
    DepthScale,
    /// Time from the first to the last row of each rolling shutter.
    Readout,
    /// A small pose correction of each image.
    ImagePoses,
    /// Gains of red, green and blue of each image.
    ImageGains,
}

impl Refine {
    /// All values with their names on the command line.
    pub const ALL: [(&str, Self); 12] = [
        ("auto", Self::Auto),
        ("none", Self::None),
        ("base", Self::Base),
        ("extrinsics", Self::Extrinsics),
        ("time-offset", Self::TimeOffset),
        ("joints", Self::Joints),
        ("depth-pose", Self::DepthPose),
        ("lens", Self::Lens),
        ("depth-scale", Self::DepthScale),
        ("readout", Self::Readout),
        ("image-poses", Self::ImagePoses),
        ("image-gains", Self::ImageGains),
    ];

    /// The name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(_, refine)| *refine == self)
            .map_or("", |(name, _)| name)
    }
}

/// Which calibration parameters are estimated, and how.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RefineSettings {
    /// By registering keyframes with depth, or from features of keyframes without depth.
    pub align: CameraRefinement,
    /// Jointly with the scene.
    pub with_scene: CameraRefinement,
}

impl RefineSettings {
    /// All parameters that may be estimated.
    fn params(&self) -> ParamSet {
        [&self.align, &self.with_scene]
            .into_iter()
            .flat_map(|choice| {
                [choice.always(), choice.watched()]
                    .into_iter()
                    .chain(choice.candidates().iter().copied())
            })
            .collect()
    }
}

/// Properties of the data that limit which calibration parameters can be estimated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AvailableData {
    /// Whether poses come from the joints of a recording, so that their errors are systematic and
    /// shared by all images.
    pub joints: bool,
    /// Whether poses come from a SLAM system or a base that uses one, so that they drift from image
    /// to image.
    pub drifts: bool,
    /// Whether keyframes have depth.
    pub depth: bool,
    /// Whether no keyframe has any depth, including depth from range scanners and rendered depth.
    pub color_only: bool,
    /// Whether cameras have at least 10 images on average. With fewer, the extrinsics of a camera
    /// are hardly different from the poses of its images.
    pub many_images_per_camera: bool,
}

/// Minimum average number of images per camera for the optimization of extrinsics by default. The
/// error of the extrinsics is shared by all images of a camera, while the errors of its poses
/// differ from image to image. With few images, the two are indistinguishable.
pub(crate) const MIN_IMAGES_PER_CAMERA: usize = 10;

impl TrainingOptions {
    /// The requested scene models; `None` if the flag is not given.
    pub fn methods(&self) -> Option<&[ModelKind]> {
        self.methods.as_deref()
    }

    /// Rejects flags that are invalid for any data, before the data is read.
    pub fn check_before_data(&self, kinds: &[ModelKind], joints: bool) -> anyhow::Result<()> {
        let all_available = AvailableData {
            joints,
            drifts: true,
            depth: true,
            color_only: false,
            many_images_per_camera: true,
        };
        self.check_for(kinds)?;
        self.refining(all_available, Refine::None)?;
        self.check_learned(kinds, all_available)
    }

    /// Rejects requested parameters that no scene model can estimate. The error lists the supported
    /// parameters.
    pub fn check_learned(
        &self,
        kinds: &[ModelKind],
        available: AvailableData,
    ) -> anyhow::Result<()> {
        let is_other = |param: &Refine| matches!(param, Refine::Auto | Refine::None | Refine::Base);
        let is_known = |param: &Refine| {
            is_other(param) || available.can_align(*param) || can_learn(kinds, *param)
        };
        let Some(unknown) = self.refine.iter().find(|param| !is_known(param)) else {
            return Ok(());
        };
        let known: Vec<&str> = Refine::ALL
            .iter()
            .filter(|(_, param)| is_known(param))
            .map(|(name, _)| *name)
            .collect();
        let without = if available.depth {
            ""
        } else {
            " without measured depth"
        };
        Err(BadInput(format!(
            "{} {}: the method {} cannot estimate this{without}; it supports {}",
            Setting::Refine,
            unknown.name(),
            describe(kinds),
            known.join(", ")
        ))
        .into())
    }

    /// Which calibration parameters to estimate; `default_value` applies if the flag is not given.
    pub fn refining(
        &self,
        available: AvailableData,
        default_value: Refine,
    ) -> anyhow::Result<RefineSettings> {
        self.estimating(Setting::Refine, available, default_value)
    }

    /// Does the same as [`Self::refining`]. `setting` is the setting that the user gave.
    pub(crate) fn estimating(
        &self,
        setting: Setting,
        available: AvailableData,
        default_value: Refine,
    ) -> anyhow::Result<RefineSettings> {
        let requested = if self.refine.is_empty() {
            std::slice::from_ref(&default_value)
        } else {
            &self.refine
        };
        let has = |param| requested.contains(&param);
        if (has(Refine::Auto) || has(Refine::None)) && requested.len() > 1 {
            let message = format!("{setting}: auto and none cannot be combined with other values");
            return Err(BadInput(message).into());
        }
        if has(Refine::Auto) {
            return Ok(available.auto_settings());
        }
        // Only registration estimates these parameters. It compares measured surfaces, so it needs
        // depth.
        let needs_depth = [
            Refine::Joints,
            Refine::DepthPose,
            Refine::DepthScale,
            Refine::Readout,
        ];
        if !available.depth
            && let Some(param) = needs_depth.into_iter().find(|param| has(*param))
        {
            let message = "needs depth images measured by a camera";
            return Err(BadInput(format!("{setting} {}: {message}", param.name())).into());
        }
        if has(Refine::Joints) && !available.joints {
            let message = format!("{setting} joints: needs a recording of an arm");
            return Err(BadInput(message).into());
        }
        let set = param_set(requested);
        // Without measured depth, features of images give a first estimate, and training with the
        // scene continues from it. Depth that was rendered allows neither.
        if !available.depth {
            let from_features = ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET | ParamSet::LENS;
            let aligned = if available.color_only {
                set & from_features
            } else {
                ParamSet::empty()
            };
            return Ok(RefineSettings {
                align: CameraRefinement::Always(aligned),
                with_scene: CameraRefinement::Always(set),
            });
        }
        // With depth, registration is more accurate than training with the scene. Only parameters
        // of single images are left for the scene.
        Ok(RefineSettings {
            align: CameraRefinement::Always(set - ParamSet::IMAGE_GAINS),
            with_scene: CameraRefinement::Always(
                set & (ParamSet::IMAGE_POSES | ParamSet::IMAGE_GAINS),
            ),
        })
    }

    /// Which calibration parameters a live run estimates. Without the flag, these are all
    /// parameters that registration or features can estimate, and image gains once the exposure
    /// changes. On a software adapter, where training is already slow, no parameters are estimated
    /// without the flag.
    pub fn refining_live(
        &self,
        available: AvailableData,
        software: bool,
    ) -> anyhow::Result<RefineSettings> {
        if !self.refine.is_empty() || software {
            return self.refining(available, Refine::None);
        }
        let settings = available.auto_settings();
        let with_scene =
            CameraRefinement::AlwaysAndWatch(settings.with_scene.always(), ParamSet::IMAGE_GAINS);
        Ok(RefineSettings {
            with_scene,
            ..settings
        })
    }

    /// On a software adapter, logs which calibration parameters are not estimated by default.
    pub(crate) fn log_unestimated(&self, available: AvailableData, is_software: bool) {
        if is_software && let Some(note) = self.note_on_software_adapter(available) {
            log::info!("{note}");
        }
    }

    /// On a software adapter: which calibration parameters are not estimated by default, and how to
    /// request them. `None` if the user has chosen the parameters.
    fn note_on_software_adapter(&self, available: AvailableData) -> Option<String> {
        if !self.refine.is_empty() {
            return None;
        }
        let on_gpu = available.auto_settings().params();
        let names: Vec<&str> = Refine::ALL
            .into_iter()
            .filter(|(_, param)| on_gpu.intersects(param_set(&[*param])))
            .map(|(name, _)| name)
            .collect();
        Some(format!(
            "no GPU: errors of the calibration, such as a wrong camera pose, are not estimated ({}), because that slows training down; \
             {} auto requests it",
            names.join(", "),
            Setting::Refine
        ))
    }

    /// Whether the pose of a mobile base is re-estimated at each station; `None` if `--refine` is
    /// not given.
    pub fn realign(&self) -> Option<bool> {
        let is_on = || {
            self.refine
                .iter()
                .any(|param| matches!(param, Refine::Auto | Refine::Base))
        };
        (!self.refine.is_empty()).then(is_on)
    }
}

/// The requested camera parameters.
fn param_set(requested: &[Refine]) -> ParamSet {
    let has = |param| requested.contains(&param);
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
    params
        .into_iter()
        .filter(|(param, _)| has(*param))
        .map(|(_, param)| param)
        .collect()
}

/// Whether one of the methods can optimize a parameter with the scene.
fn can_learn(kinds: &[ModelKind], param: Refine) -> bool {
    let set = param_set(&[param]);
    !set.is_empty()
        && kinds
            .iter()
            .any(|kind| kind.entry().learnable.contains(set))
}

impl AvailableData {
    /// Whether registration, or features without depth, can estimate a parameter.
    fn can_align(self, param: Refine) -> bool {
        if self.depth {
            // Registration compares geometry, which gains do not affect.
            param != Refine::ImageGains
        } else {
            self.color_only
                && matches!(
                    param,
                    Refine::Extrinsics | Refine::TimeOffset | Refine::Lens
                )
        }
    }

    /// Candidates for trials, the most promising first. They are estimated by registration if there
    /// is depth, otherwise jointly with the scene.
    ///
    /// Without depth, extrinsics are estimated from features and then optimized with the scene from
    /// the first step on. All images share the error of the extrinsics, so it is observable if the
    /// poses are right. They are not candidates for trials, because a trial of a few hundred steps
    /// is too short to correct this error.
    fn auto_settings(self) -> RefineSettings {
        let gains = ParamSet::IMAGE_GAINS;
        let poses = ParamSet::IMAGE_POSES;
        let with_scene = match self {
            // Poses that drift have a separate error in each image.
            Self { drifts: true, .. } => vec![gains, poses],
            Self { depth: true, .. } => vec![gains],
            Self {
                depth: false,
                many_images_per_camera: true,
                ..
            } => vec![gains, ParamSet::TIME_OFFSET],
            Self { depth: false, .. } => vec![gains, ParamSet::EXTRINSICS | ParamSet::TIME_OFFSET],
        };
        let aligned = match self {
            Self { depth: true, .. } => candidates(),
            Self {
                color_only: true,
                many_images_per_camera: true,
                ..
            } => {
                vec![ParamSet::EXTRINSICS, ParamSet::TIME_OFFSET]
            }
            _ => Vec::new(),
        };
        RefineSettings {
            align: CameraRefinement::Try(aligned),
            with_scene: if self.many_images_per_camera && !self.depth {
                CameraRefinement::AlwaysAndTry(ParamSet::EXTRINSICS, with_scene)
            } else {
                CameraRefinement::Try(with_scene)
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(name: &str) -> ModelKind {
        ModelKind::from_name(name).expect("registered")
    }

    fn available(joints: bool, depth: bool) -> AvailableData {
        AvailableData {
            joints,
            drifts: !joints,
            depth,
            color_only: !depth,
            many_images_per_camera: true,
        }
    }

    fn refining(requested: &[Refine], joints: bool, depth: bool) -> Result<RefineSettings, String> {
        let options = TrainingOptions {
            refine: requested.to_vec(),
            ..TrainingOptions::default()
        };
        options
            .refining(available(joints, depth), Refine::None)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn params_visible_in_depth_are_not_learned_with_scene() {
        let extrinsics = ParamSet::EXTRINSICS;
        let by_depth = refining(&[Refine::Extrinsics, Refine::ImageGains], true, true).unwrap();
        assert_eq!(by_depth.align, CameraRefinement::Always(extrinsics));
        assert_eq!(
            by_depth.with_scene,
            CameraRefinement::Always(ParamSet::IMAGE_GAINS)
        );
        let without = refining(&[Refine::Extrinsics], true, false).unwrap();
        assert_eq!(
            without,
            RefineSettings {
                align: CameraRefinement::Always(extrinsics),
                with_scene: CameraRefinement::Always(extrinsics)
            }
        );

        let candidates = |choice: CameraRefinement| choice.candidates().len();
        for (joints, depth, aligned, learned) in [
            (true, true, 8, 1),
            (true, false, 2, 2),
            (false, true, 8, 2),
            (false, false, 2, 2),
        ] {
            let RefineSettings { align, with_scene } =
                refining(&[Refine::Auto], joints, depth).unwrap();
            assert_eq!(
                (candidates(align), candidates(with_scene)),
                (aligned, learned),
                "joints {joints}, depth {depth}"
            );
        }
        for (joints, depth, many_images_per_camera, always) in [
            (true, false, true, extrinsics),
            (false, false, true, extrinsics),
            (true, true, true, ParamSet::empty()),
            (false, false, false, ParamSet::empty()),
        ] {
            let available = AvailableData {
                many_images_per_camera,
                ..available(joints, depth)
            };
            let options = TrainingOptions::default();
            assert_eq!(
                options
                    .refining(available, Refine::Auto)
                    .unwrap()
                    .with_scene
                    .always(),
                always
            );
            let live = options.refining_live(available, false).unwrap().with_scene;
            assert_eq!(
                live,
                CameraRefinement::AlwaysAndWatch(always, ParamSet::IMAGE_GAINS)
            );
        }
        assert_eq!(refining(&[], true, true), Ok(RefineSettings::default()));
    }

    #[test]
    fn note_on_software_adapters_names_what_is_not_estimated() {
        let note = |requested: &[Refine], depth| {
            TrainingOptions {
                refine: requested.to_vec(),
                ..TrainingOptions::default()
            }
            .note_on_software_adapter(available(true, depth))
        };
        let with_depth = note(&[], true).expect("a note");
        assert!(
            with_depth.contains("a wrong camera pose")
                && with_depth.contains("extrinsics, time-offset, joints")
                && with_depth.contains("refine auto"),
            "{with_depth}"
        );
        let without = note(&[], false).expect("a note");
        assert!(
            without.contains("extrinsics") && !without.contains("joints"),
            "{without}"
        );
        assert_eq!(note(&[Refine::Auto], true), None);
        assert_eq!(note(&[Refine::None], true), None);
    }

    #[test]
    fn unsupported_flags_are_rejected_for_each_method() {
        let options = TrainingOptions {
            max_splats: Some(5),
            refine: vec![Refine::ImageGains],
            ..TrainingOptions::default()
        };
        let available = available(true, true);
        let both = [kind("tsdf"), kind("splat")];
        assert!(
            options.check_for(&both).is_ok() && options.check_learned(&both, available).is_ok()
        );
        let message = options
            .check_for(&[kind("tsdf"), kind("nerf")])
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("max_splats") && message.contains("tsdf and nerf"),
            "{message}"
        );
        let message = options
            .check_learned(&[kind("tsdf")], available)
            .unwrap_err()
            .to_string();
        assert!(
            message.starts_with(
                "refine image-gains: the method tsdf cannot estimate this; it supports auto, none, base, extrinsics,"
            ),
            "{message}"
        );
        assert!(message.ends_with("readout, image-poses"), "{message}");
        assert!(options.check_learned(&[kind("nerf")], available).is_ok());
        let options = TrainingOptions {
            refine: vec![Refine::Extrinsics],
            ..TrainingOptions::default()
        };
        assert!(options.check_before_data(&[kind("nerf")], false).is_ok());
        let message = options
            .check_learned(
                &[kind("nerf")],
                AvailableData {
                    depth: false,
                    ..available
                },
            )
            .unwrap_err()
            .to_string();
        assert!(
            message.ends_with("supports auto, none, base, image-poses, image-gains"),
            "{message}"
        );
        let options = TrainingOptions {
            refine: vec![Refine::Joints],
            ..TrainingOptions::default()
        };
        assert!(options.check_before_data(&[kind("splat")], true).is_ok());
        assert!(options.check_before_data(&[kind("splat")], false).is_err());
    }

    #[test]
    fn unsupported_refine_params_are_rejected() {
        let message =
            |requested: &[Refine], joints, depth| refining(requested, joints, depth).unwrap_err();
        assert!(
            message(&[Refine::DepthPose], true, false).contains("depth-pose: needs depth images")
        );
        assert!(message(&[Refine::Readout], false, false).contains("readout: needs"));
        assert!(message(&[Refine::Joints], false, true).contains("needs a recording of an arm"));
        assert!(
            message(&[Refine::Auto, Refine::Extrinsics], true, true).contains("cannot be combined")
        );
    }
}
