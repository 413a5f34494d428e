//! For each pixel of an image, finds the nearest of the squares that cover it.
//!
//! Neighboring pixels in a row of depth usually cover the same lines of the color image. For such a
//! run, only the columns are computed pixel by pixel, in one strip per square width. The result is
//! then written to all lines of the run, many pixels at once.

use std::ops::Range;

/// Value of a pixel that no square covers. It is larger than every stored value (count minus one).
pub(super) const NO_DEPTH: u16 = u16::MAX;
/// Maximum square width, in columns, with its own strip. Wider squares are rare and are written
/// column by column. More strips would take more time to merge in every run.
const MAX_STRIPS: usize = 4;
/// Padding before the first column of a strip.
const PAD: usize = MAX_STRIPS;
/// Number of cells of all strips. Every 16-bit index is valid, so no access needs a bounds check.
const N_STRIP_CELLS: usize = 1 << 16;
/// Number of cells behind the strips for pixels without depth. They are used in rotation. With a
/// single cell, each write would have to wait for the previous write.
const N_DISCARD_CELLS: usize = 256;
/// Marks a square that is too wide for the strips.
const WIDE: u16 = u16::MAX;
/// Largest image width, in columns. Columns beyond it get no depth because they have no cell in a
/// strip.
pub(super) const MAX_COLUMNS: usize = N_STRIP_CELLS - 1 - N_DISCARD_CELLS - PAD - 1;
/// Number of pixels tested at once, which fill a few vector registers. A longer block computes more
/// values beyond the first match. A shorter block tests for an exit more often.
const BLOCK: usize = 32;

/// First and last column and row that each pixel of one row of depth covers, clipped to the image.
/// Indices start at 1. The index 0 is before the image. If a first index is greater than the
/// corresponding last index, the pixel covers nothing.
pub(super) struct PixelBounds {
    pub(super) first: [Vec<u16>; 2],
    pub(super) last: [Vec<u16>; 2],
}

/// Depth image under construction. Rows of depth are drawn into it one by one.
pub(super) struct NearestDepth {
    width: usize,
    /// Nearest count minus one of each pixel: `[height, width]`.
    nearest: Vec<u16>,
    /// For each column, the minimum over the squares of the current run that start there. There is
    /// one strip per square width. The array has `n_strips` strips of `stride` cells, followed by
    /// [`N_DISCARD_CELLS`] cells.
    strips: Box<[u16; N_STRIP_CELLS]>,
    /// Number of strips that fit.
    n_strips: usize,
    stride: usize,
    /// For each pixel of the row, the first line in the upper 16 bits and the last line in the
    /// lower 16 bits. The value is 0 if the pixel covers nothing.
    lines: Vec<u32>,
    /// For each pixel of the row: index of its cell in the strips.
    strip_cells: Vec<u16>,
    /// For each pixel of the row: its count minus one.
    count_minus_one: Vec<u16>,
}

impl NearestDepth {
    /// Creates an empty image into which rows of `depth_width` depth pixels are drawn.
    pub(super) fn new([width, height]: [usize; 2], depth_width: usize) -> Self {
        let stride = width.min(MAX_COLUMNS) + 1 + PAD;
        Self {
            width,
            nearest: vec![NO_DEPTH; width * height],
            strips: Box::new([NO_DEPTH; N_STRIP_CELLS]),
            // A wide image has longer strips, of which fewer fit.
            n_strips: MAX_STRIPS.min((N_STRIP_CELLS - 1 - N_DISCARD_CELLS) / stride),
            stride,
            lines: vec![0; depth_width],
            strip_cells: vec![0; depth_width],
            count_minus_one: vec![0; depth_width],
        }
    }

    /// Nearest count minus one of each pixel. The value is [`NO_DEPTH`] if no square covers the
    /// pixel.
    pub(super) fn into_nearest(self) -> Vec<u16> {
        self.nearest
    }

    /// Draws the squares of one row of depth with a depth test. Counts of 0 are skipped.
    #[inline(always)]
    pub(super) fn put(&mut self, row: &[u16], bounds: &PixelBounds) {
        self.locate_row(row, bounds);
        let mut begin = 0;
        while let Some(run) = self.next_run(begin) {
            self.fill(run.clone(), bounds);
            self.write_run(run.clone(), bounds);
            begin = run.end;
        }
    }

    /// Next run of pixels that cover the same lines. Pixels in between that cover nothing do not
    /// end the run.
    #[inline(always)]
    fn next_run(&self, begin: usize) -> Option<Range<usize>> {
        let lines = &self.lines[begin..];
        let first = find_blockwise(lines, |lines| lines != 0)?;
        let run = lines[first];
        let n = find_blockwise(&lines[first..], |lines| (lines != 0) & (lines != run))
            .unwrap_or(lines.len() - first);
        Some(begin + first..begin + first + n)
    }

    /// Writes a run of pixels into the strips.
    #[inline(always)]
    fn fill(&mut self, run: Range<usize>, bounds: &PixelBounds) {
        let strip_cells = &self.strip_cells[run.clone()];
        let count_minus_one = &self.count_minus_one[run.clone()];
        // The fast loop handles nearly all runs. It writes one cell per pixel, without a branch. A
        // pixel without depth writes into a cell that is never read, because this is faster than
        // skipping the pixel.
        let has_too_wide = strip_cells
            .iter()
            .fold(false, |any, cell| any | (*cell == WIDE));
        if !has_too_wide {
            for (cell, count_minus_one) in strip_cells.iter().zip(count_minus_one) {
                let nearest = &mut self.strips[usize::from(*cell)];
                *nearest = (*count_minus_one).min(*nearest);
            }
            return;
        }
        for (ix, (cell, count_minus_one)) in run.zip(strip_cells.iter().zip(count_minus_one)) {
            let columns = match *cell {
                // The first strip contains squares of one column. A wide square is written there as
                // a row of such squares.
                WIDE => {
                    usize::from(bounds.first[0][ix]) + PAD
                        ..usize::from(bounds.last[0][ix]) + PAD + 1
                }
                cell => usize::from(cell)..usize::from(cell) + 1,
            };
            self.strips[columns]
                .iter_mut()
                .for_each(|nearest| *nearest = (*count_minus_one).min(*nearest));
        }
    }

    /// Computes the lines and the strip cell of each pixel of a row.
    #[expect(clippy::cast_possible_truncation, reason = "cell indices have 16 bits")]
    #[inline(always)]
    fn locate_row(&mut self, row: &[u16], bounds: &PixelBounds) {
        let n = row.len();
        let PixelBounds {
            first: [left, top],
            last: [right, bottom],
        } = bounds;
        // Because the slices have one length, the compiler drops the bounds checks, which would
        // prevent vector instructions in the loop.
        let left = &left[..n];
        let top = &top[..n];
        let right = &right[..n];
        let bottom = &bottom[..n];
        let lines = &mut self.lines[..n];
        let strip_cells = &mut self.strip_cells[..n];
        let count_minus_one = &mut self.count_minus_one[..n];
        let stride = self.stride as u16;
        let n_strips = self.n_strips as u16;
        let discard = n_strips * stride;
        for ix in 0..n {
            // This loop has no branches and no short circuits. At the edges of objects, pixels with
            // and without depth alternate irregularly, so branches would be mispredicted.
            let is_visible = (row[ix] != 0) & (left[ix] <= right[ix]) & (top[ix] <= bottom[ix]);
            // The results for pixels that cover nothing may wrap around. They are replaced below.
            let n_more = right[ix].wrapping_sub(left[ix]);
            let cell = n_more
                .wrapping_mul(stride)
                .wrapping_add(left[ix])
                .wrapping_add(PAD as u16);
            let cell = if n_more < n_strips { cell } else { WIDE };
            lines[ix] = if is_visible {
                u32::from(top[ix]) << 16 | u32::from(bottom[ix])
            } else {
                0
            };
            strip_cells[ix] = if is_visible {
                cell
            } else {
                discard + (ix % N_DISCARD_CELLS) as u16
            };
            count_minus_one[ix] = row[ix].wrapping_sub(1);
        }
    }

    /// Merges the strips into the lines that the run covers, and clears the strips.
    #[inline(always)]
    fn write_run(&mut self, run: Range<usize>, bounds: &PixelBounds) {
        let lines = self.lines[run.start];
        // Only the columns that the run has touched are merged and cleared, as most runs are much
        // narrower than the image.
        let line_bounds = self.lines[run.clone()].iter();
        let columns = bounds.first[0][run.clone()]
            .iter()
            .zip(&bounds.last[0][run]);
        let (from, to) =
            line_bounds
                .zip(columns)
                .fold((u16::MAX, 0), |(from, to), (lines, (left, right))| {
                    let (left, right) = if *lines == 0 {
                        (u16::MAX, 0)
                    } else {
                        (*left, *right)
                    };
                    (from.min(left), to.max(right))
                });
        if from > to {
            return;
        }
        let n = usize::from(to - from) + 1;
        let from = usize::from(from);
        // Each strip is spread into the next narrower one, from the widest squares to single
        // columns. This takes one pass per width instead of one pass per square.
        for n_more in (1..self.n_strips).rev() {
            // A square of this many columns is the union of two squares that are one column
            // narrower.
            let (narrower, strip) =
                self.strips[(n_more - 1) * self.stride..].split_at_mut(self.stride);
            merge(
                &mut narrower[PAD + from..][..n],
                &strip[PAD + from..][..n],
                &strip[PAD + from - 1..][..n],
            );
            strip[PAD + from..][..n].fill(NO_DEPTH);
        }
        let columns = &mut self.strips[PAD + from..][..n];
        // Every square of the run covers all these lines, so the merged row is the same for each
        // line.
        for line in lines >> 16..=lines & 0xFFFF {
            let line = &mut self.nearest[(line as usize - 1) * self.width + from - 1..][..n];
            line.iter_mut()
                .zip(&*columns)
                .for_each(|(nearest, new)| *nearest = (*new).min(*nearest));
        }
        columns.fill(NO_DEPTH);
    }
}

/// Index of the first number that fulfills the predicate. Whole blocks are tested so that the
/// compiler can vectorize.
#[inline(always)]
fn find_blockwise(numbers: &[u32], predicate: impl Fn(u32) -> bool) -> Option<usize> {
    // Unlike `any`, a fold has no early exit, so it tests all numbers of a block at once.
    let (block_ix, block) = numbers.chunks(BLOCK).enumerate().find(|(_, block)| {
        block
            .iter()
            .fold(false, |any, number| any | predicate(*number))
    })?;
    Some(BLOCK * block_ix + block.iter().position(|number| predicate(*number))?)
}

/// Elementwise minimum of three slices. Each slice is its own argument so that the compiler
/// vectorizes the loop.
#[inline(always)]
fn merge(nearest: &mut [u16], center: &[u16], left: &[u16]) {
    let n = nearest.len();
    let center = &center[..n];
    let left = &left[..n];
    for ix in 0..n {
        nearest[ix] = nearest[ix].min(center[ix]).min(left[ix]);
    }
}
