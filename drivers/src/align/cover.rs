//! The nearest of the squares that cover each pixel of an image.
//!
//! Neighbours in a row of depth mostly cover the same lines of the colour image. Of such a run only the columns are worked out one by
//! one, in strips that stand for as many columns each; then the run is put into its lines, many pixels at once.

use std::ops::Range;

/// What no square covers: larger than every count less one.
pub(super) const NO_DEPTH: u16 = u16::MAX;
/// Strips: squares one, two, three and four columns wide. Wider ones are rare, and are put where they are column by column.
const MAX_STRIPS: usize = 4;
/// Room before the first column of a strip.
const PAD: usize = MAX_STRIPS;
/// Places in the strips, as many as 16 bits count: none needs to be checked.
const N_STRIP_CELLS: usize = 1 << 16;
/// Places behind the strips for what is nowhere, one after the other: were it the same for all, each would have to wait for the one
/// before.
const N_DISCARD_CELLS: usize = 256;
/// Place of a square that is too wide for the strips.
const WIDE: u16 = u16::MAX;
/// Columns beyond these are not covered: they have no place in a strip.
pub(super) const MAX_COLUMNS: usize = N_STRIP_CELLS - 1 - N_DISCARD_CELLS - PAD - 1;
/// Pixels that are looked at at once.
const BLOCK: usize = 32;

/// First and last column and row that each pixel of one row of depth covers, cut to the image; counted from 1, so that 0 is
/// before the image. Where a first one is behind a last one nothing is covered.
pub(super) struct PixelBounds {
    pub(super) first: [Vec<u16>; 2],
    pub(super) last: [Vec<u16>; 2],
}

/// An image, while the squares of one row of depth after the other are put into it.
pub(super) struct NearestDepth {
    width: usize,
    /// The nearest count less one of each pixel: `[height, width]`.
    nearest: Vec<u16>,
    /// The nearest of the squares of so many columns that begin at a column, of the run of the moment: `n_strips` times `stride`,
    /// and [`N_DISCARD_CELLS`].
    strips: Box<[u16; N_STRIP_CELLS]>,
    /// As many as there is room for.
    n_strips: usize,
    stride: usize,
    /// Of each pixel of the row: first line in the upper half, last line in the lower; 0 where it covers nothing.
    lines: Vec<u32>,
    /// Of each pixel of the row: where in the strips it is put.
    strip_cells: Vec<u16>,
    /// Of each pixel of the row: its count less one.
    count_minus_one: Vec<u16>,
}

impl NearestDepth {
    /// Of nothing, for rows of `depth_width` pixels.
    pub(super) fn new([width, height]: [usize; 2], depth_width: usize) -> Self {
        let stride = width.min(MAX_COLUMNS) + 1 + PAD;
        Self {
            width,
            nearest: vec![NO_DEPTH; width * height],
            strips: Box::new([NO_DEPTH; N_STRIP_CELLS]),
            n_strips: MAX_STRIPS.min((N_STRIP_CELLS - 1 - N_DISCARD_CELLS) / stride),
            stride,
            lines: vec![0; depth_width],
            strip_cells: vec![0; depth_width],
            count_minus_one: vec![0; depth_width],
        }
    }

    /// The nearest count less one of each pixel; [`NO_DEPTH`] where no square is.
    pub(super) fn into_nearest(self) -> Vec<u16> {
        self.nearest
    }

    /// Puts the squares of one row of depth where they are nearer than what is there; counts of 0 are nowhere.
    #[inline(always)]
    pub(super) fn put(&mut self, row: &[u16], bounds: &PixelBounds) {
        self.place_row(row, bounds);
        let mut begin = 0;
        while let Some(run) = self.next_run(begin) {
            self.fill(run.clone(), bounds);
            self.write_run(run.clone(), bounds);
            begin = run.end;
        }
    }

    /// The next pixels that cover the same lines, from the first that covers any; those between that cover nothing are no end.
    #[inline(always)]
    fn next_run(&self, begin: usize) -> Option<Range<usize>> {
        let lines = &self.lines[begin..];
        let first = find_blockwise(lines, |lines| lines != 0)?;
        let run = lines[first];
        let n = find_blockwise(&lines[first..], |lines| (lines != 0) & (lines != run)).unwrap_or(lines.len() - first);
        Some(begin + first..begin + first + n)
    }

    /// Puts a run of pixels into the strips.
    #[inline(always)]
    fn fill(&mut self, run: Range<usize>, bounds: &PixelBounds) {
        let (strip_cells, count_minus_one) = (&self.strip_cells[run.clone()], &self.count_minus_one[run.clone()]);
        let has_too_wide = strip_cells.iter().fold(false, |any, place_row| any | (*place_row == WIDE));
        if !has_too_wide {
            for (place_row, count_minus_one) in strip_cells.iter().zip(count_minus_one) {
                let nearest = &mut self.strips[usize::from(*place_row)];
                *nearest = (*count_minus_one).min(*nearest);
            }
            return;
        }
        for (ix, (place_row, count_minus_one)) in run.zip(strip_cells.iter().zip(count_minus_one)) {
            let columns = match *place_row {
                WIDE => usize::from(bounds.first[0][ix]) + PAD..usize::from(bounds.last[0][ix]) + PAD + 1,
                place_row => usize::from(place_row)..usize::from(place_row) + 1,
            };
            self.strips[columns].iter_mut().for_each(|nearest| *nearest = (*count_minus_one).min(*nearest));
        }
    }

    /// Where each pixel of a row is to be put.
    #[expect(clippy::cast_possible_truncation, reason = "places have 16 bits")]
    #[inline(always)]
    fn place_row(&mut self, row: &[u16], bounds: &PixelBounds) {
        let n = row.len();
        let PixelBounds { first: [left, top], last: [right, bottom] } = bounds;
        let (left, top, right, bottom) = (&left[..n], &top[..n], &right[..n], &bottom[..n]);
        let (lines, strip_cells) = (&mut self.lines[..n], &mut self.strip_cells[..n]);
        let count_minus_one = &mut self.count_minus_one[..n];
        let (stride, n_strips) = (self.stride as u16, self.n_strips as u16);
        let discard = n_strips * stride;
        for ix in 0..n {
            let is_visible = (row[ix] != 0) & (left[ix] <= right[ix]) & (top[ix] <= bottom[ix]);
            let n_more = right[ix].wrapping_sub(left[ix]);
            let place_row = n_more.wrapping_mul(stride).wrapping_add(left[ix]).wrapping_add(PAD as u16);
            let place_row = if n_more < n_strips { place_row } else { WIDE };
            lines[ix] = if is_visible { u32::from(top[ix]) << 16 | u32::from(bottom[ix]) } else { 0 };
            strip_cells[ix] = if is_visible { place_row } else { discard + (ix % N_DISCARD_CELLS) as u16 };
            count_minus_one[ix] = row[ix].wrapping_sub(1);
        }
    }

    /// Puts a run of pixels into the lines that they cover, and empties the strips.
    #[inline(always)]
    fn write_run(&mut self, run: Range<usize>, bounds: &PixelBounds) {
        let lines = self.lines[run.start];
        let line_bounds = self.lines[run.clone()].iter();
        let columns = bounds.first[0][run.clone()].iter().zip(&bounds.last[0][run]);
        let (from, to) = line_bounds.zip(columns).fold((u16::MAX, 0), |(from, to), (lines, (left, right))| {
            let (left, right) = if *lines == 0 { (u16::MAX, 0) } else { (*left, *right) };
            (from.min(left), to.max(right))
        });
        if from > to {
            return;
        }
        let (from, n) = (usize::from(from), usize::from(to - from) + 1);
        for n_more in (1..self.n_strips).rev() {
            // A square of so many columns is two of one column less.
            let (narrower, strip) = self.strips[(n_more - 1) * self.stride..].split_at_mut(self.stride);
            merge(&mut narrower[PAD + from..][..n], &strip[PAD + from..][..n], &strip[PAD + from - 1..][..n]);
            strip[PAD + from..][..n].fill(NO_DEPTH);
        }
        let columns = &mut self.strips[PAD + from..][..n];
        for line in lines >> 16..=lines & 0xFFFF {
            let line = &mut self.nearest[(line as usize - 1) * self.width + from - 1..][..n];
            line.iter_mut().zip(&*columns).for_each(|(nearest, new)| *nearest = (*new).min(*nearest));
        }
        columns.fill(NO_DEPTH);
    }
}

/// The first number that is so: all of a block are looked at at once.
#[inline(always)]
fn find_blockwise(numbers: &[u32], predicate: impl Fn(u32) -> bool) -> Option<usize> {
    let has_one = |block: &&[u32]| block.iter().fold(false, |any, number| any | predicate(*number));
    let (block_ix, block) = numbers.chunks(BLOCK).enumerate().find(|(_, block)| has_one(block))?;
    Some(BLOCK * block_ix + block.iter().position(|number| predicate(*number))?)
}

/// The nearest of three; each list an argument of its own, so that the compiler makes vector code of it.
#[inline(always)]
fn merge(nearest: &mut [u16], center: &[u16], left: &[u16]) {
    let n = nearest.len();
    let (center, left) = (&center[..n], &left[..n]);
    for ix in 0..n {
        nearest[ix] = nearest[ix].min(center[ix]).min(left[ix]);
    }
}
