//! Where the base stands still: told by its own poses, looking back only, so that nothing has to wait for what comes later.

use kinematics::{Stamp, Transform};
use std::collections::VecDeque;

/// The base stands once it has stayed this long ...
const STILL_SECS: f64 = 0.5;
/// ... so near to one place, metres and radians.
const STILL_M: f64 = 0.005;
const STILL_RAD: f64 = 0.005;
/// Stands that are remembered: far more than any image waits.
const MOST_STANDS: usize = 64;

/// The stands of a base that walks, counted from 0.
#[derive(Debug, Default)]
pub(super) struct Standing {
    /// Since when the base is near this place.
    still: Option<(Stamp, Transform)>,
    /// Whether the newest stand is the one of that place.
    is_known: bool,
    stands: VecDeque<Span>,
}

#[derive(Clone, Copy, Debug)]
struct Span {
    stand: usize,
    from: Stamp,
    to: Stamp,
}

impl Standing {
    /// Takes the next pose of the base.
    pub(super) fn push(&mut self, stamp: Stamp, world_from_base: &Transform) {
        let Some((since, _)) = self.still.filter(|(_, place)| is_near(place, world_from_base)) else {
            (self.still, self.is_known) = (Some((stamp, *world_from_base)), false);
            return;
        };
        if stamp.secs_since(since) < STILL_SECS {
            return;
        }
        if !std::mem::replace(&mut self.is_known, true) {
            let stand = self.stands.back().map_or(0, |last| last.stand + 1);
            self.stands.push_back(Span { stand, from: stamp, to: stamp });
            if self.stands.len() > MOST_STANDS {
                self.stands.pop_front();
            }
        }
        if let Some(span) = self.stands.back_mut() {
            span.to = stamp;
        }
    }

    /// Which stand it was at a stamp no later than the newest pose; `None` while the base walked or had just come to rest.
    pub(super) fn at(&self, stamp: Stamp) -> Option<usize> {
        let span = self.stands.iter().rev().find(|span| span.from <= stamp)?;
        (stamp <= span.to).then_some(span.stand)
    }
}

fn is_near(place: &Transform, other: &Transform) -> bool {
    // A pose that is no number is near nothing.
    (place.translation.vector - other.translation.vector).norm() <= STILL_M
        && place.rotation.angle_to(&other.rotation) <= STILL_RAD
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_stand_begins_when_the_base_was_still_for_a_while_and_ends_when_it_moves() {
        // Stands 2 s, walks 1 m within 2 s, stands and turns on the spot, stands.
        let pose = |secs: f64| {
            let x = (0.5 * (secs - 2.0)).clamp(0.0, 1.0);
            let turn = (0.3 * (secs - 6.0)).clamp(0.0, 0.3);
            let sway = 0.001 * (20.0 * secs).sin();
            Transform::new(Vector3::new(x, sway, 0.0), Vector3::new(0.0, 0.0, turn))
        };
        let mut standing = Standing::default();
        let mut told = Vec::new();
        for tick in 0..1000 {
            let stamp = Stamp::from_secs(0.01 * f64::from(tick));
            standing.push(stamp, &pose(0.01 * f64::from(tick)));
            told.push((stamp, standing.at(stamp)));
        }
        let at = |secs: f64| standing.at(Stamp::from_secs(secs));
        assert_eq!(
            [0.4, 0.6, 1.9, 2.1, 3.0, 4.3, 4.7, 5.9, 6.1, 7.7].map(at),
            [None, Some(0), Some(0), None, None, None, Some(1), Some(1), None, Some(2)]
        );
        assert_eq!(at(20.0), None, "nothing is known of later");
        // What was told at once is what is told later.
        assert!(told.iter().all(|(stamp, stand)| standing.at(*stamp) == *stand));
    }

    #[test]
    fn a_slow_walk_and_poses_that_are_no_numbers_are_no_stand() {
        let mut standing = Standing::default();
        for tick in 0..500 {
            let creeping = Transform::translation(0.02 * 0.01 * f64::from(tick), 0.0, 0.0);
            standing.push(Stamp::from_secs(0.01 * f64::from(tick)), &creeping);
        }
        let broken = Transform::translation(f64::NAN, 0.0, 0.0);
        for tick in 500..700 {
            standing.push(Stamp::from_secs(0.01 * f64::from(tick)), &broken);
        }
        assert!((0..700).all(|tick| standing.at(Stamp::from_secs(0.01 * f64::from(tick))).is_none()));
    }
}
