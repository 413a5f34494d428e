//! The nearest of the squares that cover each pixel of an image.
//!
//! Neighbours in a row of depth mostly cover the same lines of the colour image. Of such a run only the columns are worked out one by
//! one, in strips that stand for as many columns each; then the run is put into its lines, many pixels at once.

use std::ops::Range;

/// What no square covers: larger than every count less one.
pub(super) const NOTHING: u16 = u16::MAX;
/// Strips: squares one, two, three and four columns wide. Wider ones are rare, and are put where they are column by column.
const MOST_STRIPS: usize = 4;
/// Room before the first column of a strip.
const PAD: usize = MOST_STRIPS;
/// Places in the strips, as many as 16 bits count: none needs to be checked.
const N_PLACES: usize = 1 << 16;
/// Places behind the strips for what is nowhere, one after the other: were it the same for all, each would have to wait for the one
/// before.
const N_NOWHERE: usize = 256;
/// Place of a square that is too wide for the strips.
const WIDE: u16 = u16::MAX;
/// Columns beyond these are not covered: they have no place in a strip.
pub(super) const MOST_COLUMNS: usize = N_PLACES - 1 - N_NOWHERE - PAD - 1;
/// Pixels that are looked at at once.
const BLOCK: usize = 32;

/// First and last column and row that each pixel of one row of depth covers, cut to the image; counted from 1, so that 0 is
/// before the image. Where a first one is behind a last one nothing is covered.
pub(super) struct Covered {
    pub(super) first: [Vec<u16>; 2],
    pub(super) last: [Vec<u16>; 2],
}

/// An image, while the squares of one row of depth after the other are put into it.
pub(super) struct Canvas {
    width: usize,
    /// The nearest count less one of each pixel: `[height, width]`.
    nearest: Vec<u16>,
    /// The nearest of the squares of so many columns that begin at a column, of the run of the moment: `n_strips` times `stride`,
    /// and [`N_NOWHERE`].
    strips: Box<[u16; N_PLACES]>,
    /// As many as there is room for.
    n_strips: usize,
    stride: usize,
    /// Of each pixel of the row: first line in the upper half, last line in the lower; 0 where it covers nothing.
    lines: Vec<u32>,
    /// Of each pixel of the row: where in the strips it is put.
    places: Vec<u16>,
    /// Of each pixel of the row: its count less one.
    less_one: Vec<u16>,
}

impl Canvas {
    /// Of nothing, for rows of `depth_width` pixels.
    pub(super) fn new([width, height]: [usize; 2], depth_width: usize) -> Self {
        let stride = width.min(MOST_COLUMNS) + 1 + PAD;
        Self {
            width,
            nearest: vec![NOTHING; width * height],
            strips: Box::new([NOTHING; N_PLACES]),
            n_strips: MOST_STRIPS.min((N_PLACES - 1 - N_NOWHERE) / stride),
            stride,
            lines: vec![0; depth_width],
            places: vec![0; depth_width],
            less_one: vec![0; depth_width],
        }
    }

    /// The nearest count less one of each pixel; [`NOTHING`] where no square is.
    pub(super) fn into_nearest(self) -> Vec<u16> {
        self.nearest
    }

    /// Puts the squares of one row of depth where they are nearer than what is there; counts of 0 are nowhere.
    #[inline(always)]
    pub(super) fn put(&mut self, row: &[u16], covered: &Covered) {
        self.place(row, covered);
        let mut begin = 0;
        while let Some(run) = self.run_from(begin) {
            self.fill(run.clone(), covered);
            self.flush(run.clone(), covered);
            begin = run.end;
        }
    }

    /// The next pixels that cover the same lines, from the first that covers any; those between that cover nothing are no end.
    #[inline(always)]
    fn run_from(&self, begin: usize) -> Option<Range<usize>> {
        let lines = &self.lines[begin..];
        let first = place_of(lines, |lines| lines != 0)?;
        let run = lines[first];
        let n = place_of(&lines[first..], |lines| (lines != 0) & (lines != run)).unwrap_or(lines.len() - first);
        Some(begin + first..begin + first + n)
    }

    /// Puts a run of pixels into the strips.
    #[inline(always)]
    fn fill(&mut self, run: Range<usize>, covered: &Covered) {
        let (places, less_one) = (&self.places[run.clone()], &self.less_one[run.clone()]);
        let has_wide = places.iter().fold(false, |so_far, place| so_far | (*place == WIDE));
        if !has_wide {
            for (place, less_one) in places.iter().zip(less_one) {
                let nearest = &mut self.strips[usize::from(*place)];
                *nearest = (*less_one).min(*nearest);
            }
            return;
        }
        for (ix, (place, less_one)) in run.zip(places.iter().zip(less_one)) {
            let columns = match *place {
                WIDE => usize::from(covered.first[0][ix]) + PAD..usize::from(covered.last[0][ix]) + PAD + 1,
                place => usize::from(place)..usize::from(place) + 1,
            };
            self.strips[columns].iter_mut().for_each(|nearest| *nearest = (*less_one).min(*nearest));
        }
    }

    /// Where each pixel of a row is to be put.
    #[expect(clippy::cast_possible_truncation, reason = "places have 16 bits")]
    #[inline(always)]
    fn place(&mut self, row: &[u16], covered: &Covered) {
        let n = row.len();
        let Covered { first: [left, top], last: [right, bottom] } = covered;
        let (left, top, right, bottom) = (&left[..n], &top[..n], &right[..n], &bottom[..n]);
        let (lines, places) = (&mut self.lines[..n], &mut self.places[..n]);
        let less_one = &mut self.less_one[..n];
        let (stride, n_strips) = (self.stride as u16, self.n_strips as u16);
        let nowhere = n_strips * stride;
        for ix in 0..n {
            let is_seen = (row[ix] != 0) & (left[ix] <= right[ix]) & (top[ix] <= bottom[ix]);
            let n_more = right[ix].wrapping_sub(left[ix]);
            let place = n_more.wrapping_mul(stride).wrapping_add(left[ix]).wrapping_add(PAD as u16);
            let place = if n_more < n_strips { place } else { WIDE };
            lines[ix] = if is_seen { u32::from(top[ix]) << 16 | u32::from(bottom[ix]) } else { 0 };
            places[ix] = if is_seen { place } else { nowhere + (ix % N_NOWHERE) as u16 };
            less_one[ix] = row[ix].wrapping_sub(1);
        }
    }

    /// Puts a run of pixels into the lines that they cover, and empties the strips.
    #[inline(always)]
    fn flush(&mut self, run: Range<usize>, covered: &Covered) {
        let lines = self.lines[run.start];
        let seen = self.lines[run.clone()].iter();
        let columns = covered.first[0][run.clone()].iter().zip(&covered.last[0][run]);
        let (from, to) = seen.zip(columns).fold((u16::MAX, 0), |(from, to), (lines, (left, right))| {
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
            strip[PAD + from..][..n].fill(NOTHING);
        }
        let columns = &mut self.strips[PAD + from..][..n];
        for line in lines >> 16..=lines & 0xFFFF {
            let line = &mut self.nearest[(line as usize - 1) * self.width + from - 1..][..n];
            line.iter_mut().zip(&*columns).for_each(|(nearest, new)| *nearest = (*new).min(*nearest));
        }
        columns.fill(NOTHING);
    }
}

/// The first number that is so: all of a block are looked at at once.
#[inline(always)]
fn place_of(numbers: &[u32], is_so: impl Fn(u32) -> bool) -> Option<usize> {
    let has_one = |block: &&[u32]| block.iter().fold(false, |so_far, number| so_far | is_so(*number));
    let (block_ix, block) = numbers.chunks(BLOCK).enumerate().find(|(_, block)| has_one(block))?;
    Some(BLOCK * block_ix + block.iter().position(|number| is_so(*number))?)
}

/// The nearest of three; each list an argument of its own, so that the compiler makes vector code of it.
#[inline(always)]
fn merge(nearest: &mut [u16], here: &[u16], before: &[u16]) {
    let n = nearest.len();
    let (here, before) = (&here[..n], &before[..n]);
    for ix in 0..n {
        nearest[ix] = nearest[ix].min(here[ix]).min(before[ix]);
    }
}
