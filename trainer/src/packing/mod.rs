//! Packs pictures on the GPU for viewers. Color is encoded as JPEG, and depth as 16-bit counts at
//! half resolution. This reduces the read-back to about a fifth, and the CPU need not encode
//! pictures.

mod panorama;
mod tables;

use crate::view::Camera;
use crate::{Error, Picture, Projection, RenderRequest};
use gpu::{Buffer, Gpu, Passes, PendingRead, Pipeline, Source, shared};
use panorama::{Face, Panorama};

/// Number of MCUs per restart interval. An MCU has 8 x 8 pixels without subsampling, and one lane
/// encodes an interval. With more MCUs, fewer lanes work in parallel. With fewer MCUs, the markers
/// between intervals make the file longer.
const MCUS_PER_INTERVAL: u32 = 2;
/// Capacity of an interval, in words. It is four times the average that [`WORDS_PER_MCU`] allows,
/// because detail is distributed unevenly in a picture.
const WORDS_PER_INTERVAL: u32 = 4 * WORDS_PER_MCU * MCUS_PER_INTERVAL;
/// Maximum average of coded words per MCU. At quality 92, pictures of splats need about 6. The
/// read-back has this size, so a larger number makes each picture slower. A picture that does not
/// fit is read back again without packing.
const WORDS_PER_MCU: u32 = 16;
/// Words before the coded words.
const HEADER_WORDS: u32 = 4;

/// JPEG quality of complete pictures for viewers. It gives no visible blocks on textures.
pub const JPEG_QUALITY: u8 = 92;

/// Format in which a picture is read back.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Format {
    Picture { depth: bool },
    Packed(Packing),
}

/// How a rendered pinhole view is output.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Output {
    pub(crate) format: Format,
    /// The face, if the picture is a face of a panorama. Only the last face is read back.
    face: Option<Face>,
}

impl Output {
    /// A packed pinhole picture.
    pub(crate) fn packed(packing: Packing) -> Self {
        Self {
            format: Format::Packed(packing),
            face: None,
        }
    }

    /// Size of the picture, if the view has `view_px`.
    pub(crate) fn size_px(&self, view_px: [u32; 2]) -> [u32; 2] {
        self.face.map_or(view_px, |face| face.panorama_px)
    }

    /// Whether the picture is complete after this view.
    pub(crate) fn is_complete(&self) -> bool {
        self.face.is_none_or(Face::is_last)
    }
}

/// What to pack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packing {
    /// Quality of the JPEG file, 1 to 100. With `None`, the color is omitted.
    pub jpeg_quality: Option<u8>,
    /// Whether depth is included.
    pub depth: bool,
}

/// A picture as sent to viewers.
#[derive(Clone, Debug)]
pub struct PackedPicture {
    /// Width and height of the color, pixels.
    pub size_px: [u32; 2],
    /// A JPEG file with color at full resolution, if requested.
    pub jpeg: Option<Vec<u8>>,
    /// Depth, if requested.
    pub depth: Option<PackedDepth>,
}

/// Depth at half size, rounded up. Each square of 2 x 2 pixels keeps its nearest depth, so that
/// thin objects in front stay visible.
#[derive(Clone, Debug)]
pub struct PackedDepth {
    /// Width and height.
    pub size_px: [u32; 2],
    /// Length of a step of the counts, meters.
    pub meters_per_count: f64,
    /// Array `[height, width]` of 16-bit little-endian counts along z. They are 0 where nothing is
    /// visible.
    pub counts: Vec<u8>,
}

/// A rendered picture, packed if the model and the adapter support it.
#[derive(Clone, Debug)]
pub enum Rendered {
    /// Pixels and depths.
    Picture(Picture),
    /// Packed on the GPU.
    Packed(PackedPicture),
}

impl From<Picture> for Rendered {
    fn from(picture: Picture) -> Self {
        Self::Picture(picture)
    }
}

/// A picture that the GPU may still be drawing, so that several can be queued.
#[derive(Debug)]
pub struct QueuedPicture(Queued);

#[derive(Debug)]
enum Queued {
    Ready(Rendered),
    /// The first part of `read` has the counters that `is_complete` checks. The other parts are
    /// from [`Packer::record`].
    Packed {
        read: PendingRead,
        is_complete: fn(&[u8]) -> bool,
        packing: Packing,
        size_px: [u32; 2],
    },
}

impl QueuedPicture {
    /// A finished picture.
    pub fn ready(rendered: Rendered) -> Self {
        Self(Queued::Ready(rendered))
    }

    /// A picture on the GPU. `is_complete` determines from the first part of `read` whether the
    /// buffers were large enough. The other parts are from [`Packer::record`].
    pub(crate) fn packed(
        read: PendingRead,
        is_complete: fn(&[u8]) -> bool,
        packing: Packing,
        size_px: [u32; 2],
    ) -> Self {
        Self(Queued::Packed {
            read,
            is_complete,
            packing,
            size_px,
        })
    }

    /// Whether the picture is finished.
    pub fn is_ready(&self) -> bool {
        matches!(self.0, Queued::Ready(_))
    }

    /// Waits for the picture. Returns `None` if a buffer was too small. In this case,
    /// [`Method::render_packed`](crate::Method::render_packed) makes it larger.
    ///
    /// # Errors
    ///
    /// Fails if the GPU failed.
    pub fn finish(self, gpu: &Gpu) -> Result<Option<Rendered>, Error> {
        match self.0 {
            Queued::Ready(rendered) => Ok(Some(rendered)),
            Queued::Packed {
                read,
                is_complete,
                packing,
                size_px,
            } => Ok(read.finish_with(gpu, |parts| {
                let packed = is_complete(parts[0]).then(|| unpack(packing, size_px, &parts[1..]));
                packed.flatten().map(Rendered::Packed)
            })?),
        }
    }
}

impl Rendered {
    /// Renders a request with `draw`, which draws a pinhole view and returns the picture if it is
    /// complete.
    pub(crate) fn of(
        request: &RenderRequest,
        format: Format,
        mut draw: impl FnMut(&Camera, Output) -> Result<Option<Self>, Error>,
    ) -> Result<Self, Error> {
        let mut rendered = None;
        match request.projection {
            Projection::Pinhole {
                focal_px,
                principal_px,
            } => {
                let camera = Camera::from_request(request, focal_px, principal_px);
                rendered = draw(&camera, Output { format, face: None })?;
            }
            Projection::Equirectangular => {
                // Only the last face is read back, with the whole panorama.
                for face in Face::all(request.size_px) {
                    rendered = draw(
                        &face.camera(request),
                        Output {
                            format,
                            face: Some(face),
                        },
                    )?;
                }
            }
        }
        rendered.ok_or_else(|| Error::internal("no view of the picture was read back"))
    }

    /// Like [`Self::of`], but never packed.
    pub(crate) fn picture(
        request: &RenderRequest,
        draw: impl FnMut(&Camera, Output) -> Result<Option<Self>, Error>,
    ) -> Result<Picture, Error> {
        Self::of(
            request,
            Format::Picture {
                depth: request.depth,
            },
            draw,
        )?
        .into_picture()
    }

    /// The pixels and depths, if the picture is not packed.
    pub(crate) fn into_picture(self) -> Result<Picture, Error> {
        match self {
            Self::Picture(picture) => Ok(picture),
            Self::Packed(_) => Err(Error::internal("a packed picture was read as pixels")),
        }
    }

    /// A picture that shows only the background.
    pub(crate) fn empty(
        view_px: [u32; 2],
        background_srgb: [f32; 3],
        output: Output,
    ) -> Option<Self> {
        let (Format::Picture { depth } | Format::Packed(Packing { depth, .. })) = output.format;
        let size_px = output.size_px(view_px);
        output
            .is_complete()
            .then(|| Self::Picture(Picture::empty(size_px, background_srgb, depth)))
    }

    /// Width and height, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        match self {
            Self::Picture(picture) => picture.size_px,
            Self::Packed(packed) => packed.size_px,
        }
    }
}

/// `Packing` of packing.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
struct Sizes {
    size_px: [u32; 2],
    n_mcus: [u32; 2],
    n_intervals: u32,
    mcus_per_interval: u32,
    words_per_interval: u32,
    n_words: u32,
}

impl Sizes {
    fn of(size_px: [u32; 2]) -> Self {
        let n_mcus = size_px.map(|n| n.div_ceil(8));
        let n = n_mcus[0] * n_mcus[1];
        Self {
            size_px,
            n_mcus,
            n_intervals: n.div_ceil(MCUS_PER_INTERVAL),
            mcus_per_interval: MCUS_PER_INTERVAL,
            words_per_interval: WORDS_PER_INTERVAL,
            n_words: WORDS_PER_MCU * n.next_multiple_of(MCUS_PER_INTERVAL),
        }
    }

    fn n_mcus(&self) -> u32 {
        self.n_mcus[0] * self.n_mcus[1]
    }

    fn half_size_px(&self) -> [u32; 2] {
        self.size_px.map(|n| n.div_ceil(2))
    }

    fn n_squares(&self) -> u32 {
        self.half_size_px()[0] * self.half_size_px()[1]
    }
}

const SHARED: &[Source] = &[
    Source {
        name: "packing",
        text: include_str!("packing.wgsl"),
    },
    shared::FOLDED,
    shared::SCAN,
];

macro_rules! kernel {
    ($name:literal) => {
        gpu::Kernel {
            source: gpu::Source {
                name: $name,
                text: include_str!(concat!($name, ".wgsl")),
            },
            shared: crate::packing::SHARED,
        }
    };
}
use kernel;

/// Kernels and buffers that pack pictures.
#[derive(Debug)]
pub(crate) struct Packer {
    transform: Pipeline,
    code: Pipeline,
    offsets: Pipeline,
    join: Pipeline,
    halve: Pipeline,
    count: Pipeline,
    codes: Buffer,
    /// Table of the last quality.
    tables: Option<(u8, Buffer)>,
    buffers: Option<Buffers>,
}

#[derive(Debug)]
struct Buffers {
    /// Capacity in squares of 8 x 8 pixels. The next field is the capacity in squares of 2 x 2
    /// pixels.
    n_mcus: u32,
    n_squares: u32,
    packing: Buffer,
    coefficients: Buffer,
    non_zero: Buffer,
    coded: Buffer,
    n_coded: Buffer,
    halved: Buffer,
    packed: Buffer,
    depth_counts: Buffer,
}

impl Buffers {
    fn new(gpu: &Gpu, sizes: Sizes) -> Result<Self, Error> {
        let words = |name: &str, n: u32| gpu.storage(name, 4 * u64::from(n));
        let n_mcus = sizes.n_mcus();
        let n_squares = sizes.n_squares();
        Ok(Self {
            n_mcus,
            n_squares,
            packing: gpu.uniform_with("packing.packing", &sizes),
            coefficients: words("packing.coefficients", 3 * 64 * n_mcus)?,
            non_zero: words("packing.non_zero", 6 * n_mcus)?,
            coded: words("packing.coded", WORDS_PER_INTERVAL * sizes.n_intervals)?,
            n_coded: words("packing.n_coded", sizes.n_intervals)?,
            halved: words("packing.halved", n_squares)?,
            packed: words("packing.packed", HEADER_WORDS + sizes.n_words)?,
            depth_counts: words("packing.depth_counts", n_squares.div_ceil(2))?,
        })
    }
}

impl Packer {
    /// Compiles the kernels.
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            transform: Pipeline::new(gpu, kernel!("jpeg_transform"), &[])?,
            code: Pipeline::new(gpu, kernel!("jpeg_code"), &[])?,
            offsets: Pipeline::new(gpu, kernel!("jpeg_offsets"), &[])?,
            join: Pipeline::new(gpu, kernel!("jpeg_join"), &[])?,
            halve: Pipeline::new(gpu, kernel!("depth_halve"), &[])?,
            count: Pipeline::new(gpu, kernel!("depth_counts"), &[])?,
            codes: gpu.storage_with("packing.codes", bytemuck::cast_slice(&tables::codes()))?,
            tables: None,
            buffers: None,
        })
    }

    /// Allocates buffers for pictures of this size.
    fn reserve(&mut self, gpu: &Gpu, passes: &mut Passes, sizes: Sizes) -> Result<(), Error> {
        let fits = |buffers: &Buffers| {
            buffers.n_mcus >= sizes.n_mcus() && buffers.n_squares >= sizes.n_squares()
        };
        if !self.buffers.as_ref().is_some_and(fits) {
            // Cached bindings also own the old buffers. Bindings and buffers are dropped before the
            // larger buffers are allocated, so that the old and new buffers are never in memory
            // together.
            passes.clear_bindings();
            self.buffers = None;
            self.buffers = Some(Buffers::new(gpu, sizes)?);
        }
        Ok(())
    }

    /// Uploads the tables of a JPEG quality, unless the last picture had the same quality.
    fn set_quality(&mut self, gpu: &Gpu, passes: &mut Passes, quality: u8) -> Result<(), Error> {
        if self.tables.as_ref().is_none_or(|(of, _)| *of != quality) {
            passes.clear_bindings();
            let tables = tables::transform_tables(quality);
            self.tables = Some((
                quality,
                gpu.storage_with("packing.tables", bytemuck::cast_slice(&tables))?,
            ));
        }
        Ok(())
    }

    /// Records the passes that pack a picture of `size_px`: `pixels` (rgba8) and `depths` (meters).
    /// Returns the buffers to read back for [`unpack`].
    pub(crate) fn record(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        packing: Packing,
        size_px: [u32; 2],
        [pixels, depths]: [&Buffer; 2],
    ) -> Result<Vec<(&Buffer, usize)>, Error> {
        let sizes = Sizes::of(size_px);
        self.reserve(gpu, passes, sizes)?;
        if let Some(quality) = packing.jpeg_quality {
            self.set_quality(gpu, passes, quality)?;
        }
        let buffers = self
            .buffers
            .as_ref()
            .ok_or_else(|| Error::internal("the buffers of the packer are missing"))?;
        gpu.write(&buffers.packing, 0, bytemuck::bytes_of(&sizes));
        // The header has the overflow flag and the largest depth, which kernels update atomically.
        passes.clear_range(&buffers.packed, 0..4 * u64::from(HEADER_WORDS));
        // Apart from the header, only the requested parts are read back.
        let mut n_words = HEADER_WORDS;
        let tables = self
            .tables
            .as_ref()
            .filter(|_| packing.jpeg_quality.is_some());
        if let Some((_, tables)) = tables {
            n_words += sizes.n_words;
            self.record_jpeg(gpu, passes, sizes, buffers, [pixels, tables]);
        }
        let mut reads = vec![(&buffers.packed, 4 * n_words as usize)];
        if packing.depth {
            self.record_depth(gpu, passes, sizes, buffers, depths);
            reads.push((&buffers.depth_counts, 2 * sizes.n_squares() as usize));
        }
        Ok(reads)
    }

    /// Records the passes that encode the color. Each restart interval is encoded independently
    /// into its own words. Then the intervals are joined without gaps.
    fn record_jpeg(
        &self,
        gpu: &Gpu,
        passes: &mut Passes,
        sizes: Sizes,
        buffers: &Buffers,
        [pixels, tables]: [&Buffer; 2],
    ) {
        let uniform = ("packing", &buffers.packing);
        let packed = ("packed", &buffers.packed);
        let coefficients = ("coefficients", &buffers.coefficients);
        let non_zero = ("non_zero", &buffers.non_zero);
        let coded = ("coded", &buffers.coded);
        let n_coded = ("n_coded", &buffers.n_coded);
        let n_intervals = u64::from(sizes.n_intervals);
        let transformed = [
            uniform,
            ("pixels", pixels),
            ("tables", tables),
            coefficients,
            non_zero,
        ];
        passes.dispatch(gpu, &self.transform, sizes.n_mcus().into(), &transformed);
        let encoded = [
            uniform,
            coefficients,
            non_zero,
            ("codes", &self.codes),
            coded,
            n_coded,
            packed,
        ];
        passes.dispatch(gpu, &self.code, n_intervals.div_ceil(32), &encoded);
        // A single workgroup does this, because the offset of an interval is the sum of all lengths
        // before it.
        passes.dispatch(gpu, &self.offsets, 1, &[uniform, n_coded, packed]);
        passes.dispatch(
            gpu,
            &self.join,
            n_intervals.div_ceil(8),
            &[uniform, coded, n_coded, packed],
        );
    }

    /// Records the passes that halve and quantize the depths. The step of the counts depends on the
    /// largest depth of the picture, so it takes two passes.
    fn record_depth(
        &self,
        gpu: &Gpu,
        passes: &mut Passes,
        sizes: Sizes,
        buffers: &Buffers,
        depths: &Buffer,
    ) {
        let uniform = ("packing", &buffers.packing);
        let packed = ("packed", &buffers.packed);
        let n_squares = u64::from(sizes.n_squares());
        let halved = ("halved", &buffers.halved);
        let counts = ("depth_counts", &buffers.depth_counts);
        passes.dispatch(
            gpu,
            &self.halve,
            n_squares.div_ceil(256),
            &[uniform, ("depths", depths), halved, packed],
        );
        // A thread packs two counts into a word.
        passes.dispatch(
            gpu,
            &self.count,
            n_squares.div_ceil(512),
            &[uniform, halved, packed, counts],
        );
    }
}

/// Reads pictures back. Packer and panorama buffers are created on first use.
#[derive(Debug, Default)]
pub(crate) struct Reader {
    packer: Option<Packer>,
    panorama: Option<Panorama>,
}

impl Reader {
    /// The requested output if packing is available. If the adapter is a CPU, or if GPU memory is
    /// too small for packing, the output is an unpacked picture.
    pub(crate) fn available(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        output: Output,
        view_px: [u32; 2],
    ) -> Result<Output, Error> {
        let Format::Packed(Packing { depth, .. }) = output.format else {
            return Ok(output);
        };
        let unpacked = Output {
            format: Format::Picture { depth },
            ..output
        };
        // On a CPU, kernels would take longer than the encoders of the server.
        if gpu.is_software() {
            return Ok(unpacked);
        }
        // Buffers are reserved here, because another format can still be chosen at this point.
        match created(&mut self.packer, gpu)?.reserve(
            gpu,
            passes,
            Sizes::of(output.size_px(view_px)),
        ) {
            Err(error) if error.is_out_of_memory() => Ok(unpacked),
            reserved => reserved.map(|()| output),
        }
    }

    /// Records the passes that follow the drawing of a view into `canvas`. `canvas` contains pixels
    /// (rgba8) and depths (meters). Returns the buffers to read back for [`Self::take`]. Returns no
    /// buffers if the picture is not complete.
    pub(crate) fn record<'a>(
        &'a mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        output: Output,
        view_px: [u32; 2],
        canvas: [&'a Buffer; 2],
    ) -> Result<Vec<(&'a Buffer, usize)>, Error> {
        let Self { packer, panorama } = self;
        // Faces are collected in the panorama, so the next face may overwrite the canvas.
        let canvas = match output.face {
            Some(face) => Panorama::record(panorama, gpu, passes, face, canvas)?,
            None => canvas,
        };
        let size_px = output.size_px(view_px);
        match output.format {
            _ if !output.is_complete() => Ok(Vec::new()),
            Format::Picture { depth } => Ok(Picture::buffers(
                size_px,
                canvas[0],
                depth.then_some(canvas[1]),
            )),
            Format::Packed(packing) => {
                created(packer, gpu)?.record(gpu, passes, packing, size_px, canvas)
            }
        }
    }

    /// The picture from the data that was read back after [`Self::record`]. `None` if it could not
    /// be packed.
    pub(crate) fn take(output: Output, view_px: [u32; 2], parts: &[&[u8]]) -> Option<Rendered> {
        let size_px = output.size_px(view_px);
        match output.format {
            Format::Picture { .. } => Some(Rendered::Picture(Picture::from_parts(size_px, parts))),
            Format::Packed(packing) => unpack(packing, size_px, parts).map(Rendered::Packed),
        }
    }

    /// Reads a picture that could not be packed, whose last view was drawn into `canvas`.
    pub(crate) fn read_unpacked(
        &self,
        gpu: &Gpu,
        passes: &mut Passes,
        output: Output,
        view_px: [u32; 2],
        canvas: [&Buffer; 2],
    ) -> Result<Rendered, Error> {
        let (Format::Picture { depth } | Format::Packed(Packing { depth, .. })) = output.format;
        // The pixels are still on the GPU, so the view need not be drawn again.
        let [pixels, depths] = match (output.face, &self.panorama) {
            (Some(_), Some(panorama)) => panorama.canvas(),
            _ => canvas,
        };
        let size_px = output.size_px(view_px);
        let read = passes.submit_reading(
            gpu,
            &Picture::buffers(size_px, pixels, depth.then_some(depths)),
        );
        Ok(read.finish_with(gpu, |parts| {
            Rendered::Picture(Picture::from_parts(size_px, parts))
        })?)
    }

    /// Submits the passes that draw a view into `canvas`, and reads the picture back if it is
    /// complete.
    pub(crate) fn read(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        output: Output,
        view_px: [u32; 2],
        canvas: [&Buffer; 2],
    ) -> Result<Option<Rendered>, Error> {
        // If packing is not possible, or the file turns out too long, the picture is read back as
        // pixels.
        let output = self.available(gpu, passes, output, view_px)?;
        let reads = self.record(gpu, passes, output, view_px, canvas)?;
        if reads.is_empty() {
            passes.submit(gpu);
            return Ok(None);
        }
        let read = passes.submit_reading(gpu, &reads);
        let taken = read.finish_with(gpu, |parts| Self::take(output, view_px, parts))?;
        taken
            .map_or_else(
                || self.read_unpacked(gpu, passes, output, view_px, canvas),
                Ok,
            )
            .map(Some)
    }
}

/// The packer, created on first use.
fn created<'a>(packer: &'a mut Option<Packer>, gpu: &Gpu) -> Result<&'a mut Packer, Error> {
    if packer.is_none() {
        *packer = Some(Packer::new(gpu)?);
    }
    packer
        .as_mut()
        .ok_or_else(|| Error::internal("the packer is missing"))
}

/// Assembles the data read back from [`Packer::record`]. `None` if the JPEG file was too long.
pub(crate) fn unpack(
    packing: Packing,
    size_px: [u32; 2],
    parts: &[&[u8]],
) -> Option<PackedPicture> {
    let (header, coded) = parts[0].split_at(4 * HEADER_WORDS as usize);
    let header: Vec<u32> = bytemuck::pod_collect_to_vec(header);
    let [n_words, overflow, furthest, _] = header[..] else {
        return None;
    };
    // Kernels drop words that do not fit, so the file would be damaged.
    if overflow != 0 {
        return None;
    }
    let jpeg = match packing.jpeg_quality {
        Some(quality) => {
            // Sizes in JPEG files have 16 bits.
            let [Ok(width), Ok(height)] = size_px.map(u16::try_from) else {
                return None;
            };
            let interval = u16::try_from(MCUS_PER_INTERVAL).ok()?;
            let mut file = tables::file_header([width, height], quality, interval);
            file.extend_from_slice(coded.get(..4 * n_words as usize)?);
            Some(file)
        }
        None => None,
    };
    let depth = parts.get(1).map(|counts| {
        let furthest_m = f64::from(f32::from_bits(furthest));
        PackedDepth {
            size_px: Sizes::of(size_px).half_size_px(),
            // Without any depth, all counts are zero, so any step except zero is correct.
            meters_per_count: if furthest_m > 0.0 {
                furthest_m / f64::from(u16::MAX)
            } else {
                1.0
            },
            counts: counts.to_vec(),
        }
    });
    Some(PackedPicture {
        size_px,
        jpeg,
        depth,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use gpu::Kernel;
    use gpu::testing::{assert_layout, assert_valid, test_gpu};

    const KERNELS: &[Kernel] = &[
        kernel!("jpeg_transform"),
        kernel!("jpeg_code"),
        kernel!("jpeg_offsets"),
        kernel!("jpeg_join"),
        kernel!("depth_halve"),
        kernel!("depth_counts"),
        kernel!("panorama_face"),
    ];

    #[test]
    fn kernels_are_valid() {
        use Sizes as Packing;
        assert_valid(KERNELS);
        assert_layout!(
            KERNELS,
            Packing,
            [
                size_px,
                n_mcus,
                n_intervals,
                mcus_per_interval,
                words_per_interval,
                n_words
            ]
        );
    }

    struct Fixture {
        gpu: std::sync::Arc<Gpu>,
        packer: Packer,
        passes: Passes,
    }

    impl Fixture {
        fn new() -> Self {
            let gpu = test_gpu();
            Self {
                packer: Packer::new(&gpu).unwrap(),
                passes: Passes::default(),
                gpu,
            }
        }

        fn pack(&mut self, packing: Packing, picture: &Picture) -> Option<PackedPicture> {
            let pixels = self.gpu.storage_with("pixels", &picture.rgba_srgb).unwrap();
            let depths = self
                .gpu
                .storage_with("depths", bytemuck::cast_slice(&picture.depth_m))
                .unwrap();
            let read = {
                let reads = self
                    .packer
                    .record(
                        &self.gpu,
                        &mut self.passes,
                        packing,
                        picture.size_px,
                        [&pixels, &depths],
                    )
                    .unwrap();
                self.passes.submit_reading(&self.gpu, &reads)
            };
            self.passes.clear_bindings();
            read.finish_with(&self.gpu, |parts| unpack(packing, picture.size_px, parts))
                .unwrap()
        }
    }

    /// A picture with smooth colors and sharp edges, which differ in every corner. Its depths have
    /// holes.
    fn picture(size_px: [u32; 2]) -> Picture {
        let [width, height] = size_px;
        let byte = |value: u32| u8::try_from(value % 256).unwrap();
        let px = || (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)));
        let color = |(x, y): (u32, u32)| {
            let stripe = if (x / 13 + y / 7) % 5 == 0 { 90 } else { 0 };
            [
                byte(x * 160 / width + stripe),
                byte(y * 160 / height + stripe),
                byte(40 + x / 3),
                9,
            ]
        };
        let depth = |(x, y): (u32, u32)| match (x + 3 * y) % 11 {
            0 => 0.0,
            1 => f32::INFINITY,
            2 => f32::NAN,
            n => n as f32 + 0.01 * (x % 50) as f32,
        };
        Picture {
            size_px,
            rgba_srgb: px().flat_map(color).collect(),
            depth_m: px().map(depth).collect(),
        }
    }

    fn mean_abs_error(jpeg: &[u8], picture: &Picture) -> f64 {
        let decoded = image::load_from_memory_with_format(jpeg, image::ImageFormat::Jpeg)
            .unwrap()
            .to_rgb8();
        assert_eq!([decoded.width(), decoded.height()], picture.size_px);
        let source = picture
            .rgba_srgb
            .chunks_exact(4)
            .flat_map(|pixel| &pixel[..3]);
        let sum: f64 = decoded
            .as_raw()
            .iter()
            .zip(source)
            .map(|(a, b)| f64::from(a.abs_diff(*b)))
            .sum();
        sum / decoded.as_raw().len() as f64
    }

    #[test]
    fn jpeg_files_are_as_good_as_those_of_a_library() {
        let mut fixture = Fixture::new();
        for size_px in [
            [160, 128],
            [161, 129],
            [1, 1],
            [7, 50],
            [16, 17],
            [333, 255],
            [15, 1000],
            [64, 8],
        ] {
            let picture = picture(size_px);
            for quality in [60, 92] {
                let packing = Packing {
                    jpeg_quality: Some(quality),
                    depth: false,
                };
                let jpeg = fixture.pack(packing, &picture).unwrap().jpeg.unwrap();
                let rgb: Vec<u8> = picture
                    .rgba_srgb
                    .chunks_exact(4)
                    .flat_map(|pixel| pixel[..3].to_vec())
                    .collect();
                let mut by_library = Vec::new();
                image::codecs::jpeg::JpegEncoder::new_with_quality(&mut by_library, quality)
                    .encode(&rgb, size_px[0], size_px[1], image::ExtendedColorType::Rgb8)
                    .unwrap();
                let ours = mean_abs_error(&jpeg, &picture);
                let library = mean_abs_error(&by_library, &picture);
                assert!(
                    ours < library + 0.1,
                    "{size_px:?}, quality {quality}: {ours}, by a library {library}"
                );
                assert!(
                    jpeg.len() < by_library.len() * 5 / 4 + 512,
                    "{} bytes, {}",
                    jpeg.len(),
                    by_library.len()
                );
            }
        }
    }

    #[test]
    fn noise_that_is_too_long_is_not_packed() {
        let mut fixture = Fixture::new();
        let mut picture = picture([256, 256]);
        for (at, value) in (0u32..).zip(&mut picture.rgba_srgb) {
            *value = at.wrapping_mul(2_654_435_761).to_be_bytes()[1];
        }
        assert!(
            fixture
                .pack(
                    Packing {
                        jpeg_quality: Some(100),
                        depth: false
                    },
                    &picture
                )
                .is_none()
        );
        assert!(
            fixture
                .pack(
                    Packing {
                        jpeg_quality: Some(20),
                        depth: false
                    },
                    &picture
                )
                .is_some()
        );
    }

    #[test]
    fn depth_is_the_nearest_of_each_square() {
        let mut fixture = Fixture::new();
        for size_px in [[64, 32], [33, 17], [1, 1], [3, 2]] {
            let picture = picture(size_px);
            let packed = fixture
                .pack(
                    Packing {
                        jpeg_quality: None,
                        depth: true,
                    },
                    &picture,
                )
                .unwrap();
            let depth = packed.depth.unwrap();
            assert!(packed.jpeg.is_none());
            let [width, height] = depth.size_px;
            assert_eq!(depth.size_px, size_px.map(|n| n.div_ceil(2)));
            assert_eq!(depth.counts.len(), 2 * (width * height) as usize);
            let counts = depth
                .counts
                .chunks_exact(2)
                .map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
            for (count, at) in counts.zip(0..) {
                let nearest_m = [[0, 0], [1, 0], [0, 1], [1, 1]]
                    .map(|[x, y]| [2 * (at % width) + x, 2 * (at / width) + y])
                    .into_iter()
                    .filter(|px| px[0] < size_px[0] && px[1] < size_px[1])
                    .map(|px| picture.depth_m[(px[1] * size_px[0] + px[0]) as usize])
                    .filter(|depth_m| depth_m.is_finite() && *depth_m > 0.0)
                    .fold(f32::INFINITY, f32::min);
                let got_m = f64::from(count) * depth.meters_per_count;
                match nearest_m.is_finite() {
                    true => assert!(
                        (got_m - f64::from(nearest_m)).abs() < depth.meters_per_count,
                        "{at}"
                    ),
                    false => assert_eq!(count, 0),
                }
            }
        }
    }
}
