//! Seeds splats on the surfaces visible in new keyframes.

use super::view_set::ViewSet;
use crate::model_options::ModelOptions;
use crate::splat::options::{RANDOM_SPLATS, SplatOptions};
use crate::splat::seed::{self, Density, Seeder};
use crate::splat::snapshot::ObservedScene;
use crate::splat::stereo::StereoImages;
use keyframe::Keyframe;
use model_files::InitialPoints;
use model_files::splat::arrays::SplatArrays;
use numbers::quantile::{Rank, quantile};
use std::sync::Arc;

/// Maximum share of the splat limit for the seeds of one image, so that enough remains for the
/// other images.
const SEED_SHARE: f64 = 1.0 / 8.0;
/// Minimum number of pixels per seed. A higher density slows down the first steps more than it
/// helps. With 15 pixels per seed, the PSNR of redkitchen was 2.2 dB lower after 1 s
/// (docs/benchmarks/2026-11-23-splats.md).
const PX_PER_SEED: f64 = 48.0;
/// Default maximum number of seeds per image. An image of 1280 x 720 pixels has 19 200 at the
/// density above.
const SEEDS_PER_IMAGE: f64 = 20_000.0;
/// The default on a software adapter, where steps with more splats would take too long.
const SOFTWARE_SEEDS_PER_IMAGE: f64 = 4_000.0;
/// Default number of splats at random positions on a software adapter. Without depth, every step
/// updates every splat, and almost every splat of the cloud is in every image, so the duration of the
/// first steps is proportional to this number. With 50 000, a minute on two cores was enough for 270
/// steps, which are too few to sort out the wrong positions (docs/design/splats.md, section
/// "Software adapters"). With depth, training starts with about as many discs: the demo with 11 800.
const SOFTWARE_RANDOM_SPLATS: u32 = 10_000;
/// Minimum scale of the scene. With a scale of zero, which a single camera without depth would
/// give, the means could not move.
const MIN_SCENE_SIZE_M: f64 = 1e-3;
/// Fraction of an image without depth in which other images must show where the surfaces are. With
/// less, the depths in between are guesses.
const MIN_KNOWN_FRAC: f64 = 0.1;

/// Creates the initial splats for new keyframes.
#[derive(Debug)]
pub(super) struct Seeding {
    pub(super) scene: ObservedScene,
    /// Keyframes whose depth has not been used for seeding yet.
    pending: Vec<Arc<Keyframe>>,
    /// Keyframes without dense depth that arrived since the last step.
    unseeded: Vec<Arc<Keyframe>>,
    density: Density,
    random_splats: u32,
    /// Points from which training starts if no keyframe has depth.
    pub(super) points: Option<Arc<InitialPoints>>,
}

impl Seeding {
    pub(super) fn new(options: &ModelOptions<SplatOptions>, is_software: bool) -> Self {
        let default_seeds = if is_software {
            SOFTWARE_SEEDS_PER_IMAGE
        } else {
            SEEDS_PER_IMAGE
        };
        let max_discs = options
            .specific
            .seeds_per_image
            .unwrap_or(default_seeds)
            .min(f64::from(options.cap()) * SEED_SHARE);
        Self {
            scene: ObservedScene::default(),
            pending: Vec::new(),
            unseeded: Vec::new(),
            density: Density {
                max_discs,
                px_per_disc: PX_PER_SEED,
            },
            random_splats: options.specific.random_splats.unwrap_or(if is_software {
                SOFTWARE_RANDOM_SPLATS
            } else {
                RANDOM_SPLATS
            }),
            points: None,
        }
    }

    /// Maximum number of seeds per image.
    pub(super) fn seeds_per_image(&self) -> f64 {
        self.density.max_discs
    }

    /// Number of splats at random positions, if there is no depth.
    pub(super) fn random_splats(&self) -> u32 {
        self.random_splats
    }

    /// Queues a keyframe for seeding.
    pub(super) fn push(&mut self, keyframe: Arc<Keyframe>) {
        self.scene.has_depth |= keyframe.depth.is_some();
        self.pending.push(keyframe);
    }

    pub(super) fn remove(&mut self, is_removed: impl Fn(&Keyframe) -> bool) {
        self.pending.retain(|keyframe| !is_removed(keyframe));
        self.unseeded.retain(|keyframe| !is_removed(keyframe));
    }

    /// Creates discs at the uncovered depth readings of the keyframes that were queued since the
    /// last call. Returns `None` if there are none. `views` are all training views.
    pub(super) fn discs_from_depth(&mut self, views: &ViewSet) -> Option<SplatArrays> {
        let arrived = std::mem::take(&mut self.pending);
        if arrived.is_empty() {
            return None;
        }
        self.update_size(views);
        let discs = self.scene.seeder.discs(&arrived, self.density);
        self.unseeded.extend(
            arrived
                .into_iter()
                .filter(|keyframe| keyframe.lacks_dense_depth()),
        );
        Some(discs)
    }

    /// Replaces the cameras of all keyframes. `correct` replaces a keyframe. The corrected `views`
    /// determine which positions have splats.
    pub(super) fn replace_cameras(
        &mut self,
        correct: impl Fn(&mut Arc<Keyframe>),
        views: &ViewSet,
    ) {
        self.pending
            .iter_mut()
            .chain(&mut self.unseeded)
            .for_each(correct);
        // Surfaces that were found in images without depth have moved by less than a disc's size.
        if !self.scene.has_depth {
            return;
        }
        let seeded: Vec<_> = views
            .keyframes()
            .filter(|keyframe| !self.is_pending(keyframe))
            .cloned()
            .collect();
        // A second seeding with the corrected cameras marks the corrected surfaces as occupied. The
        // discs are dropped, because the model already has splats at their positions.
        self.scene.seeder = Seeder::default();
        drop(self.scene.seeder.discs(&seeded, self.density));
    }

    /// Whether a keyframe has not been used for seeding yet.
    fn is_pending(&self, keyframe: &Keyframe) -> bool {
        // Camera and stamp identify a keyframe. Pointers do not, because corrections replace it.
        self.pending
            .iter()
            .any(|other| other.camera == keyframe.camera && other.stamp == keyframe.stamp)
    }

    /// Keyframes with areas that depth does not cover.
    pub(super) fn take_unseeded(&mut self) -> Vec<Arc<Keyframe>> {
        std::mem::take(&mut self.unseeded)
    }

    /// Discs on the surfaces that several images show, for keyframes that arrived without depth,
    /// and discs in between at depths like those around them. Also returns the keyframes for which
    /// hardly any surface was found.
    pub(super) fn discs_from_images(
        &mut self,
        arrived: &[Arc<Keyframe>],
        views: &ViewSet,
    ) -> (Vec<SplatArrays>, Vec<Arc<Keyframe>>) {
        let images = StereoImages::new(views.keyframes().map(AsRef::as_ref).collect());
        let with_depth = |keyframe: &Arc<Keyframe>| {
            let depth = images.depth_of(keyframe)?;
            (depth.known_frac() >= MIN_KNOWN_FRAC).then(|| {
                Arc::new(Keyframe {
                    depth: Some(depth),
                    ..(**keyframe).clone()
                })
            })
        };
        let found: Vec<Option<Arc<Keyframe>>> = arrived.iter().map(with_depth).collect();
        let poor = std::iter::zip(arrived, &found).filter(|(_, found)| found.is_none());
        let poor = poor.map(|(keyframe, _)| keyframe.clone()).collect();
        let found: Vec<Arc<Keyframe>> = found.into_iter().flatten().collect();
        let density = self.density_in_images();
        let mut discs = vec![self.scene.seeder.discs(&found, density)];
        self.update_size(views);
        let default_m = self.scene.size_m;
        let seeder = &mut self.scene.seeder;
        discs.extend(
            found
                .iter()
                .map(|keyframe| seeder.discs_without_depth(keyframe, density, default_m)),
        );
        (discs, poor)
    }

    /// Fewer discs than with depth sensors, because depths from images have fewer pixels. On a
    /// software adapter, more discs would slow down the first minute.
    fn density_in_images(&self) -> Density {
        const DIVISOR: f64 = 2.0;
        Density {
            max_discs: self.density.max_discs / DIVISOR,
            ..self.density
        }
    }

    /// The learning rate must fit the whole scene.
    fn update_size(&mut self, views: &ViewSet) {
        self.scene.size_m = scene_size_m(views, &self.scene.seeder);
    }

    /// Discs for the areas of a keyframe that depth does not cover. `None` if there is no depth at
    /// all.
    pub(super) fn discs_without_depth(&mut self, keyframe: &Keyframe) -> Option<SplatArrays> {
        let ObservedScene {
            seeder,
            size_m,
            has_depth,
        } = &mut self.scene;
        has_depth.then(|| seeder.discs_without_depth(keyframe, self.density, *size_m))
    }

    /// Keyframes without dense depth that arrived since the last step.
    pub(super) fn unseeded(&self) -> &[Arc<Keyframe>] {
        &self.unseeded
    }

    /// Restores the state of a checkpoint.
    pub(super) fn restore(&mut self, scene: ObservedScene, unseeded: Vec<Arc<Keyframe>>) {
        self.scene = scene;
        self.unseeded = unseeded;
    }
}

/// Scale of the scene, from the spread of the cameras and their typical depth. The learning rate of
/// the means is proportional to it.
fn scene_size_m(views: &ViewSet, seeder: &Seeder) -> f64 {
    let centers: Vec<_> = views
        .keyframes()
        .map(|keyframe| keyframe.world_from_camera.translation.vector)
        .collect();
    let middle = centers.iter().sum::<nalgebra::Vector3<f64>>() / centers.len().max(1) as f64;
    let spread = centers
        .iter()
        .map(|center| (center - middle).norm())
        .fold(0.0, f64::max);
    let mut depths: Vec<f64> = views
        .iter()
        .filter_map(|view| view.median_depth_m)
        .collect();
    // Kerbl et al. 2023 use 1.1 times the spread of the cameras. It is too small if the cameras
    // hardly move, as at the beginning of a scan, so half of the typical depth is a lower limit.
    // Without depth and without surfaces, the point at which the cameras look gives the depth.
    let typical_depth_m = quantile(&mut depths, 0.5, Rank::Upper)
        .or_else(|| seeder.median_distance_m(&centers))
        .unwrap_or_else(|| {
            let keyframes: Vec<&Keyframe> = views.keyframes().map(AsRef::as_ref).collect();
            (seed::common_focus(&keyframes) - middle).norm()
        });
    (1.1 * spread)
        .max(0.5 * typical_depth_m)
        .max(MIN_SCENE_SIZE_M)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn software_adapters_start_with_fewer_random_splats() {
        let random_splats = |options: SplatOptions, is_software| {
            Seeding::new(&ModelOptions::from(options), is_software).random_splats()
        };
        assert_eq!(random_splats(SplatOptions::default(), false), 50_000);
        assert_eq!(random_splats(SplatOptions::default(), true), 10_000);
        // A checkpoint of another adapter stores its number.
        let resumed = SplatOptions {
            random_splats: Some(50_000),
            ..SplatOptions::default()
        };
        assert_eq!(random_splats(resumed, true), 50_000);
    }
}
