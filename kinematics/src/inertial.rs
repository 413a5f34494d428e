//! Masses and inertias of the links in a URDF, which only a simulation uses.

use crate::Transform;
use crate::urdf::element::{Element, Problem};
use crate::urdf::joint::origin;
use nalgebra::Matrix3;

/// Mass and inertia of a link as the URDF states them. The numbers are finite, but they need not be
/// physically possible. Many files contain zeros.
#[derive(Clone, Debug, PartialEq)]
pub struct Inertial {
    /// Pose of the inertia's frame in the frame of the link. Its origin is the center of mass.
    pub link_from_inertia: Transform,
    /// Mass, kilograms.
    pub mass_kg: f64,
    /// Symmetric inertia tensor about the center of mass, kg m^2.
    pub tensor: Matrix3<f64>,
}

/// Reads all numbers of an `<inertial>` element. A missing number is 0.
pub(crate) fn read(inertial: Element<'_>) -> Result<Inertial, Problem> {
    let mass_kg = inertial.required_child("mass")?.number("value")?;
    let inertia = inertial.required_child("inertia")?;
    let mut moments = [0.0; 6];
    for (moment, name) in moments
        .iter_mut()
        .zip(["ixx", "ixy", "ixz", "iyy", "iyz", "izz"])
    {
        *moment = inertia.number(name)?.unwrap_or_default();
    }
    let [xx, xy, xz, yy, yz, zz] = moments;
    Ok(Inertial {
        link_from_inertia: origin(inertial)?,
        mass_kg: mass_kg.unwrap_or_default(),
        tensor: Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz),
    })
}

#[cfg(test)]
mod tests {
    use crate::urdf::Robot;
    use nalgebra::{Matrix3, Vector3};

    fn robot(inertial: &str) -> Robot {
        Robot::parse(&format!(
            r#"<robot name="r"><link name="a">{inertial}</link></robot>"#
        ))
        .expect("a robot")
    }

    #[test]
    fn mass_and_tensor_are_read_in_their_frame() {
        let robot = robot(
            r#"<inertial><origin xyz="0.1 0 -0.2"/><mass value="2.5"/>
               <inertia ixx="1" ixy="2" ixz="3" iyy="4" iyz="5" izz="6"/></inertial>"#,
        );
        let inertial = robot.inertial("a").expect("it has a mass");
        assert_eq!(inertial.mass_kg, 2.5);
        assert_eq!(
            inertial.link_from_inertia.translation.vector,
            Vector3::new(0.1, 0.0, -0.2)
        );
        let tensor = Matrix3::new(1.0, 2.0, 3.0, 2.0, 4.0, 5.0, 3.0, 5.0, 6.0);
        assert_eq!(inertial.tensor, tensor);
        assert_eq!(robot.inertial("b"), None);
    }

    #[test]
    fn invalid_inertia_is_noted_and_left_out() {
        let robot = robot(r#"<inertial><mass value="heavy"/><inertia ixx="1"/></inertial>"#);
        assert_eq!(robot.inertial("a"), None);
        assert!(
            robot.notes()[0].contains("the inertia of"),
            "{:?}",
            robot.notes()
        );
    }
}
