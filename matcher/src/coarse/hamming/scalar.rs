//! Plain Rust.

pub(super) fn search(left: &[u64], right: &[u64], origin: usize, shifts: &[i32], best: &mut [u32]) {
    best.fill(u32::MAX);
    for (c, &shift) in shifts.iter().enumerate() {
        let first = (origin as i64 - i64::from(shift)) as usize;
        for ((b, l), r) in best.iter_mut().zip(left).zip(&right[first..]) {
            *b = (*b).min((l ^ r).count_ones() << 16 | c as u32);
        }
    }
}
