//! Benchmarks of inverse kinematics. They measure the time per pose over random reachable poses,
//! and the time per servo step.

use criterion::{Criterion, criterion_group, criterion_main};
use kinematics::Chain;
use kinematics::inverse::{FrankaArm, InverseSolver, ServoLimits, Target};
use numbers::random::Random;
use std::f64::consts::PI;
use std::hint::black_box;

/// The poses are solved in turn, so that the times of easy and difficult poses are averaged.
const N_POSES: usize = 1000;

/// Name, URDF, base link and tip link of the robots.
const ROBOTS: [(&str, &str, &str, &str); 6] = [
    (
        "panda",
        include_str!("../../rigs/robots/panda.urdf"),
        "panda_link0",
        "panda_link8",
    ),
    (
        "fr3",
        include_str!("../../rigs/robots/fr3.urdf"),
        "fr3_link0",
        "fr3_link8",
    ),
    (
        "ur3e",
        include_str!("../../rigs/robots/ur3e.urdf"),
        "base_link",
        "tool0",
    ),
    (
        "ur5e",
        include_str!("../../rigs/robots/ur5e.urdf"),
        "base_link",
        "tool0",
    ),
    (
        "ur10e",
        include_str!("../../rigs/robots/ur10e.urdf"),
        "base_link",
        "tool0",
    ),
    (
        "so101",
        include_str!("../../rigs/robots/so101.urdf"),
        "base_link",
        "gripper_frame_link",
    ),
];

/// A reachable pose and joint values that have it.
struct Sample {
    joints: Vec<f64>,
    target: Target,
}

fn samples(chain: &Chain) -> Vec<Sample> {
    let mut random = Random::new(1);
    let sample = |_| {
        let limits = chain.limits().iter();
        let joints: Vec<f64> = limits
            .map(|limit| random.uniform(limit.lower.max(-PI), limit.upper.min(PI)))
            .collect();
        let pose = chain.forward(&joints).expect("one finite value per joint");
        Sample {
            joints,
            target: Target::pose(pose),
        }
    };
    (0..N_POSES).map(sample).collect()
}

/// Solves poses from the middle of the ranges, which is far from most of the poses.
fn solve(criterion: &mut Criterion) {
    for (name, urdf, base, tip) in ROBOTS {
        let chain = Chain::from_urdf(urdf, base, tip).expect("the file is sound");
        let limits = chain.limits().iter();
        let seed: Vec<f64> = limits
            .map(|limit| 0.5 * (limit.lower.max(-PI) + limit.upper.min(PI)))
            .collect();
        let samples = samples(&chain);
        let mut next = samples.iter().cycle();
        let mut solver = InverseSolver::new(chain).expect("the ranges are sound");
        criterion.bench_function(&format!("{name} solve"), |bench| {
            bench.iter(|| {
                let sample = next.next().expect("the samples repeat");
                solver.solve(black_box(&sample.target), &seed)
            });
        });
    }
}

/// Takes one step from a random configuration toward the next configuration.
fn servo(criterion: &mut Criterion) {
    for (name, urdf, base, tip) in ROBOTS {
        let chain = Chain::from_urdf(urdf, base, tip).expect("the file is sound");
        let samples = samples(&chain);
        let mut next = samples.iter().zip(samples.iter().skip(1)).cycle();
        let limits = ServoLimits {
            joint_speeds: vec![2.0; chain.n_joints()],
            linear_m_s: 0.5,
            angular_rad_s: 1.5,
            comfort_hz: 0.5,
        };
        let mut joints = vec![0.0; chain.n_joints()];
        let mut solver = InverseSolver::new(chain).expect("the ranges are sound");
        criterion.bench_function(&format!("{name} servo"), |bench| {
            bench.iter(|| {
                let (from, to) = next.next().expect("the samples repeat");
                let target = black_box(&to.target);
                solver.servo(target, &from.joints, &limits, 0.001, &mut joints)
            });
        });
    }
}

/// All solutions for a given last joint.
fn closed_form(criterion: &mut Criterion) {
    let (_, urdf, base, tip) = ROBOTS[0];
    let chain = Chain::from_urdf(urdf, base, tip).expect("the file is sound");
    let arm = FrankaArm::of(&chain).expect("a Panda has this geometry");
    let samples = samples(&chain);
    let mut next = samples.iter().cycle();
    criterion.bench_function("panda all solutions", |bench| {
        bench.iter(|| {
            let sample = next.next().expect("the samples repeat");
            arm.solutions(black_box(&sample.target.base_from_tip), sample.joints[6])
        });
    });
}

criterion_group!(benches, solve, servo, closed_form);
criterion_main!(benches);
