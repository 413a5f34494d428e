//! Goals of operators: free ones, and goals inside and behind obstacles.

use super::surface_points::SurfacePoint;
use kinematics::inverse::{InverseSolver, Target};
use kinematics::{Chain, Transform};
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use numbers::random::Random;
use serde::Serialize;

/// How far a goal is behind the surface that a camera saw, meters. The closest are inside of thin
/// objects and just inside of thick ones.
const BEYOND_M: [f64; 2] = [0.01, 0.3];
/// Largest change of a joint from a posture of the tour, radians.
const MAX_CHANGE_RAD: f64 = 0.2;
/// Largest angle between the tip and the direction in which the camera saw the surface, radians.
const MAX_TILT_RAD: f64 = 0.5;
/// Number of random goals of which one must be within reach.
const MAX_TRIES: usize = 3000;

/// A kind of goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum GoalKind {
    /// Inside or behind what a camera has seen.
    Obstacle,
    /// A posture close to the tour that the page shows as reachable.
    Free,
}

impl GoalKind {
    /// All kinds.
    pub(super) const ALL: [Self; 2] = [Self::Obstacle, Self::Free];

    /// Description for tables.
    #[must_use]
    pub fn title(self) -> &'static str {
        match self {
            Self::Obstacle => "inside and behind obstacles",
            Self::Free => "free",
        }
    }
}

/// From where goals are chosen.
pub(super) struct Places {
    pub(super) surfaces: Vec<SurfacePoint>,
    pub(super) tour: Vec<Vec<f64>>,
}

/// Where the arm is, and how it is moved.
pub(super) struct Now<'a> {
    pub(super) chain: &'a Chain,
    pub(super) position: &'a [f64],
    /// Whether the page shows a posture as reachable.
    pub(super) is_free: &'a dyn Fn(&[f64]) -> bool,
}

impl Places {
    /// A goal for the tip that some posture of the arm reaches, whatever is in its way. `None` if
    /// no random goal was suitable.
    pub(super) fn choose(
        &self,
        kind: GoalKind,
        solver: &mut InverseSolver,
        now: &Now<'_>,
        random: &mut Random,
    ) -> Option<Transform> {
        (0..MAX_TRIES).find_map(|_| {
            let goal = match kind {
                GoalKind::Obstacle => self.beyond_surface(random)?,
                GoalKind::Free => self.near_tour(now.chain, random)?,
            };
            let posture = solver.solve(&Target::pose(goal), now.position).ok()?;
            (kind == GoalKind::Obstacle || (now.is_free)(&posture)).then_some(goal)
        })
    }

    /// The tip points in the direction in which the camera saw the surface, with a random tilt.
    fn beyond_surface(&self, random: &mut Random) -> Option<Transform> {
        let surface = self
            .surfaces
            .get(random.below(self.surfaces.len().max(1)))?;
        let beyond_m = random.uniform(BEYOND_M[0], BEYOND_M[1]);
        let at_m = surface.at_m + surface.seen_along * beyond_m;
        let up = if surface.seen_along.z.abs() > 0.9 {
            Vector3::x()
        } else {
            Vector3::z()
        };
        let along = Rotation3::face_towards(&surface.seen_along, &up);
        let mut angle = |most: f64| random.uniform(-most, most);
        let tilt = UnitQuaternion::from_euler_angles(
            angle(MAX_TILT_RAD),
            angle(MAX_TILT_RAD),
            angle(std::f64::consts::PI),
        );
        let rotation = UnitQuaternion::from_rotation_matrix(&along) * tilt;
        Some(Transform::from_parts(at_m.coords.into(), rotation))
    }

    fn near_tour(&self, chain: &Chain, random: &mut Random) -> Option<Transform> {
        let posture = self.tour.get(random.below(self.tour.len().max(1)))?;
        let joints = posture.iter().zip(chain.limits());
        let joints: Vec<f64> = joints
            .map(|(at, limit)| {
                let changed = at + random.uniform(-MAX_CHANGE_RAD, MAX_CHANGE_RAD);
                changed.clamp(limit.lower, limit.upper)
            })
            .collect();
        chain.forward(&joints).ok()
    }
}
