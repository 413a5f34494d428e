//! Fifth link of a base: it stops before surfaces and before space that was never seen.
//!
//! The footprint is moved along the way that the base would take, in steps that are shorter than
//! the distance to everything that is not free. The result, a [`Room`], is an input of the
//! decision, so that records contain it instead of the map.

use crate::base_footprint::Footprint;
use crate::base_verdict::SeenPose;
use crate::clearance::{ClearanceConfig, Seen, rounded_down_m, rounded_up_secs};
use crate::error::Error;
use crate::reason::Reason;
use drivers::base_motion::{BaseLimits, BaseVelocity};
use serde::{Deserialize, Serialize};

/// What the map of free space returns for places in the world, meters; `None` where nothing was seen.
type Readings<'a> = dyn FnMut(&[[f64; 3]]) -> Vec<Option<Seen>> + 'a;

/// Time from a decision until the base follows it, seconds: the transmission of the command, a cycle
/// of the thread of the base, and the reaction of its controller. With the age of the pose, this is
/// the time during which the base does not slow down.
pub(crate) const RESPONSE_SECS: f64 = 0.25;
/// Smallest and largest step along a way, meters. The smallest one is a voxel of common maps.
const MIN_STEP_M: f64 = 0.02;
const MAX_STEP_M: f64 = 0.2;
/// A distance that shrinks by less in a step does not approach anything, meters.
const PARALLEL_M: f64 = 1e-3;
/// Speed below which the measured velocity is noise, m/s.
const NOISE_M_S: f64 = 0.02;
/// The base is too fast toward an obstacle if its measured speed is this many times the permitted
/// one, and the noise above it.
const TOO_FAST: f64 = 1.05;
/// Excess of the measured speed over the one from which the base can just brake in time, m/s. Below
/// it, the base slows down as usual: distances have steps of a voxel.
const BRAKE_EXCESS_M_S: f64 = 0.05;
/// The base in the sentences of reasons.
const PART: &str = "the base";

/// How a base keeps away from the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseClearanceConfig {
    /// The space that the base occupies.
    pub footprint: Footprint,
    /// Distances from surfaces, and ages.
    pub distances: ClearanceConfig,
    /// Whether space that was never seen counts as free.
    pub is_unseen_free: bool,
}

impl BaseClearanceConfig {
    /// The defaults, with a footprint.
    pub fn new(footprint: Footprint) -> Self {
        Self {
            footprint,
            distances: ClearanceConfig {
                stop_m: 0.03,
                // With the radius of the spheres and the growth with age, this stays within the
                // distances that maps report.
                slow_m: 0.13,
                creep_frac: 0.2,
                ..ClearanceConfig::default()
            },
            is_unseen_free: false,
        }
    }
}

/// What is known along a way of a base.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Room {
    /// The first obstacle; `None` if the base can stop before everything that is not free.
    obstacle: Option<Obstacle>,
    /// What slows the base down most.
    slow: Option<Slow>,
}

/// Where a way ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Obstacle {
    /// Free way of the fastest point of the footprint, meters.
    free_m: f64,
    /// What is known there; `None` if it was never seen.
    seen: Option<Seen>,
    /// A point in the world.
    place: [f64; 3],
}

/// A reading because of which the base is slower.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Slow {
    seen: Seen,
    place: [f64; 3],
}

/// A way whose room is wanted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Way<'a> {
    pub(crate) pose: &'a SeenPose,
    pub(crate) velocity: &'a BaseVelocity,
    pub(crate) limits: &'a BaseLimits,
    /// Time during which the base does not slow down.
    pub(crate) reaction_secs: f64,
}

/// Returns the room along a way.
pub(crate) type RoomLook<'a> = dyn FnMut(&Way<'_>) -> Room + 'a;

/// The decision of this link.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Passage {
    /// Nothing is near.
    Free,
    /// The velocity is multiplied by a factor, 0 to 1.
    Slowed(f64, Reason),
    /// The base cannot stop in time with its ordinary deceleration.
    TooFast(Reason),
}

/// Walls of a base, and the rules of their distances.
#[derive(Clone, Debug)]
pub(crate) struct BaseClearance {
    config: BaseClearanceConfig,
    points: Vec<[f64; 3]>,
    radius_m: f64,
    reach_m: f64,
}

/// What is known about a point of a wall.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Known {
    /// The base itself is there.
    Own,
    Never,
    /// The distance is that of the wall.
    Seen(Seen),
}

impl BaseClearance {
    /// # Errors
    /// If a value of the configuration is out of its range.
    pub(crate) fn new(config: BaseClearanceConfig) -> Result<Self, Error> {
        config.distances.check()?;
        // A record may be damaged.
        let footprint =
            Footprint::of_points(config.footprint.outline_m(), config.footprint.height_m())?;
        let (points, radius_m) = footprint.wall_points();
        Ok(Self {
            config,
            points,
            radius_m,
            reach_m: footprint.radius_m(),
        })
    }

    /// The room along a way.
    ///
    /// * `readings`: what is known about points in the frame of the base link.
    pub(crate) fn room(&self, way: &Way<'_>, readings: &mut Readings<'_>) -> Room {
        let mut room = Room::default();
        let speed_m_s = self.speed_m_s(way.velocity);
        if speed_m_s <= 0.0 {
            return room;
        }
        let end_m = self.stop_m(way) + MIN_STEP_M;
        let mut before: Vec<Known> = Vec::new();
        let (mut at_m, mut last_m) = (0.0, 0.0);
        loop {
            let moved = self.moved(way.velocity, at_m / speed_m_s);
            let known = self.known(&moved, readings);
            self.note_slowest(way, &moved, &known, at_m == 0.0, &mut room);
            let blocked = |(ix, now): (usize, &Known)| {
                let is_blocked = match (before.get(ix), now) {
                    (None, _) | (_, Known::Own) => false,
                    (Some(_), Known::Never) => !self.config.is_unseen_free,
                    (Some(Known::Seen(before)), Known::Seen(now)) => {
                        self.missing_m(now) > 0.0 && now.distance_m < before.distance_m - PARALLEL_M
                    }
                    // A base may leave space that was never seen.
                    (Some(Known::Own | Known::Never), Known::Seen(_)) => false,
                };
                is_blocked.then_some(ix)
            };
            if let Some(ix) = known.iter().enumerate().find_map(blocked) {
                // The point was free, and is still free for as long as its distance is not used up.
                let left_m = match &before[ix] {
                    Known::Seen(seen) => -self.missing_m(seen),
                    Known::Own | Known::Never => 0.0,
                };
                room.obstacle = Some(Obstacle {
                    free_m: rounded_down_m(last_m + left_m.clamp(0.0, at_m - last_m)),
                    seen: match known[ix] {
                        Known::Seen(seen) => Some(seen),
                        Known::Own | Known::Never => None,
                    },
                    place: in_world(way.pose, moved[ix]),
                });
                return room;
            }
            if at_m >= end_m {
                return room;
            }
            last_m = at_m;
            at_m += self.step_m(&known);
            before = known;
        }
    }

    /// The largest part of a velocity with which the base can stop in time.
    ///
    /// * `way`: the way at the wanted velocity.
    /// * `measured`: the velocity that the base has.
    pub(crate) fn passage(
        &self,
        way: &Way<'_>,
        measured: &BaseVelocity,
        look: &mut RoomLook<'_>,
    ) -> Passage {
        let wanted = way.velocity;
        let way = Way {
            velocity: measured,
            ..*way
        };
        let measured_m_s = self.speed_m_s(measured);
        if measured_m_s > NOISE_M_S
            && let Some(obstacle) = look(&way).obstacle
        {
            let brake = way.limits.brake_m_s2 / way.limits.acceleration_m_s2;
            let permitted_m_s = self.stoppable_m_s(&way, obstacle.free_m, 1.0);
            let in_time_m_s = self.stoppable_m_s(&way, obstacle.free_m, brake);
            let reason = self.reason(obstacle.seen, obstacle.place);
            if measured_m_s > TOO_FAST * in_time_m_s + BRAKE_EXCESS_M_S {
                return Passage::TooFast(reason);
            }
            if measured_m_s > TOO_FAST * permitted_m_s + NOISE_M_S {
                return Passage::Slowed(0.0, reason);
            }
        }
        let wanted_m_s = self.speed_m_s(wanted);
        if wanted_m_s <= 0.0 {
            return Passage::Free;
        }
        let way = Way {
            velocity: wanted,
            ..way
        };
        let room = look(&way);
        let mut scale = 1.0;
        let mut slowest = None;
        if let Some(slow) = &room.slow {
            scale = self.config.distances.scale_of(slow.seen);
            slowest = Some((Some(slow.seen), slow.place));
        }
        if let Some(obstacle) = &room.obstacle {
            let permitted_m_s = self.stoppable_m_s(&way, obstacle.free_m, 1.0);
            if permitted_m_s < scale * wanted_m_s {
                scale = permitted_m_s / wanted_m_s;
                slowest = Some((obstacle.seen, obstacle.place));
            }
        }
        match slowest {
            Some((seen, place)) if scale < 1.0 => Passage::Slowed(scale, self.reason(seen, place)),
            _ => Passage::Free,
        }
    }

    /// Upper bound of the speed of all points of the footprint.
    fn speed_m_s(&self, velocity: &BaseVelocity) -> f64 {
        velocity.speed_m_s() + velocity.yaw_rad_s.abs() * self.reach_m
    }

    /// Deceleration of the fastest point if all parts of a velocity end at the same time.
    fn deceleration_m_s2(&self, way: &Way<'_>) -> f64 {
        let Way {
            velocity, limits, ..
        } = way;
        let straight_secs = velocity.speed_m_s() / limits.acceleration_m_s2;
        let turn_secs = velocity.yaw_rad_s.abs() / limits.yaw_acceleration_rad_s2;
        self.speed_m_s(velocity) / straight_secs.max(turn_secs)
    }

    /// Largest speed of the fastest point that still permits a stop within a distance.
    ///
    /// * `factor`: of the deceleration.
    fn stoppable_m_s(&self, way: &Way<'_>, free_m: f64, factor: f64) -> f64 {
        let deceleration_m_s2 = factor * self.deceleration_m_s2(way);
        stoppable_m_s(free_m, deceleration_m_s2, way.reaction_secs)
    }

    /// Distance in which the fastest point stops.
    fn stop_m(&self, way: &Way<'_>) -> f64 {
        let speed_m_s = self.speed_m_s(way.velocity);
        way.reaction_secs * speed_m_s + speed_m_s * speed_m_s / (2.0 * self.deceleration_m_s2(way))
    }

    /// The points after a time, in the frame of the base link now.
    fn moved(&self, velocity: &BaseVelocity, secs: f64) -> Vec<[f64; 3]> {
        let turned = velocity.yaw_rad_s * secs;
        let (sin, cos) = turned.sin_cos();
        // The way at a constant velocity is an arc, whose chord points in the direction at half of
        // the turn. The chord is shorter than the arc by the sinc of half of the turn.
        let half = 0.5 * turned;
        let sinc = if half.abs() < 1e-6 {
            1.0
        } else {
            half.sin() / half
        };
        let (half_sin, half_cos) = half.sin_cos();
        let forward_m = velocity.forward_m_s * secs * sinc;
        let left_m = velocity.left_m_s * secs * sinc;
        let x_m = forward_m * half_cos - left_m * half_sin;
        let y_m = forward_m * half_sin + left_m * half_cos;
        let place = |[x, y, z]: &[f64; 3]| [x_m + x * cos - y * sin, y_m + x * sin + y * cos, *z];
        self.points.iter().map(place).collect()
    }

    fn known(&self, moved: &[[f64; 3]], readings: &mut Readings<'_>) -> Vec<Known> {
        let read = readings(moved);
        let known = |(ix, point): (usize, &[f64; 3])| {
            let seen = read.get(ix).copied().flatten();
            // Ages and distances that are not numbers are not knowledge.
            let seen = seen.filter(|seen| seen.age_secs >= 0.0 && !seen.distance_m.is_nan());
            match seen {
                _ if self.config.footprint.contains([point[0], point[1]]) && seen.is_none() => {
                    Known::Own
                }
                None => Known::Never,
                Some(seen) => Known::Seen(Seen {
                    // JSON has no infinity.
                    distance_m: rounded_down_m((seen.distance_m - self.radius_m).clamp(-1e3, 1e3)),
                    age_secs: rounded_up_secs(seen.age_secs.min(1e9)),
                }),
            }
        };
        moved.iter().enumerate().map(known).collect()
    }

    /// How much a distance is too small, meters.
    fn missing_m(&self, seen: &Seen) -> f64 {
        let distances = &self.config.distances;
        distances.stop_m + distances.growth_m(seen.age_secs) - seen.distance_m
    }

    /// A step in which no point comes closer to anything than permitted.
    fn step_m(&self, known: &[Known]) -> f64 {
        let left_m = known.iter().map(|known| match known {
            Known::Seen(seen) => -self.missing_m(seen),
            Known::Own | Known::Never => 0.0,
        });
        // Points of the base itself, and those close to a surface beside the way, need short steps.
        left_m
            .fold(MAX_STEP_M, f64::min)
            .clamp(MIN_STEP_M, MAX_STEP_M)
    }

    /// Notes the reading that slows the base down most: near surfaces where the base is, and old
    /// readings along the whole way.
    fn note_slowest(
        &self,
        way: &Way<'_>,
        moved: &[[f64; 3]],
        known: &[Known],
        is_here: bool,
        room: &mut Room,
    ) {
        let scale_of = |slow: &Slow| self.config.distances.scale_of(slow.seen);
        for (point, known) in moved.iter().zip(known) {
            let Known::Seen(seen) = known else {
                continue;
            };
            let seen = Seen {
                // Farther along the way, the distance decides where the way ends.
                distance_m: if is_here { seen.distance_m } else { 1e3 },
                ..*seen
            };
            let slow = Slow {
                seen,
                place: in_world(way.pose, *point),
            };
            let scale = scale_of(&slow);
            if scale < room.slow.as_ref().map_or(1.0, scale_of) {
                room.slow = Some(slow);
            }
        }
    }

    fn reason(&self, seen: Option<Seen>, place: [f64; 3]) -> Reason {
        let part = PART.to_owned();
        match seen {
            None => Reason::NeverSeen { part, place },
            Some(seen) if self.config.distances.is_far(&seen) => Reason::LongUnseen {
                part,
                age_secs: seen.age_secs,
                place,
            },
            // The map does not distinguish surfaces from unseen space in its distances.
            Some(seen) => Reason::BaseNear {
                distance_m: seen.distance_m,
                place,
            },
        }
    }
}

/// A point in the frame of the base link, in the world.
fn in_world(seen: &SeenPose, [x, y, z]: [f64; 3]) -> [f64; 3] {
    let pose = &seen.pose;
    let (sin, cos) = pose.yaw_rad.sin_cos();
    let millimeters = |x: f64| (x * 1e3).round() / 1e3;
    [
        pose.x_m + x * cos - y * sin,
        pose.y_m + x * sin + y * cos,
        seen.z_m + z,
    ]
    .map(millimeters)
}

/// Largest speed that still permits a stop within a distance, after the reaction time: the positive
/// solution of `distance = reaction * speed + speed^2 / (2 * deceleration)`.
pub(crate) fn stoppable_m_s(distance_m: f64, deceleration_m_s2: f64, reaction_secs: f64) -> f64 {
    if distance_m <= 0.0 {
        return 0.0;
    }
    let reaction = deceleration_m_s2 * reaction_secs;
    (reaction * reaction + 2.0 * deceleration_m_s2 * distance_m).sqrt() - reaction
}
