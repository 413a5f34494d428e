//! Histories of joints and base poses. They interpolate between readings and never extrapolate.

use crate::{JointState, Stamp, Transform, Twist, transform};
use std::collections::VecDeque;
use std::time::Duration;

/// Reason why a history has no value for a stamp, or dropped a reading.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HistoryError {
    /// The newest reading is older than the stamp. Retry after more readings have arrived.
    #[error("no reading at or after the requested stamp yet{}", .newest.map(|newest| behind(newest, *.requested)).unwrap_or_default())]
    NotYet {
        /// Stamp of the newest reading. `None` if the history is empty.
        newest: Option<Stamp>,
        /// Requested stamp.
        requested: Stamp,
    },
    /// The stamp is before the oldest stored reading. Retrying does not help.
    #[error("the requested stamp is {:.3} s before the oldest reading kept", .oldest.secs_since(*.requested))]
    TooOld {
        /// The oldest reading kept.
        oldest: Stamp,
        /// Requested stamp.
        requested: Stamp,
    },
    /// The readings around the stamp are too far apart to interpolate. Retrying does not help.
    #[error("readings are missing for {:.1} ms around the requested stamp (at most {:.1} ms)", .after.secs_since(*.before) * 1e3, .max_gap.as_secs_f64() * 1e3)]
    Gap {
        /// The last reading before the stamp.
        before: Stamp,
        /// The first reading after the stamp.
        after: Stamp,
        /// Longest gap allowed.
        max_gap: Duration,
    },
    /// A pushed reading was dropped because it was not later than the newest reading.
    #[error("reading is {:.3} ms older than the newest one, dropped", .newest.secs_since(*.pushed) * 1e3)]
    OutOfOrder {
        /// The newest reading kept.
        newest: Stamp,
        /// Stamp of the dropped reading.
        pushed: Stamp,
    },
    /// A pushed reading was dropped because it contained NaN or infinity.
    #[error("reading contains a non-finite value, dropped")]
    NotFinite,
    /// A pushed reading was dropped because it had a different number of joints than earlier
    /// readings.
    #[error("reading has {got} joints, earlier readings had {expected}; dropped")]
    JointCount {
        /// Number of joints in the reading.
        got: usize,
        /// Number of joints in earlier readings.
        expected: usize,
    },
}

fn behind(newest: Stamp, requested: Stamp) -> String {
    format!(
        " (the newest is {:.1} ms older)",
        requested.secs_since(newest) * 1e3
    )
}

/// Stamped readings in order. If the capacity is exceeded, the oldest reading is dropped.
#[derive(Clone, Debug)]
struct Readings<T> {
    max_gap: Duration,
    capacity: usize,
    buffer: VecDeque<(Stamp, T)>,
    n_rejected: u64,
}

/// Two neighboring readings and the position of the stamp between them, from 0 to 1. If the
/// position is 0 or 1, the stamp coincides with a reading. If that reading has no neighbor within
/// `max_gap`, both entries are that reading.
struct Bracket<'a, T> {
    before: (Stamp, &'a T),
    after: (Stamp, &'a T),
    frac: f64,
}

impl<T> Readings<T> {
    fn new(max_gap: Duration, capacity: usize) -> Self {
        Self {
            max_gap,
            // Nothing can be interpolated with fewer than two readings.
            capacity: capacity.max(2),
            buffer: VecDeque::new(),
            n_rejected: 0,
        }
    }

    fn push(&mut self, stamp: Stamp, reading: T) -> Result<(), HistoryError> {
        // Readings must be in order, because stamps are searched by bisection. Two equal stamps
        // would also give an interval of length zero, and `around` divides by this length.
        if let Some(&(newest, _)) = self.buffer.back()
            && stamp <= newest
        {
            return self.reject(HistoryError::OutOfOrder {
                newest,
                pushed: stamp,
            });
        }
        // The capacity bounds the memory of a long run.
        if self.buffer.len() == self.capacity {
            self.buffer.pop_front();
        }
        self.buffer.push_back((stamp, reading));
        Ok(())
    }

    fn reject(&mut self, why: HistoryError) -> Result<(), HistoryError> {
        self.n_rejected += 1;
        Err(why)
    }

    /// The readings between which a stamp lies.
    fn around(&self, requested: Stamp) -> Result<Bracket<'_, T>, HistoryError> {
        let (Some((oldest, _)), Some((newest, _))) = (self.buffer.front(), self.buffer.back())
        else {
            return Err(HistoryError::NotYet {
                newest: None,
                requested,
            });
        };
        // Extrapolation could place a camera where it never was, so the caller has to wait.
        if requested > *newest {
            return Err(HistoryError::NotYet {
                newest: Some(*newest),
                requested,
            });
        }
        if requested < *oldest {
            return Err(HistoryError::TooOld {
                oldest: *oldest,
                requested,
            });
        }
        let after_ix = self.buffer.partition_point(|(stamp, _)| *stamp < requested);
        let after = self
            .reading(after_ix)
            .expect("the newest reading is not before the stamp");
        let before = after_ix.checked_sub(1).and_then(|ix| self.reading(ix));
        if after.0 == requested {
            return Ok(self.around_reading(after_ix, before, after));
        }
        let before = before.expect("the oldest reading is not after the stamp");
        // The motion between readings that are far apart is unknown, because a device may have been
        // disconnected while the arm moved.
        if !self.is_near(before.0, after.0) {
            return Err(HistoryError::Gap {
                before: before.0,
                after: after.0,
                max_gap: self.max_gap,
            });
        }
        let frac = requested.secs_since(before.0) / after.0.secs_since(before.0);
        Ok(Bracket {
            before,
            after,
            frac,
        })
    }

    /// The bracket of a stamp that is equal to the stamp of a reading. It exists even if both
    /// neighbors are too far away, because nothing has to be interpolated. A neighbor is included
    /// if possible, because callers derive velocities from it. The earlier neighbor is preferred,
    /// because the result then does not depend on whether the next reading has arrived yet.
    ///
    /// * `before`: the reading before `reading`, if any.
    fn around_reading<'a>(
        &'a self,
        reading_ix: usize,
        before: Option<(Stamp, &'a T)>,
        reading: (Stamp, &'a T),
    ) -> Bracket<'a, T> {
        match (before, self.reading(reading_ix + 1)) {
            (Some(before), _) if self.is_near(before.0, reading.0) => Bracket {
                before,
                after: reading,
                frac: 1.0,
            },
            (_, Some(next)) if self.is_near(reading.0, next.0) => Bracket {
                before: reading,
                after: next,
                frac: 0.0,
            },
            _ => Bracket {
                before: reading,
                after: reading,
                frac: 0.0,
            },
        }
    }

    fn reading(&self, ix: usize) -> Option<(Stamp, &T)> {
        self.buffer
            .get(ix)
            .map(|(stamp, reading)| (*stamp, reading))
    }

    /// Whether two readings are close enough to interpolate between them.
    fn is_near(&self, a: Stamp, b: Stamp) -> bool {
        b.duration_since(a) <= self.max_gap
    }

    fn newest(&self) -> Option<Stamp> {
        self.buffer.back().map(|(stamp, _)| *stamp)
    }

    fn oldest(&self) -> Option<Stamp> {
        self.buffer.front().map(|(stamp, _)| *stamp)
    }
}

/// Recent joint readings of one arm.
///
/// ```
/// use kinematics::{JointHistory, JointState, Stamp};
/// use std::time::Duration;
///
/// let mut history = JointHistory::new(Duration::from_millis(50), 1000);
/// for (millis, position_rad) in [(0, 0.0), (10, 0.1), (20, 0.2)] {
///     let stamp = Stamp(millis * 1_000_000);
///     history.push(JointState { stamp, position: vec![position_rad], velocity: Vec::new(), effort: Vec::new() })?;
/// }
/// let at_shutter = history.at(Stamp(15_000_000))?;
/// assert!((at_shutter.position[0] - 0.15).abs() < 1e-9);
/// assert!(history.at(Stamp(30_000_000)).is_err(), "histories never extrapolate");
/// # Ok::<(), kinematics::HistoryError>(())
/// ```
#[derive(Clone, Debug)]
pub struct JointHistory {
    readings: Readings<JointState>,
}

impl JointHistory {
    /// Creates a history that keeps the newest `capacity` readings (at least 2) and interpolates
    /// between neighbors at most `max_gap` apart.
    pub fn new(max_gap: Duration, capacity: usize) -> Self {
        Self {
            readings: Readings::new(max_gap, capacity),
        }
    }

    /// Adds a reading. A reading that is invalid or not later than all stored readings is dropped
    /// and counted, and an error is returned.
    pub fn push(&mut self, state: JointState) -> Result<(), HistoryError> {
        let mut numbers = state
            .position
            .iter()
            .chain(&state.velocity)
            .chain(&state.effort);
        if !numbers.all(|number| number.is_finite()) {
            return self.readings.reject(HistoryError::NotFinite);
        }
        // A different number of joints comes from another device or a faulty message. It must be
        // rejected, because interpolation pairs joints by index.
        if let Some((_, last)) = self.readings.buffer.back()
            && last.position.len() != state.position.len()
        {
            let expected = last.position.len();
            return self.readings.reject(HistoryError::JointCount {
                got: state.position.len(),
                expected,
            });
        }
        self.readings.push(state.stamp, state)
    }

    /// The joints at a stamp.
    ///
    /// Positions follow the cubic polynomial through the positions and velocities of both
    /// neighbors. If the device does not report velocities, positions follow a line. Velocities are
    /// the derivative of this curve. Efforts are interpolated linearly. At the stamp of a reading,
    /// this reading is returned unchanged. If it has no velocities, the slope of the line to a
    /// neighbor is returned as its velocity.
    pub fn at(&self, stamp: Stamp) -> Result<JointState, HistoryError> {
        let Bracket {
            before: (before, a),
            after: (after, b),
            frac,
        } = self.readings.around(stamp)?;
        let span_secs = after.secs_since(before);
        let n_joints = a.position.len();
        let has_velocities = |state: &JointState| state.velocity.len() == n_joints;
        // A reading is returned bit for bit. The cubic polynomial would round its values.
        if frac == 0.0 || frac == 1.0 {
            let mut at_reading = if frac == 0.0 { a.clone() } else { b.clone() };
            if !has_velocities(&at_reading) && before < after {
                at_reading.velocity = a
                    .position
                    .iter()
                    .zip(&b.position)
                    .map(|(from, to)| (to - from) / span_secs)
                    .collect();
            }
            return Ok(at_reading);
        }
        // The cubic needs velocities. It is more accurate than the line when the arm accelerates
        // between readings. If only one of the two readings has velocities, the line is used.
        let is_cubic = has_velocities(a) && has_velocities(b);
        let (position, velocity) = (0..n_joints)
            .map(|joint| {
                let from = a.position[joint];
                let to = b.position[joint];
                if is_cubic {
                    let velocities = [a.velocity[joint], b.velocity[joint]];
                    hermite([from, to], velocities, span_secs, frac)
                } else {
                    (from + (to - from) * frac, (to - from) / span_secs)
                }
            })
            .unzip();
        let effort = a
            .effort
            .iter()
            .zip(&b.effort)
            .map(|(from, to)| from + (to - from) * frac)
            .collect();
        Ok(JointState {
            stamp,
            position,
            velocity,
            effort,
        })
    }

    /// Stamp of the newest reading.
    pub fn newest(&self) -> Option<Stamp> {
        self.readings.newest()
    }

    /// Stamp of the oldest reading kept.
    pub fn oldest(&self) -> Option<Stamp> {
        self.readings.oldest()
    }

    /// Number of readings dropped because they were out of order or invalid.
    pub fn n_rejected(&self) -> u64 {
        self.readings.n_rejected
    }

    /// Removes all readings, for a device whose clock restarted.
    pub fn clear(&mut self) {
        self.readings.buffer.clear();
    }
}

/// Position and velocity at `frac` (0 to 1) on the cubic with the given end positions and end
/// velocities.
fn hermite([p0, p1]: [f64; 2], [v0, v1]: [f64; 2], span_secs: f64, frac: f64) -> (f64, f64) {
    // The coefficients of `p0 + m0 f + second f² + third f³`, from the conditions at both ends.
    // Velocities are scaled to the span first, because the curve is a function of `frac`.
    let m0 = v0 * span_secs;
    let m1 = v1 * span_secs;
    let rise = p1 - p0;
    let second = 3.0 * rise - 2.0 * m0 - m1;
    let third = m0 + m1 - 2.0 * rise;
    let position = p0 + frac * (m0 + frac * (second + frac * third));
    let slope = m0 + frac * (2.0 * second + frac * 3.0 * third);
    (position, slope / span_secs)
}

/// Recent poses of one body.
#[derive(Clone, Debug)]
pub struct PoseHistory {
    readings: Readings<Transform>,
}

impl PoseHistory {
    /// Creates a history that keeps the newest `capacity` poses (at least 2) and interpolates
    /// between neighbors at most `max_gap` apart.
    pub fn new(max_gap: Duration, capacity: usize) -> Self {
        Self {
            readings: Readings::new(max_gap, capacity),
        }
    }

    /// Adds a pose. A pose that is not finite or not later than all stored poses is dropped and
    /// counted, and an error is returned.
    pub fn push(&mut self, stamp: Stamp, pose: Transform) -> Result<(), HistoryError> {
        let finite = transform::to_rows(&pose)
            .iter()
            .all(|number| number.is_finite());
        if !finite {
            return self.readings.reject(HistoryError::NotFinite);
        }
        self.readings.push(stamp, pose)
    }

    /// The pose at a stamp, by [`transform::interpolate`].
    pub fn at(&self, stamp: Stamp) -> Result<Transform, HistoryError> {
        let Bracket {
            before: (_, a),
            after: (_, b),
            frac,
        } = self.readings.around(stamp)?;
        Ok(match frac {
            0.0 => *a,
            1.0 => *b,
            _ => transform::interpolate(a, b, frac),
        })
    }

    /// The pose and velocity at a stamp. The velocity is assumed to be constant between neighboring
    /// poses. It is expressed in the body frame at the stamp. It is zero if the pose has no
    /// neighbor within the allowed gap.
    pub fn with_twist_at(&self, stamp: Stamp) -> Result<(Transform, Twist), HistoryError> {
        let Bracket {
            before: (before, a),
            after: (after, b),
            ..
        } = self.readings.around(stamp)?;
        let pose = self.at(stamp)?;
        let span_secs = after.secs_since(before);
        // Both entries are the same reading, because the reading has no neighbor. The velocity is
        // therefore unknown, and zero is returned.
        if span_secs <= 0.0 {
            return Ok((pose, Twist::zero()));
        }
        // The velocity matches the motion of `transform::interpolate`, in which the position moves
        // along a line and the rotation has a constant rate.
        let velocity_m_s = (b.translation.vector - a.translation.vector) / span_secs;
        let angular_rad_s = (a.rotation.inverse() * b.rotation).scaled_axis() / span_secs;
        Ok((
            pose,
            Twist {
                linear_m_s: pose.rotation.inverse() * velocity_m_s,
                angular_rad_s,
            },
        ))
    }

    /// Stamp of the newest pose.
    pub fn newest(&self) -> Option<Stamp> {
        self.readings.newest()
    }

    /// Stamp of the oldest pose kept.
    pub fn oldest(&self) -> Option<Stamp> {
        self.readings.oldest()
    }

    /// Number of poses dropped because they were out of order or not finite.
    pub fn n_rejected(&self) -> u64 {
        self.readings.n_rejected
    }

    /// Removes all poses, for a source whose clock restarted.
    pub fn clear(&mut self) {
        self.readings.buffer.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    const MAX_GAP: Duration = Duration::from_millis(20);

    fn state(secs: f64, position: f64, velocity: Option<f64>) -> JointState {
        JointState {
            stamp: Stamp::from_secs(secs),
            position: vec![position, -2.0 * position],
            velocity: velocity
                .map(|velocity| vec![velocity, -2.0 * velocity])
                .unwrap_or_default(),
            effort: vec![10.0 * position; 2],
        }
    }

    fn history(states: impl IntoIterator<Item = JointState>) -> JointHistory {
        let mut history = JointHistory::new(MAX_GAP, 100);
        states
            .into_iter()
            .for_each(|state| history.push(state).unwrap());
        history
    }

    #[test]
    fn cubic_motion_with_velocities_is_exact() {
        let motion = |secs: f64| {
            (
                1.0 + secs - 3.0 * secs * secs + 20.0 * secs.powi(3),
                1.0 - 6.0 * secs + 60.0 * secs * secs,
            )
        };
        let readings = (0..10).map(|ix| f64::from(ix) * 0.02).map(|secs| {
            let (position, velocity) = motion(secs);
            state(secs, position, Some(velocity))
        });
        let history = history(readings);
        for secs in [0.0, 0.013, 0.0999, 0.1, 0.17] {
            let (position, velocity) = motion(secs);
            let at = history.at(Stamp::from_secs(secs)).unwrap();
            assert_eq!(at.stamp, Stamp::from_secs(secs));
            for (got, expected_position) in at.position.iter().zip([position, -2.0 * position]) {
                assert!(
                    (got - expected_position).abs() < 1e-12,
                    "{secs}: {got} {expected_position}"
                );
            }
            assert!((at.velocity[1] + 2.0 * velocity).abs() < 1e-11, "{secs}"); // Rounding over the 20 ms between readings.
        }
    }

    #[test]
    fn without_velocities_interpolation_is_linear() {
        let history = history([state(1.0, 0.5, None), state(1.02, 0.7, None)]);
        let at = history.at(Stamp::from_secs(1.005)).unwrap();
        assert!((at.position[0] - 0.55).abs() < 1e-12 && (at.position[1] + 1.1).abs() < 1e-12);
        assert!((at.velocity[0] - 10.0).abs() < 1e-9);
        assert!((at.effort[0] - 5.5).abs() < 1e-12);
        for (secs, position) in [(1.0, 0.5), (1.02, 0.7)] {
            let at_reading = history.at(Stamp::from_secs(secs)).unwrap();
            assert!((at_reading.velocity[0] - 10.0).abs() < 1e-9);
            assert_eq!(
                JointState {
                    velocity: vec![],
                    ..at_reading
                },
                state(secs, position, None)
            );
        }
        let alone = self::history([state(1.0, 0.5, None)]);
        assert_eq!(
            alone.at(Stamp::from_secs(1.0)).unwrap(),
            state(1.0, 0.5, None)
        );
    }

    #[test]
    fn no_extrapolation_and_specific_errors() {
        let empty = JointHistory::new(MAX_GAP, 3);
        assert!(matches!(
            empty.at(Stamp(0)),
            Err(HistoryError::NotYet { newest: None, .. })
        ));
        let mut history = JointHistory::new(MAX_GAP, 3);
        for secs in [1.0, 1.01, 1.02, 1.05] {
            history.push(state(secs, secs, None)).unwrap();
        }
        let ask = |secs: f64| history.at(Stamp::from_secs(secs));
        assert_eq!(history.oldest(), Some(Stamp::from_secs(1.01)));
        assert!(matches!(
            ask(1.05001),
            Err(HistoryError::NotYet {
                newest: Some(_),
                ..
            })
        ));
        assert!(matches!(ask(1.00999), Err(HistoryError::TooOld { .. })));
        assert!(matches!(ask(1.03), Err(HistoryError::Gap { .. })));
        assert_eq!(
            ask(1.03).unwrap_err().to_string(),
            "readings are missing for 30.0 ms around the requested stamp (at most 20.0 ms)"
        );
        // There are values at the edges of a gap and of the history.
        for secs in [1.01, 1.015, 1.02, 1.05] {
            assert!(ask(secs).is_ok(), "{secs}");
        }
    }

    #[test]
    fn invalid_readings_are_dropped_and_counted() {
        let mut history = history([state(1.0, 0.5, None), state(1.01, 0.6, None)]);
        let late = history.push(state(1.005, 9.0, None));
        assert!(matches!(late, Err(HistoryError::OutOfOrder { .. })));
        assert!(matches!(
            history.push(state(1.01, 9.0, None)),
            Err(HistoryError::OutOfOrder { .. })
        ));
        assert_eq!(
            history.push(state(1.02, f64::NAN, None)),
            Err(HistoryError::NotFinite)
        );
        let short = JointState {
            position: vec![0.0],
            ..state(1.02, 0.0, None)
        };
        assert_eq!(
            history.push(short),
            Err(HistoryError::JointCount {
                got: 1,
                expected: 2
            })
        );
        assert_eq!(history.n_rejected(), 4);
        assert_eq!(history.newest(), Some(Stamp::from_secs(1.01)));
        assert!((history.at(Stamp::from_secs(1.005)).unwrap().position[0] - 0.55).abs() < 1e-12);
        history.clear();
        assert!(history.push(state(0.0, 0.0, None)).is_ok());
    }

    #[test]
    fn pose_history_follows_the_same_rules() {
        let pose = |x: f64| Transform::new(Vector3::new(x, 0.0, 0.0), Vector3::new(0.0, 0.0, x));
        let mut history = PoseHistory::new(MAX_GAP, 10);
        history.push(Stamp::from_secs(1.0), pose(0.0)).unwrap();
        history.push(Stamp::from_secs(1.02), pose(1.0)).unwrap();
        history.push(Stamp::from_secs(1.1), pose(2.0)).unwrap();
        let at = history.at(Stamp::from_secs(1.005)).unwrap();
        assert!(
            (at.to_homogeneous() - pose(0.25).to_homogeneous())
                .abs()
                .max()
                < 1e-12
        );
        assert_eq!(history.at(Stamp::from_secs(1.1)).unwrap(), pose(2.0));
        assert!(matches!(
            history.at(Stamp::from_secs(1.05)),
            Err(HistoryError::Gap { .. })
        ));
        assert!(matches!(
            history.at(Stamp::from_secs(1.2)),
            Err(HistoryError::NotYet { .. })
        ));
        assert!(matches!(
            history.at(Stamp::from_secs(0.9)),
            Err(HistoryError::TooOld { .. })
        ));
        let broken = pose(f64::NAN);
        assert_eq!(
            history.push(Stamp::from_secs(2.0), broken),
            Err(HistoryError::NotFinite)
        );
        assert!(history.push(Stamp::from_secs(1.05), pose(0.0)).is_err());
        assert_eq!(history.n_rejected(), 2);
    }
}
