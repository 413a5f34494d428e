//! Benchmarks of the signed distance field with voxels of 1 cm. They measure fusing a keyframe of
//! 640x480 with color, rendering, and meshing. Times for fusing, rendering, and meshing the changes
//! of one keyframe are GPU times if the adapter has timestamps. The times of all passes of one
//! keyframe are printed first.

use criterion::{Criterion, criterion_group, criterion_main};
use gpu::{Gpu, GpuOptions, PassTiming};
use keyframe::Keyframe;
use keyframe::scenes::{TestShape, large_keyframe, look_at};
use kinematics::Stamp;
use nalgebra::{Point3, Vector3};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::tsdf::{TsdfModel, TsdfOptions};
use trainer::{Method, Projection, RenderRequest};

/// Number of keyframes that are fused before anything is measured. Measurements fuse the same
/// images again.
const N_KEYFRAMES: usize = 12;

/// A ball on a floor in front of a wall. The camera moves around it.
fn keyframes() -> Vec<Arc<Keyframe>> {
    let shapes = [
        TestShape::Sphere {
            center_m: Point3::new(0.0, 0.0, 0.3),
            radius_m: 0.3,
        },
        TestShape::Plane {
            normal: Vector3::z(),
            offset_m: 0.0,
        },
        TestShape::Plane {
            normal: Vector3::new(0.0, -1.0, 0.0),
            offset_m: -1.5,
        },
    ];
    let keyframe_at = |ix: usize| {
        let turn_rad = 0.02 * ix as f64 - 1.57;
        let eye = Point3::new(1.6 * turn_rad.cos(), 1.6 * turn_rad.sin(), 0.9);
        Arc::new(large_keyframe(
            ix as i64,
            &shapes,
            look_at(eye, Point3::new(0.0, 0.3, 0.3)),
        ))
    };
    (0..N_KEYFRAMES).map(keyframe_at).collect()
}

/// Fuses the same images again and again, with new stamps.
struct Fusion {
    model: TsdfModel,
    keyframes: Vec<Arc<Keyframe>>,
    n_pushed: usize,
}

impl Fusion {
    fn new() -> Self {
        let gpu = Gpu::open(&GpuOptions::default()).expect("an adapter");
        eprintln!("{}", gpu.describe());
        let options = TsdfOptions {
            voxel_m: Some(0.01),
            noise_per_m2: Some(1.5e-3),
            ..TsdfOptions::default()
        };
        let model = TsdfModel::new(gpu, options.into()).expect("the options are valid");
        let mut fusion = Self {
            model,
            keyframes: keyframes(),
            n_pushed: 0,
        };
        for _ in 0..N_KEYFRAMES {
            fusion.push();
            fusion.fuse_all();
        }
        fusion
    }

    fn push(&mut self) {
        let keyframe = &self.keyframes[self.n_pushed % N_KEYFRAMES];
        let stamp = Stamp(self.n_pushed as i64);
        self.model
            .push(Arc::new(Keyframe {
                stamp,
                ..keyframe.as_ref().clone()
            }))
            .expect("a valid keyframe");
        self.n_pushed += 1;
    }

    fn fuse_all(&mut self) {
        while !self.model.is_idle() {
            self.model.step(u64::MAX).expect("the GPU works");
        }
    }

    fn profile_step(&mut self) -> Vec<PassTiming> {
        self.push();
        self.model.profile_step().expect("the GPU works")
    }
}

/// Sum of the times of the passes. Without timestamps, it is the wall time since `begin`.
fn gpu_time(passes: &[PassTiming], begin: Instant) -> Duration {
    match passes {
        [] => begin.elapsed(),
        passes => {
            Duration::from_secs_f64(passes.iter().map(|pass| pass.millis).sum::<f64>() * 1e-3)
        }
    }
}

fn request() -> RenderRequest {
    RenderRequest {
        world_from_camera: look_at(Point3::new(0.1, -1.6, 0.9), Point3::new(0.0, 0.3, 0.3)),
        size_px: [640, 480],
        projection: Projection::Pinhole {
            focal_px: [525.0; 2],
            principal_px: [320.0, 240.0],
        },
        shutter: None,
        near_m: 0.01,
        far_m: 100.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0, 0.5, 1.0],
        appearance_of: None,
        depth: true,
    }
}

fn tsdf(criterion: &mut Criterion) {
    let mut fusion = Fusion::new();
    for pass in fusion.profile_step() {
        eprintln!("{}: {:.4} ms", pass.name, pass.millis);
    }
    criterion.bench_function("fuse 640x480, GPU", |bench| {
        bench.iter_custom(|n| {
            let timed = (0..n).map(|_| {
                let begin = Instant::now();
                gpu_time(&fusion.profile_step(), begin)
            });
            timed.sum()
        });
    });
    criterion.bench_function("render 640x480, GPU", |bench| {
        bench.iter_custom(|n| {
            let timed = (0..n).map(|_| {
                let begin = Instant::now();
                let millis = fusion
                    .model
                    .profile_picture(&request())
                    .expect("the GPU works");
                millis.map_or_else(
                    || begin.elapsed(),
                    |millis| Duration::from_secs_f64(millis * 1e-3),
                )
            });
            timed.sum()
        });
    });
    // Every iteration changes the blocks that one keyframe observes.
    criterion.bench_function("mesh changes of a keyframe, GPU", |bench| {
        bench.iter_custom(|n| {
            let timed = (0..n).map(|_| {
                fusion.model.update_mesh().expect("the GPU works");
                fusion.push();
                fusion.fuse_all();
                let begin = Instant::now();
                gpu_time(&fusion.model.profile_mesh().expect("the GPU works"), begin)
            });
            timed.sum()
        });
    });
    criterion.bench_function("mesh changes of a keyframe and read them back", |bench| {
        bench.iter_custom(|n| {
            let timed = (0..n).map(|_| {
                fusion.push();
                fusion.fuse_all();
                let begin = Instant::now();
                fusion.model.update_mesh().expect("the GPU works");
                begin.elapsed()
            });
            timed.sum()
        });
    });
    criterion.bench_function("join the meshes of all blocks", |bench| {
        bench.iter(|| fusion.model.mesh().expect("the GPU works").triangles.len());
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = tsdf
}
criterion_main!(benches);
