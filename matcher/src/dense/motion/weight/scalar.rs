//! Plain Rust.

use super::Weighted;

pub(super) fn weigh(gradient: &[i32], grey: &[i32], times: &[i32; 8], out: &mut Weighted<'_>) {
    let len = out.ilt.len();
    let halves = |word: i32| [(word << 16) >> 16, word >> 16];
    for x in 0..len {
        let [mut ilt, mut it, mut st, mut stt] = [0i32; 4];
        for (pair, time) in (0..gradient.len() / len).zip(times) {
            let at = pair * len + x;
            let (g, l, time) = (halves(gradient[at]), halves(grey[at]), halves(*time));
            let mut word = 0;
            for f in 0..2 {
                let weighted = (g[f] * time[f] + 0x4000) >> 15;
                word |= (weighted & 0xFFFF) << (16 * f);
                ilt += weighted * l[f];
                it += weighted;
                st += weighted * g[f];
                stt += weighted * weighted;
            }
            out.gradient[at] = word;
        }
        (out.ilt[x], out.it[x]) = (ilt as f32, it as f32);
        (out.st[x], out.stt[x]) = (st as f32, stt as f32);
    }
}
