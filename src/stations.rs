//! The pose of a base that walks, estimated anew at each stand from what its cameras see there and saw before.
//!
//! Keyframes pass through on their way from join to trainer. Those at the first stand pass as they are; from there on the ones
//! taken while the base walks and the first ones of the next stand are held back, until the stand's can be laid over earlier ones
//! ([`trainer::align::stand`]). Then they pass corrected, and so does what comes later. What is decided follows from the keyframes
//! and their order alone, so that a run, its recording and the replay of that agree; only when keyframes pass depends on a clock.

use crate::config::{BaseDriver, Parent, Rig};
use crate::feed::Change;
use kinematics::{Stamp, Transform};
use serde::Serialize;
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use trainer::align::{self, Stand};
use trainer::{BasePlace, Keyframe, Split};

/// So many keyframes with depth, test keyframes aside, tell where the base stands; that takes a few seconds of scanning.
const ENOUGH: usize = 14;
/// A scan that brings fewer is not waited for longer, seconds.
const MOST_SCAN_SECS: f64 = 10.0;
/// A walk as long as this, or with as many keyframes, is not waited for: what is held is corrected as the stand before it.
const MOST_WALK_SECS: f64 = 30.0;
const MOST_HELD: usize = 128;
/// Keyframes of earlier stands that later ones are laid over; past these every other one is forgotten.
const MOST_SEEN: usize = 160;

/// Corrects keyframes for the errors of the base's poses.
pub(crate) struct Stands {
    /// Cameras that the base carries.
    carried: BTreeSet<Arc<str>>,
    max_wait_secs: f64,
    /// The stand of the keyframes that passed last; none before the first.
    stand: Option<usize>,
    /// Where its base was told to be.
    world_from_base: Transform,
    /// What the base's poses are corrected by since that stand.
    world_from_told: Transform,
    /// Keyframes with depth of the stands so far, corrected.
    seen: Vec<Arc<Keyframe>>,
    /// On the way to the next stand and at it, in order.
    held: Vec<Change>,
    /// What came since the next stand began to be looked for.
    later: VecDeque<Change>,
    looking: Option<JoinHandle<Looked>>,
    told: Vec<StandReport>,
    /// Time that looking took.
    spent: Duration,
}

/// What came of looking for a stand.
struct Looked {
    found: Option<Stand>,
    took: Duration,
}

/// A stand after the first, for people.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct StandReport {
    /// Counted from 0.
    stand: usize,
    /// Keyframes that it was looked for with.
    n_keyframes: usize,
    /// What was found since the stand before; null where its images show nothing of earlier ones.
    found: Option<Stand>,
    /// How far the base is from where it truly is, before and after; simulators know that.
    #[serde(skip_serializing_if = "Option::is_none")]
    off: Option<[Off; 2]>,
}

/// Distance between two poses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct Off {
    m: f64,
    rad: f64,
}

impl Stands {
    /// For a rig whose base moves and is to be realigned; `None` for others.
    pub(crate) fn new(rig: &Rig) -> Option<Self> {
        let carried = || {
            let on_base = rig.cameras.iter().filter(|camera| camera.parent != Parent::World);
            on_base.map(|camera| Arc::clone(&camera.name)).collect()
        };
        (rig.base.driver != BaseDriver::Fixed && rig.base.realign).then(|| Self {
            carried: carried(),
            max_wait_secs: rig.join.max_wait_millis * 1e-3,
            stand: None,
            world_from_base: Transform::identity(),
            world_from_told: Transform::identity(),
            seen: Vec::new(),
            held: Vec::new(),
            later: VecDeque::new(),
            looking: None,
            told: Vec::new(),
            spent: Duration::ZERO,
        })
    }

    /// Continues after the keyframes of an earlier run: the base's first stand is looked for among them.
    pub(crate) fn after(mut self, keyframes: &[Arc<Keyframe>]) -> Self {
        /// For the earlier run: no stand of this run has this number.
        const EARLIER: usize = usize::MAX;
        if let Some(place) = keyframes.iter().rev().find_map(|keyframe| keyframe.base.as_ref()) {
            (self.stand, self.world_from_base, self.world_from_told) =
                (Some(EARLIER), place.world_from_base, place.world_from_told);
        }
        keyframes.iter().for_each(|keyframe| self.remember(keyframe));
        self
    }

    /// Takes a change of the keyframes; gives those that follow from all so far.
    pub(crate) fn push(&mut self, change: Change) -> Vec<Change> {
        self.later.push_back(change);
        let mut passed = Vec::new();
        self.go_on(false, &mut passed);
        passed
    }

    /// Takes notice of the time: a stand is not waited for without bound. `newest` is the newest stamp of all samples.
    pub(crate) fn pass_time(&mut self, newest: Stamp) -> Vec<Change> {
        let mut passed = Vec::new();
        self.go_on(false, &mut passed);
        // An image becomes a keyframe this much later at most.
        let settled = newest.plus_secs(-self.max_wait_secs);
        if self.looking.is_none() && self.is_overdue(settled) {
            self.look(&mut passed);
        }
        passed
    }

    /// Gives what is left when nothing more comes.
    pub(crate) fn finish(&mut self) -> Vec<Change> {
        let mut passed = Vec::new();
        self.go_on(true, &mut passed);
        while !self.held.is_empty() {
            self.look(&mut passed);
            self.go_on(true, &mut passed);
        }
        passed
    }

    /// All keyframes of a recording.
    pub(crate) fn corrected(&mut self, keyframes: Vec<Arc<Keyframe>>) -> Vec<Arc<Keyframe>> {
        let mut passed: Vec<Change> = Vec::new();
        for keyframe in keyframes {
            passed.extend(self.push(Change::Accepted(keyframe)));
        }
        passed.extend(self.finish());
        let keyframe = |change| match change {
            Change::Accepted(keyframe) => Some(keyframe),
            Change::Evicted { .. } => None,
        };
        passed.into_iter().filter_map(keyframe).collect()
    }

    /// Where a camera is now, that the base's poses place at `world_from_camera`.
    pub(crate) fn pose_now(&self, camera: &str, world_from_camera: &Transform) -> Transform {
        if self.carried.contains(camera) { self.world_from_told * world_from_camera } else { *world_from_camera }
    }

    /// What was found at each stand after the first.
    pub(crate) fn reports(&self) -> &[StandReport] {
        &self.told
    }

    /// Time spent on finding it.
    pub(crate) fn spent(&self) -> Duration {
        self.spent
    }

    /// Works off what waits; `to_the_end`: however long looking takes.
    fn go_on(&mut self, to_the_end: bool, passed: &mut Vec<Change>) {
        loop {
            if let Some(looking) = self.looking.take_if(|looking| to_the_end || looking.is_finished()) {
                // A stand that cannot be told costs its correction, not the run.
                let looked = looking.join().unwrap_or_else(|_| {
                    log::error!("looking for a stand panicked: this is a bug");
                    Looked { found: None, took: Duration::ZERO }
                });
                self.settle(looked, passed);
            }
            if self.looking.is_some() {
                return;
            }
            let Some(change) = self.later.pop_front() else { return };
            self.take(change, passed);
        }
    }

    fn take(&mut self, change: Change, passed: &mut Vec<Change>) {
        let closes = match &change {
            Change::Accepted(keyframe) => self.is_overdue(keyframe.stamp) || self.leaves_stand(keyframe),
            Change::Evicted { .. } => false,
        };
        if closes {
            self.look(passed);
            self.later.push_front(change);
            return;
        }
        match change {
            Change::Accepted(keyframe) if self.held.is_empty() && self.is_here(&keyframe) => {
                passed.push(Change::Accepted(self.placed(keyframe)));
            }
            change if self.held.is_empty() && matches!(change, Change::Evicted { .. }) => passed.push(change),
            change => {
                self.held.push(change);
                if self.group().filter(|keyframe| tells(keyframe)).count() >= ENOUGH || self.held.len() >= MOST_HELD {
                    self.look(passed);
                }
            }
        }
    }

    /// Whether a keyframe is at the stand that was settled last, or has nothing to do with one.
    fn is_here(&self, keyframe: &Keyframe) -> bool {
        match &keyframe.base {
            None => true,
            Some(place) => self.stand.is_none() || place.stand == self.stand,
        }
    }

    /// Whether a keyframe shows that the base left the stand that is waited for.
    fn leaves_stand(&self, keyframe: &Keyframe) -> bool {
        let next = self.group().next().and_then(stand_of);
        keyframe.base.is_some() && next.is_some() && stand_of(keyframe) != next
    }

    /// Whether what is held waited for long enough at a time.
    fn is_overdue(&self, now: Stamp) -> bool {
        let waited_secs = |first: Option<&Keyframe>| first.map(|first| now.secs_since(first.stamp));
        match (waited_secs(self.group().next()), waited_secs(self.held_keyframes().next())) {
            (Some(scan_secs), _) => scan_secs > MOST_SCAN_SECS,
            (None, Some(walk_secs)) => walk_secs > MOST_WALK_SECS,
            (None, None) => false,
        }
    }

    fn held_keyframes(&self) -> impl Iterator<Item = &Keyframe> {
        self.held.iter().filter_map(|change| match change {
            Change::Accepted(keyframe) => Some(keyframe.as_ref()),
            Change::Evicted { .. } => None,
        })
    }

    /// The held keyframes of the next stand.
    fn group(&self) -> impl Iterator<Item = &Keyframe> {
        self.held_keyframes().filter(|keyframe| stand_of(keyframe).is_some())
    }

    /// Begins to look for the next stand; where there is none in what is held, that passes.
    fn look(&mut self, passed: &mut Vec<Change>) {
        let guess = self.world_from_told;
        let Some(place) = self.group().next().and_then(|keyframe| keyframe.base.clone()) else {
            for change in std::mem::take(&mut self.held) {
                passed.push(corrected(change, |_| guess));
            }
            return;
        };
        let new: Vec<Arc<Keyframe>> = self
            .group()
            .filter(|keyframe| tells(keyframe))
            .map(|keyframe| Arc::new(keyframe.carried(&guess)))
            .collect();
        let (seen, world_from_base) = (self.seen.clone(), guess * place.world_from_base);
        self.looking = Some(std::thread::spawn(move || {
            let begun = Instant::now();
            let found = align::beside_training(|| align::stand(&seen, &new, &world_from_base));
            Looked { found, took: begun.elapsed() }
        }));
    }

    /// Passes what was held on, placed by what was found.
    fn settle(&mut self, Looked { found, took }: Looked, passed: &mut Vec<Change>) {
        self.spent += took;
        let place = self.group().next().and_then(|keyframe| keyframe.base.clone());
        let place = place.expect("what was looked for is held");
        let (left, before) = (self.world_from_base, self.world_from_told);
        // The error of the walk, of a base that is told to be somewhere on it, as poses up to the last stand have it.
        let since = |told: &Transform, share: f64| {
            let guess = before * told;
            found.as_ref().map_or(before, |found| found.world_from_told(&guess, share) * before)
        };
        let now = since(&place.world_from_base, 1.0);
        let fix = |at: &BasePlace| match at.stand {
            Some(_) => now,
            None => {
                let (from, to) =
                    (apart(&left, &at.world_from_base), apart(&at.world_from_base, &place.world_from_base));
                since(&at.world_from_base, if from > 0.0 { from / (from + to) } else { 0.0 })
            }
        };
        let report =
            StandReport::new(&place, [&before, &now], self.group().filter(|of| tells(of)).count(), found.as_ref());
        log::info!("{report}");
        self.told.push(report);
        let held: Vec<Change> = std::mem::take(&mut self.held).into_iter().map(|held| corrected(held, fix)).collect();
        (self.stand, self.world_from_base, self.world_from_told) = (place.stand, place.world_from_base, now);
        for change in &held {
            if let Change::Accepted(keyframe) = change {
                self.remember(keyframe);
            }
        }
        passed.extend(held);
    }

    /// A keyframe of the stand that was settled last.
    fn placed(&mut self, keyframe: Arc<Keyframe>) -> Arc<Keyframe> {
        let Some(place) = &keyframe.base else { return keyframe };
        if place.stand.is_some() {
            (self.stand, self.world_from_base) = (place.stand, place.world_from_base);
        }
        let keyframe = carried(&keyframe, &self.world_from_told);
        self.remember(&keyframe);
        keyframe
    }

    fn remember(&mut self, keyframe: &Arc<Keyframe>) {
        if stand_of(keyframe).is_none() || !tells(keyframe) {
            return;
        }
        self.seen.push(Arc::clone(keyframe));
        if self.seen.len() > MOST_SEEN {
            // Of each split, or selection keyframes could all be forgotten.
            self.seen.sort_by_key(|seen| (seen.split == Split::Selection, seen.stamp));
            let mut ixs = 0..;
            self.seen.retain(|_| ixs.next().is_some_and(|ix| ix % 2 == 0));
        }
    }
}

fn stand_of(keyframe: &Keyframe) -> Option<usize> {
    keyframe.base.as_ref()?.stand
}

/// Whether a keyframe may tell where the base stands.
fn tells(keyframe: &Keyframe) -> bool {
    keyframe.depth.is_some() && keyframe.split != Split::Test
}

/// The way between two poses of a base, a radian counting as a metre.
fn apart(one: &Transform, other: &Transform) -> f64 {
    (one.translation.vector - other.translation.vector).norm() + one.rotation.angle_to(&other.rotation)
}

fn carried(keyframe: &Arc<Keyframe>, world_from_told: &Transform) -> Arc<Keyframe> {
    // Where nothing is corrected no bit changes.
    if *world_from_told == Transform::identity() {
        keyframe.clone()
    } else {
        Arc::new(keyframe.carried(world_from_told))
    }
}

fn corrected(change: Change, fix: impl Fn(&BasePlace) -> Transform) -> Change {
    match change {
        Change::Accepted(keyframe) => Change::Accepted(match &keyframe.base {
            Some(place) => carried(&keyframe, &fix(place)),
            None => keyframe,
        }),
        Change::Evicted { .. } => change,
    }
}

impl StandReport {
    fn new(place: &BasePlace, [before, after]: [&Transform; 2], n_keyframes: usize, found: Option<&Stand>) -> Self {
        let off = place.truth.map(|truth| {
            [before, after].map(|world_from_told| {
                let base = world_from_told * place.world_from_base;
                Off {
                    m: (base.translation.vector - truth.translation.vector).norm(),
                    rad: base.rotation.angle_to(&truth.rotation),
                }
            })
        });
        Self { stand: place.stand.unwrap_or_default(), n_keyframes, found: found.cloned(), off }
    }
}

impl std::fmt::Display for StandReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "base at stand {}: ", self.stand)?;
        match &self.found {
            None => f.write_str("its images show nothing of earlier ones, so it stays where it was told to be")?,
            Some(found) if found.kept => write!(f, "{found}")?,
            Some(found) => write!(f, "stays where it was told to be, for this is not sure or does not pay: {found}")?,
        }
        for unseen in self.found.iter().flat_map(|found| &found.unseen) {
            write!(f, "; cannot be seen: {unseen}")?;
        }
        if let Some([before, after]) = self.off {
            let told = |off: Off| format!("{:.1} mm and {:.2} degrees", 1e3 * off.m, off.rad.to_degrees());
            write!(f, "; off by {} before, by {} now", told(before), told(after))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use trainer::DepthMap;

    /// A room corner with marks on its walls, as a camera at a pose sees it: brightness, and depth.
    fn seen(pose: &Transform) -> (Vec<u8>, Vec<f32>) {
        let (mut rgba, mut depth_m) = (Vec::new(), Vec::new());
        let origin = pose.translation.vector;
        for pixel in 0..SIZE_PX[0] * SIZE_PX[1] {
            let [x, y] = [pixel % SIZE_PX[0], pixel / SIZE_PX[0]].map(|place| f64::from(place) + 0.5);
            let along = pose.rotation * Vector3::new((x - 80.0) / FOCAL_PX, (y - 60.0) / FOCAL_PX, 1.0);
            let walls =
                [(Vector3::x(), 2.0), (Vector3::y(), 1.1), (-Vector3::y(), 1.2), (Vector3::new(0.3, 0.2, -1.0), 0.9)];
            let reach = |(normal, offset): &(Vector3<f64>, f64)| {
                let z = (offset - normal.dot(&origin)) / normal.dot(&along);
                if z > 0.0 { z } else { f64::INFINITY }
            };
            let z = walls.iter().map(reach).fold(f64::INFINITY, f64::min);
            let at = origin + along * z;
            let wave = |size: f64, x: f64, y: f64, z: f64| size * (x * at.x + y * at.y + z * at.z).sin();
            let level = 128.0 + wave(30.0, 9.0, 13.0, -8.0) + wave(30.0, -6.0, 7.0, 15.0) + wave(25.0, 4.0, -5.0, 3.0);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a level of a test")]
            let level = level.round() as u8;
            rgba.extend([level, level, level, 255]);
            #[expect(clippy::cast_possible_truncation, reason = "metres of a test")]
            depth_m.push(if z.is_finite() { z as f32 } else { 0.0 });
        }
        (rgba, depth_m)
    }

    const SIZE_PX: [u32; 2] = [160, 120];
    const FOCAL_PX: f64 = 120.0;

    /// Where the base truly is: at one place, on the way, at another place.
    fn true_base(share: f64) -> Transform {
        Transform::new(Vector3::new(0.5 * share, 0.1 * share, 0.0), Vector3::new(0.0, 0.0, 0.15 * share))
    }

    /// What its source gets wrong on the way.
    fn told_base(share: f64) -> Transform {
        let truth = true_base(share);
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.003, -0.004, 0.014) * share);
        Transform::from_parts(
            (truth.translation.vector + Vector3::new(0.012, -0.015, 0.005) * share).into(),
            turn * truth.rotation,
        )
    }

    /// The `ix`-th image of a second each half: ten seconds at a stand, three on the way, ten at the next.
    fn keyframe(ix: usize) -> Arc<Keyframe> {
        let (stand, share) = match ix {
            0..24 => (Some(0), 0.0),
            24..30 => (None, (ix as f64 - 23.0) / 7.0),
            _ => (Some(1), 1.0),
        };
        let wave = |hz: f64, phase: f64| (hz * ix as f64 + phase).sin();
        let looking = Transform::from_parts(
            Vector3::new(0.15 * wave(0.9, 0.0), 0.2 * wave(0.7, 1.0), 0.3 + 0.1 * wave(0.5, 2.0)).into(),
            nalgebra::UnitQuaternion::from_scaled_axis(Vector3::z() * (0.4 * wave(0.8, 0.5)))
                * nalgebra::UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&[
                    -Vector3::y(),
                    -Vector3::z(),
                    Vector3::x(),
                ])),
        );
        let (rgba, depth_m) = seen(&(true_base(share) * looking));
        let world_from_camera = told_base(share) * looking;
        let lens = ([FOCAL_PX; 2], [80.0, 60.0]);
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp::from_secs(0.5 * ix as f64),
            size_px: SIZE_PX,
            focal_px: lens.0,
            principal_px: lens.1,
            rgba_srgb: rgba.into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: lens.0,
                principal_px: lens.1,
                depth_m: depth_m.into(),
                world_from_camera,
            }),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: Some(BasePlace {
                stand,
                world_from_base: told_base(share),
                world_from_told: Transform::identity(),
                truth: Some(true_base(share)),
            }),
            split: Split::of(ix),
            truth: None,
        })
    }

    fn all() -> Vec<Arc<Keyframe>> {
        (0..54).map(keyframe).collect()
    }

    fn stands() -> Stands {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/mobile-arm.toml");
        Stands::new(&Rig::load(&path, &[]).unwrap()).expect("its base walks")
    }

    /// Millimetres and degrees that a keyframe's base is off.
    fn off(keyframe: &Keyframe) -> (f64, f64) {
        let place = keyframe.base.as_ref().unwrap();
        let base = place.world_from_told * place.world_from_base;
        let left = place.truth.unwrap().inverse() * base;
        (1e3 * left.translation.vector.norm(), left.rotation.angle().to_degrees())
    }

    fn bits(keyframes: &[Arc<Keyframe>]) -> Vec<String> {
        let shown = |keyframe: &Arc<Keyframe>| {
            format!("{:?} {:?} {:?}", keyframe.stamp, keyframe.world_from_camera, keyframe.base)
        };
        keyframes.iter().map(shown).collect()
    }

    #[test]
    fn keyframes_of_a_wrong_stand_and_of_the_way_there_are_corrected_in_their_order() {
        let given = all();
        let mut stands = stands();
        let passed = stands.corrected(given.clone());
        let stamps = |keyframes: &[Arc<Keyframe>]| keyframes.iter().map(|keyframe| keyframe.stamp).collect::<Vec<_>>();
        assert_eq!(stamps(&given), stamps(&passed));
        assert!(given[..24].iter().zip(&passed).all(|(given, passed)| Arc::ptr_eq(given, passed)), "the first stays");
        for (given, passed) in given.iter().zip(&passed).skip(24) {
            let ((before_mm, _), (mm, degrees)) = (off(given), off(passed));
            assert!(mm < 0.5 && degrees < 0.05, "{:?}: {before_mm} mm, now {mm} mm, {degrees}", passed.stamp);
            // Depth goes along.
            let [was, is] =
                [given, passed].map(|of| of.world_from_camera.inverse() * of.depth.as_ref().unwrap().world_from_camera);
            assert!((was.to_homogeneous() - is.to_homogeneous()).abs().max() < 1e-9);
        }
        let [report] = stands.reports() else { panic!("{:?}", stands.reports()) };
        let [before, after] = report.off.unwrap();
        assert!(report.stand == 1 && before.m > 0.019 && after.m < 5e-4 && after.rad < 1e-3, "{report}");
        assert!(report.to_string().starts_with("base at stand 1: moved by"), "{report}");
        let camera = Transform::translation(0.1, 0.2, 0.3);
        assert_ne!(stands.pose_now("wrist", &camera), camera);
        assert_eq!(stands.pose_now("of the room", &camera), camera);
    }

    #[test]
    fn one_by_one_with_time_between_gives_what_all_at_once_gives() {
        let at_once = stands().corrected(all());
        for patience in [0.0, 0.05] {
            let mut stands = stands();
            let mut passed = Vec::new();
            for keyframe in all() {
                let stamp = keyframe.stamp;
                passed.extend(stands.push(Change::Accepted(keyframe)));
                std::thread::sleep(Duration::from_secs_f64(patience));
                passed.extend(stands.pass_time(stamp));
            }
            passed.extend(stands.finish());
            let passed: Vec<_> = passed
                .into_iter()
                .filter_map(|change| if let Change::Accepted(keyframe) = change { Some(keyframe) } else { None })
                .collect();
            assert_eq!(bits(&at_once), bits(&passed));
        }
    }

    #[test]
    fn nothing_is_held_back_for_ever_and_what_goes_keeps_its_place() {
        let mut stands = stands();
        let count = |passed: &[Change]| passed.len();
        for keyframe in all().into_iter().take(24) {
            assert_eq!(count(&stands.push(Change::Accepted(keyframe))), 1, "the first stand waits for nothing");
        }
        let gone = || Change::Evicted { camera: "wrist".into(), stamp: Stamp(0) };
        assert_eq!(count(&stands.push(gone())), 1);
        assert!(stands.push(Change::Accepted(keyframe(25))).is_empty(), "on the way");
        assert!(stands.push(gone()).is_empty());
        assert!(stands.pass_time(Stamp::from_secs(30.0)).is_empty());
        let passed = stands.pass_time(Stamp::from_secs(12.5 + MOST_WALK_SECS + 1.0));
        assert!(matches!(&passed[..], [Change::Accepted(_), Change::Evicted { .. }]), "{}", passed.len());
        // A scan that is too short is looked at when it has lasted long enough.
        for ix in 40..44 {
            assert!(stands.push(Change::Accepted(keyframe(ix))).is_empty());
        }
        let late = Stamp::from_secs(20.0 + MOST_SCAN_SECS + 1.0);
        let mut passed = stands.pass_time(late);
        while passed.is_empty() {
            std::thread::sleep(Duration::from_millis(10));
            passed = stands.pass_time(late);
        }
        assert_eq!((passed.len(), stands.reports().len()), (4, 1));
        let Change::Accepted(keyframe) = &passed[0] else { panic!("a keyframe") };
        assert!(stands.reports()[0].found.as_ref().is_none_or(|found| !found.kept || off(keyframe).0 < 2.0));
    }

    #[test]
    fn a_stand_that_shows_nothing_of_the_first_stays_and_is_told() {
        let away = |keyframe: Arc<Keyframe>| match keyframe.base.as_ref().and_then(|base| base.stand) {
            Some(1) => Arc::new(keyframe.carried(&Transform::translation(90.0, 0.0, 0.0))),
            _ => keyframe,
        };
        let given: Vec<_> = all().into_iter().map(away).collect();
        let mut stands = stands();
        let passed = stands.corrected(given.clone());
        assert_eq!(bits(&given), bits(&passed));
        assert!(stands.reports()[0].to_string().contains("show nothing of earlier ones"), "{}", stands.reports()[0]);
    }

    #[test]
    fn only_a_base_that_walks_is_realigned_and_only_if_asked_for() {
        let rig = |name: &str, realign: bool| {
            let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs").join(name);
            Rig::load(&path, &[crate::config::Override::new("base.realign", realign)]).unwrap()
        };
        assert!(Stands::new(&rig("mobile-arm.toml", false)).is_none());
        assert!(Stands::new(&rig("static-arm.toml", true)).is_none());
    }
}
