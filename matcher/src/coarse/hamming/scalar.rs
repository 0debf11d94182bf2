//! Plain Rust.

pub(super) fn search(left: &[u64], right: &[u64], origin: usize, shifts: &[i32], best: &mut [u32]) {
    best.fill(u32::MAX);
    for &shift in shifts {
        let first = (origin as i64 - i64::from(shift)) as usize;
        for ((b, l), r) in best.iter_mut().zip(left).zip(&right[first..]) {
            *b = (*b).min((l ^ r).count_ones() << 16 | (shift - shifts[0]) as u32);
        }
    }
}

/// Distance << 32 | index of the row's nearest; all ones for none.
#[inline(always)]
pub(super) fn nearest(value: u64, row: &[u64]) -> u64 {
    let keys = row.iter().enumerate();
    keys.map(|(i, other)| u64::from((value ^ other).count_ones()) << 32 | i as u64)
        .fold(u64::MAX, u64::min)
}

/// The number of those that are not taken. What is written behind them does not count.
pub(super) fn untaken(
    taken: &[u8],
    row: &[u64],
    descriptors: &mut [u64],
    columns: &mut [u16],
) -> usize {
    let mut n = 0;
    for (x, (taken, descriptor)) in taken.iter().zip(row).enumerate() {
        // Without a branch.
        (descriptors[n], columns[n]) = (*descriptor, x as u16);
        n += usize::from(*taken == 0);
    }
    n
}
