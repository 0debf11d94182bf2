//! NEON: 8 pixels' distances a register.

use std::arch::aarch64::*;

/// Pixels that are compared with a candidate at a time.
const BLOCK: usize = 16;
/// Descriptors of a row that [`nearest`] looks at at a time.
const LANES: usize = 8;

/// How many bits of eight descriptors differ from eight others.
///
/// # Safety
/// The processor has NEON; eight descriptors are readable at `to`.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn distances(from: &[uint64x2_t], to: *const u64) -> uint16x8_t {
    let mut counts = [vdupq_n_u8(0); 4];
    for (k, (count, from)) in counts.iter_mut().zip(from).enumerate() {
        // SAFETY: the caller's promise.
        let other = unsafe { vld1q_u64(to.add(2 * k)) };
        *count = vcntq_u8(vreinterpretq_u8_u64(veorq_u64(*from, other)));
    }
    let [a, b, c, d] = counts;
    // From eight bytes a descriptor to four, two and one of 16 bits.
    vpaddlq_u8(vpaddq_u8(vpaddq_u8(a, b), vpaddq_u8(c, d)))
}

/// # Safety
/// The processor has NEON; arguments are as [`super::best_candidates`] checks.
#[target_feature(enable = "neon")]
pub(super) unsafe fn search(
    left: &[u64],
    right: &[u64],
    origin: usize,
    shifts: &[i32],
    best: &mut [u32],
) {
    for at in (0..left.len()).step_by(BLOCK) {
        let mut own = [vdupq_n_u64(0); BLOCK / 2];
        for (k, own) in own.iter_mut().enumerate() {
            // SAFETY: `at + 16` lies within `left`.
            *own = unsafe { vld1q_u64(left.as_ptr().add(at + 2 * k)) };
        }
        let mut least = [vdupq_n_u16(u16::MAX); 2];
        let mut which = least;
        for &shift in shifts {
            let index = vdupq_n_u16((shift - shifts[0]) as u16);
            for half in 0..2 {
                // SAFETY: the candidate lies inside for the whole block.
                let bits = unsafe {
                    let from = right.as_ptr().offset((origin + at) as isize - shift as isize);
                    distances(&own[4 * half..][..4], from.add(8 * half))
                };
                which[half] = vbslq_u16(vcltq_u16(bits, least[half]), index, which[half]);
                least[half] = vminq_u16(bits, least[half]);
            }
        }
        for half in 0..2 {
            let (which, least) = (which[half], least[half]);
            // SAFETY: `at + 16` lies within `best`; a key is two halves.
            unsafe {
                let to = best.as_mut_ptr().add(at + 8 * half).cast::<u16>();
                vst1q_u16(to, vzip1q_u16(which, least));
                vst1q_u16(to.add(8), vzip2q_u16(which, least));
            }
        }
    }
}

/// Distance << 32 | index of the row's nearest; all ones for none.
///
/// # Safety
/// The processor has NEON.
#[target_feature(enable = "neon")]
pub(super) unsafe fn nearest(value: u64, row: &[u64]) -> u64 {
    let value_twice = [vdupq_n_u64(value); 4];
    // As many as there are numbers of 16 bits for.
    let blocks = (row.len() / LANES).min(usize::from(u16::MAX));
    let mut least = vdupq_n_u16(u16::MAX);
    let mut which = vdupq_n_u16(0);
    for block in 0..blocks {
        // SAFETY: a whole block of the row.
        let bits = unsafe { distances(&value_twice, row.as_ptr().add(LANES * block)) };
        which = vbslq_u16(vcltq_u16(bits, least), vdupq_n_u16(block as u16), which);
        least = vminq_u16(bits, least);
    }
    let (mut bits, mut at) = ([0_u16; LANES], [0_u16; LANES]);
    // SAFETY: 16 bytes each.
    unsafe {
        vst1q_u16(bits.as_mut_ptr(), least);
        vst1q_u16(at.as_mut_ptr(), which);
    }
    let lanes = bits.into_iter().zip(at).enumerate().filter(|_| blocks > 0);
    let key = |(lane, (bits, block)): (usize, (u16, u16))| {
        u64::from(bits) << 32 | (LANES * usize::from(block) + lane) as u64
    };
    let rest = super::scalar::nearest(value, &row[LANES * blocks..]);
    // All ones stay so.
    let rest = rest.saturating_add((LANES * blocks) as u64);
    lanes.map(key).fold(rest, u64::min)
}
