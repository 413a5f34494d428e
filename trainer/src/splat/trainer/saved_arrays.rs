//! The arrays of a checkpoint, which contain splats, seeds and camera parameters.

use crate::Error;
use crate::splat::buffers::{N_PLANAR_BUFFERS, SplatBuffers};
use crate::splat::seed::{SeedSnapshot, Seeder};
use gpu::{Buffer, Gpu, PendingRead};
use model_files::checkpoint::{Array, Checkpoint};

/// Names of the arrays, in the order of [`SplatBuffers::planes`].
const ARRAYS: [&str; N_PLANAR_BUFFERS] = [
    "means",
    "rotations",
    "shapes",
    "sh_dc",
    "sh_rest",
    "moments",
    "sh_dc_moments",
    "sh_rest_moments",
    "error_sums",
];
const SEED_POSITIONS: &str = "seed_positions";
const SEED_CELLS: &str = "seed_cells";
pub(super) const CAMERA_PARAMS: &str = "camera_params";

/// Reads splats of size `[n_splats, capacity, sh_degree, active_degree]` from the arrays with this
/// prefix.
pub(super) fn read_splats(
    gpu: &Gpu,
    checkpoint: &Checkpoint,
    prefix: &str,
    [n_splats, capacity, sh_degree, active_degree]: [u32; 4],
) -> Result<SplatBuffers, Error> {
    // The numbers are checked, because they come from a file and determine the offsets at which
    // buffers are written.
    if n_splats > capacity || active_degree > sh_degree || sh_degree > 3 {
        return Err(invalid_state(format!(
            "{n_splats} splats of SH degree {active_degree} do not fit capacity {capacity} and SH degree {sh_degree}"
        )));
    }
    let mut splats = SplatBuffers::new(gpu, capacity, sh_degree)?;
    for (name, (buffer, n_planes, bytes)) in ARRAYS.into_iter().zip(splats.planes()) {
        let used_bytes = u64::from(n_splats) * bytes;
        let array =
            checkpoint.array(&format!("{prefix}{name}"), u64::from(n_planes) * used_bytes)?;
        // Planes are contiguous in the checkpoint. On the GPU, their distance is the capacity.
        for plane in 0..u64::from(n_planes) {
            let from = to_usize(plane * used_bytes);
            let at = plane * u64::from(capacity) * bytes;
            gpu.write(buffer, at, &array[from..from + to_usize(used_bytes)]);
        }
    }
    splats.set_active_degree(gpu, active_degree);
    splats.set_n_splats(gpu, n_splats);
    Ok(splats)
}

pub(super) fn read_seeds(
    checkpoint: &Checkpoint,
    prefix: &str,
    n_seeds: u64,
) -> Result<Seeder, Error> {
    // Each seed has one position and one cell.
    let n_position_bytes = n_seed_bytes(n_seeds, Seeder::POSITION_BYTES)?;
    let positions = checkpoint.array(&format!("{prefix}{SEED_POSITIONS}"), n_position_bytes)?;
    let n_cell_bytes = n_seed_bytes(n_seeds, Seeder::CELL_BYTES)?;
    let cells = checkpoint.array(&format!("{prefix}{SEED_CELLS}"), n_cell_bytes)?;
    Ok(Seeder::from_bytes(positions, cells))
}

/// Size of an array with `bytes` per seed. The number of seeds comes from a file.
fn n_seed_bytes(n_seeds: u64, bytes: u64) -> Result<u64, Error> {
    n_seeds
        .checked_mul(bytes)
        .ok_or_else(|| invalid_state(format!("{n_seeds} seeds are too many")))
}

/// The arrays of one model state, while they are being copied to the host.
pub(super) struct PendingArrays {
    prefix: &'static str,
    planes: Vec<Planes>,
    seeds: SeedSnapshot,
    params: Option<PendingRead>,
}

impl PendingArrays {
    pub(super) fn begin(
        gpu: &Gpu,
        prefix: &'static str,
        splats: &SplatBuffers,
        seeder: &Seeder,
        params: (&Buffer, u64),
    ) -> Self {
        let planes = splats.planes().map(|(buffer, n_planes, bytes)| Planes {
            read: begin_read(gpu, buffer, n_planes, bytes, splats),
            n_planes: n_planes as usize,
            used_bytes: splats.n_splats as usize * to_usize(bytes),
            stride_bytes: splats.capacity as usize * to_usize(bytes),
        });
        let (buffer, n_bytes) = params;
        Self {
            prefix,
            planes: planes.into(),
            seeds: seeder.snapshot(),
            params: (n_bytes > 0).then(|| gpu.begin_read(buffer, to_usize(n_bytes / 4))),
        }
    }

    pub(super) fn finish(self, gpu: &Gpu, arrays: &mut Vec<Array>) -> Result<(), Error> {
        let prefix = self.prefix;
        for (name, planes) in ARRAYS.into_iter().zip(self.planes) {
            arrays.push(named(prefix, name, planes.finish(gpu)?));
        }
        let (positions, cells) = self.seeds.into_bytes();
        arrays.push(named(prefix, SEED_POSITIONS, positions));
        arrays.push(named(prefix, SEED_CELLS, cells));
        let params: Vec<u8> = self
            .params
            .map_or(Ok(Vec::new()), |read| read.finish(gpu))?;
        arrays.push(named(prefix, CAMERA_PARAMS, params));
        Ok(())
    }
}

/// An array of the model state with this prefix.
fn named(prefix: &str, name: &str, bytes: Vec<u8>) -> Array {
    Array {
        name: format!("{prefix}{name}"),
        bytes,
    }
}

/// One buffer, while it is being copied to the host.
struct Planes {
    read: Option<PendingRead>,
    n_planes: usize,
    used_bytes: usize,
    stride_bytes: usize,
}

impl Planes {
    /// The used parts of all planes, concatenated.
    fn finish(self, gpu: &Gpu) -> Result<Vec<u8>, Error> {
        let Some(read) = self.read else {
            return Ok(Vec::new());
        };
        let all: Vec<u8> = read.finish(gpu)?;
        if self.n_planes == 1 {
            return Ok(all);
        }
        let plane = |ix: usize| &all[ix * self.stride_bytes..][..self.used_bytes];
        Ok((0..self.n_planes).flat_map(plane).copied().collect())
    }
}

fn begin_read(
    gpu: &Gpu,
    buffer: &Buffer,
    n_planes: u32,
    bytes: u64,
    splats: &SplatBuffers,
) -> Option<PendingRead> {
    if n_planes == 0 || splats.n_splats == 0 {
        return None;
    }
    // All planes are read in one copy, without the unused end of the last plane.
    let n = u64::from(n_planes - 1) * u64::from(splats.capacity) + u64::from(splats.n_splats);
    Some(gpu.begin_read(buffer, to_usize(n * bytes / 4)))
}

/// Returns the error for invalid checkpoint contents.
pub(super) fn invalid_state(reason: String) -> Error {
    Error::CheckpointState { reason }
}

fn to_usize(n_bytes: u64) -> usize {
    usize::try_from(n_bytes).expect("a buffer fits into memory")
}
