//! What IC-GN reads: both stacks with the frames of a pixel side by side, so that time fills the SIMD
//! lanes, and per-pixel sums of the reference from which a subset's Hessian and norms are built.

use rayon::prelude::*;

use crate::{
    Image, Interpolation, SAMPLES_PER_DN8, Sample, StereoStack,
    bspline::{self, LANES, mirrored},
};

/// Largest subset radius: a row of a subset fits in [`LANES`] columns.
pub const SUBSET_RADIUS_LIMIT: usize = 7;

/// Columns and rows of margin around `Prepared::row_sums` that a subset may reach into.
pub const MARGIN: usize = 8;

/// Coefficients stored beyond either end of a right row.
pub const RIGHT_MARGIN: usize = 4;

/// Per-pixel sums over the frames, with L the left grey value and I its derivative along the row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sum {
    /// Sum of I^2.
    II = 0,
    /// Sum of I L.
    IL = 1,
    /// Sum of I.
    I = 2,
    /// Sum of L.
    L = 3,
    /// Sum of L^2.
    LL = 4,
}

/// Pixels outside a mask that reflect those inside; beyond, nothing reaches back into it.
const REFLECTED: usize = 4;

/// Number of [`Sum`]s.
pub const SUMS: usize = 5;

/// A stack made ready for IC-GN. Grey values are in DN of 8 bits.
#[derive(Debug, Default)]
pub struct Prepared {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) frames: usize,
    pub(crate) kind: Interpolation,
    /// Left grey values, `[y][x][LANES]`.
    pub(crate) left: Vec<f32>,
    /// Their derivative along the row, `[y][x][LANES]`.
    pub(crate) gradient: Vec<f32>,
    /// Right spline coefficients, `[y][RIGHT_MARGIN + x][LANES]`, mirrored into the margins.
    pub(crate) right: Vec<f32>,
    /// `[MARGIN + y][SUMS][MARGIN + x]`.
    pub(crate) sums: Vec<f32>,
    /// Per right row, how many columns before this one are outside the mask.
    pub(crate) right_outside: Option<Vec<u16>>,
}

impl Prepared {
    /// Fills this from a stack that [`StereoStack::check`] accepts, reusing its memory.
    pub fn fill(&mut self, stack: &StereoStack<'_>, kind: Interpolation) {
        let (width, height) = (stack.width(), stack.height());
        (self.width, self.height, self.frames, self.kind) = (width, height, stack.frames(), kind);
        self.left.resize(width * height * LANES, 0.0);
        self.gradient.resize(width * height * LANES, 0.0);
        self.right.resize(self.right_pitch() * height, 0.0);
        let sums_row = SUMS * self.sums_pitch();
        self.sums.clear();
        self.sums.resize(sums_row * (height + 2 * MARGIN) + LANES, 0.0);
        let sums_pitch = self.sums_pitch();
        self.left
            .par_chunks_mut(width * LANES)
            .zip(self.gradient.par_chunks_mut(width * LANES))
            .zip(self.sums[MARGIN * sums_row..].par_chunks_mut(sums_row))
            .enumerate()
            .for_each_init(Vec::new, |coefficients, (y, ((left, gradient), sums))| {
                interleave(stack.left, stack.left_mask, y, left);
                coefficients.clear();
                coefficients.extend_from_slice(left);
                bspline::prefilter(coefficients, kind);
                differentiate(coefficients, kind, gradient);
                add_up(left, gradient, sums, sums_pitch);
            });
        let margin = RIGHT_MARGIN * LANES;
        let pitch = self.right_pitch();
        self.right.par_chunks_mut(pitch).enumerate().for_each(|(y, row)| {
            let inner = &mut row[margin..margin + width * LANES];
            interleave(stack.right, stack.right_mask, y, inner);
            bspline::prefilter(inner, kind);
            for k in 1..=RIGHT_MARGIN {
                for (to, from) in [
                    (-(k as isize), -(k as isize)),
                    ((width + k - 1) as isize, (width + k - 1) as isize),
                ] {
                    let from = RIGHT_MARGIN + mirrored(from, width);
                    let to = (RIGHT_MARGIN as isize + to) as usize;
                    row.copy_within(from * LANES..(from + 1) * LANES, to * LANES);
                }
            }
        });
        self.right_outside = stack.right_mask.map(|mask| {
            let mut outside = vec![0u16; (width + 1) * height];
            outside.par_chunks_mut(width + 1).enumerate().for_each(|(y, row)| {
                for (x, &m) in mask.row(y).iter().enumerate() {
                    row[x + 1] = row[x] + (m == 0) as u16;
                }
            });
            outside
        });
    }

    /// Values in a row of [`Prepared::right`].
    pub(crate) fn right_pitch(&self) -> usize {
        (self.width + 2 * RIGHT_MARGIN) * LANES
    }

    /// Values in a row of one [`Sum`].
    pub(crate) fn sums_pitch(&self) -> usize {
        self.width + 2 * MARGIN
    }

    /// Whether the right camera saw position `at` of row `y`, its border pixels' outer halves included:
    /// one of the two pixels beside it is inside.
    pub(crate) fn right_sees(&self, y: usize, at: f64) -> bool {
        let column = at.floor() as i64;
        self.right_is_inside(y, column, column) || self.right_is_inside(y, column + 1, column + 1)
    }

    /// Whether the right columns `first..=last` of row `y` are all inside the image and its mask.
    pub(crate) fn right_is_inside(&self, y: usize, first: i64, last: i64) -> bool {
        if first < 0 || last >= self.width as i64 || last < first {
            return false;
        }
        self.right_outside.as_ref().is_none_or(|outside| {
            let row = &outside[y * (self.width + 1)..];
            row[last as usize + 1] == row[first as usize]
        })
    }
}

/// Puts the frames of row `y` side by side. Pixels outside the mask continue those inside by a
/// reflection about the border's own value, which keeps the slope there: what they held never enters a
/// filter.
fn interleave(frames: &[&Image<Sample>], mask: Option<&Image<u8>>, y: usize, out: &mut [f32]) {
    let (pixels, _) = out.as_chunks_mut::<LANES>();
    for (t, frame) in frames.iter().enumerate() {
        for (pixel, &v) in pixels.iter_mut().zip(frame.row(y)) {
            pixel[t] = v as f32 * (1.0 / SAMPLES_PER_DN8 as f32);
        }
    }
    for pixel in pixels.iter_mut() {
        pixel[frames.len()..].fill(0.0);
    }
    let Some(mask) = mask.map(|m| m.row(y)) else { return };
    let Some(first) = mask.iter().position(|&m| m != 0) else {
        return pixels.iter_mut().for_each(|p| p.fill(0.0));
    };
    let mut border = first;
    for x in 0..pixels.len() {
        if mask[x] != 0 {
            border = x;
            continue;
        }
        let (edge, distance) = (pixels[border], border.abs_diff(x).min(REFLECTED));
        // To the left of the first border, and to the right of the others.
        let inner = if x < border { border + distance } else { border.wrapping_sub(distance) };
        pixels[x] = match mask.get(inner) {
            Some(&m) if m != 0 => {
                let inner = pixels[inner];
                std::array::from_fn(|t| 2.0 * edge[t] - inner[t])
            }
            _ => edge,
        };
    }
}

/// Derivative of the spline at the pixels.
fn differentiate(coefficients: &[f32], kind: Interpolation, out: &mut [f32]) {
    let (c, _) = coefficients.as_chunks::<LANES>();
    let (out, _) = out.as_chunks_mut::<LANES>();
    let [near, far] = kind.derivative();
    let width = c.len();
    for (x, out) in out.iter_mut().enumerate() {
        let at = |k: isize| &c[mirrored(x as isize + k, width)];
        let inside = x >= 2 && x + 2 < width;
        let (p1, m1, p2, m2) = if inside {
            (&c[x + 1], &c[x - 1], &c[x + 2], &c[x - 2])
        } else {
            (at(1), at(-1), at(2), at(-2))
        };
        for t in 0..LANES {
            out[t] = near * (p1[t] - m1[t]) + far * (p2[t] - m2[t]);
        }
    }
}

/// The [`Sum`]s of one row.
fn add_up(left: &[f32], gradient: &[f32], sums: &mut [f32], pitch: usize) {
    let (left, _) = left.as_chunks::<LANES>();
    let (gradient, _) = gradient.as_chunks::<LANES>();
    for (x, (l, i)) in left.iter().zip(gradient).enumerate() {
        let mut put = |sum: Sum, value: f32| sums[sum as usize * pitch + MARGIN + x] = value;
        let dot = |a: &[f32; LANES], b: &[f32; LANES]| (0..LANES).map(|t| a[t] * b[t]).sum::<f32>();
        put(Sum::II, dot(i, i));
        put(Sum::IL, dot(i, l));
        put(Sum::I, i.iter().sum());
        put(Sum::L, l.iter().sum());
        put(Sum::LL, dot(l, l));
    }
}
