//! Erased space on the GPU.

use crate::Error;
use crate::edits::Edits;
use gpu::{Buffer, Gpu, Passes};
use nalgebra::Matrix4;
use std::sync::Arc;

/// The buffers of shared/erased.wgsl: views without edits have one of their own, so that
/// alternating views with and without edits replace neither.
#[derive(Debug)]
pub(crate) struct ErasedSpace {
    nothing: Buffer,
    newest: Option<Erased>,
}

/// The edits of the last view that had any.
#[derive(Debug)]
struct Erased {
    edits: Arc<Edits>,
    world_from_drawn: Matrix4<f64>,
    buffer: Buffer,
}

impl Erased {
    /// Whether the buffer holds these edits in this frame.
    fn is_of(&self, edits: &Arc<Edits>, world_from_drawn: &Matrix4<f64>) -> bool {
        // Requests of one client share the edits, so most comparisons end at the address.
        let has_same_edits = Arc::ptr_eq(&self.edits, edits) || self.edits == *edits;
        has_same_edits && self.world_from_drawn == *world_from_drawn
    }
}

impl ErasedSpace {
    /// Nothing is erased.
    pub(crate) fn none(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            nothing: buffer(gpu, &Edits::default(), &Matrix4::identity())?,
            newest: None,
        })
    }

    /// The buffer of these edits. Replaces the previous one if the edits or the frame have changed.
    ///
    /// * `world_from_drawn`: maps points of the kernel to world, meters.
    pub(crate) fn set(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        edits: &Arc<Edits>,
        world_from_drawn: Matrix4<f64>,
    ) -> Result<&Buffer, Error> {
        if edits.is_empty() {
            return Ok(&self.nothing);
        }
        let same = self
            .newest
            .take()
            .filter(|erased| erased.is_of(edits, &world_from_drawn));
        let erased = match same {
            Some(erased) => erased,
            None => {
                // Cached bindings hold the previous buffer, which would not be freed.
                passes.clear_bindings();
                Erased {
                    edits: Arc::clone(edits),
                    world_from_drawn,
                    buffer: buffer(gpu, edits, &world_from_drawn)?,
                }
            }
        };
        Ok(&self.newest.insert(erased).buffer)
    }
}

fn buffer(gpu: &Gpu, edits: &Edits, world_from_drawn: &Matrix4<f64>) -> Result<Buffer, Error> {
    Ok(gpu.storage_with(
        "erased",
        bytemuck::cast_slice(&edits.words(world_from_drawn)),
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Aabb;
    use crate::edits::Edit;
    use gpu::testing::test_gpu;
    use kinematics::Transform;

    #[test]
    fn alternating_views_with_and_without_edits_keep_their_buffers() {
        let gpu = test_gpu();
        let mut passes = Passes::default();
        let mut erased = ErasedSpace::none(&gpu).unwrap();
        let with_boxes = |n: usize| {
            let aabb = Aabb {
                world_from_box: Transform::identity(),
                min_m: [0.0; 3],
                max_m: [1.0; 3],
            };
            let mut edits = Edits::default();
            (0..n).for_each(|_| edits.push(Edit::Box(aabb)).unwrap());
            Arc::new(edits)
        };
        let mut id_of = |edits: &Arc<Edits>, scale: f64| {
            erased
                .set(&gpu, &mut passes, edits, Matrix4::new_scaling(scale))
                .unwrap()
                .id()
        };
        let none = Arc::default();
        let one = with_boxes(1);
        let other = with_boxes(2);
        let ids = [id_of(&none, 1.0), id_of(&one, 1.0)];
        for _ in 0..3 {
            assert_eq!([id_of(&none, 2.0), id_of(&one, 1.0)], ids);
        }
        assert_ne!(id_of(&one, 2.0), ids[1], "another frame");
        assert_ne!(id_of(&other, 2.0), id_of(&one, 2.0), "other edits");
        assert_eq!(id_of(&none, 1.0), ids[0]);
    }
}
