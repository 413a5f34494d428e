//! Visual and collision shapes of the links in a URDF.

use crate::Transform;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// A shape that is attached to a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Pose of the shape in the frame of its link.
    pub link_from_shape: Transform,
    /// Form and size.
    pub geometry: Geometry,
    /// Red, green, blue (sRGB) and opacity, 0 to 1; `None` if the URDF sets no color.
    pub color_srgba: Option<[f64; 4]>,
}

/// Form and size of a shape. Its frame is in its center.
#[derive(Clone, Debug, PartialEq)]
pub enum Geometry {
    /// A box.
    Box {
        /// Lengths along x, y and z, meters.
        size_m: [f64; 3],
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius, meters.
        radius_m: f64,
        /// Length, meters.
        length_m: f64,
    },
    /// A cylinder along z with a half sphere at each end.
    Capsule {
        /// Radius, meters.
        radius_m: f64,
        /// Length of the cylinder, meters.
        length_m: f64,
    },
    /// A sphere.
    Sphere {
        /// Radius, meters.
        radius_m: f64,
    },
    /// A triangle mesh in a file.
    Mesh {
        /// The file as named in the URDF, such as `package://arm/meshes/link1.stl`.
        file: String,
        /// Scale along x, y and z; negative values mirror the mesh.
        scale: [f64; 3],
    },
}

/// Reads a visual shape. The error states which value is invalid.
pub(crate) fn visual(parsed: &urdf_rs::Visual, materials: &[urdf_rs::Material]) -> Result<Shape, String> {
    let color = |material: &urdf_rs::Material| {
        // A material without a color refers to a material of the robot by its name.
        let named = || materials.iter().find(|known| known.name == material.name)?.color.clone();
        material.color.clone().or_else(named)
    };
    let color_srgba = parsed.material.as_ref().and_then(color).map(|color| color.rgba.0);
    if let Some(color) = color_srgba.filter(|color| !color.iter().all(|channel| (0.0..=1.0).contains(channel))) {
        return Err(format!("its color is {color:?}, expected four numbers from 0 to 1"));
    }
    Ok(Shape { color_srgba, ..shape(&parsed.origin, &parsed.geometry)? })
}

/// Reads a collision shape. The error states which value is invalid.
pub(crate) fn collision(parsed: &urdf_rs::Collision) -> Result<Shape, String> {
    shape(&parsed.origin, &parsed.geometry)
}

fn shape(origin: &urdf_rs::Pose, geometry: &urdf_rs::Geometry) -> Result<Shape, String> {
    let (xyz, rpy) = (origin.xyz.0, origin.rpy.0);
    if xyz.iter().chain(&rpy).any(|number| !number.is_finite()) {
        return Err(format!("its origin is xyz {xyz:?}, rpy {rpy:?}, expected finite numbers"));
    }
    let positive = |what: &str, value: f64| match value > 0.0 && value.is_finite() {
        true => Ok(value),
        false => Err(format!("its {what} is {value}, expected a positive number")),
    };
    let geometry = match geometry {
        urdf_rs::Geometry::Box { size } => {
            let [x, y, z] = size.0;
            Geometry::Box { size_m: [positive("size", x)?, positive("size", y)?, positive("size", z)?] }
        }
        urdf_rs::Geometry::Cylinder { radius, length } => {
            Geometry::Cylinder { radius_m: positive("radius", *radius)?, length_m: positive("length", *length)? }
        }
        urdf_rs::Geometry::Capsule { radius, length } => {
            Geometry::Capsule { radius_m: positive("radius", *radius)?, length_m: positive("length", *length)? }
        }
        urdf_rs::Geometry::Sphere { radius } => Geometry::Sphere { radius_m: positive("radius", *radius)? },
        urdf_rs::Geometry::Mesh { filename, scale } => {
            let scale = scale.map_or([1.0; 3], |scale| scale.0);
            if scale.iter().any(|factor| !factor.is_finite() || *factor == 0.0) {
                return Err(format!("its scale is {scale:?}, expected finite numbers other than 0"));
            }
            Geometry::Mesh { file: filename.clone(), scale }
        }
    };
    let link_from_shape = Transform::from_parts(
        Translation3::from(Vector3::from(xyz)),
        UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]),
    );
    Ok(Shape { link_from_shape, geometry, color_srgba: None })
}

#[cfg(test)]
mod tests {
    use super::Geometry;
    use crate::urdf::Robot;
    use nalgebra::Point3;

    fn robot(shapes: &str) -> Robot {
        let xml = format!(
            r#"<robot name="r"><material name="steel"><color rgba="0.5 0.5 0.6 1"/></material>
               <link name="a">{shapes}</link></robot>"#
        );
        Robot::parse(&xml).expect("a robot")
    }

    #[test]
    fn shapes_keep_pose_size_and_color() {
        let robot = robot(
            r#"<visual><origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/><geometry><box size="1 2 3"/></geometry>
                 <material name="steel"/></visual>
               <visual><geometry><cylinder radius="0.1" length="0.4"/></geometry>
                 <material name="own"><color rgba="1 0 0 0.5"/></material></visual>
               <visual><geometry><sphere radius="0.2"/></geometry></visual>
               <visual><geometry><mesh filename="package://r/a.stl" scale="0.001 0.001 0.001"/></geometry></visual>
               <collision><geometry><capsule radius="0.1" length="0.3"/></geometry></collision>"#,
        );
        let visuals = robot.visuals("a");
        assert_eq!(visuals[0].geometry, Geometry::Box { size_m: [1.0, 2.0, 3.0] });
        assert_eq!(visuals[0].color_srgba, Some([0.5, 0.5, 0.6, 1.0]), "a material of the robot");
        let corner = visuals[0].link_from_shape * Point3::new(1.0, 0.0, 0.0);
        assert!((corner - Point3::new(1.0, 1.0, 0.0)).norm() < 1e-12, "{corner}");
        assert_eq!(visuals[1].geometry, Geometry::Cylinder { radius_m: 0.1, length_m: 0.4 });
        assert_eq!(visuals[1].color_srgba, Some([1.0, 0.0, 0.0, 0.5]));
        assert_eq!((&visuals[2].geometry, visuals[2].color_srgba), (&Geometry::Sphere { radius_m: 0.2 }, None));
        assert_eq!(visuals[3].geometry, Geometry::Mesh { file: "package://r/a.stl".into(), scale: [0.001; 3] });
        assert_eq!(robot.collisions("a")[0].geometry, Geometry::Capsule { radius_m: 0.1, length_m: 0.3 });
        assert!(robot.ignored_shapes().is_empty() && robot.visuals("b").is_empty());
    }

    #[test]
    fn invalid_shapes_are_ignored_with_a_reason() {
        for (shape, named) in [
            (r#"<geometry><sphere radius="-1"/></geometry>"#, "radius is -1"),
            (r#"<geometry><box size="1 0 1"/></geometry>"#, "size is 0"),
            (r#"<origin xyz="nan 0 0"/><geometry><sphere radius="1"/></geometry>"#, "origin"),
            (r#"<geometry><mesh filename="a.stl" scale="1 inf 1"/></geometry>"#, "scale"),
            (
                r#"<geometry><sphere radius="1"/></geometry><material name="x"><color rgba="2 0 0 1"/></material>"#,
                "color",
            ),
        ] {
            let robot = robot(&format!("<visual>{shape}</visual>"));
            assert!(robot.visuals("a").is_empty());
            let reasons = robot.ignored_shapes();
            assert!(reasons.len() == 1 && reasons[0].contains(named) && reasons[0].contains("\"a\""), "{reasons:?}");
        }
    }
}
