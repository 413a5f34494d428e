//! A simulated arm in its scene, with the decisions of a run on the simulated clock.

use super::live_map::LiveMap;
use super::scenes::GoalScene;
use super::targets::{GoalKind, Now, Places};
use anyhow::{Context, Result, bail};
use capture::config::Rig;
use capture::open::{self, CountedArm, Devices};
use drivers::motion::{JointTarget, Motion, SteeringPort};
use drivers::{Camera, Sample};
use kinematics::inverse::{InverseSolver, Target};
use kinematics::urdf::Robot as Urdf;
use kinematics::{Chain, Stamp, Transform, transform};
use numbers::random::Random;
use std::time::Duration;
use steering::{
    Body, Command, Device, Effect, Intent, Limit, Link, NearestPosture, Operator, Reason, Request,
    Robot, Steering, SteeringConfig,
};

const OPERATOR: Operator = Operator(1);
const DEVICE: Device = Device(1);
/// Acceleration and jerk of braking, as a factor of the limits of motions, as in runs.
const BRAKE_FACTOR: f64 = 2.0;
/// Milliseconds between two decisions, between two samples of the operator's device, and between
/// two looks for images.
const DECISION_MILLIS: u64 = 5;
const SAMPLE_MILLIS: u64 = 11;
const IMAGE_MILLIS: u64 = 20;
/// Milliseconds for which the switch is open before a grip.
const OPEN_MILLIS: u64 = 40;
/// Longest way to a goal, and time without motion after which the way has ended, milliseconds.
const MAX_WAY_MILLIS: u64 = 20_000;
const STILL_MILLIS: u64 = 500;
/// Longest brake, milliseconds.
const MAX_BRAKE_MILLIS: u64 = 5000;
/// Largest change of a joint in a millisecond of an arm that does not move, radians.
const STILL_RAD: f64 = 1e-7;
/// Distance and angle within which a goal is reached.
const REACHED_M: f64 = 0.005;
const REACHED_RAD: f64 = 0.02;
/// Time between two postures of the tour that are kept, seconds.
const KEPT_SECS: f64 = 0.5;
/// Longest motion to the posture of the tour, milliseconds.
const MAX_MOVE_MILLIS: u64 = 60_000;
/// A reading comes every millisecond.
const READ_TIMEOUT: Duration = Duration::from_millis(10);

/// What happened on the way to a goal.
#[derive(Clone, Debug)]
pub(super) struct Attempt {
    pub(super) is_reached: bool,
    /// How often a part of the robot has begun to touch an object.
    pub(super) n_contacts: u64,
    /// Why the arm was not moved further at the end, if a link refused it.
    refusal: Option<Reason>,
    link: Option<Link>,
}

impl Attempt {
    /// * `refusal`: the link that stopped the arm, and its reason.
    pub(super) fn ended(
        is_reached: bool,
        n_contacts: u64,
        refusal: Option<(Link, Reason)>,
    ) -> Self {
        let (link, refusal) = refusal.unzip();
        Self {
            is_reached,
            n_contacts,
            refusal,
            link,
        }
    }

    /// The name of what ended the way.
    pub(super) fn reason_name(&self) -> &'static str {
        match &self.refusal {
            Some(Reason::Near { .. }) => "near a surface",
            Some(Reason::NeverSeen { .. }) => "never seen",
            Some(Reason::LongUnseen { .. }) => "long unseen",
            Some(Reason::SelfCollision { .. }) => "self-collision",
            Some(Reason::JointRange { .. }) => "joint range",
            Some(Reason::OtherPosture { .. }) => "other posture needed",
            Some(Reason::Unreachable { .. } | Reason::Workspace { .. }) => "out of reach",
            Some(_) => "other refusal",
            None => "not refused",
        }
    }

    /// The place of the refusal, if it has one.
    pub(super) fn place(&self) -> Option<[f64; 3]> {
        self.refusal.as_ref()?.place()
    }

    /// Whether the scene is the reason.
    pub(super) fn is_refused_by_scene(&self) -> bool {
        self.link == Some(Link::Clearance)
    }
}

/// The arm and its operator.
pub(super) struct SteeredScene {
    opened: CountedArm,
    port: SteeringPort,
    steering: Steering,
    map: LiveMap,
    chain: Chain,
    solver: InverseSolver,
    places: Places,
    random: Random,
    now: Stamp,
    millis: u64,
    sequence: u64,
    grip: u64,
    /// Newest refusals.
    limits: Vec<Limit>,
}

impl SteeredScene {
    /// Opens a scene, and makes a map of it from its tour.
    ///
    /// # Errors
    ///
    /// If the scene cannot be opened.
    pub(super) fn open(scene: GoalScene, seed: u64) -> Result<Self> {
        let rig = scene.rig()?;
        let urdf = Urdf::parse(&rig.arm.urdf_text)?;
        let chain = Chain::new(&urdf, &rig.arm.base_link, &rig.arm.flange_link)?;
        if rig.arm.joints != chain.joint_names() {
            bail!("the joints of the scene are not in the order of the chain");
        }
        let body = Body::new(&urdf, &chain, &|_| None)?;
        let mut random = Random::new(seed);
        let mut map = LiveMap::new(&rig, &chain, &body)?;
        let places = tour(scene, &rig, &mut map, &mut random)?;
        map.restart(scene.tour_secs());
        let mut opened = open::counted(&rig)?;
        // The tour comes to this posture when the base stands still.
        let first = places.tour.first().context("the tour has no posture")?;
        go_to(&mut opened, &mut map, first, scene.rests_from_secs())?;
        let port = opened.arm.steering_port(BRAKE_FACTOR)?;
        // The arm reports its state to the port with its next step.
        map.observe_joints(opened.arm.read(READ_TIMEOUT)?);
        let limits = port.limits().to_vec();
        let steered = Robot {
            inverse: Box::new(NearestPosture::new(chain.clone())),
            body,
            chain: chain.clone(),
            joints: &limits,
            free_posture: Some(first),
        };
        let config = SteeringConfig::default();
        let margin = config.limits.joint_margin;
        let ranges = limits
            .iter()
            .map(|joint| [joint.position[0] + margin, joint.position[1] - margin]);
        let solver = InverseSolver::within(chain.clone(), ranges.collect())?;
        let mut opened_scene = Self {
            steering: Steering::new(config, steered)?,
            now: map.newest()?.stamp,
            opened,
            port,
            map,
            chain,
            solver,
            places,
            random,
            millis: 0,
            sequence: 0,
            grip: 0,
            limits: Vec::new(),
        };
        opened_scene.request(&Request::TakeLease(OPERATOR))?;
        Ok(opened_scene)
    }

    /// Steers the tip to a random goal, as far as the arm is moved.
    ///
    /// # Errors
    ///
    /// If there is no goal, or the arm does not come to rest.
    pub(super) fn attempt(&mut self, kind: GoalKind) -> Result<Attempt> {
        let n_before = self.opened.n_contacts();
        let goal = self.choose(kind)?;
        let intent = Intent::Pose {
            base_from_tip: transform::to_xyz_xyzw(&goal),
        };
        self.run(OPEN_MILLIS, None)?;
        self.grip += 1;
        let mut n_still = 0;
        for _ in 0..MAX_WAY_MILLIS {
            let before = self.position()?;
            self.run(1, Some(&intent))?;
            let after = self.position()?;
            let changes = before.iter().zip(&after).map(|(a, b)| (a - b).abs());
            n_still = if changes.fold(0.0, f64::max) > STILL_RAD {
                0
            } else {
                n_still + 1
            };
            if n_still > STILL_MILLIS {
                break;
            }
        }
        // An arm also comes to rest if a link slows it down to almost nothing.
        let remaining_speed = |limit: &&Limit| match limit.effect {
            Effect::Refused | Effect::Braked => 0.0,
            Effect::Slowed(scale) => scale,
        };
        let ended_by = self
            .limits
            .iter()
            .min_by(|a, b| remaining_speed(a).total_cmp(&remaining_speed(b)))
            .cloned();
        let tip = self.chain.forward(&self.position()?)?;
        let gap = Target::pose(goal).gap(&tip);
        log::debug!(
            "goal {}: {:.1} mm and {:.3} rad left; {:?}; {:?}",
            kind.title(),
            1e3 * gap.distance_m,
            gap.angle_rad,
            self.limits,
            self.port
                .state()
                .map(|state| (state.position, state.is_at_rest)),
        );
        self.release()?;
        Ok(Attempt::ended(
            gap.distance_m <= REACHED_M && gap.angle_rad <= REACHED_RAD,
            self.opened.n_contacts() - n_before,
            ended_by.map(|limit| (limit.link, limit.reason)),
        ))
    }

    fn choose(&mut self, kind: GoalKind) -> Result<Transform> {
        let position = self.position()?;
        let (steering, map, at) = (&self.steering, &self.map, self.now);
        let now = Now {
            chain: &self.chain,
            position: &position,
            is_free: &|posture: &[f64]| steering.check_posture(at, posture, map).is_ok(),
        };
        let goal = self
            .places
            .choose(kind, &mut self.solver, &now, &mut self.random);
        goal.with_context(|| format!("no goal {} is within reach", kind.title()))
    }

    /// Opens the switch, and waits until the arm is at rest.
    fn release(&mut self) -> Result<()> {
        for _ in 0..MAX_BRAKE_MILLIS {
            self.run(1, None)?;
            if self.port.state().is_some_and(|state| state.is_at_rest) {
                return Ok(());
            }
        }
        bail!("the arm has not come to rest after a goal")
    }

    fn position(&self) -> Result<Vec<f64>> {
        let state = self.port.state();
        Ok(state.context("the arm has reported no state")?.position)
    }

    fn request(&mut self, request: &Request) -> Result<()> {
        let handled = self.steering.handle(self.now, request);
        handled.map_err(|reason| anyhow::anyhow!("{reason}"))
    }

    /// Advances the simulation.
    ///
    /// * `intent`: of the operator; `None` while the switch is open.
    fn run(&mut self, millis: u64, intent: Option<&Intent>) -> Result<()> {
        for _ in 0..millis {
            let reading = self.opened.arm.read(READ_TIMEOUT)?;
            self.now = reading.stamp;
            self.map.observe_joints(reading);
            self.millis += 1;
            if self.millis.is_multiple_of(IMAGE_MILLIS) {
                take_images(&mut self.opened.cameras, &mut self.map, &mut self.random)?;
            }
            if self.millis.is_multiple_of(SAMPLE_MILLIS) {
                self.send(intent);
            }
            if self.millis.is_multiple_of(DECISION_MILLIS) {
                self.decide()?;
            }
        }
        Ok(())
    }

    fn send(&mut self, intent: Option<&Intent>) {
        self.sequence += 1;
        let command = Command {
            operator: OPERATOR,
            device: DEVICE,
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip: intent.map(|_| self.grip),
            intent: intent.cloned().unwrap_or(Intent::JointVelocity {
                velocity: vec![0.0; self.chain.n_joints()],
            }),
        };
        // A refusal shows in the verdict, or in the motion.
        let _ = self.steering.handle(self.now, &Request::Command(command));
    }

    fn decide(&mut self) -> Result<()> {
        let state = self.port.state();
        let arm = state.context("the arm has reported no state")?;
        self.map.set_posture(self.now, &arm.position)?;
        let verdict = self.steering.cycle(self.now, &arm, &self.map);
        self.port.send(&verdict.output);
        self.limits = verdict.limits;
        // Nobody replays these decisions.
        let _ = self.steering.take_record();
        Ok(())
    }
}

/// Lets the arm make its tour, from which the map is made. Returns surfaces and postures.
fn tour(scene: GoalScene, rig: &Rig, map: &mut LiveMap, random: &mut Random) -> Result<Places> {
    let mut source = open::rig(rig.clone(), Devices::Real)?.source;
    let mut places = Places {
        surfaces: Vec::new(),
        tour: Vec::new(),
    };
    let mut kept_at = f64::NEG_INFINITY;
    while let Some(sample) = source.next_sample()? {
        let secs = sample.stamp().secs_since(Stamp(0));
        if secs > scene.tour_secs() {
            break;
        }
        let is_resting = secs >= scene.rests_from_secs();
        match sample {
            Sample::Base(base) if !is_resting || kept_at.is_infinite() => {
                map.set_base(base.world_from_base);
            }
            Sample::Joints(reading) if is_resting => {
                if secs - kept_at >= KEPT_SECS {
                    kept_at = secs;
                    places.tour.push(reading.position.clone());
                }
                map.observe_joints(reading);
                map.sweep()?;
            }
            Sample::Image(image) if is_resting => {
                places.surfaces.extend(map.observe_image(&image, random)?);
            }
            _ => {}
        }
    }
    Ok(places)
}

/// Moves the arm to a posture, and waits until the base stands still.
fn go_to(opened: &mut CountedArm, map: &mut LiveMap, posture: &[f64], secs: f64) -> Result<()> {
    let target = JointTarget {
        position: posture.to_vec(),
    };
    opened.arm.command(&target)?;
    let mut random = Random::new(0);
    for millis in 0..MAX_MOVE_MILLIS {
        let reading = opened.arm.read(READ_TIMEOUT)?;
        let is_resting = reading.stamp.secs_since(Stamp(0)) >= secs;
        if is_resting {
            map.observe_joints(reading);
        }
        if millis.is_multiple_of(IMAGE_MILLIS) {
            take_images(&mut opened.cameras, map, &mut random)?;
        }
        if is_resting && opened.arm.motion() == Motion::Holding {
            return Ok(());
        }
    }
    bail!("the arm has not reached the first posture of its tour")
}

/// Takes the images that have arrived.
fn take_images(
    cameras: &mut [Box<dyn Camera>],
    map: &mut LiveMap,
    random: &mut Random,
) -> Result<()> {
    for camera in cameras {
        // Without waiting, there is no image if none has arrived.
        while let Ok(image) = camera.next_image(Duration::ZERO) {
            map.observe_image(&image, random)?;
        }
    }
    Ok(())
}
