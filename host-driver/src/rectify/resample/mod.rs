//! The two loops of the resampling, eight taps an output: along a line of samples, and across lines.
//!
//! Both read where to interpolate from [`Places`], and give the same whole numbers at every level. An
//! AVX-512 form would gain nothing: the loops are bound by one load of taps a pixel.

mod scalar;

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "aarch64")]
mod neon;

use stspp_matcher::{Image, Level};

use super::kernel::{PHASE_BITS, PHASES, TAPS};

/// Outputs that share a [`Block`].
pub(super) const BLOCK: usize = 16;

/// Where a block of outputs begins.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Block {
    /// First sample of the output whose first tap is outermost.
    pub first: u32,
    /// Whole samples by which the first taps of the block's outputs differ.
    pub span: u32,
}

/// For rows of outputs, where each takes its eight taps: a block's first sample, and a distance from
/// there in 2^-10 samples. Two bytes an output instead of four, which every frame reads.
#[derive(Debug)]
pub(super) struct Places {
    /// Blocks of a row.
    per_row: usize,
    blocks: Vec<Block>,
    /// By rows of whole blocks.
    offsets: Image<u16>,
    /// Samples that a line must have: no tap reaches farther.
    reach: usize,
}

/// The places of one row of outputs.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    pub blocks: &'a [Block],
    pub offsets: &'a [u16],
    reach: usize,
}

impl Places {
    /// Packs rows of `width` positions in 2^-10 samples. Within a block, positions more than 63
    /// samples from the first are brought to that: no view of a camera has them.
    pub fn new(positions: &[u32], width: usize) -> Self {
        let per_row = width.div_ceil(BLOCK);
        let rows = positions.len().checked_div(width).unwrap_or(0);
        let mut blocks = Vec::with_capacity(per_row * rows);
        let mut offsets = Vec::with_capacity(per_row * rows * BLOCK);
        let mut reach = 0;
        for row in positions.chunks(width.max(1)) {
            for block in row.chunks(BLOCK) {
                let first = block.iter().map(|p| p >> PHASE_BITS).min().unwrap_or(0);
                let offset = |p: &u32| (p - (first << PHASE_BITS)).min(u32::from(u16::MAX)) as u16;
                let last = offset(block.last().unwrap_or(&(first << PHASE_BITS)));
                let padding = std::iter::repeat_n(last, BLOCK - block.len());
                offsets.extend(block.iter().map(offset).chain(padding));
                let farthest = block.iter().map(offset).max().unwrap_or(0);
                let span = u32::from(farthest) >> PHASE_BITS;
                blocks.push(Block { first, span });
                reach = reach.max((first + span) as usize + TAPS);
            }
        }
        let offsets = Image::from_vec(per_row * BLOCK, rows, offsets);
        // Copied into memory of its own kind, which large images are in.
        let offsets = offsets.map_or_else(|| Image::new(0, 0, 0), |image| image.clone());
        Self { per_row, blocks, offsets, reach }
    }

    /// Row `y`.
    pub fn row(&self, y: usize) -> Row<'_> {
        Row {
            blocks: &self.blocks[y * self.per_row..][..self.per_row],
            offsets: self.offsets.row(y),
            reach: self.reach,
        }
    }
}

/// Fills `out`, a whole number of blocks, from the samples of `line`; sums are divided by 2^`shift`,
/// rounded and saturated.
pub(super) fn along(
    level: Level,
    line: &[i16],
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    assert!(line.len() >= row.reach && taps.len() >= PHASES && (1..=24).contains(&shift));
    assert!(row.blocks.len() * BLOCK == row.offsets.len() && row.offsets.len() == out.len());
    match level {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: both levels include AVX2; the line reaches as far as any tap, and slices are as
        // long as checked above.
        Level::Avx2 | Level::Avx512 => unsafe { avx2::along(line, row, taps, shift, out) },
        #[cfg(target_arch = "aarch64")]
        // SAFETY: the level is this processor's; the rest as above.
        Level::Neon => unsafe { neon::along(line, row, taps, shift, out) },
        _ => scalar::along(line, row, taps, shift, out),
    }
}

/// Fills `out` from as many columns of `lines`, each `stride` long: output k from the samples of
/// column k.
pub(super) fn across(
    level: Level,
    lines: &[i16],
    stride: usize,
    row: Row<'_>,
    taps: &[[i16; TAPS]],
    shift: u32,
    out: &mut [i16],
) {
    assert!(lines.len() >= row.reach * stride && taps.len() >= PHASES);
    assert!((1..=24).contains(&shift) && row.blocks.len() * BLOCK == row.offsets.len());
    assert!(out.len() <= row.offsets.len() && row.offsets.len() <= stride);
    match level {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: both levels include AVX2; the lines are as many as any tap reaches, and as long
        // as the row's blocks.
        Level::Avx2 | Level::Avx512 => unsafe {
            avx2::across(lines, stride, row, taps, shift, out);
        },
        #[cfg(target_arch = "aarch64")]
        // SAFETY: the level is this processor's; the rest as above.
        Level::Neon => unsafe { neon::across(lines, stride, row, taps, shift, out) },
        _ => scalar::across(lines, stride, row, taps, shift, out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn taps() -> Vec<[i16; TAPS]> {
        (0..PHASES as i32)
            .map(|p| std::array::from_fn(|k| ((p * 37 + k as i32 * 5003) % 8000 - 4000) as i16))
            .collect()
    }

    fn rough(seed: u64, n: usize) -> Vec<i16> {
        let mut state = seed | 1;
        (0..n)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(9);
                (state >> 48) as i16
            })
            .collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        /// Positions that run, jump and turn; widths of all remainders.
        #[test]
        fn levels_are_bit_equal_and_do_what_the_positions_say(
            seed in any::<u64>(),
            width in 1_usize..70,
            scale in 200_i64..2200,
            jitter in 1_i64..9000,
            shift in 8_u32..16,
        ) {
            let (samples, rows) = (300_usize, 3);
            let noise = rough(seed, rows * width);
            let most = ((samples - TAPS) as i64) << PHASE_BITS;
            let positions: Vec<u32> = (0..rows * width)
                .map(|i| {
                    let at = 40_000 + (i % width) as i64 * scale + i64::from(noise[i]) % jitter;
                    at.clamp(0, most) as u32
                })
                .collect();
            let (places, taps) = (Places::new(&positions, width), taps());
            let whole = width.next_multiple_of(BLOCK);
            let line = rough(seed ^ 5, samples);
            let lines = rough(seed ^ 6, samples * whole);
            for y in 0..rows {
                let row = places.row(y);
                let (mut want, mut want_across) = (vec![0; whole], vec![0; width]);
                along(Level::Scalar, &line, row, &taps, shift, &mut want);
                across(Level::Scalar, &lines, whole, row, &taps, shift, &mut want_across);
                for x in 0..width {
                    let p = positions[y * width + x];
                    let (first, taps) = ((p >> PHASE_BITS) as usize, taps[p as usize % PHASES]);
                    let sum: i64 = (0..TAPS)
                        .map(|k| i64::from(line[first + k]) * i64::from(taps[k])).sum();
                    let sum = (sum + (1 << (shift - 1))) >> shift;
                    prop_assert_eq!(i64::from(want[x]), sum.clamp(-32_768, 32_767));
                    let sum: i64 = (0..TAPS)
                        .map(|k| i64::from(lines[(first + k) * whole + x]) * i64::from(taps[k]))
                        .sum();
                    let sum = (sum + (1 << (shift - 1))) >> shift;
                    prop_assert_eq!(i64::from(want_across[x]), sum.clamp(-32_768, 32_767));
                }
                for level in Level::available() {
                    let (mut got, mut got_across) = (vec![0; whole], vec![0; width]);
                    along(level, &line, row, &taps, shift, &mut got);
                    across(level, &lines, whole, row, &taps, shift, &mut got_across);
                    prop_assert_eq!(&got, &want, "{}", level);
                    prop_assert_eq!(&got_across, &want_across, "{}", level);
                }
            }
        }
    }
}
