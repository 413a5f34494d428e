//! Real models, which are drawn and published on a thread of their own, like those of a run.

use gpu::{Gpu, GpuOptions};
use keyframe::scenes::{ball, floor, ring};
use kinematics::Transform;
use model_files::splat::arrays::SplatArrays;
use model_files::splat::cloud::scan_cloud;
use nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use trainer::splat::{SplatOptions, SplatTrainer};
use trainer::tsdf::{TsdfModel, TsdfOptions};
use trainer::{Method, ModelOptions, Projection, RenderRequest};
use viz::{Hub, ModelStatus, SceneHint, Status};

/// A wall of splats at y = 0 that faces -y. Without color coefficients of degree 3, which are not
/// sent.
#[expect(clippy::cast_possible_truncation, reason = "splats are f32")]
pub(crate) fn wall(n_splats: usize) -> SplatArrays {
    let mut splats = scan_cloud(n_splats, 4);
    // The wall is made for a camera that looks along z.
    let rotation =
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2);
    for mean in &mut splats.means {
        *mean = (rotation * Vector3::from(mean.map(f64::from)))
            .map(|along| along as f32)
            .into();
    }
    for wxyz in &mut splats.rotations_wxyz {
        let [w, x, y, z] = wxyz.map(f64::from);
        let rotated = rotation.into_inner() * Quaternion::new(w, x, y, z);
        *wxyz = [rotated.w, rotated.i, rotated.j, rotated.k].map(|part| part as f32);
    }
    splats
        .sh
        .chunks_exact_mut(16)
        .for_each(|coefficients| coefficients[9..].fill([0.0; 3]));
    splats
}

/// Publishes a view of the wall, and the status of a splat and a TSDF model that clients can draw.
///
/// * `others`: further models.
pub(crate) fn publish_wall(hub: &Hub, others: Vec<ModelStatus>) {
    let center = Point3::new(0.0, 0.0, 0.1);
    // Upright, and not along an axis.
    let eye = Point3::new(0.5, -2.9, 0.6);
    let upright = UnitQuaternion::face_towards(&(center - eye), &-Vector3::z());
    hub.set_scene_hint(SceneHint {
        center_m: center.into(),
        radius_m: 1.5,
        world_from_camera: Transform::from_parts(eye.into(), upright),
    });
    let status = |method: &str| ModelStatus {
        method: method.to_owned(),
        has_chunks: true,
        ..ModelStatus::default()
    };
    hub.set_status(Status {
        model: status("splat"),
        others: [vec![status("tsdf")], others].concat(),
        ..Status::default()
    });
}

pub(crate) fn gpu() -> Arc<Gpu> {
    Gpu::open(&GpuOptions::default()).expect("an adapter")
}

pub(crate) fn splat_model(splats: &SplatArrays) -> SplatTrainer {
    let options = ModelOptions::from(SplatOptions {
        max_splats: 1_000_000,
        ..SplatOptions::default()
    });
    SplatTrainer::from_arrays(gpu(), options, splats).expect("a model")
}

/// A ball on the floor, seen from a few sides.
pub(crate) fn tsdf_model(n_keyframes: usize) -> TsdfModel {
    let options = TsdfOptions {
        voxel_m: Some(0.02),
        ..TsdfOptions::default()
    };
    let mut model = TsdfModel::new(gpu(), ModelOptions::from(options)).expect("a model");
    for keyframe in ring(
        &[ball(Point3::origin()), floor()],
        Point3::origin(),
        n_keyframes,
    ) {
        model.push(keyframe).expect("a keyframe");
    }
    while !model.is_idle() {
        model.step(u64::MAX).expect("fused");
    }
    model
}

/// Models by method, and the requests so far.
pub(crate) struct ModelThread {
    requests: Arc<Mutex<Vec<ReceivedRequest>>>,
    /// Whether requests for depth alone fail.
    refuses_depth: Arc<AtomicBool>,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<Models>>,
}

/// A request, and whether it asks for colors.
type ReceivedRequest = (RenderRequest, bool);

pub(crate) type Models = Vec<(&'static str, Box<dyn Method + Send>)>;

impl ModelThread {
    pub(crate) fn start(hub: Hub, models: Models) -> Self {
        let requests: Arc<Mutex<Vec<ReceivedRequest>>> = Arc::default();
        let (refuses_depth, stop): (Arc<AtomicBool>, Arc<AtomicBool>) = Default::default();
        let (received, refuses, stopped) = (
            Arc::clone(&requests),
            Arc::clone(&refuses_depth),
            Arc::clone(&stop),
        );
        let thread = std::thread::spawn(move || serve(&hub, models, &received, &refuses, &stopped));
        Self {
            requests,
            refuses_depth,
            stop,
            thread: Some(thread),
        }
    }

    /// Lets requests for depth alone fail from now on.
    pub(crate) fn refuse_depth(&self) {
        self.refuses_depth.store(true, Ordering::Relaxed);
    }

    /// The newest request.
    pub(crate) fn last_request(&self) -> RenderRequest {
        self.requests
            .lock()
            .expect("no panic")
            .last()
            .expect("a picture was requested")
            .0
            .clone()
    }

    /// Number of requests for colors.
    pub(crate) fn n_color_requests(&self) -> usize {
        self.requests
            .lock()
            .expect("no panic")
            .iter()
            .filter(|(_, has_color)| *has_color)
            .count()
    }

    /// Ends the thread.
    pub(crate) fn finish(mut self) -> Models {
        self.stop.store(true, Ordering::Relaxed);
        self.thread
            .take()
            .expect("it runs")
            .join()
            .expect("no panic")
    }
}

fn serve(
    hub: &Hub,
    mut models: Models,
    requests: &Mutex<Vec<ReceivedRequest>>,
    refuses_depth: &AtomicBool,
    stop: &AtomicBool,
) -> Models {
    while !stop.load(Ordering::Relaxed) {
        hub.pictures().wait_for_request(Duration::from_millis(20));
        if let Some(pending) = hub.pictures().next_request() {
            let is_panorama = pending.request.projection == Projection::Equirectangular;
            let has_color = pending
                .packing()
                .is_none_or(|packing| packing.jpeg_quality.is_some());
            // Panoramas are requested for the surroundings of a view.
            if !is_panorama {
                requests
                    .lock()
                    .expect("no panic")
                    .push((pending.request.clone(), has_color));
            }
            if !has_color && refuses_depth.load(Ordering::Relaxed) {
                pending.fail("");
                continue;
            }
            let name = pending.method().unwrap_or(models[0].0).to_owned();
            match models.iter_mut().find(|(other, _)| *other == name) {
                Some((_, model)) => {
                    let picture = model.render(&pending.request).expect("drawn");
                    pending.deliver(picture);
                }
                None => pending.fail("no such model"),
            }
        }
        for (name, model) in &mut models {
            if hub.model_chunks().period(name).is_some() && !hub.model_chunks().contains(name) {
                let chunks = model
                    .queue_chunks(false, &Arc::default())
                    .expect("queued")
                    .expect("not empty")
                    .finish()
                    .expect("encoded");
                hub.model_chunks().set(name, chunks);
            }
        }
    }
    models
}
