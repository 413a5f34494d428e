//! Visual and collision shapes of the links in a URDF.

use crate::Transform;
use crate::inertial::{self, Inertial};
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
    /// Red, green, blue (sRGB) and opacity, 0 to 1. `None` if the URDF sets no color.
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
        /// Scale along x, y and z. Negative values mirror the mesh.
        scale: [f64; 3],
    },
}

#[derive(Clone, Debug, Default)]
pub(crate) struct LinkShapes {
    pub(crate) visuals: Vec<Shape>,
    pub(crate) collisions: Vec<Shape>,
    pub(crate) inertial: Option<Inertial>,
}

/// Reads the shapes of all links that have any. Invalid shapes and colors are noted and left out.
pub(crate) fn read_all(robot: Element<'_>, notes: &mut Notes) -> HashMap<String, LinkShapes> {
    let mut materials = Materials::new();
    // Materials of the robot are read first, so that they take precedence over materials of links
    // with the same name.
    for material in robot.all("material") {
        read_material(material, "the robot", &mut materials, notes);
    }
    let mut by_link = HashMap::<String, LinkShapes>::new();
    // Visual shapes are added after all links have been read. All other links, including earlier
    // links, may use a material that a link defines.
    let mut visuals = Vec::new();
    let mut seen = HashSet::new();
    for link in robot.all("link") {
        let name = link.attribute("name").unwrap_or_default();
        // If several links have the same name, the robot uses the first link. The other links have
        // already been noted.
        if !seen.insert(name) {
            continue;
        }
        let of_link = format!("link {name:?}");
        link.note_unknown(
            &["name", "type"],
            &["visual", "collision", "inertial"],
            notes,
        );
        if let Some(inertial) = read_inertial(link, &of_link, notes) {
            by_link.entry(name.to_owned()).or_default().inertial = Some(inertial);
        }
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
    add_visuals(visuals, &materials, &mut by_link, notes);
    by_link
}

/// A visual shape with the name of its link and its material, if it has a valid one.
type Visual<'a> = (&'a str, Element<'a>, Option<Element<'a>>);

/// Reads the visual shapes and gives each shape its color. The color is its own, or the color of
/// the material that it names.
fn add_visuals<'a>(
    visuals: Vec<Visual<'a>>,
    materials: &Materials<'a>,
    by_link: &mut HashMap<String, LinkShapes>,
    notes: &mut Notes,
) {
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
}

type Materials<'a> = HashMap<&'a str, [f64; 4]>;

/// Returns the value, or `None` after adding a note.
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
        // As with links, the first definition is used. A material without a color is a reference
        // and defines nothing.
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
        // Values from 0 to 255 are a common mistake. They would be drawn as white.
        Some(rgba) if !rgba.iter().all(|channel| (0.0..=1.0).contains(channel)) => Err(color
            .problem(format!(
                "rgba is {rgba:?}, expected four numbers from 0 to 1"
            ))),
        rgba => Ok(rgba),
    }
}

/// The first valid mass and inertia of a link. Only a simulation uses mass and inertia. Invalid
/// values are noted anyway, because they show that the file is damaged or unfinished.
fn read_inertial(link: Element<'_>, of_link: &str, notes: &mut Notes) -> Option<Inertial> {
    let mut first = None;
    for element in link.all("inertial") {
        match inertial::read(element) {
            Ok(inertial) => first = first.or(Some(inertial)),
            Err(Problem { line, why }) => notes.add(
                line,
                &format!("the inertia of {of_link} is invalid (it is not used): {why}"),
            ),
        }
    }
    first
}

/// Reads a visual or collision shape, without its color.
fn shape(element: Element<'_>, notes: &mut Notes) -> Result<Shape, Problem> {
    element.note_unknown(
        &["name", "group"],
        &["origin", "geometry", "material", "verbose"],
        notes,
    );
    let geometry = element.required_child("geometry")?;
    // This only notes unknown attributes. Problems of the element are reported when the pose is
    // read below.
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
    // The tag decides which attributes are known, so it is checked before them.
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

/// A required attribute that is a positive number.
fn length(form: Element<'_>, attribute: &str) -> Result<f64, Problem> {
    form.required(attribute)?;
    positive(form, attribute, form.number(attribute)?.unwrap_or_default())
}

/// The value, or a problem if it is not positive.
fn positive(form: Element<'_>, what: &str, value: f64) -> Result<f64, Problem> {
    if value > 0.0 {
        return Ok(value);
    }
    Err(form.problem(format!("its {what} is {value}, expected a positive number")))
}

fn read_geometry(form: Element<'_>) -> Result<Geometry, Problem> {
    Ok(match form.tag() {
        "box" => {
            form.required("size")?;
            let [x, y, z] = form.numbers("size")?.unwrap_or_default();
            Geometry::Box {
                size_m: [
                    positive(form, "size", x)?,
                    positive(form, "size", y)?,
                    positive(form, "size", z)?,
                ],
            }
        }
        "cylinder" => Geometry::Cylinder {
            radius_m: length(form, "radius")?,
            length_m: length(form, "length")?,
        },
        "capsule" => Geometry::Capsule {
            radius_m: length(form, "radius")?,
            length_m: length(form, "length")?,
        },
        "sphere" => Geometry::Sphere {
            radius_m: length(form, "radius")?,
        },
        _ => {
            let scale = form.numbers("scale")?.unwrap_or([1.0; 3]);
            // A scale of zero flattens the mesh, and its normals cannot be computed. Negative
            // values are allowed, because they mirror the mesh.
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
