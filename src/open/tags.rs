//! A base whose place is told by tags that its cameras see: its poses are made of the images and join the samples.

use crate::config::{BaseDriver, Camera, Parent, Rig};
use crate::join::{Motion, Posed};
use anyhow::bail;
use drivers::tags::{PlacedTag, Seeing, Sighting, Spotter, Steady, Unlocated, locate};
use drivers::{BasePose, Error, Image, Sample, Source};
use kinematics::{HistoryError, Stamp, Transform, Twist};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::{BTreeMap, VecDeque};

/// Sightings that wait for joint states; more are of a rig whose arm is silent, which is told elsewhere.
const MAX_WAITING: usize = 64;
/// So many images in which no pose fits the tags are no chance: one of the tags is not where the rig file has it.
const SURELY_WRONG: u64 = 3;
/// After so long without a pose a person is told why, seconds.
const UNTIL_TOLD_SECS: f64 = 5.0;

/// A source with the poses of the base added.
pub(super) struct WithTags {
    source: Box<dyn Source>,
    spotter: Spotter,
    /// Every image is looked at, however long that takes.
    is_patient: bool,
    cameras: Vec<Camera>,
    tags: BTreeMap<u32, PlacedTag>,
    /// The arm alone: on a base in the world's origin.
    arm: Motion,
    waiting: VecDeque<Sighting>,
    ready: VecDeque<Sample>,
    max_sigma: [f64; 2],
    steady: Steady,
    newest: Option<Stamp>,
    told: Option<Stamp>,
    counts: Counts,
}

/// What became of the images.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    n_images: u64,
    n_busy: u64,
    n_poses: u64,
    n_without_tag: u64,
    n_ambiguous: u64,
    n_far_off: u64,
    n_unsure: u64,
    n_without_joints: u64,
}

impl WithTags {
    pub(super) fn new(rig: &Rig, source: Box<dyn Source>) -> anyhow::Result<Self> {
        let mut arm = rig.clone();
        (arm.base.driver, arm.base.world_from_base) = (BaseDriver::Fixed, Transform::identity());
        let is_carried = |camera: &&Camera| camera.parent != Parent::World;
        let cameras: Vec<_> = rig.cameras.iter().filter(is_carried).cloned().collect();
        if cameras.is_empty() {
            bail!(
                "base.driver is tags, and no camera is on the base or the arm (camera.NAME.parent): none would see them move"
            );
        }
        Ok(Self {
            source,
            spotter: Spotter::start(rig.base.tag_family)?,
            is_patient: rig.sim.lockstep,
            cameras,
            tags: rig.base.tags.clone(),
            arm: Motion::new(&arm)?,
            waiting: VecDeque::new(),
            ready: VecDeque::new(),
            max_sigma: [rig.base.max_sigma_m, rig.base.max_sigma_rad],
            steady: Steady::default(),
            newest: None,
            told: None,
            counts: Counts::default(),
        })
    }

    /// Has an image of a camera that the base carries looked at.
    fn look(&mut self, image: &Image) {
        if image.is_depth() || self.camera(&image.camera).is_none() {
            return;
        }
        self.counts.n_images += 1;
        if self.is_patient {
            let found = self.spotter.look_now(image.clone());
            self.wait(found);
        } else if !self.spotter.look(image.clone()) {
            self.counts.n_busy += 1;
        }
    }

    fn camera(&self, name: &str) -> Option<&Camera> {
        self.cameras.iter().find(|camera| &*camera.name == name)
    }

    fn wait(&mut self, found: Vec<Result<Sighting, Error>>) {
        for sighting in found {
            match sighting {
                Ok(sighting) => self.waiting.push_back(sighting),
                Err(error) => log::debug!("base: {error}"),
            }
        }
        while self.waiting.len() > MAX_WAITING {
            self.waiting.pop_front();
            self.counts.n_without_joints += 1;
        }
    }

    /// Makes poses of the sightings for which the joints are known.
    fn settle(&mut self) {
        while let Some(sighting) = self.waiting.front() {
            let Some(camera) = self.camera(&sighting.camera) else { return };
            let stamp = camera.mid_exposure(sighting.stamp);
            match self.arm.at(camera, stamp) {
                Ok(posed) => self.locate(stamp, &posed),
                Err(HistoryError::NotYet { .. }) => return,
                Err(_) => self.counts.n_without_joints += 1,
            }
            self.waiting.pop_front();
        }
    }

    fn locate(&mut self, stamp: Stamp, posed: &Posed) {
        let base_from_camera = &posed.world_from_camera;
        let Some(sighting) = self.waiting.front() else { return };
        let Some(camera) = self.camera(&sighting.camera) else { return };
        let known = sighting.tags.iter().filter_map(|tag| Some((self.tags.get(&tag.id)?, tag.corners_px)));
        let seeing = Seeing {
            intrinsics: &camera.intrinsics,
            twist: posed.twist.unwrap_or_else(Twist::zero),
            readout_secs: camera.readout_micros.unwrap_or(0.0) * 1e-6,
        };
        let located = locate(&seeing, &known.collect::<Vec<_>>());
        match located {
            Ok(located) if self.newest.is_none_or(|newest| stamp > newest) => {
                let world_from_base = located.world_from_camera * base_from_camera.inverse();
                let covariance = of_base(&located.covariance, base_from_camera);
                if !self.is_sure(&covariance) {
                    self.counts.n_unsure += 1;
                    return;
                }
                let world_from_base = self.steady.push(&world_from_base, &covariance);
                self.ready.push_back(Sample::Base(BasePose { stamp, world_from_base }));
                (self.newest, self.told) = (Some(stamp), None);
                self.counts.n_poses += 1;
            }
            // Two cameras at once: the other one was first.
            Ok(_) => {}
            Err(why) => {
                let name = camera.name.clone();
                let seen: Vec<_> = sighting.tags.iter().map(|tag| tag.id.to_string()).collect();
                self.miss(stamp, &name, &seen, why);
            }
        }
    }

    /// Whether a covariance is what the rig file asks for.
    fn is_sure(&self, covariance: &Matrix6<f64>) -> bool {
        let sigma = |first: usize| covariance.diagonal().fixed_rows::<3>(first).sum().sqrt();
        sigma(0) <= self.max_sigma[0] && sigma(3) <= self.max_sigma[1]
    }

    /// Counts an image without a pose, and tells of a long time without any.
    fn miss(&mut self, stamp: Stamp, camera: &str, seen: &[String], why: Unlocated) {
        match why {
            Unlocated::NoTag => self.counts.n_without_tag += 1,
            Unlocated::Ambiguous => self.counts.n_ambiguous += 1,
            Unlocated::FarOff { .. } => {
                self.counts.n_far_off += 1;
                if self.counts.n_far_off == SURELY_WRONG {
                    log::warn!(
                        "base: camera {camera:?}: {SURELY_WRONG} images fit no pose: {why}; what single tags told before may be wrong, too"
                    );
                }
            }
        }
        let since = *self.told.get_or_insert(self.newest.unwrap_or(stamp));
        if stamp.secs_since(since) >= UNTIL_TOLD_SECS {
            let others = match why {
                Unlocated::NoTag if !seen.is_empty() => format!(", but the tags {}", seen.join(", ")),
                _ => String::new(),
            };
            log::warn!("base: no pose for {:.0} s; camera {camera:?}: {why}{others}", stamp.secs_since(since));
            self.told = Some(stamp);
        }
    }
}

impl Source for WithTags {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        let found = self.spotter.found();
        self.wait(found);
        self.settle();
        if let Some(pose) = self.ready.pop_front() {
            return Ok(Some(pose));
        }
        let Some(sample) = self.source.next_sample()? else {
            let found = self.spotter.finish();
            self.wait(found);
            self.settle();
            return Ok(self.ready.pop_front());
        };
        match &sample {
            Sample::Joints(state) => drop(self.arm.push_joints(state.clone())),
            Sample::Image(image) => self.look(image),
            _ => {}
        }
        Ok(Some(sample))
    }

    fn n_others_dropped(&self) -> u64 {
        self.source.n_others_dropped()
    }
}

impl Drop for WithTags {
    fn drop(&mut self) {
        let Counts { n_images, n_busy, n_poses, n_without_tag, n_ambiguous, n_far_off, n_unsure, n_without_joints } =
            self.counts;
        log::info!(
            "base: {n_poses} poses by tags in {n_images} images ({n_busy} not looked at, {n_without_tag} without a known tag, \
             {n_ambiguous} ambiguous, {n_far_off} that fit no pose, {n_unsure} too unsure, {n_without_joints} without joint states)"
        );
    }
}

/// The covariance of the base's pose, in its own axes, by that of a camera on it.
fn of_base(of_camera: &Matrix6<f64>, base_from_camera: &Transform) -> Matrix6<f64> {
    let camera_from_base = base_from_camera.inverse();
    let columns: [Vector6<f64>; 6] = std::array::from_fn(|ix| {
        let unit = |first: usize| Vector3::from_fn(|axis, _| f64::from(u8::from(axis + first == ix)));
        let moved = Twist { linear_m_s: unit(0), angular_rad_s: unit(3) }.of_attached(&camera_from_base);
        Vector6::from_iterator(moved.linear_m_s.iter().chain(&moved.angular_rad_s).copied())
    });
    let adjoint = Matrix6::from_columns(&columns);
    adjoint * of_camera * adjoint.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_base_far_from_its_camera_is_known_worse_across_the_line_between_them() {
        let base_from_camera = Transform::translation(0.0, 0.0, 2.0);
        let of_camera = Matrix6::from_diagonal(&Vector6::new(1e-6, 1e-6, 1e-6, 1e-4, 0.0, 0.0));
        let of_base = of_base(&of_camera, &base_from_camera);
        // Turned by 10 mrad about x, 2 m away: 20 mm along y.
        assert!((of_base[(1, 1)] - (1e-6 + 4e-4)).abs() < 1e-12, "{of_base}");
        assert!((of_base[(0, 0)] - 1e-6).abs() < 1e-12 && (of_base[(2, 2)] - 1e-6).abs() < 1e-12, "{of_base}");
        let off = kinematics::transform::exp(
            &Twist { linear_m_s: Vector3::zeros(), angular_rad_s: Vector3::new(1e-2, 0.0, 0.0) },
            1.0,
        );
        let moved = base_from_camera * off * base_from_camera.inverse();
        assert!((moved.translation.y.abs() - 2e-2).abs() < 1e-5, "{moved}");
    }
}
