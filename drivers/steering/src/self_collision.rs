//! Fourth link: parts of the robot keep a distance from each other.

use crate::body::Body;
use crate::capsule::{Capsule, Gap};
use crate::error::Error;
use crate::ramp::{check_ramp, speed_scale};
use crate::reason::Reason;
use numbers::random::Random;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

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

/// How much closer than at the start a pair may come that was too close there: positions are
/// rounded, and joints at rest vibrate.
const START_TOLERANCE_M: f64 = 1e-3;

/// The pairs of parts that must not touch.
#[derive(Clone, Debug)]
pub struct SelfCollision {
    config: SelfCollisionConfig,
    pairs: Vec<Pair>,
    notes: Vec<String>,
}

/// Two parts that are checked.
#[derive(Clone, Copy, Debug)]
struct Pair {
    part_ixs: [usize; 2],
    /// Distance in the free posture, if it is below the stop distance.
    start_m: Option<f64>,
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
    /// * `free_posture`: a posture in which no parts touch, if one is known, such as the posture at
    ///   the start. Parts whose capsules are too close there may not come closer than that.
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
            selected.keep_distances_at(body, free_posture);
        }
        Ok(selected)
    }

    /// One sentence for each pair of links that is closer than the stop distance in the free
    /// posture.
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
        for (pair_ix, pair) in self.pairs.iter().enumerate() {
            let [a, b] = pair.part_ixs;
            let gap = capsules[a].gap(&capsules[b]);
            // Written so that NaN counts as close.
            let is_far = gap.distance_m >= self.config.slow_m;
            if !is_far {
                close.push(ClosePair { pair_ix, gap });
            }
        }
        close
    }

    /// Speed as a fraction of full speed, with its reason if it is less. Pairs that are too close
    /// in the free posture do not count: the arm would be slow wherever it works.
    pub(crate) fn speed(&self, here: &[ClosePair], body: &Body) -> (f64, Option<Reason>) {
        let nearest = here
            .iter()
            .filter(|close| self.pairs[close.pair_ix].start_m.is_none())
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
            let is_free = pair.gap.distance_m >= self.stop_m(pair);
            let is_leaving = pair.gap.distance_m >= before_m;
            !is_free && !is_leaving
        });
        refused.map(|pair| self.reason(pair, body))
    }

    /// Distance below which the parts of a pair may not approach each other.
    fn stop_m(&self, close: &ClosePair) -> f64 {
        let start_m = self.pairs[close.pair_ix].start_m;
        start_m.map_or(self.config.stop_m, |start_m| start_m - START_TOLERANCE_M)
    }

    fn reason(&self, pair: &ClosePair, body: &Body) -> Reason {
        Reason::SelfCollision {
            parts: self.pairs[pair.pair_ix]
                .part_ixs
                .map(|part_ix| body.part(part_ix).link.clone()),
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

    /// Keeps the distances of pairs that are too close in the free posture.
    fn keep_distances_at(&mut self, body: &Body, free_posture: &[f64]) {
        // A link may have several capsules, and gets one note.
        let mut nearest: BTreeMap<[&str; 2], f64> = BTreeMap::new();
        for close in self.close_pairs(&body.capsules(free_posture)) {
            let distance_m = close.gap.distance_m;
            // Written so that NaN counts as too close. No distance is then free.
            let is_far = distance_m >= self.config.stop_m;
            if is_far {
                continue;
            }
            let pair = &mut self.pairs[close.pair_ix];
            pair.start_m = Some(distance_m);
            let links = pair.part_ixs.map(|ix| body.part(ix).link.as_str());
            let least_m = nearest.entry(links).or_insert(distance_m);
            *least_m = least_m.min(distance_m);
        }
        let note = |([a, b], distance_m): (&[&str; 2], &f64)| {
            let millimeters = 1000.0 * distance_m;
            format!(
                "{a} and {b}, or the capsules around them, are {millimeters:.0} mm apart at the \
                 start: they cannot come closer"
            )
        };
        self.notes = nearest.iter().map(note).collect();
    }
}

/// All pairs of parts that move relative to each other, except neighbors.
fn moving_pairs(body: &Body) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for a in 0..body.n_parts() {
        for b in a + 1..body.n_parts() {
            let frames = [body.part(a).frame_ix, body.part(b).frame_ix];
            if frames[0] != frames[1] && !body.are_adjacent(frames[0], frames[1]) {
                pairs.push(Pair {
                    part_ixs: [a, b],
                    start_m: None,
                });
            }
        }
    }
    pairs
}
