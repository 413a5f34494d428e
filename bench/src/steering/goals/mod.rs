//! Whether operators reach goals in free space, and touch nothing if their goals are inside or
//! behind obstacles.
//!
//! A simulated arm moves in simulated scenes. The camera on its flange sees depth, from which a map
//! of free space is made while the arm moves, as in a run. The clock is simulated, so the results do
//! not depend on the computer. Contacts are counted by MuJoCo, which knows the true shapes.

mod live_map;
mod scenes;
mod steered_scene;
mod surface_points;
mod targets;

pub use scenes::GoalScene;
pub use targets::GoalKind;

use anyhow::{Context, Result};
use report::Table;
use serde::Serialize;
use std::collections::BTreeMap;
use steered_scene::{Attempt, SteeredScene};

/// Goals after which a worker opens its scene again, so that the arm does not stay in one region.
const MAX_GOALS_PER_WORKER: u32 = 250;

/// Results of all goals of a kind in a scene.
#[derive(Clone, Debug, Serialize)]
pub struct GoalRow {
    /// The scene.
    pub scene: GoalScene,
    /// The kind of the goals.
    pub kind: GoalKind,
    /// Number of goals.
    pub n_goals: u32,
    /// Goals that the tip has reached.
    pub n_reached: u32,
    /// Goals on the way to which the arm was refused a motion, with a place.
    pub n_refused_with_place: u32,
    /// Goals on the way to which the scene refused a motion without a place.
    pub n_without_place: u32,
    /// How often a part of the robot has begun to touch an object.
    pub n_contacts: u64,
    /// How often each reason ended the way to a goal.
    pub reasons: BTreeMap<&'static str, u32>,
}

impl GoalRow {
    fn new(scene: GoalScene, kind: GoalKind) -> Self {
        Self {
            scene,
            kind,
            n_goals: 0,
            n_reached: 0,
            n_refused_with_place: 0,
            n_without_place: 0,
            n_contacts: 0,
            reasons: BTreeMap::new(),
        }
    }

    fn add(&mut self, attempt: &Attempt) {
        self.n_goals += 1;
        self.n_contacts += attempt.n_contacts;
        if attempt.is_reached {
            self.n_reached += 1;
            return;
        }
        *self.reasons.entry(attempt.reason_name()).or_default() += 1;
        if attempt.place().is_some() {
            self.n_refused_with_place += 1;
        } else if attempt.is_refused_by_scene() {
            self.n_without_place += 1;
        }
    }

    fn merge(&mut self, other: &Self) {
        self.n_goals += other.n_goals;
        self.n_reached += other.n_reached;
        self.n_refused_with_place += other.n_refused_with_place;
        self.n_without_place += other.n_without_place;
        self.n_contacts += other.n_contacts;
        for (reason, n) in &other.reasons {
            *self.reasons.entry(*reason).or_default() += n;
        }
    }

    fn cells(&self) -> Vec<String> {
        let reasons = self.reasons.iter();
        let reasons: Vec<String> = reasons.map(|(name, n)| format!("{name}: {n}")).collect();
        let numbers = [
            u64::from(self.n_goals),
            u64::from(self.n_reached),
            self.n_contacts,
            u64::from(self.n_refused_with_place),
            u64::from(self.n_without_place),
        ];
        let mut cells = vec![self.scene.title().to_owned(), self.kind.title().to_owned()];
        cells.extend(numbers.map(|n| n.to_string()));
        cells.push(reasons.join(", "));
        cells
    }
}

/// Tries goals of both kinds in a scene, on several threads.
///
/// * `n_goals`: of each kind.
///
/// # Errors
///
/// If the scene cannot be opened, or the arm does not obey.
pub(super) fn measure(scene: GoalScene, n_goals: u32) -> Result<[GoalRow; 2]> {
    let n_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let n_threads = u32::try_from(n_threads).unwrap_or(1).min(n_goals).max(1);
    let rows = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..n_threads)
            .map(|worker| {
                let n_of_worker = n_goals / n_threads + u32::from(worker < n_goals % n_threads);
                scope.spawn(move || try_goals(scene, n_of_worker, u64::from(worker)))
            })
            .collect();
        let joined = workers.into_iter().map(|worker| match worker.join() {
            Ok(rows) => rows,
            Err(_) => anyhow::bail!("a thread that steers a simulated arm has panicked"),
        });
        joined.collect::<Result<Vec<_>>>()
    })?;
    let mut sum = GoalKind::ALL.map(|kind| GoalRow::new(scene, kind));
    for of_worker in &rows {
        for (row, added) in sum.iter_mut().zip(of_worker) {
            row.merge(added);
        }
    }
    Ok(sum)
}

fn try_goals(scene: GoalScene, n_goals: u32, worker: u64) -> Result<[GoalRow; 2]> {
    let mut rows = GoalKind::ALL.map(|kind| GoalRow::new(scene, kind));
    let mut n_done = 0;
    while n_done < n_goals {
        let n_now = (n_goals - n_done).min(MAX_GOALS_PER_WORKER);
        let seed = (worker << 32) + u64::from(n_done);
        let opened = SteeredScene::open(scene, seed);
        let mut steered = opened.with_context(|| format!("the scene {:?}", scene.title()))?;
        for _ in 0..n_now {
            for row in &mut rows {
                row.add(&steered.attempt(row.kind)?);
            }
        }
        n_done += n_now;
    }
    Ok(rows)
}

/// The table of all scenes.
pub(super) fn table(rows: &[GoalRow]) -> Table {
    let head = [
        "scene",
        "goals",
        "number",
        "reached",
        "contacts",
        "refused, with place",
        "refused by the scene without place",
        "why others were not reached",
    ];
    Table {
        title: "Goals".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: rows.iter().map(GoalRow::cells).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use steering::{Link, Reason};

    #[test]
    fn ways_are_counted_by_how_they_end() {
        let near = Reason::Near {
            part: "hand".to_owned(),
            distance_m: 0.02,
            age_secs: 0.0,
            place: [0.1, 0.2, 0.3],
        };
        let mut row = GoalRow::new(GoalScene::Table, GoalKind::Obstacle);
        let reached = Attempt::ended(true, 0, None);
        let touched = Attempt::ended(true, 2, None);
        let refused = Attempt::ended(false, 0, Some((Link::Clearance, near)));
        let stuck = Attempt::ended(false, 0, None);
        for attempt in [&reached, &touched, &refused, &stuck] {
            row.add(attempt);
        }
        let mut both = GoalRow::new(GoalScene::Table, GoalKind::Obstacle);
        both.merge(&row);
        both.merge(&row);
        assert_eq!((both.n_goals, both.n_reached, both.n_contacts), (8, 4, 4));
        assert_eq!((both.n_refused_with_place, both.n_without_place), (2, 0));
        let reasons = both.reasons.iter().map(|(name, n)| (*name, *n));
        let expected = [("near a surface", 2), ("not refused", 2)];
        assert_eq!(reasons.collect::<Vec<_>>(), expected);
    }
}
