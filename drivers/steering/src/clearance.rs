//! Fifth link: the arm keeps a distance from the scene, which is known only where and when it was
//! seen.
//!
//! This file decides how fast the arm may move. The distances come from a model of the scene behind
//! the trait [`Clearance`].

use crate::body::Body;
use crate::capsule::Capsule;
use crate::check::check;
use crate::error::Error;
use crate::ramp::{check_ramp, speed_scale};
use crate::reason::Reason;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// Rounding of a product, so that a multiple of a step stays the same.
const ROUNDING: f64 = 1e-6;

/// What is known about the surroundings of a point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// Distance to the closest surface, or a lower bound of it, meters; negative inside.
    pub distance_m: f64,
    /// Time since the region up to this distance was last seen.
    pub age_secs: f64,
}

/// A model of the scene around the arm.
///
/// The model must not contain the robot itself. The volume that the robot occupies now is free,
/// also if no camera ever saw it: otherwise, an arm in an unseen region could not leave it.
pub trait Clearance {
    /// What is known about each point at a time; `None` if the region has never been seen. A model
    /// that cannot answer in time returns an empty list, which counts as never seen.
    ///
    /// * `points_in_base`: points in the frame of the arm's base, meters.
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>>;

    /// What is known about points of the footprint of a base. The space that the footprint occupies
    /// now is free. A model without a base knows nothing.
    ///
    /// * `points_in_base`: points in the frame of the base link, meters.
    fn base_readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        let _ = (points_in_base, now);
        Vec::new()
    }

    /// Why the model is no longer updated, in words; `None` while it is. The arm is stopped after a
    /// failure, because the scene may change.
    fn failure(&self) -> Option<String> {
        None
    }
}

/// Distances from the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClearanceConfig {
    /// Distance from a surface below which no part approaches it any more.
    pub stop_m: f64,
    /// Distance below which the arm is slower.
    pub slow_m: f64,
    /// Smallest fraction of full speed.
    pub creep_frac: f64,
    /// Age up to which the arm moves at full speed.
    pub fresh_secs: f64,
    /// Age from which the arm moves at `stale_frac` of full speed.
    pub stale_secs: f64,
    /// Fraction of full speed in a region that was not seen for `stale_secs` or longer.
    pub stale_frac: f64,
    /// How far surfaces may have moved since they were seen: growth of both distances.
    pub growth_m_s: f64,
    /// Maximum growth.
    pub max_growth_m: f64,
    /// Links that may touch surfaces, such as fingers. They slow down, but are refused only in
    /// regions that were never seen.
    pub may_touch: Vec<String>,
}

impl Default for ClearanceConfig {
    fn default() -> Self {
        Self {
            // About two voxels of a TSDF of a table.
            stop_m: 0.02,
            slow_m: 0.15,
            creep_frac: 0.1,
            fresh_secs: 2.0,
            stale_secs: 30.0,
            stale_frac: 0.25,
            growth_m_s: 0.001,
            max_growth_m: 0.03,
            may_touch: Vec::new(),
        }
    }
}

impl ClearanceConfig {
    /// Growth of the distances with age.
    pub(crate) fn growth_m(&self, age_secs: f64) -> f64 {
        (self.growth_m_s * (age_secs - self.fresh_secs).max(0.0)).min(self.max_growth_m)
    }

    /// Fraction of full speed because of age.
    fn age_scale(&self, age_secs: f64) -> f64 {
        let span_secs = self.stale_secs - self.fresh_secs;
        let staleness_frac = ((age_secs - self.fresh_secs) / span_secs).clamp(0.0, 1.0);
        1.0 - staleness_frac * (1.0 - self.stale_frac)
    }

    /// Fraction of full speed because of a reading.
    pub(crate) fn scale_of(&self, seen: Seen) -> f64 {
        let growth_m = self.growth_m(seen.age_secs);
        let near = speed_scale(
            seen.distance_m - growth_m,
            self.stop_m,
            self.slow_m,
            self.creep_frac,
        );
        // Both factors act at once: near a surface, a stale region deserves more caution.
        (near * self.age_scale(seen.age_secs)).max(self.creep_frac.min(self.stale_frac))
    }

    /// Whether a reading is too far away to slow the robot down because of its distance.
    pub(crate) fn is_far(&self, seen: &Seen) -> bool {
        seen.distance_m >= self.slow_m + self.growth_m(seen.age_secs)
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        check_ramp("clearance", self.stop_m, self.slow_m, self.creep_frac)?;
        let fresh = self.fresh_secs;
        check(
            "clearance.fresh_secs",
            fresh,
            fresh >= 0.0,
            "0 or a positive number",
        )?;
        let stale = self.stale_secs;
        let is_valid = stale > fresh && stale.is_finite();
        check(
            "clearance.stale_secs",
            stale,
            is_valid,
            "more than fresh_secs",
        )?;
        let frac = self.stale_frac;
        let is_valid = frac > 0.0 && frac <= 1.0;
        check(
            "clearance.stale_frac",
            frac,
            is_valid,
            "more than 0 and at most 1",
        )?;
        for (what, value) in [
            ("clearance.growth_m_s", self.growth_m_s),
            ("clearance.max_growth_m", self.max_growth_m),
        ] {
            let is_valid = value >= 0.0 && value.is_finite();
            check(what, value, is_valid, "0 or a positive number")?;
        }
        Ok(())
    }
}

/// A reading that restricts the arm. All other points are free, and were seen recently.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Restriction {
    /// Index of the point.
    pub point_ix: usize,
    /// Distance of the part's surface instead of the point; `None` if never seen.
    pub seen: Option<Seen>,
}

/// A distance in steps of 0.1 mm. It is far more exact than any map, and the records of long motions
/// stay small.
pub(crate) fn rounded_down_m(distance_m: f64) -> f64 {
    const STEPS_PER_M: f64 = 1e4;
    (distance_m * STEPS_PER_M + ROUNDING).floor() / STEPS_PER_M
}

/// An age in steps of 0.1 s, for the same reason.
pub(crate) fn rounded_up_secs(age_secs: f64) -> f64 {
    const STEPS_PER_SEC: f64 = 10.0;
    (age_secs * STEPS_PER_SEC - ROUNDING).ceil() / STEPS_PER_SEC
}

/// Points of the robot whose distances are asked for.
#[derive(Clone, Debug)]
pub struct ClearancePoints {
    config: ClearanceConfig,
    points: Vec<PartPoint>,
}

/// A sphere in a part. The spheres of a part together cover it.
#[derive(Clone, Debug)]
struct PartPoint {
    part_ix: usize,
    /// Position between the ends of the capsule.
    frac: f64,
    radius_m: f64,
    may_touch: bool,
}

impl ClearancePoints {
    /// Points of all parts that move with the joints of the chain.
    ///
    /// * `posture`: any finite joint values; the points do not depend on them.
    ///
    /// # Errors
    /// If the configuration is invalid.
    pub fn new(config: ClearanceConfig, body: &Body, posture: &[f64]) -> Result<Self, Error> {
        config.check()?;
        let mut points = Vec::new();
        for (part_ix, capsule) in body.capsules(posture).iter().enumerate() {
            let part = body.part(part_ix);
            if part.frame_ix == 0 {
                continue;
            }
            let (centers, radius_m) = capsule.spheres(capsule.radius_m);
            let n_spans = centers.len().saturating_sub(1).max(1);
            points.extend((0..centers.len()).map(|ix| PartPoint {
                part_ix,
                frac: ix as f64 / n_spans as f64,
                radius_m,
                may_touch: config.may_touch.contains(&part.link),
            }));
        }
        Ok(Self { config, points })
    }

    /// Number of points.
    pub fn n_points(&self) -> usize {
        self.points.len()
    }

    /// The points in the frame of the base.
    pub(crate) fn in_base(&self, capsules: &[Capsule]) -> Vec<[f64; 3]> {
        let place = |point: &PartPoint| {
            let [start, end] = capsules[point.part_ix].ends;
            start.lerp(&end, point.frac).into()
        };
        self.points.iter().map(place).collect()
    }

    /// The readings that restrict the arm. Only these need to be recorded.
    pub(crate) fn restrictions(&self, readings: &[Option<Seen>]) -> Vec<Restriction> {
        let mut restrictions = Vec::new();
        for (point_ix, point) in self.points.iter().enumerate() {
            let seen = readings.get(point_ix).copied().flatten();
            // Ages and distances that are not numbers are not knowledge.
            let seen = seen.filter(|seen| seen.age_secs >= 0.0 && !seen.distance_m.is_nan());
            let seen = seen.map(|seen| Seen {
                // JSON has no infinity. Beyond these bounds, nothing changes.
                distance_m: rounded_down_m((seen.distance_m - point.radius_m).clamp(-1e3, 1e3)),
                age_secs: rounded_up_secs(seen.age_secs.min(1e9)),
            });
            if seen.is_none_or(|seen| self.config.scale_of(seen) < 1.0) {
                restrictions.push(Restriction { point_ix, seen });
            }
        }
        restrictions
    }

    /// Speed as a fraction of full speed, with its reason if it is less.
    pub(crate) fn speed(
        &self,
        here: &[Restriction],
        points_in_base: &[[f64; 3]],
        body: &Body,
    ) -> (f64, Option<Reason>) {
        let scale = |restriction: &Restriction| {
            restriction
                .seen
                .map_or(self.config.creep_frac, |seen| self.config.scale_of(seen))
        };
        let slowest = here.iter().min_by(|a, b| scale(a).total_cmp(&scale(b)));
        slowest.map_or((1.0, None), |slowest| {
            let reason = self.reason(slowest, points_in_base, body);
            (scale(slowest), Some(reason))
        })
    }

    /// Why the arm may not move to a close posture, if it may not. A motion away from a surface,
    /// and out of a region that was never seen, is permitted.
    pub(crate) fn refusal(
        &self,
        here: &[Restriction],
        there: &[Restriction],
        points_in_base: &[[f64; 3]],
        body: &Body,
    ) -> Option<Reason> {
        let refused = there.iter().find(|restriction| {
            let depth_there_m = self.depth_m(restriction);
            let before = here
                .iter()
                .find(|before| before.point_ix == restriction.point_ix);
            let depth_here_m = before.map_or(0.0, |before| self.depth_m(before));
            let is_free = depth_there_m <= 0.0;
            let is_leaving = restriction.seen.is_some() && depth_there_m <= depth_here_m;
            !is_free && !is_leaving
        });
        refused.map(|restriction| self.reason(restriction, points_in_base, body))
    }

    /// The restriction with the smallest distance, and this distance. Regions that were never seen
    /// are closer than everything else. Parts that may touch surfaces do not count.
    pub(crate) fn nearest(&self, restrictions: &[Restriction]) -> (f64, Option<Restriction>) {
        let distance_m = |restriction: &Restriction| match restriction.seen {
            None => f64::NEG_INFINITY,
            Some(_) if self.points[restriction.point_ix].may_touch => f64::INFINITY,
            Some(seen) => seen.distance_m,
        };
        let nearest = restrictions
            .iter()
            .min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)));
        nearest.map_or((f64::INFINITY, None), |nearest| {
            (distance_m(nearest), Some(*nearest))
        })
    }

    /// Distance below which no part approaches a surface that was seen just now.
    pub(crate) fn stop_m(&self) -> f64 {
        self.config.stop_m
    }

    /// The reason of a restriction.
    pub(crate) fn reason(
        &self,
        restriction: &Restriction,
        points_in_base: &[[f64; 3]],
        body: &Body,
    ) -> Reason {
        let point_ix = restriction.point_ix;
        let part = body.part(self.points[point_ix].part_ix).link.clone();
        let place = points_in_base[point_ix];
        let Some(seen) = restriction.seen else {
            return Reason::NeverSeen { part, place };
        };
        let Seen {
            distance_m,
            age_secs,
        } = seen;
        if self.config.is_far(&seen) {
            return Reason::LongUnseen {
                part,
                age_secs,
                place,
            };
        }
        Reason::Near {
            part,
            distance_m,
            age_secs,
            place,
        }
    }

    /// How far a part is inside the stop distance; infinite if the region was never seen.
    fn depth_m(&self, restriction: &Restriction) -> f64 {
        let Some(seen) = restriction.seen else {
            return f64::INFINITY;
        };
        if self.points[restriction.point_ix].may_touch {
            return 0.0;
        }
        self.config.stop_m + self.config.growth_m(seen.age_secs) - seen.distance_m
    }
}
