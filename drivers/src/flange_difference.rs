//! Compares the flange pose of a robot description with the pose that the robot's controller
//! reports.

#[cfg(target_os = "linux")]
use kinematics::Chain;
use kinematics::Transform;

/// Difference between the flange poses of a robot description and of a controller, for the same
/// joint positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlangeDifference {
    /// Distance of the two flanges, meters.
    pub translation_m: f64,
    /// Angle between their orientations, radians.
    pub rotation_rad: f64,
}

impl FlangeDifference {
    /// The difference between two poses in the same frame.
    #[must_use]
    pub fn between(one: &Transform, other: &Transform) -> Self {
        let one_from_other = one.inverse() * other;
        Self {
            translation_m: one_from_other.translation.vector.norm(),
            rotation_rad: one_from_other.rotation.angle(),
        }
    }

    /// Whether both parts are at most as large as the limits. NaN is not.
    #[must_use]
    pub fn is_within(&self, max_m: f64, max_rad: f64) -> bool {
        self.translation_m <= max_m && self.rotation_rad <= max_rad
    }
}

impl std::fmt::Display for FlangeDifference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{:.1} mm and {:.2} degrees",
            self.translation_m * 1e3,
            self.rotation_rad.to_degrees()
        )
    }
}

/// The poses that are compared, all in the base frame of the controller.
#[cfg(target_os = "linux")]
#[derive(Clone, Copy, Debug)]
pub(crate) struct FlangePoses {
    /// The flange by the robot description.
    pub(crate) described: Transform,
    /// The flange by the controller.
    pub(crate) reported: Transform,
    /// The tool by the controller.
    pub(crate) base_from_tool: Transform,
}

#[cfg(target_os = "linux")]
impl FlangePoses {
    /// Computes the poses for one state of the robot.
    ///
    /// * `joint_names`, `position_rad`: the joints in the order of the controller.
    /// * `flange_from_tool`: the tool that is set in the controller. Its pose is removed, so that
    ///   the result depends only on the joints.
    ///
    /// # Errors
    ///
    /// If the chain has other joints.
    pub(crate) fn new(
        chain: &Chain,
        joint_names: &[String],
        position_rad: &[f64],
        base_from_tool: Transform,
        flange_from_tool: &Transform,
    ) -> Result<Self, String> {
        let chain_error = |error: kinematics::Error| error.to_string();
        let sequence = chain.order_in(joint_names).map_err(chain_error)?;
        // The chain may list the joints in another order than the robot.
        let q: Vec<f64> = sequence.iter().map(|ix| position_rad[*ix]).collect();
        Ok(Self {
            described: chain.forward(&q).map_err(chain_error)?,
            reported: base_from_tool * flange_from_tool.inverse(),
            base_from_tool,
        })
    }

    /// Both flange poses as the beginning of a sentence.
    ///
    /// * `source`: how the controller reports its flange.
    pub(crate) fn describe(
        &self,
        tip: &str,
        source: &str,
        difference: &FlangeDifference,
    ) -> String {
        format!(
            "the rig file puts {tip:?} at {}, but {source} at {}, {difference} away",
            format_pose(&self.described),
            format_pose(&self.reported)
        )
    }
}

#[cfg(target_os = "linux")]
fn format_pose(pose: &Transform) -> String {
    let [x, y, z] = pose.translation.vector.into();
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
    format!("({x:.4}, {y:.4}, {z:.4}) m, roll {roll:.2}, pitch {pitch:.2}, yaw {yaw:.2} degrees")
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    const URDF: &str = r#"<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
        <joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
        <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
        <joint name="j2" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
        <origin xyz="0.5 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"#;

    #[test]
    fn joints_are_matched_by_name_and_the_tool_is_removed() {
        let chain = Chain::from_urdf(URDF, "a", "c").expect("a chain");
        let names = ["j2", "j1"].map(str::to_owned);
        let tool = Transform::translation(0.0, 0.0, 0.1);
        let flange = chain.forward(&[0.3, -0.4]).expect("two joints");
        let poses = FlangePoses::new(&chain, &names, &[-0.4, 0.3], flange * tool, &tool)
            .expect("the same joints");
        let difference = FlangeDifference::between(&poses.described, &poses.reported);
        assert!(difference.is_within(1e-12, 1e-7), "{difference}");
        // In the wrong order, the flange is elsewhere.
        let swapped = FlangePoses::new(&chain, &names, &[0.3, -0.4], flange * tool, &tool)
            .expect("the same joints");
        let difference = FlangeDifference::between(&swapped.described, &swapped.reported);
        assert!(!difference.is_within(0.1, 0.1), "{difference}");
    }

    #[test]
    fn differences_are_in_millimeters_and_degrees() {
        let one = Transform::translation(0.0, 0.0012, 0.0);
        let other = Transform::rotation(nalgebra::Vector3::z() * 0.5_f64.to_radians());
        let difference = FlangeDifference::between(&one, &other);
        assert_eq!(difference.to_string(), "1.2 mm and 0.50 degrees");
        let invalid = FlangeDifference {
            translation_m: f64::NAN,
            ..difference
        };
        assert!(!invalid.is_within(1.0, 1.0));
    }
}
