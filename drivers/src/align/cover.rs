//! The nearest of the squares that cover each pixel of an image.
//!
//! Neighbours in a row of depth mostly cover the same lines of the colour image. Of such a run only the columns are worked out one by
//! one, in strips that stand for as many columns each; then the run is put into its lines, many pixels at once.

use std::ops::Range;

/// What no square covers: larger than every count less one.
pub(super) const NOTHING: u16 = u16::MAX;
/// Strips: squares one, two, three and four columns wide. Wider ones are rare, and are put where they are column by column.
const N_STRIPS: usize = 4;
/// Room before the first column of a strip.
const PAD: usize = N_STRIPS;
/// Place of a square that is too wide for the strips.
const WIDE: u32 = u32::MAX;
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
    /// The nearest of the squares of so many columns that begin at a column, of the run of the moment: [`N_STRIPS`] times `stride`,
    /// and a place for each pixel of depth that is nowhere: were it the same for all, each would have to wait for the one before.
    strips: Vec<u16>,
    stride: usize,
    /// Of each pixel of the row: first line in the upper half, last line in the lower; 0 where it covers nothing.
    lines: Vec<u32>,
    /// Of each pixel of the row: where in the strips it is put.
    places: Vec<u32>,
}

impl Canvas {
    /// Of nothing, for rows of `depth_width` pixels.
    pub(super) fn new([width, height]: [usize; 2], depth_width: usize) -> Self {
        let stride = width + 1 + PAD;
        Self {
            width,
            nearest: vec![NOTHING; width * height],
            strips: vec![NOTHING; N_STRIPS * stride + depth_width],
            stride,
            lines: vec![0; depth_width],
            places: vec![0; depth_width],
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
        let (mut begin, mut run) = (0, 0);
        for block in (0..row.len()).step_by(BLOCK) {
            let end = (block + BLOCK).min(row.len());
            let lines = &self.lines[block..end];
            // Without branches: numbers that are 0 where all is well.
            let others = lines.iter().fold(0, |so_far, lines| so_far | if *lines == 0 { 0 } else { lines ^ run });
            let wide = self.places[block..end].iter().fold(0, |so_far, place| so_far | u32::from(*place == WIDE));
            if others | wide == 0 {
                let strips = &mut self.strips[..];
                for (place, count) in self.places[block..end].iter().zip(&row[block..end]) {
                    let nearest = &mut strips[*place as usize];
                    *nearest = count.wrapping_sub(1).min(*nearest);
                }
                continue;
            }
            for (ix, count) in (block..end).zip(&row[block..end]) {
                let lines = self.lines[ix];
                if lines == 0 {
                    continue;
                }
                if lines != run {
                    self.flush(begin..ix, run, covered);
                    (begin, run) = (ix, lines);
                }
                let columns = match self.places[ix] {
                    WIDE => usize::from(covered.first[0][ix]) + PAD..usize::from(covered.last[0][ix]) + PAD + 1,
                    place => place as usize..place as usize + 1,
                };
                let less_one = count - 1;
                self.strips[columns].iter_mut().for_each(|nearest| *nearest = less_one.min(*nearest));
            }
        }
        self.flush(begin..row.len(), run, covered);
    }

    /// Where each pixel of a row is to be put.
    #[expect(clippy::cast_possible_truncation, reason = "widths of images have 16 bits")]
    #[inline(always)]
    fn place(&mut self, row: &[u16], covered: &Covered) {
        let n = row.len();
        let Covered { first: [left, top], last: [right, bottom] } = covered;
        let (left, top, right, bottom) = (&left[..n], &top[..n], &right[..n], &bottom[..n]);
        let (lines, places) = (&mut self.lines[..n], &mut self.places[..n]);
        let stride = self.stride as u32;
        for ix in 0..n {
            let is_seen = (row[ix] != 0) & (left[ix] <= right[ix]) & (top[ix] <= bottom[ix]);
            let n_more = u32::from(right[ix].wrapping_sub(left[ix]));
            let place = n_more.wrapping_mul(stride).wrapping_add(u32::from(left[ix]) + PAD as u32);
            let place = if n_more < N_STRIPS as u32 { place } else { WIDE };
            lines[ix] = if is_seen { u32::from(top[ix]) << 16 | u32::from(bottom[ix]) } else { 0 };
            places[ix] = if is_seen { place } else { N_STRIPS as u32 * stride + ix as u32 };
        }
    }

    /// Puts a run of pixels into the lines that they cover, and empties the strips.
    #[inline(always)]
    fn flush(&mut self, run: Range<usize>, lines: u32, covered: &Covered) {
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
        for n_more in (1..N_STRIPS).rev() {
            // A square of so many columns is two of one column less.
            let (narrower, strip) = self.strips[(n_more - 1) * self.stride..].split_at_mut(self.stride);
            let narrower = &mut narrower[PAD + from..][..n];
            let two = strip[PAD + from..][..n].iter().zip(&strip[PAD + from - 1..][..n]);
            for (nearest, (here, before)) in narrower.iter_mut().zip(two) {
                *nearest = (*nearest).min(*here).min(*before);
            }
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
