//! Plain Rust.

use super::{Rows, codes::BLOCK};

pub(super) fn blocks(rows: &Rows<'_>, out: &mut [u64]) {
    for (block, out) in out.chunks_exact_mut(BLOCK).enumerate() {
        out.fill(0);
        for (k, (codes, than)) in rows.codes.iter().zip(rows.than).enumerate() {
            let pairs = codes[block * BLOCK..].iter().zip(&than[block * BLOCK..]);
            for (out, (code, than)) in out.iter_mut().zip(pairs) {
                *out |= u64::from(code > than) << k;
            }
        }
    }
}
