//! A Franka controller whose arm follows a script until a client moves it.

use super::JointTrack;
use drivers::Error;
use drivers::franka::played::{Joints, PlayedRobot, RobotConfig};

/// Takes clients until it is dropped. Once a client has moved the arm it stays with what clients want.
pub fn play_fci(track: JointTrack, config: RobotConfig) -> Result<PlayedRobot, Error> {
    let mut is_moved = false;
    let owner = move |now, wanted: &drivers::franka::played::Wanted| {
        if wanted.is_moving && !std::mem::replace(&mut is_moved, true) {
            log::info!("a client moves the arm: from now on it stays where clients want it");
        }
        if is_moved {
            let (position_rad, velocity_rad_s) = (wanted.position_rad, wanted.velocity_rad_s);
            return Joints { position_rad, velocity_rad_s, ..Joints::default() };
        }
        let state = track.at(now);
        let seven = |numbers: Vec<f64>| std::array::from_fn(|ix| numbers.get(ix).copied().unwrap_or(0.0));
        Joints {
            position_rad: seven(state.position),
            velocity_rad_s: seven(state.velocity),
            torque_nm: seven(state.effort),
            ..Joints::default()
        }
    };
    PlayedRobot::start(config, Box::new(owner))
}
