//! Blocks that find no room on the GPU wait in host memory until a camera sees them again.
//!
//! Before a frame is fused, every block it could touch is brought back: so the field has the bits it would have with room
//! for all.

use super::super::block::{Blocks, Place};
use super::super::chosen::Lattice;
use super::super::params::DepthFrame;
use super::TsdfModel;
use crate::Error;
use crate::splat::Camera;
use kinematics::Transform;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeSet;

/// Share of the pool that is made free at once, so that not every frame sends blocks away.
const FREED_FRAC: f64 = 0.125;
/// Added to the radius of a block, voxels: who decides on the GPU rounds differently.
const SLACK_VOXELS: f64 = 0.5;

/// What a camera can see, roughly.
struct Cone {
    camera_from_field: Transform,
    center_m: Point3<f64>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    size_px: [f64; 2],
    far_m: f64,
    block_m: f64,
}

impl Cone {
    fn new(
        field_from_camera: &Transform,
        lens: [[f64; 2]; 2],
        size_px: [u32; 2],
        far_m: f64,
        lattice: &Lattice,
    ) -> Self {
        Self {
            camera_from_field: field_from_camera.inverse(),
            center_m: field_from_camera.translation.vector.into(),
            focal_px: lens[0],
            principal_px: lens[1],
            size_px: size_px.map(f64::from),
            far_m,
            block_m: 8.0 * lattice.voxel_m,
        }
    }

    fn middle_m(&self, block: Place) -> Point3<f64> {
        (Vector3::from(block.map(|along| f64::from(along) + 0.5)) * self.block_m).into()
    }

    /// At least where the kernel `find_visible` says so.
    fn may_see(&self, block: Place) -> bool {
        let middle = self.camera_from_field * self.middle_m(block);
        let radius_m = self.block_m * (7.0 + SLACK_VOXELS) / 8.0;
        let sides = (0..2).all(|axis| {
            let (focal, low) = (self.focal_px[axis], self.principal_px[axis]);
            let high = self.size_px[axis] - low;
            focal * middle[axis] + low * middle.z >= -radius_m * focal.hypot(low)
                && high * middle.z - focal * middle[axis] >= -radius_m * focal.hypot(high)
        });
        sides && middle.z >= -radius_m && middle.z <= self.far_m + radius_m
    }

    fn distance_m(&self, block: Place) -> f64 {
        (self.middle_m(block) - self.center_m).norm()
    }
}

impl TsdfModel {
    fn cone_of_next(&self) -> Option<Cone> {
        let (lattice, keyframe) = (self.lattice.as_ref()?, self.pending.front()?);
        let depth = keyframe.depth.as_ref()?;
        let field_from_depth = lattice.field_from_world() * depth.world_from_camera;
        let far_m = lattice.max_depth_m + lattice.scale_m;
        DepthFrame::of(keyframe, lattice)?;
        Some(Cone::new(&field_from_depth, [depth.focal_px, depth.principal_px], depth.size_px, far_m, lattice))
    }

    /// Makes room for at least `n` blocks more than there is, for the next frame; leaves the frame out where it cannot.
    pub(super) fn send_away(&mut self, n: u32) -> Result<(), Error> {
        let Some(cone) = self.cone_of_next() else { return Ok(()) };
        let spare = f64::from(self.most_blocks()) * FREED_FRAC;
        let n_sent = self.exchange(&cone, n as usize, spare, Blocks::new())?;
        if n_sent < n as usize {
            self.n_refused += 1;
            log::warn!("tsdf: one image shows more than {} blocks hold; it is left out", self.most_blocks());
            self.pass_over();
        }
        Ok(())
    }

    /// Brings back what the next frame could touch, and fuses it.
    pub(super) fn step_within_budget(&mut self, n: u64) -> Result<u64, Error> {
        let before = self.step;
        let n = n.min(self.pending.len() as u64).min(1);
        if n == 0 {
            return Ok(0);
        }
        if let Some(cone) = self.cone_of_next() {
            self.bring(&cone, false)?;
        }
        if self.step != before {
            return Ok(n); // The frame was left out; the next one wants other blocks.
        }
        self.record(0, 0)?;
        self.passes.submit(&self.gpu);
        let counters = self.field.as_ref().ok_or(Error::DeviceLost)?.counters(&self.gpu)?;
        self.take_note(&counters)?;
        Ok(n)
    }

    /// Brings back what a picture shows, the nearest first where not all fit.
    pub(super) fn bring_for(&mut self, camera: &Camera) -> Result<(), Error> {
        let Some(lattice) = self.lattice.as_ref().filter(|_| !self.waiting.is_empty()) else { return Ok(()) };
        let lens = [camera.focal_px, camera.principal_px];
        let cone = Cone::new(&camera.world_from_camera, lens, camera.size_px, camera.far_m, lattice);
        self.bring(&cone, true)
    }

    /// Brings the waiting blocks that may be seen; `as_many_as_fit` of them, else a frame that cannot have all is left out.
    fn bring(&mut self, cone: &Cone, as_many_as_fit: bool) -> Result<(), Error> {
        let mut wanted: Vec<Place> = self.waiting.keys().copied().filter(|block| cone.may_see(*block)).collect();
        if wanted.is_empty() {
            return Ok(());
        }
        wanted.sort_by(|a, b| cone.distance_m(*a).total_cmp(&cone.distance_m(*b)));
        let Some(field) = &self.field else { return Ok(()) };
        let n_seen = field.places(&self.gpu)?.into_iter().filter(|block| cone.may_see(*block)).count();
        let most = field.capacity.n_blocks as usize - n_seen.min(field.capacity.n_blocks as usize);
        if wanted.len() > most && !as_many_as_fit {
            self.n_refused += 1;
            log::warn!("tsdf: one image shows more than {} blocks hold; it is left out", self.most_blocks());
            self.pass_over();
            return Ok(());
        }
        wanted.truncate(most);
        let coming: Blocks =
            wanted.into_iter().filter_map(|block| Some((block, self.waiting.remove(&block)?))).collect();
        let n_free = field.capacity.n_blocks as usize - field.n_blocks(&self.gpu)? as usize;
        let n = coming.len().saturating_sub(n_free);
        self.exchange(cone, n, 0.0, coming).map(drop)
    }

    /// Sends at least `n` blocks that the cone does not see to wait, the furthest first, and `spare` more where there are;
    /// puts `coming` in. Says how many went.
    fn exchange(&mut self, cone: &Cone, n: usize, spare: f64, coming: Blocks) -> Result<usize, Error> {
        let Some(field) = &mut self.field else { return Ok(0) };
        self.due.extend(field.take_changed(&self.gpu)?);
        let places = field.places(&self.gpu)?;
        let mut unseen: Vec<(u32, Place)> =
            (0..).zip(&places).map(|(slot, place)| (slot, *place)).filter(|(_, block)| !cone.may_see(*block)).collect();
        unseen.sort_by(|(_, a), (_, b)| cone.distance_m(*b).total_cmp(&cone.distance_m(*a)).then_with(|| a.cmp(b)));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share of a u32")]
        unseen.truncate(n + spare as usize);
        let leaving: BTreeSet<u32> = unseen.iter().map(|(slot, _)| *slot).collect();
        let slots: Vec<u32> = leaving.iter().copied().collect();
        let blocks = field.read(&self.gpu, &self.pipelines, &slots)?;
        self.waiting.extend(slots.iter().map(|slot| places[*slot as usize]).zip(blocks));
        field.exchange(&self.gpu, &self.pipelines, &slots, &coming)?;
        self.n_resident = field.n_blocks(&self.gpu)?;
        Ok(slots.len())
    }
}
