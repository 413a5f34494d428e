//! Fourth link: parts of the robot keep a distance from each other.

use crate::body::Body;
use crate::capsule::{Capsule, Gap};
use crate::error::Error;
use crate::ramp::{check_ramp, speed_scale};
use crate::reason::Reason;
use numbers::random::Random;
use serde::{Deserialize, Serialize};

/// Distances between parts of the robot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelfCollisionConfig {
    /// Distance below which parts do not approach each other any more.
    pub stop_m: f64,
    /// Distance below which the arm is slower.
    pub slow_m: f64,
    /// Smallest fraction of full speed.
    pub creep_frac: f64,
}

impl Default for SelfCollisionConfig {
    fn default() -> Self {
        Self {
            // Capsules enclose the parts, so this is in addition to their excess.
            stop_m: 0.01,
            slow_m: 0.04,
            creep_frac: 0.1,
        }
    }
}

/// Number of postures in which all pairs are tried.
const N_POSTURES: u32 = 500;
/// Pairs that are close in this share of postures are shaped like this, and are not checked. The
/// set-up assistant of `MoveIt` selects pairs by the same rule.
const ALWAYS_CLOSE_FRAC: f64 = 0.95;
/// Range of a joint without limits, radians or meters, from which postures are drawn.
const UNLIMITED: f64 = std::f64::consts::PI;

/// The pairs of parts that must not touch.
#[derive(Clone, Debug)]
pub struct SelfCollision {
    config: SelfCollisionConfig,
    pairs: Vec<[usize; 2]>,
    notes: Vec<String>,
}

/// A pair that is closer than [`SelfCollisionConfig::slow_m`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClosePair {
    pair_ix: usize,
    gap: Gap,
}

impl SelfCollision {
    /// Selects the pairs: parts that move relative to each other, except neighbors along the chain,
    /// and except parts that are close in nearly every posture, because they are shaped like this
    /// or because their capsules are larger than they are.
    ///
    /// * `ranges`: range of each joint.
    /// * `free_posture`: a posture in which no parts touch, if one is known. Pairs whose capsules
    ///   are too close there are not checked.
    ///
    /// # Errors
    /// If the configuration is invalid or the numbers of joints differ.
    pub fn new(
        config: SelfCollisionConfig,
        body: &Body,
        ranges: &[[f64; 2]],
        free_posture: Option<&[f64]>,
    ) -> Result<Self, Error> {
        let SelfCollisionConfig {
            stop_m,
            slow_m,
            creep_frac,
        } = config;
        check_ramp("self_collision", stop_m, slow_m, creep_frac)?;
        for (what, got) in [
            ("the list of ranges", ranges.len()),
            (
                "the free posture",
                free_posture.map_or(body.n_joints(), <[f64]>::len),
            ),
        ] {
            if got != body.n_joints() {
                let expected = body.n_joints();
                return Err(Error::JointCount {
                    what,
                    got,
                    expected,
                });
            }
        }
        let mut selected = Self {
            config,
            pairs: moving_pairs(body),
            notes: Vec::new(),
        };
        selected.drop_always_close(body, ranges);
        if let Some(free_posture) = free_posture {
            selected.drop_close_at(body, free_posture);
        }
        Ok(selected)
    }

    /// One sentence for each pair of links that is not checked because of the free posture.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Number of pairs of capsules that are checked.
    pub fn n_pairs(&self) -> usize {
        self.pairs.len()
    }

    /// All close pairs, in a fixed order.
    pub(crate) fn close_pairs(&self, capsules: &[Capsule]) -> Vec<ClosePair> {
        let mut close = Vec::new();
        for (pair_ix, [a, b]) in self.pairs.iter().enumerate() {
            let gap = capsules[*a].gap(&capsules[*b]);
            // Written so that NaN counts as close.
            let is_far = gap.distance_m >= self.config.slow_m;
            if !is_far {
                close.push(ClosePair { pair_ix, gap });
            }
        }
        close
    }

    /// Speed as a fraction of full speed, with its reason if it is less.
    pub(crate) fn speed(&self, here: &[ClosePair], body: &Body) -> (f64, Option<Reason>) {
        let nearest = here
            .iter()
            .min_by(|a, b| a.gap.distance_m.total_cmp(&b.gap.distance_m));
        let Some(nearest) = nearest else {
            return (1.0, None);
        };
        let SelfCollisionConfig {
            stop_m,
            slow_m,
            creep_frac,
        } = self.config;
        let scale = speed_scale(nearest.gap.distance_m, stop_m, slow_m, creep_frac);
        (scale, Some(self.reason(nearest, body)))
    }

    /// Why the arm may not move from one posture to a close one, if it may not. A motion away from
    /// a contact is permitted.
    pub(crate) fn refusal(
        &self,
        here: &[ClosePair],
        there: &[ClosePair],
        body: &Body,
    ) -> Option<Reason> {
        let refused = there.iter().find(|pair| {
            let before = here.iter().find(|before| before.pair_ix == pair.pair_ix);
            let before_m = before.map_or(self.config.slow_m, |before| before.gap.distance_m);
            let is_free = pair.gap.distance_m >= self.config.stop_m;
            let is_leaving = pair.gap.distance_m >= before_m;
            !is_free && !is_leaving
        });
        refused.map(|pair| self.reason(pair, body))
    }

    fn reason(&self, pair: &ClosePair, body: &Body) -> Reason {
        Reason::SelfCollision {
            parts: self.pairs[pair.pair_ix].map(|part_ix| body.part(part_ix).link.clone()),
            distance_m: pair.gap.distance_m,
            place: pair.gap.place.into(),
        }
    }

    fn drop_always_close(&mut self, body: &Body, ranges: &[[f64; 2]]) {
        // The seed is fixed, so that the same robot always has the same pairs.
        let mut random = Random::new(0);
        let mut n_close = vec![0_u32; self.pairs.len()];
        for _ in 0..N_POSTURES {
            let q: Vec<f64> = ranges
                .iter()
                .map(|range| {
                    let [lower, upper] = range.map(|bound| bound.clamp(-UNLIMITED, UNLIMITED));
                    random.uniform(lower, upper)
                })
                .collect();
            for close in self.close_pairs(&body.capsules(&q)) {
                n_close[close.pair_ix] += 1;
            }
        }
        let is_always_close = |n: &u32| f64::from(*n) >= ALWAYS_CLOSE_FRAC * f64::from(N_POSTURES);
        let mut counts = n_close.iter();
        self.pairs
            .retain(|_| !counts.next().is_some_and(is_always_close));
    }

    fn drop_close_at(&mut self, body: &Body, free_posture: &[f64]) {
        let mut too_close: Vec<usize> = self
            .close_pairs(&body.capsules(free_posture))
            .iter()
            .filter(|pair| pair.gap.distance_m < self.config.stop_m)
            .map(|pair| pair.pair_ix)
            .collect();
        // From the end, so that the remaining indices stay valid.
        too_close.reverse();
        for pair_ix in too_close {
            let links = self
                .pairs
                .remove(pair_ix)
                .map(|ix| body.part(ix).link.as_str());
            self.notes.push(format!(
                "capsules around {} and {} overlap in the free posture and are not checked",
                links[0], links[1]
            ));
        }
        self.notes.sort();
        self.notes.dedup();
    }
}

/// All pairs of parts that move relative to each other, except neighbors.
fn moving_pairs(body: &Body) -> Vec<[usize; 2]> {
    let mut pairs = Vec::new();
    for a in 0..body.n_parts() {
        for b in a + 1..body.n_parts() {
            let frames = [body.part(a).frame_ix, body.part(b).frame_ix];
            if frames[0] != frames[1] && !body.are_adjacent(frames[0], frames[1]) {
                pairs.push([a, b]);
            }
        }
    }
    pairs
}
