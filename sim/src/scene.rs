//! Builds the MuJoCo model of a scene and its robot.

use crate::base;
use crate::config::{Config, Parent, Scene, TargetParent};
use crate::convex_pieces::convex_pieces;
use crate::objects::{self, Object};
use crate::texture::Texture;
use crate::texture_cache::{self, Textures};
use crate::twin::{Pedestal, RobotBody, RobotConfig, TwinPlan};
use crate::{Error, cabinet, lab, light, panda, printed_target};
use kinematics::Transform;
use mujoco_rs::prelude::MjModel;
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use nalgebra::{Point3, Translation3};
use parking_lot::Mutex;
use rayon::prelude::{IntoParallelIterator, ParallelIterator};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

/// Group of the arm's geometry. The arm can be hidden by hiding this group.
pub(crate) const ARM_GROUP: usize = 1;
/// Group of transparent geometry.
pub(crate) const GLASS_GROUP: usize = 2;

/// Near and far plane, meters. The larger the ratio of far to near, the lower is the resolution of
/// the depth buffer. Each scene therefore has the narrowest range that contains it.
pub(crate) fn near_far_m(scene: Scene) -> [f64; 2] {
    match scene {
        Scene::StaticArm | Scene::MobileArm => [0.02, 12.0],
        Scene::MobileBase => [0.05, 25.0],
    }
}

/// Factor on all lamps. Rooms whose walls face away from the key lamp need more light.
fn brightness(scene: Scene) -> f64 {
    match scene {
        Scene::StaticArm => 1.0,
        Scene::MobileBase => 1.35,
        Scene::MobileArm => 1.15,
    }
}

/// Builds the model with the scene's own robot, for rendered images of up to `largest_px`.
pub(crate) fn build(config: &Config, largest_px: [u32; 2]) -> Result<MjModel, Error> {
    build_with(config, None, largest_px)
}

/// Builds the model with the robot of a rig file, for rendered images of up to `largest_px`.
pub(crate) fn build_twin(
    config: &Config,
    (robot, plan): (&RobotConfig, &TwinPlan),
    largest_px: [u32; 2],
) -> Result<MjModel, Error> {
    build_with(config, Some((robot, plan)), largest_px)
}

fn build_with(
    config: &Config,
    twin: Option<(&RobotConfig, &TwinPlan)>,
    largest_px: [u32; 2],
) -> Result<MjModel, Error> {
    let mut files = MjVfs::new();
    let mut assets = format!("{MATERIALS}{}", extra_materials(config.scene));
    let mut bodies = String::new();
    let scene_assets = SceneAssets::get(config.scene)?;
    // The scene comes first. It consists of textures, each with a material of the same name, and
    // then meshes.
    for (name, png) in &scene_assets.textures_png {
        add_file(&mut files, &format!("{name}.png"), png)?;
        let specular = if name == "metal" { 0.25 } else { 0.03 };
        let _ = writeln!(
            assets,
            "<texture name=\"{name}\" type=\"2d\" file=\"{name}.png\"/>\n\
             <material name=\"{name}\" texture=\"{name}\" specular=\"{specular}\" shininess=\"0.4\"/>"
        );
    }
    for Object {
        name,
        material,
        mesh,
        world_from_mesh,
    } in &scene_assets.objects
    {
        // The frame of the table includes the pedestal of the scene's own robot.
        let msh = if twin.is_some() && config.scene == Scene::StaticArm && *name == "frame" {
            objects::table_frame().to_msh()
        } else {
            mesh.to_msh()
        };
        add_file(&mut files, &format!("{name}.msh"), &msh)?;
        let _ = writeln!(
            assets,
            "<mesh name=\"{name}\" file=\"{name}.msh\" inertia=\"shell\"/>"
        );
        let pose = panda::pose_attributes(world_from_mesh);
        let group = if *material == "glass" { GLASS_GROUP } else { 0 };
        let _ = writeln!(
            bodies,
            "<geom type=\"mesh\" mesh=\"{name}\" material=\"{material}\" group=\"{group}\" {pose}/>"
        );
    }
    let (lamps, ambient) = light::mjcf(brightness(config.scene));
    // The robot of a rig file stays where it is, and the scene with its lamps is moved.
    let mut bodies = match twin {
        Some((_, plan)) => format!(
            "<body name=\"scene\" {}>\n{lamps}{bodies}</body>\n",
            panda::pose_attributes(&plan.world_from_scene)
        ),
        None => lamps + &bodies,
    };
    // Then come the printed targets. Targets on the flange become part of the arm's last body.
    let mut on_flange = String::new();
    let mut in_hand = String::new();
    for (ix, target) in config.targets.iter().enumerate() {
        let printed_target::Printed { png, mesh, plate } = printed_target::print(target)?;
        let name = format!("target{ix}");
        // A hand moves the whole body of the target.
        let pose = match target.parent {
            TargetParent::Hand { .. } => String::new(),
            _ => panda::pose_attributes(&target.parent_from_board),
        };
        add_file(&mut files, &format!("{name}.png"), &png)?;
        add_file(&mut files, &format!("{name}.msh"), &mesh.to_msh())?;
        add_file(&mut files, &format!("{name}_plate.msh"), &plate.to_msh())?;
        let _ = writeln!(
            assets,
            "<texture name=\"{name}\" type=\"2d\" file=\"{name}.png\"/>\n\
             <material name=\"{name}\" texture=\"{name}\" specular=\"0\"/>\n\
             <mesh name=\"{name}\" file=\"{name}.msh\" inertia=\"shell\"/>\n\
             <mesh name=\"{name}_plate\" file=\"{name}_plate.msh\" inertia=\"shell\"/>"
        );
        // The target is visible even if the arm is hidden, and it has no mass.
        let geoms = format!(
            "<geom type=\"mesh\" mesh=\"{name}\" material=\"{name}\" group=\"0\" mass=\"0\" {pose}/>\n\
             <geom type=\"mesh\" mesh=\"{name}_plate\" material=\"frame\" group=\"0\" mass=\"0\" {pose}/>\n"
        );
        match target.parent {
            TargetParent::World => bodies += &geoms,
            TargetParent::Flange => on_flange += &geoms,
            TargetParent::Hand { .. } => {
                let _ = writeln!(in_hand, "<body mocap=\"true\">\n{geoms}</body>");
            }
        }
    }
    // Contacts are off, because no objects touch each other. Shadows are off, because they are
    // baked into the textures.
    let [near, far] = near_far_m(config.scene);
    let [width, height] = largest_px;
    let (compiler, robot) = match twin {
        // Principal moments in a robot description may violate the triangle inequality slightly.
        Some((robot, plan)) => (
            "<compiler angle=\"radian\" autolimits=\"true\" balanceinertia=\"true\"/>",
            add_twin(
                &mut files,
                &mut assets,
                plan.body(robot, &(brackets(config) + &on_flange)),
                plan.pedestal.as_ref(),
            )?,
        ),
        None => (
            "<compiler angle=\"radian\" autolimits=\"true\"/>",
            robot(config, &on_flange),
        ),
    };
    let xml = format!(
        "<mujoco model=\"{}\">\n\
         {compiler}\n\
         <option timestep=\"0.001\" integrator=\"implicitfast\"><flag contact=\"disable\"/></option>\n\
         <statistic extent=\"1\" center=\"0.7 0 0.2\"/>\n\
         <visual>\n\
         <global offwidth=\"{width}\" offheight=\"{height}\"/>\n\
         <quality shadowsize=\"0\" offsamples=\"0\" numslices=\"24\" numstacks=\"12\"/>\n\
         {ambient}\n\
         <map znear=\"{near}\" zfar=\"{far}\"/>\n\
         </visual>\n\
         <default><geom contype=\"0\" conaffinity=\"0\" group=\"0\"/>\n\
         <default class=\"arm\"><geom contype=\"0\" conaffinity=\"0\" group=\"{ARM_GROUP}\" mass=\"0\"/></default></default>\n\
         <asset>\n{assets}</asset>\n\
         <worldbody>\n{bodies}{robot}{in_hand}</worldbody>\n</mujoco>\n",
        config.scene.name()
    );
    add_file(&mut files, "scene.xml", xml.as_bytes())?;
    MjModel::from_xml_vfs("scene.xml", &files).map_err(|error| Error::Scene {
        reason: error.to_string(),
    })
}

/// Builds the model that counts contacts of the robot with the scene: the robot, and convex pieces of
/// all objects. Nothing is drawn.
pub(crate) fn build_contacts(
    config: &Config,
    twin: Option<(&RobotConfig, &TwinPlan)>,
) -> Result<MjModel, Error> {
    let mut files = MjVfs::new();
    let mut assets = MATERIALS.to_owned();
    let mut bodies = String::new();
    let world_from_scene = twin.map_or_else(Transform::identity, |(_, plan)| plan.world_from_scene);
    let scene_assets = SceneAssets::get(config.scene)?;
    for object in &scene_assets.objects {
        let pose = panda::pose_attributes(&(world_from_scene * object.world_from_mesh));
        let name = object.name;
        // Each object is a body, so that its pieces are counted as one.
        let _ = writeln!(bodies, "<body name=\"{name}\" {pose}>");
        for (ix, points) in convex_pieces(object).iter().enumerate() {
            let vertices: Vec<String> = points.iter().map(list).collect();
            let vertices = vertices.join(" ");
            let _ = writeln!(assets, "<mesh name=\"{name}{ix}\" vertex=\"{vertices}\"/>");
            let _ = writeln!(bodies, "<geom type=\"mesh\" mesh=\"{name}{ix}\"/>");
        }
        bodies.push_str("</body>\n");
    }
    let robot = match twin {
        Some((robot, plan)) => add_twin(
            &mut files,
            &mut assets,
            plan.quiet_body(robot, &brackets(config)),
            plan.pedestal.as_ref(),
        )?,
        None => robot(config, ""),
    };
    // Only pairs of a part of the robot and an object are tested.
    let xml = format!(
        "<mujoco model=\"contacts\">\n\
         <compiler angle=\"radian\" autolimits=\"true\" balanceinertia=\"true\"/>\n\
         <default><geom contype=\"0\" conaffinity=\"1\"/>\n\
         <default class=\"arm\"><geom contype=\"1\" conaffinity=\"0\" mass=\"0\"/></default></default>\n\
         <asset>\n{assets}</asset>\n\
         <worldbody>\n{bodies}{robot}</worldbody>\n</mujoco>\n"
    );
    add_file(&mut files, "contacts.xml", xml.as_bytes())?;
    MjModel::from_xml_vfs("contacts.xml", &files).map_err(|error| Error::Scene {
        reason: error.to_string(),
    })
}

/// Numbers in full precision, as MJCF lists them.
fn list(numbers: &[f64; 3]) -> String {
    numbers.map(|number| format!("{number:e}")).join(" ")
}

/// Adds the files and assets of a rig file's robot. Returns its elements.
fn add_twin(
    files: &mut MjVfs,
    assets: &mut String,
    body: RobotBody,
    pedestal: Option<&Pedestal>,
) -> Result<String, Error> {
    for (name, bytes) in &body.files {
        add_file(files, name, bytes)?;
    }
    assets.push_str(&body.assets);
    let mut xml = body.body;
    if let Some(Pedestal { center_m, half_m }) = pedestal {
        let _ = writeln!(
            xml,
            "<geom type=\"box\" pos=\"{}\" size=\"{}\" material=\"frame\"/>",
            list(center_m),
            list(half_m)
        );
    }
    Ok(xml)
}

/// MJCF body of the robot, which is an arm alone, or a base with or without an arm.
fn robot(config: &Config, on_flange: &str) -> String {
    let arm = if config.scene.has_arm() {
        panda::mjcf(&(brackets(config) + on_flange))
    } else {
        String::new()
    };
    if !config.scene.has_moving_base() {
        return arm;
    }
    let top_plate_pose = panda::pose_attributes(&base::base_from_arm());
    format!(
        "<body name=\"base\" mocap=\"true\" childclass=\"arm\">\n{QUADRUPED}<body name=\"top_plate\" {top_plate_pose}>\n{arm}</body>\n</body>\n"
    )
}

/// Body, legs and head of the quadruped, centered at the origin.
const QUADRUPED: &str = "<geom type=\"box\" size=\"0.38 0.13 0.08\" material=\"quadruped\"/>\n\
     <geom type=\"box\" pos=\"0.42 0 0.02\" size=\"0.06 0.09 0.06\" material=\"arm_gray\"/>\n\
     <geom type=\"cylinder\" pos=\"-0.2 0 0.13\" size=\"0.05 0.035\" material=\"arm_gray\"/>\n\
     <geom type=\"capsule\" fromto=\"0.3 0.17 0 0.2 0.19 -0.26\" size=\"0.04\" material=\"quadruped\"/>\n\
     <geom type=\"capsule\" fromto=\"0.2 0.19 -0.26 0.3 0.19 -0.49\" size=\"0.025\" material=\"arm_gray\"/>\n\
     <geom type=\"capsule\" fromto=\"0.3 -0.17 0 0.2 -0.19 -0.26\" size=\"0.04\" material=\"quadruped\"/>\n\
     <geom type=\"capsule\" fromto=\"0.2 -0.19 -0.26 0.3 -0.19 -0.49\" size=\"0.025\" material=\"arm_gray\"/>\n\
     <geom type=\"capsule\" fromto=\"-0.3 0.17 0 -0.4 0.19 -0.26\" size=\"0.04\" material=\"quadruped\"/>\n\
     <geom type=\"capsule\" fromto=\"-0.4 0.19 -0.26 -0.3 0.19 -0.49\" size=\"0.025\" material=\"arm_gray\"/>\n\
     <geom type=\"capsule\" fromto=\"-0.3 -0.17 0 -0.4 -0.19 -0.26\" size=\"0.04\" material=\"quadruped\"/>\n\
     <geom type=\"capsule\" fromto=\"-0.4 -0.19 -0.26 -0.3 -0.19 -0.49\" size=\"0.025\" material=\"arm_gray\"/>\n";

fn extra_materials(scene: Scene) -> &'static str {
    match scene {
        Scene::StaticArm => "",
        Scene::MobileBase => lab::MATERIALS,
        Scene::MobileArm => cabinet::MATERIALS,
    }
}

/// Assets of a scene. They are created once per process, because this takes a second and does not
/// depend on the configuration.
struct SceneAssets {
    textures_png: Textures,
    objects: Vec<Object>,
}

impl SceneAssets {
    fn get(scene: Scene) -> Result<Arc<Self>, Error> {
        static SCENE_ASSETS: Mutex<BTreeMap<&str, Arc<SceneAssets>>> = Mutex::new(BTreeMap::new());
        // The lock is held while assets are created, so that two rigs that open at once do not
        // create the same assets twice.
        let mut all = SCENE_ASSETS.lock();
        if let Some(scene_assets) = all.get(scene.name()) {
            return Ok(Arc::clone(scene_assets));
        }
        let objects = match scene {
            Scene::StaticArm => objects::objects(),
            Scene::MobileBase => lab::objects(),
            Scene::MobileArm => cabinet::objects(),
        };
        let textures_png = texture_cache::textures(scene.name(), || create_textures(scene))?;
        let scene_assets = Arc::new(Self {
            textures_png,
            objects,
        });
        all.insert(scene.name(), Arc::clone(&scene_assets));
        Ok(scene_assets)
    }
}

/// Paints and lights the textures of a scene.
fn create_textures(scene: Scene) -> Result<Textures, Error> {
    let textures = match scene {
        Scene::StaticArm => objects::textures(),
        Scene::MobileBase => lab::textures(),
        Scene::MobileArm => cabinet::textures(),
    };
    // Compression takes long, so textures are compressed in parallel.
    textures.into_par_iter().map(encode_texture).collect()
}

/// A texture as the bytes of a PNG file.
fn encode_texture((name, texture): (&'static str, Texture)) -> Result<(String, Vec<u8>), Error> {
    texture
        .to_png()
        .map(|png| (name.to_owned(), png))
        .map_err(|source| Error::Texture {
            name: name.to_owned(),
            source,
        })
}

const MATERIALS: &str = "<material name=\"arm_white\" rgba=\"0.93 0.93 0.92 1\" specular=\"0.4\" shininess=\"0.6\"/>\n\
     <material name=\"arm_gray\" rgba=\"0.28 0.29 0.31 1\" specular=\"0.3\" shininess=\"0.5\"/>\n\
     <material name=\"quadruped\" rgba=\"0.95 0.76 0.10 1\" specular=\"0.3\" shininess=\"0.5\"/>\n\
     <material name=\"frame\" rgba=\"0.20 0.21 0.23 1\" specular=\"0.1\"/>\n";

fn add_file(files: &mut MjVfs, name: &str, bytes: &[u8]) -> Result<(), Error> {
    files
        .add_from_buffer(name, bytes)
        .map_err(|error| Error::Scene {
            reason: format!("{name}: {error}"),
        })
}

/// Camera bodies on the flange, just behind the optical centers.
fn brackets(config: &Config) -> String {
    let mut xml = String::new();
    for camera in config
        .cameras
        .iter()
        .filter(|camera| camera.parent == Parent::Flange)
    {
        // The housing ends behind the optical center, so that it does not block the camera's view.
        let pose = panda::pose_attributes(
            &(camera.parent_from_camera * Translation3::new(0.0, 0.0, -0.016)),
        );
        let [x, y, z] = (camera.parent_from_camera * Point3::new(0.0, 0.0, -0.02))
            .coords
            .into();
        let _ = writeln!(
            xml,
            "<geom type=\"box\" {pose} size=\"0.045 0.0125 0.0125\" material=\"arm_gray\"/>\n\
             <geom type=\"capsule\" fromto=\"0 0 0 {x} {y} {z}\" size=\"0.008\" material=\"arm_gray\"/>"
        );
    }
    xml
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::panda::Joints;
    use mujoco_rs::prelude::{MjData, MjtObjBase};
    use nalgebra::{Quaternion, UnitQuaternion, Vector3};

    #[test]
    fn flange_matches_kinematics_and_urdf() {
        const TOLERANCE: f64 = 1e-9;
        let model = build(&Config::default(), [64, 64]).expect("the scene is valid");
        let flange_ix = model
            .name_to_id(MjtObjBase::mjOBJ_BODY, "panda_link8")
            .expect("the flange is a body");
        let chain = kinematics::Chain::from_urdf(crate::PANDA_URDF, "panda_link0", "panda_link8")
            .expect("valid");
        let mut data = MjData::new(&model);
        for position_rad in [
            [0.0; 7],
            [0.4, -0.9, 1.3, -2.2, -0.7, 1.8, 0.6],
            [-2.1, 1.1, 0.3, -0.4, 2.2, 3.1, -1.9],
        ] {
            data.qpos_mut().copy_from_slice(&position_rad);
            data.forward_kinematics();
            let [w, x, y, z] = data.xquat()[flange_ix];
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let ours = panda::base_from_flange(&Joints::from(position_rad));
            let urdf = chain.forward(&position_rad).expect("seven joints");
            for pose in [ours, urdf] {
                assert!(
                    (pose.translation.vector - Vector3::from(data.xpos()[flange_ix])).norm()
                        < TOLERANCE
                );
                assert!(pose.rotation.angle_to(&rotation) < 10.0 * TOLERANCE);
            }
        }
    }

    #[test]
    fn moving_base_and_arm_match_urdfs() {
        const TOLERANCE: f64 = 1e-9;
        let names = |scene: Scene| {
            if scene.has_arm() {
                Config::default().joint_names
            } else {
                Vec::new()
            }
        };
        for scene in [Scene::MobileBase, Scene::MobileArm] {
            let mut config = Config {
                scene,
                joint_names: names(scene),
                reading_order: names(scene),
                ..Config::default()
            };
            if !scene.has_arm() {
                config.cameras[0].parent = Parent::Base;
            }
            let model = build(&config, [64, 64]).expect("the scene is valid");
            let tip = if scene.has_arm() {
                "panda_link8"
            } else {
                "top_plate"
            };
            let chain = kinematics::Chain::from_urdf(crate::rig::urdf_of(scene), "base", tip)
                .expect("valid");
            let tip_ix = model
                .name_to_id(MjtObjBase::mjOBJ_BODY, tip)
                .expect("a body");
            let mut data = MjData::new(&model);
            let position_rad: &[f64] = if scene.has_arm() {
                &[0.4, -0.9, 1.3, -2.2, -0.7, 1.8, 0.6]
            } else {
                &[]
            };
            let world_from_base = crate::base::BaseMotion::of(scene, 1.0).world_from_base(16.3);
            data.qpos_mut().copy_from_slice(position_rad);
            crate::render::set_base_pose(&mut data, &world_from_base);
            data.forward_kinematics();
            let expected = world_from_base * chain.forward(position_rad).expect("as many joints");
            let [w, x, y, z] = data.xquat()[tip_ix];
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            assert!(
                (expected.translation.vector - Vector3::from(data.xpos()[tip_ix])).norm()
                    < TOLERANCE
            );
            assert!(expected.rotation.angle_to(&rotation) < 10.0 * TOLERANCE);
        }
    }
}
