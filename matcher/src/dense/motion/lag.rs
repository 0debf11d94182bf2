//! Which time a fit at rest stands for, pixel by pixel: the mean time of its window's frames, weighted
//! by their squared gradients as the fit weights them.
//!
//! Seen from the frames' mean, a moving surface's disparity is off by the rate times this. Left in, it
//! takes a part of the motion for its own: four in a hundred of the rate for the sensor's dots.

use super::{BLOCK, Motion, sums::Frame};
use crate::{
    dense::job::image_rows,
    dense::moments::{PAD, box_sum},
    lanes::vectorised,
    params::RADIUS_LIMIT,
};

/// Rows of squared gradients around a row of blocks.
#[derive(Debug, Default)]
pub(crate) struct Lag {
    /// Per image row: sum over time of S, and of S t (padded rows).
    rows: Vec<[Vec<f32>; 2]>,
    column: Vec<f32>,
    threes: Vec<f32>,
    windows: [Vec<f32>; 2],
}

impl Lag {
    /// Takes rows `top..end` and `radius` more on both sides.
    pub fn fill(&mut self, frame: &Frame<'_>, (top, end): (usize, usize), radius: usize) {
        let width = frame.stack.width();
        let padded = width.next_multiple_of(32) + 2 * PAD;
        self.rows.resize_with(BLOCK + 2 * radius, Default::default);
        for (k, sums) in self.rows.iter_mut().enumerate() {
            for sum in sums.iter_mut() {
                sum.clear();
                sum.resize(padded, 0.0);
            }
            let y = (top + k).wrapping_sub(radius);
            if y >= frame.stack.height() || y >= end + radius {
                continue;
            }
            let rows = image_rows(frame.stack.left, y as isize);
            let times = &frame.times.centred[..frame.stack.frames()];
            let [s, st] = sums;
            vectorised!(
                frame.level,
                square_loop(
                    rows: &[&[crate::Sample]] = &rows[..times.len()],
                    times: &[f32] = times,
                    s: &mut [f32] = &mut s[PAD..PAD + width],
                    st: &mut [f32] = &mut st[PAD..PAD + width],
                )
            );
        }
        self.column.resize(padded, 0.0);
        self.threes.resize(padded, 0.0);
        for window in &mut self.windows {
            window.resize(padded, 0.0);
        }
    }

    /// Brings the disparities `w` of row `y` to the frames' mean time.
    pub fn correct(
        &mut self,
        frame: &Frame<'_>,
        motion: &Motion,
        (y, top): (usize, usize),
        radius: usize,
        w: &mut [f32],
    ) {
        let len = w.len();
        for (k, window) in self.windows.iter_mut().enumerate() {
            let side = 2 * radius + 1;
            let around: [&[f32]; 2 * RADIUS_LIMIT + 1] =
                std::array::from_fn(|j| &self.rows[y - top + j.min(side - 1)][k][..]);
            let scratch = (&mut self.column[..], &mut self.threes[..]);
            box_sum(frame.level, &around[..side], radius, len, scratch, window);
        }
        let [s, st] = &self.windows;
        let times = s[PAD..].iter().zip(&st[PAD..]);
        for ((w, rate), (s, st)) in w.iter_mut().zip(motion.rate.row(y)).zip(times) {
            *w -= rate * frame.times.unit * st / s.max(f32::MIN_POSITIVE);
        }
    }
}

/// Sums over time of the squared differences between a pixel's neighbours, and of these weighted by time.
#[inline(always)]
fn square_loop(rows: &[&[crate::Sample]], times: &[f32], s: &mut [f32], st: &mut [f32]) {
    let inner = s.len().saturating_sub(2);
    let (s, st) = (&mut s[1..], &mut st[1..]);
    for (row, &time) in rows.iter().zip(times) {
        let (before, after) = (&row[..inner], row.get(2..).unwrap_or(&[]));
        for (((&a, &b), s), st) in before.iter().zip(after).zip(s.iter_mut()).zip(st.iter_mut()) {
            let slope = (i32::from(b) - i32::from(a)) as f32;
            *s += slope * slope;
            *st += slope * slope * time;
        }
    }
}
