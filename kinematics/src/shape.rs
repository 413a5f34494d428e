//! Visual and collision shapes of the links in a URDF.

use crate::Transform;
use crate::urdf::element::{Element, Notes, Problem};
use crate::urdf::joint::{ORIGIN_ATTRIBUTES, origin};
use std::collections::{HashMap, HashSet};

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

#[derive(Clone, Debug, Default)]
pub(crate) struct LinkShapes {
    pub(crate) visuals: Vec<Shape>,
    pub(crate) collisions: Vec<Shape>,
}

/// Reads the shapes of all links that have any. Invalid shapes and colors are noted and left out.
pub(crate) fn read_all(robot: Element<'_>, notes: &mut Notes) -> HashMap<String, LinkShapes> {
    let mut materials = Materials::new();
    for material in robot.all("material") {
        read_material(material, "the robot", &mut materials, notes);
    }
    let mut by_link = HashMap::<String, LinkShapes>::new();
    // A material that a link defines may be used by all others.
    let mut visuals = Vec::new();
    let mut seen = HashSet::new();
    for link in robot.all("link") {
        let name = link.attribute("name").unwrap_or_default();
        if !seen.insert(name) {
            continue;
        }
        let of_link = format!("link {name:?}");
        link.note_unknown(
            &["name", "type"],
            &["visual", "collision", "inertial"],
            notes,
        );
        check_inertials(link, &of_link, notes);
        for collision in link.all("collision") {
            if let Some(shape) = noted(
                shape(collision, notes),
                &format!("a collision shape of {of_link}"),
                notes,
            ) {
                by_link
                    .entry(name.to_owned())
                    .or_default()
                    .collisions
                    .push(shape);
            }
        }
        for visual in link.all("visual") {
            let material = noted(
                visual.only("material"),
                &format!("a material of {of_link}"),
                notes,
            )
            .flatten();
            if let Some(material) = material {
                read_material(material, &of_link, &mut materials, notes);
            }
            visuals.push((name, visual, material));
        }
    }
    for (link, visual, material) in visuals {
        if let Some(mut shape) = noted(
            shape(visual, notes),
            &format!("a visual shape of link {link:?}"),
            notes,
        ) {
            shape.color_srgba = material.and_then(|material| {
                own_color(material)
                    .ok()
                    .flatten()
                    .or_else(|| materials.get(material.attribute("name")?).copied())
            });
            by_link
                .entry(link.to_owned())
                .or_default()
                .visuals
                .push(shape);
        }
    }
    by_link
}

type Materials<'a> = HashMap<&'a str, [f64; 4]>;

/// The value, or `None` and a note.
fn noted<T>(read: Result<T, Problem>, what: &str, notes: &mut Notes) -> Option<T> {
    read.map_err(|Problem { line, why }| notes.add(line, &format!("{what} is not used: {why}")))
        .ok()
}

/// Remembers a material with a name and a color.
fn read_material<'a>(
    material: Element<'a>,
    owner: &str,
    materials: &mut Materials<'a>,
    notes: &mut Notes,
) {
    material.note_unknown(&["name"], &["color", "texture"], notes);
    let color = noted(own_color(material), &format!("a color of {owner}"), notes).flatten();
    if let (Some(name), Some(color)) = (material.attribute("name"), color) {
        materials.entry(name).or_insert(color);
    }
    if let Some(texture) = material.all("texture").next() {
        let file = texture.attribute("filename").unwrap_or_default();
        notes.add(
            texture.line(),
            &format!("a texture of {owner} is not drawn: {file:?}"),
        );
    }
}

fn own_color(material: Element<'_>) -> Result<Option<[f64; 4]>, Problem> {
    let Some(color) = material.only("color")? else {
        return Ok(None);
    };
    let rgba = color.numbers::<4>("rgba")?;
    match rgba {
        Some(rgba) if !rgba.iter().all(|channel| (0.0..=1.0).contains(channel)) => Err(color
            .problem(format!(
                "rgba is {rgba:?}, expected four numbers from 0 to 1"
            ))),
        rgba => Ok(rgba),
    }
}

/// Masses are not used, but an invalid one shows that the file is damaged or unfinished.
fn check_inertials(link: Element<'_>, of_link: &str, notes: &mut Notes) {
    for inertial in link.all("inertial") {
        let check = || -> Result<(), Problem> {
            let child = |tag| {
                inertial
                    .only(tag)?
                    .ok_or_else(|| inertial.problem(format!("it has no <{tag}>")))
            };
            child("mass")?.number("value")?;
            let inertia = child("inertia")?;
            for moment in ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"] {
                inertia.number(moment)?;
            }
            Ok(())
        };
        if let Err(Problem { line, why }) = check() {
            notes.add(
                line,
                &format!("the inertia of {of_link} is invalid (it is not used): {why}"),
            );
        }
    }
}

fn shape(element: Element<'_>, notes: &mut Notes) -> Result<Shape, Problem> {
    element.note_unknown(
        &["name", "group"],
        &["origin", "geometry", "material", "verbose"],
        notes,
    );
    let geometry = element
        .only("geometry")?
        .ok_or_else(|| element.problem("it has no <geometry>"))?;
    if let Ok(Some(origin)) = element.only("origin") {
        origin.note_unknown(&ORIGIN_ATTRIBUTES, &[], notes);
    }
    let forms: Vec<Element<'_>> = geometry.children().collect();
    let [form] = forms[..] else {
        return Err(geometry.problem(format!(
            "<geometry> has {} children, expected one",
            forms.len()
        )));
    };
    let attributes: &[&str] = match form.tag() {
        "box" => &["size"],
        "cylinder" | "capsule" => &["radius", "length"],
        "sphere" => &["radius"],
        "mesh" => &["filename", "scale"],
        other => {
            return Err(form.problem(format!(
                "unknown geometry <{other}>, expected box, cylinder, capsule, sphere or mesh"
            )));
        }
    };
    form.note_unknown(attributes, &[], notes);
    Ok(Shape {
        link_from_shape: origin(element)?,
        geometry: read_geometry(form)?,
        color_srgba: None,
    })
}

fn read_geometry(form: Element<'_>) -> Result<Geometry, Problem> {
    let positive = |what: &str, value: f64| match value > 0.0 {
        true => Ok(value),
        false => Err(form.problem(format!("its {what} is {value}, expected a positive number"))),
    };
    let length = |what: &str| {
        form.required(what)?;
        positive(what, form.number(what)?.unwrap_or_default())
    };
    Ok(match form.tag() {
        "box" => {
            form.required("size")?;
            let [x, y, z] = form.numbers("size")?.unwrap_or_default();
            Geometry::Box {
                size_m: [
                    positive("size", x)?,
                    positive("size", y)?,
                    positive("size", z)?,
                ],
            }
        }
        "cylinder" => Geometry::Cylinder {
            radius_m: length("radius")?,
            length_m: length("length")?,
        },
        "capsule" => Geometry::Capsule {
            radius_m: length("radius")?,
            length_m: length("length")?,
        },
        "sphere" => Geometry::Sphere {
            radius_m: length("radius")?,
        },
        _ => {
            let scale = form.numbers("scale")?.unwrap_or([1.0; 3]);
            if scale.contains(&0.0) {
                return Err(form.problem(format!(
                    "its scale is {scale:?}, expected numbers other than 0"
                )));
            }
            Geometry::Mesh {
                file: form.required("filename")?.to_owned(),
                scale,
            }
        }
    })
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
        assert_eq!(
            visuals[0].geometry,
            Geometry::Box {
                size_m: [1.0, 2.0, 3.0]
            }
        );
        assert_eq!(
            visuals[0].color_srgba,
            Some([0.5, 0.5, 0.6, 1.0]),
            "a material of the robot"
        );
        let corner = visuals[0].link_from_shape * Point3::new(1.0, 0.0, 0.0);
        assert!(
            (corner - Point3::new(1.0, 1.0, 0.0)).norm() < 1e-12,
            "{corner}"
        );
        assert_eq!(
            visuals[1].geometry,
            Geometry::Cylinder {
                radius_m: 0.1,
                length_m: 0.4
            }
        );
        assert_eq!(visuals[1].color_srgba, Some([1.0, 0.0, 0.0, 0.5]));
        assert_eq!(
            (&visuals[2].geometry, visuals[2].color_srgba),
            (&Geometry::Sphere { radius_m: 0.2 }, None)
        );
        assert_eq!(
            visuals[3].geometry,
            Geometry::Mesh {
                file: "package://r/a.stl".into(),
                scale: [0.001; 3]
            }
        );
        assert_eq!(
            robot.collisions("a")[0].geometry,
            Geometry::Capsule {
                radius_m: 0.1,
                length_m: 0.3
            }
        );
        assert!(robot.notes().is_empty() && robot.visuals("b").is_empty());
    }

    #[test]
    fn invalid_shapes_are_ignored_with_a_reason() {
        for (shape, named) in [
            (
                r#"<geometry><sphere radius="-1"/></geometry>"#,
                "radius is -1",
            ),
            (r#"<geometry><box size="1 0 1"/></geometry>"#, "size is 0"),
            (
                r#"<origin xyz="nan 0 0"/><geometry><sphere radius="1"/></geometry>"#,
                "origin",
            ),
            (
                r#"<geometry><mesh filename="a.stl" scale="1 inf 1"/></geometry>"#,
                "scale",
            ),
            (
                r#"<geometry><mesh/></geometry>"#,
                r#"<mesh> has no attribute "filename""#,
            ),
            (
                r#"<geometry><cone radius="1"/></geometry>"#,
                "unknown geometry <cone>",
            ),
            (r#"<geometry/>"#, "<geometry> has 0 children"),
            (r#"<origin xyz="0 0 0"/>"#, "it has no <geometry>"),
        ] {
            let robot = robot(&format!("<visual>{shape}</visual>"));
            assert!(robot.visuals("a").is_empty());
            let reasons = robot.notes();
            assert!(
                reasons.len() == 1 && reasons[0].contains(named) && reasons[0].contains("\"a\""),
                "{reasons:?}"
            );
        }
    }

    #[test]
    fn invalid_color_costs_only_the_color() {
        let sphere = r#"<geometry><sphere radius="1"/></geometry>"#;
        for color in ["2 0 0 1", "1 0 0", "red"] {
            let material = format!(r#"<material name="x"><color rgba="{color}"/></material>"#);
            let robot = robot(&format!("<visual>{sphere}{material}</visual>"));
            assert_eq!(robot.visuals("a")[0].color_srgba, None);
            let [note] = robot.notes() else {
                panic!("{:?}", robot.notes())
            };
            assert!(
                note.starts_with("line 2: a color of link \"a\" is not used: rgba"),
                "{note}"
            );
        }
    }

    #[test]
    fn material_of_another_link_is_found() {
        let sphere = r#"<geometry><sphere radius="1"/></geometry>"#;
        let robot = robot(&format!(
            r#"<visual>{sphere}<material name="red"/></visual></link>
               <link name="b"><visual>{sphere}<material name="red"><color rgba="1 0 0 1"/></material></visual>"#
        ));
        assert_eq!(
            robot.visuals("a")[0].color_srgba,
            Some([1.0, 0.0, 0.0, 1.0])
        );
    }
}
