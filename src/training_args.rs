//! Flags that every training command has; they override keys of the same name in a rig file.

use crate::config::{self, MAX_BYTES, MAX_SPLATS, Override, SEED};
use crate::exit::BadArgument;
use crate::method::{self, Kind};
use clap::{ValueEnum, value_parser};
use trainer::align;
use trainer::splat::{CameraChoice, CountChoice, TermSet};

/// The key of a rig file that `--refine` stands for.
pub(crate) const REALIGN: &str = "base.realign";

/// What to train, and how large it may become.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct TrainingArgs {
    /// Scene model: splat; nerf, a neural field; or tsdf, a distance field with a mesh; or several, separated by commas: `train`
    /// and `run` let them learn at once, `bench curve` one after the other [default: the rig file's, else splat]
    #[arg(long, value_name = "METHOD", value_parser = methods)]
    pub(crate) method: Option<Methods>,
    /// Seed of everything random, 0 to 2^63 - 1; trained for the same number of steps, one seed gives one result
    /// [default: the rig file's, else 1]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(SEED))]
    pub(crate) seed: Option<u64>,
    /// Most GPU bytes the model may take, at least 1000000, and what the smallest model of the method takes [default: the rig file's, else no bound but memory]
    #[arg(long, value_name = "BYTES", value_parser = value_parser!(u64).range(MAX_BYTES))]
    pub(crate) max_bytes: Option<u64>,
    /// Most splats, 1 to 100000000 [default: the rig file's, else 400000]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(MAX_SPLATS))]
    pub(crate) max_splats: Option<u64>,
    /// What is found about cameras: auto (what pays on held-back images), none, or a list of base, mount, delay, joints,
    /// depth-pose, lens, depth-scale, readout, image-poses and image-gains, separated by commas. Where images have depth they are
    /// laid over each other at the start, with base at each stand of a base that walks; else it is learned with the scene
    /// [default: base; for data on disk auto on a GPU]
    #[arg(long, value_name = "TERMS", value_delimiter = ',', hide_possible_values = true)]
    pub(crate) refine: Vec<Refine>,
    /// How many splats there are in the end: tested (grown up to --max-splats, then halved as long as that costs less than
    /// 0.1 dB on held-back images) or to-cap (--max-splats) [default: to-cap; for data on disk tested on a GPU]
    #[arg(long, value_name = "HOW", hide_possible_values = true)]
    pub(crate) count: Option<HowMany>,
}

/// Different scene models, at least one.
#[derive(Clone, Debug)]
pub(crate) struct Methods(Vec<Kind>);

fn methods(text: &str) -> Result<Methods, String> {
    let mut kinds = Vec::new();
    for name in text.split(',') {
        let kind =
            Kind::named(name).ok_or_else(|| format!("there is no {name:?}, only {}", method::in_words(&Kind::ALL)))?;
        if kinds.contains(&kind) {
            return Err(format!("{name} stands there twice"));
        }
        kinds.push(kind);
    }
    Ok(Methods(kinds))
}

/// What `--count` takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum HowMany {
    Tested,
    ToCap,
}

/// What `--refine` takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Refine {
    Auto,
    None,
    /// Not of the cameras: the rig file's `base.realign`.
    Base,
    Mount,
    Delay,
    Joints,
    DepthPose,
    Lens,
    DepthScale,
    Readout,
    ImagePoses,
    ImageGains,
}

impl Refine {
    /// As it is written.
    fn name(&self) -> String {
        self.to_possible_value().map_or(String::new(), |name| name.get_name().to_owned())
    }
}

/// What is found about cameras, and how.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Refining {
    /// By laying keyframes with depth over each other.
    pub(crate) align: CameraChoice,
    /// Along with the splats.
    pub(crate) learn: CameraChoice,
}

/// What data have that cameras could be refined by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Evidence {
    /// Poses come from a recording's joints, which are wrong in what all images share.
    pub(crate) joints: bool,
    /// Poses come from a SLAM system, or from a base that has one: they drift from image to image.
    pub(crate) drifts: bool,
    /// Keyframes, known from the start, with depth.
    pub(crate) depth: bool,
}

impl TrainingArgs {
    /// The scene models asked for, if any are.
    pub(crate) fn methods(&self) -> Option<&[Kind]> {
        self.method.as_ref().map(|Methods(kinds)| kinds.as_slice())
    }

    /// Refuses flags that only splats have where no scene model is splats.
    pub(crate) fn check_for(&self, kinds: &[Kind]) -> Result<(), BadArgument> {
        let of_splats = [(self.max_splats.is_some(), "--max-splats"), (self.count.is_some(), "--count")];
        match of_splats.into_iter().find(|(is_given, _)| *is_given && !kinds.contains(&Kind::Splat)) {
            Some((_, flag)) => Err(BadArgument(format!(
                "{flag}: only the method splat has it, and the method is {}",
                method::in_words(kinds)
            ))),
            None => Ok(()),
        }
    }

    /// Refuses flags that make no sense whatever the data hold, before those are read.
    pub(crate) fn check_before_data(&self, kinds: &[Kind], joints: bool) -> Result<(), BadArgument> {
        let most = Evidence { joints, drifts: true, depth: true };
        self.check_for(kinds)?;
        self.refining(most, Refine::None)?;
        self.check_learned(kinds, most)
    }

    /// Refuses terms that were asked for and that no scene model finds, and names those that one does.
    pub(crate) fn check_learned(&self, kinds: &[Kind], evidence: Evidence) -> Result<(), BadArgument> {
        let can_align = |term: &Refine| evidence.depth && *term != Refine::ImageGains;
        let can_learn =
            |term: &Refine| kinds.contains(&Kind::Nerf) && matches!(term, Refine::ImagePoses | Refine::ImageGains);
        let is_other = |term: &Refine| matches!(term, Refine::Auto | Refine::None | Refine::Base);
        let is_known = |term: &Refine| is_other(term) || can_align(term) || can_learn(term);
        if kinds.contains(&Kind::Splat) {
            return Ok(());
        }
        let Some(unknown) = self.refine.iter().find(|term| !is_known(term)) else { return Ok(()) };
        let known: Vec<String> =
            Refine::value_variants().iter().filter(|term| is_known(term)).map(Refine::name).collect();
        let without = if evidence.depth { "" } else { " of images without depth, or whose depth comes later" };
        Err(BadArgument(format!(
            "--refine {}: the method {} does not find that{without}, only {}",
            unknown.name(),
            method::in_words(kinds),
            known.join(", ")
        )))
    }

    /// What is found about cameras; `usual` where no flag says.
    pub(crate) fn refining(&self, evidence: Evidence, usual: Refine) -> Result<Refining, BadArgument> {
        let asked = if self.refine.is_empty() { std::slice::from_ref(&usual) } else { &self.refine };
        let has = |term| asked.contains(&term);
        if (has(Refine::Auto) || has(Refine::None)) && asked.len() > 1 {
            return Err(BadArgument("--refine: auto and none stand alone".into()));
        }
        if has(Refine::Auto) {
            return Ok(evidence.what_pays());
        }
        let needs_depth = [Refine::Joints, Refine::DepthPose, Refine::DepthScale, Refine::Readout];
        if let (Some(term), false) = (needs_depth.into_iter().find(|term| has(*term)), evidence.depth) {
            let told = "needs images with depth, and all of them at the start";
            return Err(BadArgument(format!("--refine {}: {told}", term.name())));
        }
        if has(Refine::Joints) && !evidence.joints {
            return Err(BadArgument("--refine joints: needs a recording of an arm".into()));
        }
        let set = TermSet {
            mount: has(Refine::Mount),
            delay: has(Refine::Delay),
            lens: has(Refine::Lens),
            image_poses: has(Refine::ImagePoses),
            image_gains: has(Refine::ImageGains),
            joints: has(Refine::Joints),
            depth_pose: has(Refine::DepthPose),
            depth_scale: has(Refine::DepthScale),
            readout: has(Refine::Readout),
        };
        if !evidence.depth {
            return Ok(Refining { align: CameraChoice::default(), learn: CameraChoice::Given(set) });
        }
        let own = TermSet { image_poses: set.image_poses, image_gains: set.image_gains, ..TermSet::default() };
        Ok(Refining {
            align: CameraChoice::Given(TermSet { image_gains: false, ..set }),
            learn: CameraChoice::Given(own),
        })
    }

    /// How the number of splats is found; `usual` where no flag says.
    pub(crate) fn count(&self, usual: HowMany) -> CountChoice {
        match self.count.unwrap_or(usual) {
            HowMany::Tested => CountChoice::Tested,
            HowMany::ToCap => CountChoice::ToCap,
        }
    }

    /// The keys of the rig file that the flags stand for.
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

    /// Whether a base that walks is found anew at each stand, where `--refine` is given.
    pub(crate) fn realign(&self) -> Option<bool> {
        let is_on = || self.refine.iter().any(|term| matches!(term, Refine::Auto | Refine::Base));
        (!self.refine.is_empty()).then(is_on)
    }
}

impl Evidence {
    /// Candidates, the likelier first: alignment for what it can do, a trial with the scene for the rest.
    fn what_pays(self) -> Refining {
        let gains = TermSet { image_gains: true, ..TermSet::NONE };
        let poses = TermSet { image_poses: true, ..TermSet::NONE };
        let learn = match self {
            Self { drifts: true, .. } => vec![gains, poses],
            Self { depth: true, .. } => vec![gains],
            Self { depth: false, .. } => vec![gains, TermSet { mount: true, delay: true, ..TermSet::NONE }],
        };
        Refining {
            align: CameraChoice::Try(if self.depth { align::candidates() } else { Vec::new() }),
            learn: CameraChoice::Try(learn),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn no_flags() -> TrainingArgs {
        TrainingArgs { method: None, seed: None, max_bytes: None, max_splats: None, refine: Vec::new(), count: None }
    }

    fn refining(asked: &[Refine], joints: bool, depth: bool) -> Result<Refining, String> {
        let args = TrainingArgs { refine: asked.to_vec(), ..no_flags() };
        args.refining(Evidence { joints, drifts: !joints, depth }, Refine::None).map_err(|error| error.to_string())
    }

    #[test]
    fn what_depth_can_tell_is_not_learned_with_the_scene() {
        let mount = TermSet { mount: true, ..TermSet::NONE };
        let by_depth = refining(&[Refine::Mount, Refine::ImageGains], true, true).unwrap();
        assert_eq!(by_depth.align, CameraChoice::Given(mount));
        assert_eq!(by_depth.learn, CameraChoice::Given(TermSet { image_gains: true, ..TermSet::NONE }));
        let without = refining(&[Refine::Mount], true, false).unwrap();
        assert_eq!(without, Refining { align: CameraChoice::default(), learn: CameraChoice::Given(mount) });

        let candidates = |choice: CameraChoice| match choice {
            CameraChoice::Try(candidates) => candidates.len(),
            CameraChoice::Given(_) => panic!("auto tries"),
        };
        for (joints, depth, aligned, learned) in
            [(true, true, 8, 1), (true, false, 0, 2), (false, true, 8, 2), (false, false, 0, 2)]
        {
            let Refining { align, learn } = refining(&[Refine::Auto], joints, depth).unwrap();
            assert_eq!((candidates(align), candidates(learn)), (aligned, learned), "joints {joints}, depth {depth}");
        }
        assert_eq!(refining(&[], true, true), Ok(Refining::default()));
    }

    #[test]
    fn methods_are_different_ones_and_flags_of_splats_need_splats() {
        assert_eq!(methods("tsdf,splat").map(|Methods(kinds)| kinds), Ok(vec![Kind::Tsdf, Kind::Splat]));
        for (text, told) in [("mesh", "\"mesh\""), ("splat,splat", "twice"), ("splat,", "\"\""), ("", "\"\"")] {
            assert!(methods(text).is_err_and(|error| error.contains(told)), "{text}");
        }
        let args = TrainingArgs { max_splats: Some(5), refine: vec![Refine::ImageGains], ..no_flags() };
        let evidence = Evidence { joints: true, drifts: false, depth: true };
        let both = [Kind::Tsdf, Kind::Splat];
        assert!(args.check_for(&both).is_ok() && args.check_learned(&both, evidence).is_ok());
        let told = args.check_for(&[Kind::Tsdf, Kind::Nerf]).unwrap_err().0;
        assert!(told.contains("--max-splats") && told.contains("tsdf and nerf"), "{told}");
        let told = args.check_learned(&[Kind::Tsdf], evidence).unwrap_err().0;
        assert!(
            told.starts_with("--refine image-gains: the method tsdf does not find that, only auto, none, base, mount,"),
            "{told}"
        );
        assert!(told.ends_with("readout, image-poses"), "{told}");
        assert!(args.check_learned(&[Kind::Nerf], evidence).is_ok());
        let args = TrainingArgs { refine: vec![Refine::Mount], ..no_flags() };
        assert!(args.check_before_data(&[Kind::Nerf], false).is_ok());
        let told = args.check_learned(&[Kind::Nerf], Evidence { depth: false, ..evidence }).unwrap_err().0;
        assert!(told.ends_with("only auto, none, base, image-poses, image-gains"), "{told}");
        let args = TrainingArgs { refine: vec![Refine::Joints], ..no_flags() };
        assert!(args.check_before_data(&[Kind::Splat], true).is_ok());
        assert!(args.check_before_data(&[Kind::Splat], false).is_err());
    }

    #[test]
    fn what_cannot_be_found_is_refused() {
        let told = |asked: &[Refine], joints, depth| refining(asked, joints, depth).unwrap_err();
        assert!(told(&[Refine::DepthPose], true, false).contains("depth-pose: needs images with depth"));
        assert!(told(&[Refine::Readout], false, false).contains("readout: needs"));
        assert!(told(&[Refine::Joints], false, true).contains("needs a recording of an arm"));
        assert!(told(&[Refine::Auto, Refine::Mount], true, true).contains("stand alone"));
    }
}
