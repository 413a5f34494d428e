//! The map as the rest of the program uses it: images go in, answers come out, on any thread.

use crate::config::MapConfig;
use crate::error::Error;
use crate::image::{DepthImage, Posture};
use crate::query::{Query, Robot};
use crate::rows::Obstacles;
use crate::snapshot::Snapshot;
use crate::voxel_map::VoxelMap;
use kinematics::{Stamp, Transform};
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::JoinHandle;
use steering::{Body, Capsule, Clearance, Footprint, Seen};

/// Maximum number of cameras whose newest image waits. Images of more cameras replace the oldest.
const MAX_WAITING: usize = 16;

/// The failure of a map whose thread has ended.
const ENDED: &str = "the thread of the map of free space has ended, which is a bug: \
                     start the program again to move the arm";

/// Free space around an arm. Share it in an [`Arc`].
///
/// Its thread integrates the newest image of each camera. Answers never wait for it: they use the
/// newest complete version of the map. They wait for other answers.
#[derive(Debug)]
pub struct ClearanceMap {
    shared: Arc<Shared>,
    query: Mutex<Query>,
    /// For the footprint of the base, if there is one.
    base_query: Option<Mutex<Query>>,
    thread: Option<JoinHandle<()>>,
}

/// A base that moves in the map.
#[derive(Clone, Debug)]
pub struct MapBase {
    /// The space that the base occupies.
    pub footprint: Footprint,
    /// Whether the base may enter space that was never seen.
    pub is_unseen_free: bool,
    /// Distance around the footprint up to which space is free where the base was, for
    /// [`ClearanceMap::sweep`]; 0 to 0.2 m.
    pub swept_margin_m: f64,
}

/// Counts since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MapState {
    /// Integrated images.
    pub n_integrated: u64,
    /// Images that were replaced by newer ones before they were integrated.
    pub n_replaced: u64,
    /// Images that were too old, or showed nothing of the region.
    pub n_unused: u64,
    /// Stamp of the newest integrated image.
    pub newest: Option<Stamp>,
    /// Memory of the voxels, bytes.
    pub voxel_bytes: usize,
}

/// What the thread and the handle share.
#[derive(Debug)]
struct Shared {
    body: Body,
    footprint: MapFootprint,
    inbox: Mutex<Inbox>,
    arrived: Condvar,
    published: Mutex<Published>,
}

/// The footprint of a base in the map; empty without a base.
#[derive(Debug, Default)]
struct MapFootprint {
    capsules: Vec<Capsule>,
    heights_m: Option<[f64; 2]>,
    swept_margin_m: f64,
}

impl MapFootprint {
    fn of(base: &MapBase) -> Self {
        Self {
            capsules: base.footprint.capsules(),
            heights_m: Some(base.footprint.height_m()),
            swept_margin_m: base.swept_margin_m,
        }
    }
}

#[derive(Debug, Default)]
struct Inbox {
    images: VecDeque<DepthImage>,
    swept: VecDeque<(Posture, f64)>,
    n_replaced: u64,
    must_forget: bool,
    is_closing: bool,
}

#[derive(Debug)]
struct Published {
    snapshot: Arc<Snapshot>,
    state: MapState,
}

/// Work of the thread.
enum Job {
    Forget,
    Sweep(Posture, f64),
    Integrate(Box<DepthImage>),
}

impl ClearanceMap {
    /// Starts the thread with an empty map, in which nothing was ever seen.
    ///
    /// * `body`: the robot, which is not part of the map.
    ///
    /// # Errors
    /// If a setting is out of its range, or the thread cannot be started.
    pub fn start(config: &MapConfig, body: Body) -> Result<Self, Error> {
        Self::start_with(config, body, None)
    }

    /// Starts the thread of a map in which a base moves, too.
    ///
    /// # Errors
    /// As [`ClearanceMap::start`].
    pub fn start_with_base(config: &MapConfig, body: Body, base: &MapBase) -> Result<Self, Error> {
        check_margin(base.swept_margin_m)?;
        let config = MapConfig {
            has_surfaces: base.is_unseen_free,
            ..config.clone()
        };
        Self::start_with(&config, body, Some(base))
    }

    fn start_with(config: &MapConfig, body: Body, base: Option<&MapBase>) -> Result<Self, Error> {
        let map = VoxelMap::new(config)?;
        let snapshot = Arc::new(map.snapshot());
        let query = Query::new(config, Arc::clone(&snapshot), Obstacles::NotFree);
        let base_query = base.map(|base| {
            let obstacles = if base.is_unseen_free {
                Obstacles::Surfaces
            } else {
                Obstacles::NotFree
            };
            Mutex::new(Query::new(config, Arc::clone(&snapshot), obstacles))
        });
        let shared = Arc::new(Shared {
            body,
            footprint: base.map_or_else(MapFootprint::default, MapFootprint::of),
            inbox: Mutex::default(),
            arrived: Condvar::new(),
            published: Mutex::new(Published {
                snapshot,
                state: MapState::default(),
            }),
        });
        let of_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("clearance map".to_owned())
            .spawn(move || of_thread.work(map))?;
        Ok(Self {
            shared,
            query: Mutex::new(query),
            base_query,
            thread: Some(thread),
        })
    }

    /// Queues an image. It replaces an older waiting image of the same camera and origin.
    ///
    /// # Errors
    /// If the image or its posture is invalid. The map is unchanged.
    pub fn push(&self, image: DepthImage) -> Result<(), Error> {
        image.check(self.shared.body.n_joints())?;
        let mut inbox = self.shared.inbox.lock();
        let same = inbox
            .images
            .iter()
            .position(|waiting| waiting.camera == image.camera && waiting.origin == image.origin);
        if let Some(ix) = same {
            inbox.images.remove(ix);
            inbox.n_replaced += 1;
        } else if inbox.images.len() == MAX_WAITING {
            inbox.images.pop_front();
            inbox.n_replaced += 1;
        }
        inbox.images.push_back(image);
        drop(inbox);
        self.shared.arrived.notify_one();
        Ok(())
    }

    /// Marks the space that the robot occupies at a posture, and `margin_m` around it, as free
    /// where nothing was ever seen, and the footprint of its base with the margin of [`MapBase`]. Space in which cameras saw surfaces does not change.
    ///
    /// For motions that are known to be safe, such as a scan before steering: an arm whose links
    /// are never in view could not be steered otherwise. Never call it while an operator steers,
    /// because the arm could then enter unseen space bit by bit.
    ///
    /// # Errors
    /// If the posture is invalid, or the margin is not between 0 and 0.2 m.
    pub fn sweep(&self, posture: Posture, margin_m: f64) -> Result<(), Error> {
        posture.check(self.shared.body.n_joints())?;
        check_margin(margin_m)?;
        let mut inbox = self.shared.inbox.lock();
        if inbox.swept.len() == MAX_WAITING {
            inbox.swept.pop_front();
        }
        inbox.swept.push_back((posture, margin_m));
        drop(inbox);
        self.shared.arrived.notify_one();
        Ok(())
    }

    /// Sets where the robot is now, in whose volume everything is free, and where its base is.
    /// Before the first posture, the base is at the origin of the world and the robot has no
    /// volume.
    ///
    /// # Errors
    /// If the posture is invalid. The posture before it stays.
    pub fn set_posture(&self, posture: &Posture) -> Result<(), Error> {
        posture.check(self.shared.body.n_joints())?;
        let robot = Robot {
            stamp: posture.stamp,
            capsules: self.shared.body.capsules(&posture.position),
            world_from_base: posture.world_from_base,
            heights_m: None,
        };
        self.query.lock().set_robot(robot);
        self.set_base(posture.stamp, posture.world_from_base);
        Ok(())
    }

    /// Sets where the base is now, in whose footprint everything is free for the base itself. A
    /// posture also sets it.
    pub fn set_base(&self, stamp: Stamp, world_from_base: Transform) {
        if let Some(query) = &self.base_query {
            query.lock().set_robot(Robot {
                stamp,
                capsules: self.shared.footprint.capsules.clone(),
                world_from_base,
                heights_m: self.shared.footprint.heights_m,
            });
        }
    }

    /// What is known about points, from the newest complete version of the map.
    fn answer(&self, query: &Mutex<Query>, points: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        // The newest map would look as if only its ages grew, while the scene may change.
        if self.has_ended() {
            return Vec::new();
        }
        // The lock of the published map is held only while a pointer is copied.
        let snapshot = Arc::clone(&self.shared.published.lock().snapshot);
        let mut query = query.lock();
        query.set_snapshot(snapshot);
        query.readings(points, now)
    }

    /// Forgets everything, for example after a correction has moved the frame of the poses.
    pub fn forget(&self) {
        let mut inbox = self.shared.inbox.lock();
        inbox.must_forget = true;
        inbox.images.clear();
        inbox.swept.clear();
        drop(inbox);
        self.shared.arrived.notify_one();
    }

    /// Whether the thread has ended, which only a panic makes it do.
    fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Counts since the start.
    pub fn state(&self) -> MapState {
        let n_replaced = self.shared.inbox.lock().n_replaced;
        MapState {
            n_replaced,
            ..self.shared.published.lock().state
        }
    }
}

impl Clearance for ClearanceMap {
    fn readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        self.answer(&self.query, points_in_base, now)
    }

    fn base_readings(&self, points_in_base: &[[f64; 3]], now: Stamp) -> Vec<Option<Seen>> {
        match &self.base_query {
            Some(query) => self.answer(query, points_in_base, now),
            None => Vec::new(),
        }
    }

    fn failure(&self) -> Option<String> {
        self.has_ended().then(|| ENDED.to_owned())
    }
}

fn check_margin(margin_m: f64) -> Result<(), Error> {
    if (0.0..=0.2).contains(&margin_m) {
        return Ok(());
    }
    Err(Error::Value {
        what: "the margin of swept space",
        value: margin_m,
        expected: "from 0 to 0.2",
    })
}

impl Drop for ClearanceMap {
    fn drop(&mut self) {
        self.shared.inbox.lock().is_closing = true;
        self.shared.arrived.notify_one();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            log::error!("the thread of the clearance map has panicked");
        }
    }
}

impl Shared {
    /// The loop of the thread.
    fn work(&self, mut map: VoxelMap) {
        let mut state = MapState::default();
        while let Some(job) = self.next_job() {
            match job {
                Job::Forget => map.clear(),
                Job::Sweep(posture, margin_m) => {
                    let capsules = self.body.capsules(&posture.position);
                    map.sweep(&capsules, &posture, margin_m);
                    let footprint = &self.footprint;
                    map.sweep(&footprint.capsules, &posture, footprint.swept_margin_m);
                }
                Job::Integrate(image) => {
                    let capsules = self.body.capsules(&image.posture.position);
                    if map.integrate(&image, &capsules) {
                        state.n_integrated += 1;
                        state.newest = state.newest.max(Some(image.stamp));
                    } else {
                        state.n_unused += 1;
                    }
                }
            }
            state.voxel_bytes = map.bytes();
            let snapshot = Arc::new(map.snapshot());
            *self.published.lock() = Published { snapshot, state };
        }
    }

    /// Waits for the next job; `None` if the map is closed.
    fn next_job(&self) -> Option<Job> {
        let mut inbox = self.inbox.lock();
        loop {
            if inbox.is_closing {
                return None;
            }
            if std::mem::take(&mut inbox.must_forget) {
                return Some(Job::Forget);
            }
            if let Some((posture, margin_m)) = inbox.swept.pop_front() {
                return Some(Job::Sweep(posture, margin_m));
            }
            if let Some(image) = inbox.images.pop_front() {
                return Some(Job::Integrate(Box::new(image)));
            }
            self.arrived.wait(&mut inbox);
        }
    }
}

#[cfg(test)]
mod ended_tests;
