//! The same inputs give the same decisions, bit for bit.

use super::{ANA, Sim, ageless, hand, new_steering, pose_intent};
use crate::{AnalyticScene, Entry, Request, Setup, Solid, SteeringConfig};
use kinematics::{Stamp, Transform};
use numbers::random::Random;

/// A session with motions, refusals, a stop and broken commands, near an obstacle.
fn session() -> (SteeringConfig, Vec<Entry>) {
    let config = SteeringConfig {
        clearance: ageless().clearance,
        ..SteeringConfig::default()
    };
    let mut sim = Sim::ready(config.clone());
    let mut random = Random::new(3);
    sim.scene = Box::new(AnalyticScene {
        solids: vec![Solid::HalfSpace {
            point: [0.0, 0.0, sim.tip().translation.z - 0.12],
            normal: [0.0, 0.0, 1.0],
        }],
        seen_at: Stamp(0),
        seen_radius_m: 1.0,
    });
    let mut grip = 1;
    for step in 0..1500_u32 {
        let by = 0.2 * (0.01 * f64::from(step)).sin();
        let near = Transform::translation(by, 0.0, -by.abs()) * sim.tip();
        let intent = match random.below(20) {
            0 => hand(f64::NAN, f64::NEG_INFINITY, 0.0),
            1 => hand(0.1, 0.2, 0.3),
            _ => pose_intent(&near),
        };
        let _ = sim.send(Some(grip), intent);
        if step % 400 == 399 {
            sim.request(Request::Stop { by: None }).unwrap();
            sim.cycle();
            sim.rearm(ANA).unwrap();
        }
        if super::is_braking(&sim.cycle()) {
            grip += 1;
        }
    }
    let (entries, n_dropped) = sim.steering.take_record();
    assert_eq!(n_dropped, 0);
    (config, entries)
}

#[test]
fn record_survives_json_and_replays_bit_for_bit() {
    let (config, entries) = session();
    let lines: Vec<String> = entries
        .iter()
        .map(|entry| serde_json::to_string(entry).unwrap())
        .collect();
    let config: SteeringConfig =
        serde_json::from_str(&serde_json::to_string(&config).unwrap()).unwrap();
    let mut steering = new_steering(config);
    let mut n_follows = 0;
    for line in &lines {
        let entry: Entry = serde_json::from_str(line).unwrap();
        assert_eq!(serde_json::to_string(&entry).unwrap(), *line);
        steering.replay(&entry).unwrap();
        n_follows += u32::from(entry.has_target());
    }
    assert!(n_follows > 200, "{n_follows}");
    assert!(lines.iter().any(|line| line.contains("NaN")));
    assert!(lines.iter().any(|line| line.contains("Near")));
}

#[test]
fn changed_record_is_detected() {
    let (config, mut entries) = session();
    let changed = entries.iter_mut().rev().find_map(|entry| match entry {
        Entry::Cycle { arm, .. } => match &mut arm.as_mut()?.verdict.output {
            crate::Output::Follow(target) => Some(&mut target.position[3]),
            crate::Output::Brake => None,
        },
        Entry::Request { .. } => None,
    });
    let changed = changed.expect("a target");
    *changed = f64::from_bits(changed.to_bits() ^ 1);
    let mut steering = new_steering(config);
    let difference = entries
        .iter()
        .find_map(|entry| steering.replay(entry).err());
    assert!(difference.is_some(), "one bit differs");
}

#[test]
fn record_is_bounded_and_counts_what_it_drops() {
    let mut sim = Sim::ready(ageless());
    for _ in 0..6100 {
        let _ = sim.request(Request::RenewLease(ANA));
    }
    let (entries, n_dropped) = sim.steering.take_record();
    assert_eq!((entries.len(), n_dropped), (6000, 102));
}

#[test]
fn record_that_begins_in_the_middle_of_a_grip_replays_from_its_setup() {
    let mut sim = Sim::ready(ageless());
    for step in 0..150_u32 {
        let _ = sim.send(Some(1), hand(0.0, 0.0, -5e-4 * f64::from(step)));
        sim.cycle();
    }
    sim.steering.take_record();
    let text = serde_json::to_string(&sim.steering.setup(super::PANDA.to_owned())).unwrap();
    for step in 150..400_u32 {
        let _ = sim.send(Some(1), hand(0.0, 2e-4 * f64::from(step), -0.075));
        if step == 300 {
            sim.request(Request::Stop { by: Some(ANA) }).unwrap();
        }
        sim.cycle();
    }
    let (entries, _) = sim.steering.take_record();
    let setup: Setup = serde_json::from_str(&text).unwrap();
    assert_eq!(serde_json::to_string(&setup).unwrap(), text);
    let mut steering = setup.build().unwrap();
    let mut n_follows = 0;
    for entry in &entries {
        steering.replay(entry).unwrap();
        n_follows += u32::from(entry.has_target());
    }
    assert!(n_follows > 100, "{n_follows}");
    assert_eq!(steering.state(), sim.steering.state());
    // From another state, the same entries give other decisions.
    let mut fresh = new_steering(ageless());
    assert!(entries.iter().any(|entry| fresh.replay(entry).is_err()));
}

#[test]
fn damaged_setup_and_record_are_refused() {
    let (config, entries) = session();
    let steering = new_steering(config.clone());
    let text = serde_json::to_string(&steering.setup(super::PANDA.to_owned())).unwrap();
    for (from, to) in [
        (r#""frame_ix":1"#, r#""frame_ix":99"#),
        (r#""max_speed_m_s":0.25"#, r#""max_speed_m_s":-1.0"#),
        (
            r#""motion":null"#,
            r#""motion":{"grip":1,"target":[0.0],"accepted_m":1.0}"#,
        ),
        (
            r#""tip_link":"panda_link8""#,
            r#""tip_link":"panda_link80""#,
        ),
    ] {
        assert!(text.contains(from), "{from}");
        let setup: Setup = serde_json::from_str(&text.replace(from, to)).unwrap();
        let error = setup.build().map(|_| ()).unwrap_err();
        assert!(!error.to_string().is_empty());
    }
    let mut steering = new_steering(config);
    let mut entry = entries
        .iter()
        .find(|entry| {
            matches!(entry, Entry::Cycle { arm: Some(arm), .. } if arm.seen.concat().len() > 1)
        })
        .cloned()
        .expect("near an obstacle");
    if let Entry::Cycle { arm: Some(arm), .. } = &mut entry {
        for restriction in arm.seen.iter_mut().flatten() {
            restriction.point_ix = usize::MAX;
        }
    }
    assert!(steering.replay(&entry).is_err());
}
