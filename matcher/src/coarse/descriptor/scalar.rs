//! Plain Rust.

use super::{BLOCK, Rows};

pub(super) fn blocks(
    rows: &Rows<'_>,
    mean: &[i16],
    begin: usize,
    at: impl Iterator<Item = usize>,
    out: &mut [u64],
) {
    for from in at {
        for i in from..from + BLOCK {
            out[i] = rows.iter().enumerate().fold(0, |bits, (k, (row, other))| {
                let than = other.map_or(mean[i - begin], |o| o[i]);
                bits | u64::from(row[i] > than) << k
            });
        }
    }
}
