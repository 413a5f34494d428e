//! Translates between the joint values of the arm's driver and those of its kinematic chain.
//!
//! A driver has its own order of joints, and its positions lack the offsets of the rig file. All
//! decisions use the order of the chain, and positions of the robot description.

use anyhow::bail;
use drivers::motion::{ArmState, MotionLimits, Output, Target};
use kinematics::Chain;

/// The order and the offsets of the joints.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct JointMap {
    /// Index in the driver's lists of each joint of the chain.
    driver_ixs: Vec<usize>,
    /// Added to positions of the driver, in the order of the chain.
    offsets: Vec<f64>,
}

impl JointMap {
    /// * `driver_names`: joints in the order of the driver.
    /// * `driver_offsets`: offsets in the same order; empty if there are none.
    ///
    /// # Errors
    /// If a joint of the chain is missing, or the driver has other joints, too.
    pub(super) fn new(
        chain: &Chain,
        driver_names: &[String],
        driver_offsets: &[f64],
    ) -> anyhow::Result<Self> {
        let driver_ixs = chain.order_in(driver_names)?;
        // The devices are opened only if this holds. Without it, targets would lack positions.
        if driver_ixs.len() != driver_names.len() {
            bail!(
                "the arm has {} joints, the chain to {:?} has {}",
                driver_names.len(),
                chain.tip_link(),
                driver_ixs.len()
            );
        }
        let offset = |ix: &usize| driver_offsets.get(*ix).copied().unwrap_or(0.0);
        Ok(Self {
            offsets: driver_ixs.iter().map(offset).collect(),
            driver_ixs,
        })
    }

    /// Positions of the chain for positions of the driver. A list of another length is returned unchanged,
    /// so that the chain of decisions reports it.
    pub(super) fn in_chain(&self, of_driver: &[f64]) -> Vec<f64> {
        if of_driver.len() != self.driver_ixs.len() {
            return of_driver.to_vec();
        }
        let joints = self.driver_ixs.iter().zip(&self.offsets);
        joints.map(|(ix, offset)| of_driver[*ix] + offset).collect()
    }

    /// Positions of the driver for positions of the chain.
    fn for_driver(&self, in_chain: &[f64]) -> Vec<f64> {
        let mut of_driver = vec![0.0; in_chain.len()];
        for (position, (ix, offset)) in in_chain
            .iter()
            .zip(self.driver_ixs.iter().zip(&self.offsets))
        {
            of_driver[*ix] = position - offset;
        }
        of_driver
    }

    /// The state of the arm in the order of the chain.
    pub(super) fn state_in_chain(&self, state: ArmState) -> ArmState {
        ArmState {
            position: self.in_chain(&state.position),
            ..state
        }
    }

    /// What the driver should do.
    pub(super) fn output_for_driver(&self, output: Output) -> Output {
        match output {
            Output::Follow(target) => Output::Follow(Target {
                position: self.for_driver(&target.position),
                ..target
            }),
            Output::Brake => Output::Brake,
        }
    }

    /// The limits in the order of the chain.
    pub(super) fn limits_in_chain(&self, of_driver: &[MotionLimits]) -> Vec<MotionLimits> {
        let joints = self.driver_ixs.iter().zip(&self.offsets);
        joints
            .map(|(ix, offset)| MotionLimits {
                position: of_driver[*ix].position.map(|bound| bound + offset),
                ..of_driver[*ix]
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Stamp;

    const URDF: &str = r#"<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
        <joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
        <joint name="j2" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
        <limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"#;

    #[test]
    fn values_of_the_driver_are_ordered_and_shifted_and_come_back() {
        let chain = Chain::from_urdf(URDF, "a", "c").expect("a chain");
        let names = ["j2", "j1"].map(str::to_owned);
        let map = JointMap::new(&chain, &names, &[0.5, 0.25]).expect("both joints");
        let state = ArmState {
            reported_at: Stamp(1),
            position: vec![1.0, 2.0],
            is_at_rest: true,
            braked_motion: 0,
            stopped: None,
        };
        assert_eq!(map.state_in_chain(state).position, [2.25, 1.5]);
        let target = Target {
            motion: 1,
            serial: 1,
            position: vec![2.25, 1.5],
            expires_at: Stamp(5),
        };
        let Output::Follow(target) = map.output_for_driver(Output::Follow(target)) else {
            panic!("it is still a target");
        };
        assert_eq!(target.position, [1.0, 2.0]);
        let of_driver = [2.0, 1.0].map(|upper| MotionLimits {
            position: [-upper, upper],
            velocity: 10.0 * upper,
            acceleration: 1.0,
            jerk: 1.0,
        });
        let limits = map.limits_in_chain(&of_driver);
        assert_eq!(limits[0].position, [-0.75, 1.25]);
        assert_eq!([limits[0].velocity, limits[1].velocity], [10.0, 20.0]);
        assert!(JointMap::new(&chain, &names[..1], &[]).is_err());
        let more = ["j2", "gripper", "j1"].map(str::to_owned);
        let refusal = JointMap::new(&chain, &more, &[]).expect_err("a joint too many");
        assert!(refusal.to_string().contains("3 joints"), "{refusal}");
    }
}
