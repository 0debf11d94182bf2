//! The rate's sums of a scene taken for still, made along with its fit.
//!
//! They need the right stack at the disparities found, weighted by time: what the fit's second warp has in
//! registers. On the rows that [`super::sums`] would look at, it gives one more sum, from which
//! b_t and q of the gradients weighted by time follow as q does. At the end of the sweep, where the
//! disparity d is known, the sums are brought from the place of the warp to it,
//! (1 - w_x) sum b = sum S d - sum q, and added up by blocks.

use super::{
    BLOCK, Times,
    sums::{Block, PIXELS_MIN, ROWS_APART, Surfaces, ZNCC_MIN, total_loop},
    weight::{Weighted, weigh, words},
};
use crate::{
    Image, Level, StereoStack,
    dense::{normalise::TimedTerms, rings::Ring, warp::Timed},
    lanes::{Lanes, dispatch, vectorised},
};

/// A fit within this of a block's surface, as the coarse search found it, belongs to it.
const NEAR_PX: f32 = 2.0;

/// Sums of a block: pixels, disparities, S, S t, S t^2, and (1 - w_x) b and (1 - w_x) b t.
const SUMS: usize = 7;

/// When a stack's frames were taken, as its fit needs it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Watch {
    times: [i32; 8],
}

impl Watch {
    /// `None` where motion is not looked for.
    pub fn of(stack: &StereoStack<'_>) -> Option<Self> {
        Times::of(stack).map(|times| Self { times: words(&times.centred) })
    }

    /// Whether row `y` of the image takes part.
    pub fn samples(y: isize) -> bool {
        y.rem_euclid(ROWS_APART as isize) == ROWS_APART as isize / 2
    }
}

/// Rows of a tile that lie between its second warp and its end, and sums of the row of blocks in work.
#[derive(Debug, Default)]
pub(crate) struct Along {
    /// Gradients times the frame's time.
    weighted: Vec<i32>,
    ilt: Ring,
    it: Ring,
    igt: Ring,
    st: Ring,
    stt: Ring,
    qt: Ring,
    /// One at steps.
    step: Vec<f32>,
    sums: [Vec<f32>; SUMS],
    surfaces: Surfaces,
}

/// What a row's end is made of: padded rows from the first pixel of a block on, of whole blocks.
pub(crate) struct Found<'a> {
    /// Disparities without the origin.
    pub disparity: &'a [f32],
    pub origin: f32,
    pub zncc: &'a [f32],
    pub valid: &'a [f32],
    pub s: &'a [f32],
    pub q: &'a [f32],
}

impl Along {
    /// Makes room for rows of `len` pixels, as long as windows are wide.
    pub fn resize(&mut self, stride: usize, words: usize, window: usize) {
        self.weighted.resize(words, 0);
        let rows = [&mut self.ilt, &mut self.it, &mut self.igt];
        for ring in rows.into_iter().chain([&mut self.st, &mut self.stt, &mut self.qt]) {
            ring.resize(stride, window);
        }
    }

    /// Weighs the gradients of row `y`, and says where its warp's sums go.
    pub fn weigh(
        &mut self,
        level: Level,
        (gradient, grey): (&[i32], &[i32]),
        watch: &Watch,
        y: isize,
    ) -> Timed<'_> {
        let mut out = Weighted {
            gradient: &mut self.weighted,
            ilt: self.ilt.inner_mut(y),
            it: self.it.inner_mut(y),
            st: self.st.inner_mut(y),
            stt: self.stt.inner_mut(y),
        };
        weigh(level, gradient, grey, &watch.times, &mut out);
        Timed { gradient: &self.weighted, ig: self.igt.inner_mut(y) }
    }

    /// The terms of row `y` whose q is wanted.
    pub fn terms(&mut self, y: isize) -> TimedTerms<'_> {
        TimedTerms {
            s: self.st.row(y),
            il: self.ilt.row(y),
            i: self.it.row(y),
            ig: self.igt.row(y),
            q: self.qt.row_mut(y),
        }
    }

    /// Takes in row `y`, columns `from..to` of the image, of which the row buffers' column `at` is the
    /// first; `blocks` are those of these columns. Blocks are whole after their last row.
    #[allow(clippy::too_many_arguments)]
    pub fn add(
        &mut self,
        level: Level,
        (start, step): (&Image<f32>, &Image<u8>),
        y: usize,
        (from, to): (usize, usize),
        at: usize,
        found: &Found<'_>,
        blocks: &mut [Block],
    ) {
        let height = start.height();
        let top = y / BLOCK * BLOCK;
        let len = blocks.len() * BLOCK;
        if y < top + ROWS_APART {
            for sum in &mut self.sums {
                sum.clear();
                sum.resize(len, 0.0);
            }
            let rows = (y..height.min(top + BLOCK)).step_by(ROWS_APART);
            self.surfaces.bound(level, rows.map(|y| &start.row(y)[from..to]), blocks.len());
        }
        self.step.clear();
        self.step.resize(len, 1.0);
        let step = &step.row(y)[from..to];
        vectorised!(level, step_loop(step: &[u8] = step, to: &mut [f32] = &mut self.step));
        let [st, stt, qt] = [&self.st, &self.stt, &self.qt].map(|ring| &ring.row(y as isize)[at..]);
        let rows =
            [found.disparity, found.zncc, found.valid, &self.step, found.s, found.q, st, stt, qt];
        let rows = rows.map(|row| &row[..len]);
        dispatch!(
            level,
            add_lanes(
                rows: [&[f32]; 9] = rows,
                origin: f32 = found.origin,
                bounds: &[(f32, f32)] = &self.surfaces.bounds,
                sums: [&mut [f32]; SUMS] = self.sums.each_mut().map(|sum| &mut sum[..len]),
            )
        );
        if y + ROWS_APART >= height.min(top + BLOCK) {
            for (column, block) in blocks.iter_mut().enumerate() {
                let mut totals = [0.0; SUMS];
                vectorised!(
                    level,
                    total_loop(
                        sums: &[Vec<f32>] = &self.sums,
                        from: usize = column * BLOCK,
                        totals: &mut [f64] = &mut totals,
                    )
                );
                *block = solve(totals);
            }
        }
    }
}

#[inline(always)]
fn step_loop(step: &[u8], to: &mut [f32]) {
    for (to, &step) in to.iter_mut().zip(step) {
        *to = if step == 0 { 0.0 } else { 1.0 };
    }
}

/// Adds a row's terms to the sums, all of them as long as `bounds` has blocks.
#[inline(always)]
fn add_lanes<V: Lanes>(
    rows: [&[f32]; 9],
    origin: f32,
    bounds: &[(f32, f32)],
    mut sums: [&mut [f32]; SUMS],
) {
    let len = bounds.len() * BLOCK;
    assert!(rows.iter().all(|row| row.len() >= len) && sums.iter().all(|sum| sum.len() >= len));
    let [zero, one, half] = [0.0, 1.0, 0.5].map(V::splat);
    for (k, &(low, high)) in bounds.iter().enumerate() {
        let low = V::splat(low - NEAR_PX - origin);
        let high = V::splat(high + NEAR_PX - origin);
        for i in (k * BLOCK..(k + 1) * BLOCK).step_by(V::COUNT) {
            // SAFETY: `i + COUNT <= len`, as COUNT divides a block.
            let [d, zncc, valid, step, s, q, st, stt, qt] =
                rows.map(|row| unsafe { V::load(row.as_ptr().add(i)) });
            // False for NaN.
            let near = V::both(low.lt(d), d.lt(high));
            let good = V::both(V::splat(ZNCC_MIN).lt(zncc), half.lt(valid));
            let used = V::both(V::both(near, good), step.lt(half));
            let (b, bt) = (s.mul(d).sub(q), st.mul(d).sub(qt));
            for (sum, term) in sums.iter_mut().zip([one, d, s, st, stt, b, bt]) {
                // SAFETY: as above.
                unsafe {
                    let to = sum.as_mut_ptr().add(i);
                    V::load(to).add(V::select(used, term, zero)).store(to);
                }
            }
        }
    }
}

/// The rate from a block's sums; the disparity lacks the origin, which the search for motion does not ask for.
fn solve([n, d, s, st, stt, b, bt]: [f64; SUMS]) -> Block {
    // The part of S t^2 that a shift of all frames does not explain.
    let weight = stt - st * st / s;
    if n < f64::from(PIXELS_MIN) || weight.is_nan() || weight <= 0.0 {
        return Block::default();
    }
    let rate = -(bt - st / s * b) / weight;
    Block { rate: rate as f32, weight: weight as f32, disparity_px: (d / n) as f32 }
}

#[cfg(test)]
mod tests {
    use super::{super::Maker, super::sums::Blocks, *};
    use crate::{
        DisparityRange, ShapeFunction,
        coarse::{Coarse, CoarseMap, INVALID},
        dense::{DenseFit, DenseMaps, mark_steps},
        synthetic::{Layer, Scene},
    };

    /// What is seen along the way is what a pass of its own finds at the disparities of the same fit.
    #[test]
    fn the_fit_sees_the_rates_that_a_pass_of_their_own_finds() {
        let level = Level::best();
        // Few and small: this runs under a memory checker and an emulator too.
        for (rate, frames, radius) in [(0.0, 10, 4), (0.02, 7, 8), (-0.02, 5, 2)] {
            let plane = Layer {
                rate_px_per_frame: rate,
                ..Layer::everywhere(|x, y| 21.3 + 0.11 * x - 0.07 * y)
            };
            let scene = Scene::new(135, 106, frames, vec![plane]).render();
            scene.with_stack(|stack| {
                let mut coarse = Coarse::new(level, DisparityRange { min_px: -20, max_px: 60 });
                let mut map = CoarseMap::new(135, 106);
                coarse.describe(stack);
                coarse.search(stack, true, &mut map);
                let start =
                    map.disparity.map(|d| if d == INVALID { f32::NAN } else { f32::from(d) });
                let mut step = Image::new(135, 106, 0);
                mark_steps(level, &start, radius, 1.5, &mut step);
                let mut maps = DenseMaps::new(135, 106);
                let mut fit = DenseFit::new(level, radius, ShapeFunction::Auto, 1.5);
                fit.fit(stack, &start, &step, &mut maps);
                let times = Times::of(stack).unwrap();
                let maker = Maker { level, stack, step: &step, times: &times };
                let mut apart = Blocks::default();
                apart.sum(&maker.of(&maps.second_px, &maps.zncc, None), None);
                let seen = fit.seen().unwrap();
                let known = |b: &&Block| b.weight > 0.0;
                // In px per frame: mean error and noise of both.
                let (mut n, mut mean, mut noise) = (0.0, [0.0; 2], [0.0; 2]);
                let both = seen.blocks.iter().zip(&apart.blocks);
                for (a, b) in both.filter(|(a, b)| known(a) && known(b)) {
                    let off = [a, b].map(|block| f64::from(block.rate / times.unit) - rate);
                    n += 1.0;
                    mean = std::array::from_fn(|k| mean[k] + off[k]);
                    noise = std::array::from_fn(|k| noise[k] + off[k] * off[k]);
                }
                let (mean, noise) =
                    (mean.map(|sum| sum / n), noise.map(|sum: f64| (sum / n).sqrt()));
                println!("{rate} {frames} {radius}: {n} blocks, off {mean:.5?}, noise {noise:.5?}");
                assert!(n >= 0.97 * apart.blocks.iter().filter(known).count() as f64);
                assert!(noise[0] < 1.3 * noise[1], "{noise:?}");
                let chance = 2.5 * noise[1] / n.sqrt();
                assert!((mean[0] - mean[1]).abs() < 0.06 * rate.abs() + chance, "{mean:?}");
            });
        }
    }
}
