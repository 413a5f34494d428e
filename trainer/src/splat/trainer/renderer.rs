//! Draws splats from pinhole cameras. The forward pass of training uses the same pipelines and
//! scratch buffers.

use super::products::{self, Products};
use super::recorder::Recorder;
use crate::packing::{Format, Output, Reader};
use crate::splat::buffers::{ImageBuffers, Scratch, ScratchSize, SplatBuffers, n_bins, n_tiles};
use crate::splat::clipping::Clipper;
use crate::splat::kernels::DrawPipelines;
use crate::splat::params::{Camera, Supervision, View, status};
use crate::splat::passes::ViewPasses;
use crate::{Error, Packing, QueuedPicture, Rendered};
use gpu::{Buffer, Gpu, PendingRead, Pipeline};

/// Minimum capacity of the bin lists, in entries. In a small model, splats are large and need many
/// entries each. With a smaller capacity, such models would overflow in their first steps.
const MIN_ENTRIES: u32 = 1 << 14;

/// Divisors of the required size that give the headroom of grown buffers. The headroom is 1/2 of
/// the required size, then 1/16, then none, until memory is sufficient. Each overflow repeats
/// steps, so more headroom saves time.
const HEADROOM_DIVISORS: [u32; 3] = [2, 16, u32::MAX];

/// Draws pinhole views of splats.
#[derive(Debug)]
pub(super) struct Renderer {
    pub(super) pipelines: DrawPipelines,
    scratch: Option<(ScratchSize, Scratch)>,
    image_buffers: Option<ImageBuffers>,
    status: Buffer,
    view: Buffer,
    background: Buffer,
    clipper: Clipper,
    /// Buffer for images uploaded for comparison, kept for reuse.
    compared: Option<Buffer>,
    reader: Reader,
}

/// A view to draw.
#[derive(Clone, Copy, Debug)]
pub(super) struct DrawnView<'a> {
    pub(super) splats: &'a SplatBuffers,
    pub(super) camera: &'a Camera,
    pub(super) background_srgb: [f32; 3],
}

/// Results to read back after drawing.
#[derive(Clone, Copy, Debug)]
enum ReadParts<'a> {
    Picture(Output),
    /// The sums of `score.wgsl` for a comparison with an image.
    Comparison {
        score: &'a Pipeline,
        image: &'a Buffer,
    },
}

impl Renderer {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            pipelines: DrawPipelines::new(gpu)?,
            scratch: None,
            image_buffers: None,
            status: gpu.storage_with("splat.draw_status", &[0; 4 * status::LEN])?,
            view: gpu.uniform_with("splat.draw_view", &<View as bytemuck::Zeroable>::zeroed()),
            background: gpu.uniform_with(
                "splat.background",
                &<Supervision as bytemuck::Zeroable>::zeroed(),
            ),
            clipper: Clipper::new(gpu)?,
            compared: None,
            reader: Reader::default(),
        })
    }

    /// Draws a view, and returns the picture if it is complete.
    pub(super) fn picture(
        &mut self,
        recorder: &mut Recorder,
        drawn: DrawnView<'_>,
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        let view_px = drawn.camera.size_px;
        let output = self
            .reader
            .available(&recorder.gpu, &mut recorder.passes, output, view_px)?;
        let taken = self.draw(recorder, drawn, ReadParts::Picture(output), |parts| {
            output
                .is_complete()
                .then(|| Reader::take(output, view_px, parts))
        })?;
        match (taken, &self.image_buffers) {
            // If the picture could not be packed, it is read from the image buffers in a second
            // step.
            (Some(None), Some(ImageBuffers { pixels, depths, .. })) => {
                let Recorder { gpu, passes } = recorder;
                self.reader
                    .read_unpacked(gpu, passes, output, view_px, [pixels, depths])
                    .map(Some)
            }
            (taken, _) => Ok(taken.flatten()),
        }
    }

    /// Draws a picture and compares it with an image of the same size.
    pub(super) fn compare(
        &mut self,
        recorder: &mut Recorder,
        drawn: DrawnView<'_>,
        score: &Pipeline,
        image: &Buffer,
    ) -> Result<[Products; 3], Error> {
        let sum_up = |parts: &[&[u8]]| {
            products::sum_up(&bytemuck::pod_collect_to_vec::<u8, [u32; 4]>(parts[0]))
        };
        self.draw(
            recorder,
            drawn,
            ReadParts::Comparison { score, image },
            sum_up,
        )
    }

    /// Draws a picture and compares it with an image of the same size in host memory.
    pub(super) fn compare_with_upload(
        &mut self,
        recorder: &mut Recorder,
        drawn: DrawnView<'_>,
        score: &Pipeline,
        rgba: &[u8],
    ) -> Result<[Products; 3], Error> {
        // A buffer that is too large can be used, because the kernel reads only the pixels of the
        // view.
        let image = match self.compared.take() {
            Some(image) if image.bytes() >= rgba.len() as u64 => {
                recorder.gpu.write(&image, 0, rgba);
                image
            }
            _ => {
                recorder.passes.clear_bindings();
                recorder.gpu.storage_with("splat.compared", rgba)?
            }
        };
        let products = self.compare(recorder, drawn, score, &image)?;
        self.compared = Some(image);
        Ok(products)
    }

    /// Whether pictures of this size can be packed.
    pub(super) fn may_pack(
        &mut self,
        recorder: &mut Recorder,
        packing: Packing,
        size_px: [u32; 2],
    ) -> Result<bool, Error> {
        let output = self.reader.available(
            &recorder.gpu,
            &mut recorder.passes,
            Output::packed(packing),
            size_px,
        )?;
        Ok(matches!(output.format, Format::Packed(_)))
    }

    /// Starts to draw and pack a picture.
    pub(super) fn queue(
        &mut self,
        recorder: &mut Recorder,
        drawn: DrawnView<'_>,
        packing: Packing,
    ) -> Result<QueuedPicture, Error> {
        let read = self.submit(recorder, drawn, ReadParts::Picture(Output::packed(packing)))?;
        Ok(QueuedPicture::packed(
            read,
            is_complete,
            packing,
            drawn.camera.size_px,
        ))
    }

    /// Draws a view and passes the bytes of the requested parts to `take`. If a buffer was too
    /// small, grows it and draws again.
    fn draw<R>(
        &mut self,
        recorder: &mut Recorder,
        drawn: DrawnView<'_>,
        parts: ReadParts<'_>,
        take: impl Fn(&[&[u8]]) -> R,
    ) -> Result<R, Error> {
        // The required sizes depend on the view, and are known only after the view is binned. The
        // counters contain the required sizes of the whole view even if it does not fit, so one
        // repetition is sufficient.
        loop {
            let (counters, taken) =
                self.submit(recorder, drawn, parts)?
                    .finish_with(&recorder.gpu, |parts| {
                        let counters: Vec<u32> = bytemuck::pod_collect_to_vec(parts[0]);
                        (counters, is_complete(parts[0]).then(|| take(&parts[1..])))
                    })?;
            if let Some(taken) = taken {
                return Ok(taken);
            }
            // Guards against an endless loop.
            if !self.grow_scratch(recorder, &counters, false)? {
                return Err(Error::internal(
                    "a view failed although all of its buffers are large enough",
                ));
            }
            clear_failure(&recorder.gpu, &self.status);
        }
    }

    /// Submits the passes that draw a view. Reads the counters and the requested parts back.
    fn submit(
        &mut self,
        recorder: &mut Recorder,
        DrawnView {
            splats,
            camera,
            background_srgb,
        }: DrawnView<'_>,
        parts: ReadParts<'_>,
    ) -> Result<PendingRead, Error> {
        let size_px = camera.size_px;
        self.write_view(&recorder.gpu, camera, background_srgb);
        // Reserving may submit recorded passes and replace buffers, so it comes before the passes
        // of this view are recorded.
        self.reserve_view(recorder, splats.capacity, size_px, false)?;
        reserve_image(recorder, &mut self.image_buffers, size_px, false)?;
        let Recorder { gpu, passes } = &mut *recorder;
        let clipping = self.clipper.prepare(gpu, passes, camera, splats.capacity)?;
        let image_buffers = self
            .image_buffers
            .as_ref()
            .ok_or_else(|| Error::internal("no image buffers are reserved for a view"))?;
        let scratch = self
            .scratch
            .as_ref()
            .map(|(_, scratch)| scratch)
            .ok_or_else(no_scratch)?;
        let Recorder { gpu, passes: list } = recorder;
        write_n_splats(gpu, &self.status, splats.n_splats);
        let passes = ViewPasses {
            gpu,
            splats,
            scratch,
            image_buffers,
            status: &self.status,
            view: &self.view,
            size_px,
            clipping,
        };
        passes.draw(list, &self.pipelines);
        passes.finish(list, &self.pipelines, &self.background);
        // The counters are read together with the results, because they show whether the results
        // are complete.
        let mut read = vec![(&self.status, 4 * status::LEN)];
        match parts {
            ReadParts::Picture(output) => {
                let canvas = [&image_buffers.pixels, &image_buffers.depths];
                read.extend(self.reader.record(gpu, list, output, size_px, canvas)?);
            }
            ReadParts::Comparison { score, image } => {
                let buffers = (&self.view, image_buffers);
                let n_bytes = products::record(gpu, list, score, buffers, size_px, image);
                read.push((&image_buffers.products, n_bytes));
            }
        }
        Ok(list.submit_reading(gpu, &read))
    }

    /// Uploads the camera and the background of the next picture.
    fn write_view(&self, gpu: &Gpu, camera: &Camera, [red, green, blue]: [f32; 3]) {
        gpu.write(&self.view, 0, bytemuck::bytes_of(&camera.view()));
        // Pictures share the kernel with training, but have no loss and no random background.
        let background = Supervision {
            background_srgb: [red, green, blue, 0.0],
            ..bytemuck::Zeroable::zeroed()
        };
        gpu.write(&self.background, 0, bytemuck::bytes_of(&background));
    }

    /// The scratch buffers, which must be reserved first.
    pub(super) fn scratch(&self) -> Result<&Scratch, Error> {
        self.scratch
            .as_ref()
            .map(|(_, scratch)| scratch)
            .ok_or_else(no_scratch)
    }

    /// Reserves buffers to draw a view of this size with up to `capacity` splats, and to train on
    /// it if `learned`.
    pub(super) fn reserve_view(
        &mut self,
        recorder: &mut Recorder,
        capacity: u32,
        size_px: [u32; 2],
        learned: bool,
    ) -> Result<(), Error> {
        // The first estimates are two bins per splat, and two tiles per bin. Buffers grow if a view
        // needs more.
        let n_entries = (2 * capacity).max(MIN_ENTRIES);
        let n_slots = if learned { 2 * n_entries } else { 0 };
        self.reserve(
            recorder,
            ScratchSize {
                n_splats: capacity,
                n_entries,
                n_slots,
                n_bins: n_bins(size_px),
            },
        )
    }

    /// Reserves buffers to draw up to `capacity` splats. Does nothing before the first view.
    pub(super) fn reserve_splats(
        &mut self,
        recorder: &mut Recorder,
        capacity: u32,
    ) -> Result<(), Error> {
        let Some((have, _)) = self.scratch else {
            return Ok(());
        };
        let n_entries = have.n_entries.max(2 * capacity);
        let n_slots = if have.n_slots > 0 {
            have.n_slots.max(4 * capacity)
        } else {
            0
        };
        self.reserve(
            recorder,
            ScratchSize {
                n_splats: capacity,
                n_entries,
                n_slots,
                ..have
            },
        )
    }

    /// Grows the scratch buffers if the submit failed. They become larger than required if memory
    /// permits. Buffers for gradients grow only if `learned` is set. Returns whether the submit
    /// failed.
    pub(super) fn grow_scratch(
        &mut self,
        recorder: &mut Recorder,
        counters: &[u32],
        learned: bool,
    ) -> Result<bool, Error> {
        if counters[status::FAILED] == 0 {
            return Ok(false);
        }
        let Some((size, _)) = self.scratch else {
            return Ok(false);
        };
        let mut grown = Ok(());
        for headroom_divisor in HEADROOM_DIVISORS {
            let need = ScratchSize {
                n_entries: with_headroom(
                    counters[status::NEED_ENTRIES],
                    size.n_entries,
                    headroom_divisor,
                ),
                n_slots: if learned {
                    with_headroom(counters[status::NEED_SLOTS], size.n_slots, headroom_divisor)
                } else {
                    size.n_slots
                },
                ..size
            };
            log::debug!("splat: growing the intersection buffers to {need:?}");
            grown = self.reserve(recorder, need);
            // Only a lack of memory is a reason to try again with less headroom.
            if !grown.as_ref().is_err_and(Error::is_out_of_memory) {
                break;
            }
        }
        grown.map(|()| true)
    }

    fn reserve(&mut self, recorder: &mut Recorder, need: ScratchSize) -> Result<(), Error> {
        let have = self.scratch.as_ref().map(|(size, _)| *size);
        let fits = have.is_some_and(|have| {
            have.n_splats >= need.n_splats
                && have.n_entries >= need.n_entries
                && have.n_slots >= need.n_slots
                && have.n_bins >= need.n_bins
        });
        if fits {
            return Ok(());
        }
        // No dimension shrinks. Otherwise, views of different sizes would alternately replace the
        // buffers.
        let other = have.unwrap_or(need);
        let size = ScratchSize {
            n_splats: need.n_splats.max(other.n_splats),
            n_entries: need.n_entries.max(other.n_entries),
            n_slots: need.n_slots.max(other.n_slots),
            n_bins: need.n_bins.max(other.n_bins),
        };
        recorder.submit_and_release_buffers();
        self.scratch = None; // Freed before the larger one is allocated.
        let made = Scratch::new(&recorder.gpu, &self.pipelines, size);
        // Restores the previous size, so that views that fit can still be drawn and trained on.
        if made.is_err()
            && let Some(had) = have
        {
            self.scratch = Some((had, Scratch::new(&recorder.gpu, &self.pipelines, had)?));
        }
        self.scratch = Some((size, made?));
        Ok(())
    }
}

/// Whether the buffers were large enough, according to the counters that were read back.
fn is_complete(counters: &[u8]) -> bool {
    counters[4 * status::FAILED..4 * (status::FAILED + 1)] == [0; 4]
}

/// New size of a buffer. It is `have` if that suffices, and otherwise `need` plus its fraction `1 /
/// headroom_divisor`.
fn with_headroom(need: u32, have: u32, headroom_divisor: u32) -> u32 {
    if need > have {
        need.saturating_add(need / headroom_divisor)
    } else {
        have
    }
}

/// Reserves buffers for a picture of this size, including its gradients if `learned`.
pub(super) fn reserve_image(
    recorder: &mut Recorder,
    image_buffers: &mut Option<ImageBuffers>,
    size_px: [u32; 2],
    learned: bool,
) -> Result<(), Error> {
    let need = (size_px[0] * size_px[1], n_tiles(size_px));
    let have = image_buffers
        .as_ref()
        .map_or((0, 0), |buffers| (buffers.n_pixels, buffers.n_tiles));
    if image_buffers.is_none() || have.0 < need.0 || have.1 < need.1 {
        recorder.submit_and_release_buffers();
        *image_buffers = None; // Freed before the larger one is allocated.
        *image_buffers = Some(ImageBuffers::new(
            &recorder.gpu,
            need.0.max(have.0),
            need.1.max(have.1),
            learned,
        )?);
    }
    Ok(())
}

/// Sets the number of splats for the next passes that use this status.
pub(super) fn write_n_splats(gpu: &Gpu, status: &Buffer, n_splats: u32) {
    gpu.write(
        status,
        4 * u64::from(status::N_SPLATS),
        bytemuck::bytes_of(&n_splats),
    );
}

/// Clears the failure flag and the requested buffer sizes.
pub(super) fn clear_failure(gpu: &Gpu, status: &Buffer) {
    // This clears three adjacent words, which are the flag and the two required sizes.
    gpu.write(status, 4 * status::FAILED as u64, &[0; 12]);
}

/// The error if a view is drawn before its buffers are reserved.
fn no_scratch() -> Error {
    Error::internal("a view was drawn before its scratch buffers were reserved")
}
