//! Which bytes of four numbers come to the front when only some of them are wanted.

/// Numbers of a register.
pub(super) const LANES: usize = 4;

/// For each set of lanes, as bits, the bytes of theirs, and behind them places that both `pshufb` and `tbl`
/// fill with zeros.
pub(super) const FRONT: [[u8; 16]; 16] = {
    let mut front = [[u8::MAX; 16]; 16];
    let mut set = 0;
    while set < 16 {
        let (mut lane, mut to) = (0, 0);
        while lane < LANES {
            let mut byte = 0;
            while byte < 4 && set >> lane & 1 == 1 {
                front[set][to] = (4 * lane + byte) as u8;
                (byte, to) = (byte + 1, to + 1);
            }
            lane += 1;
        }
        set += 1;
    }
    front
};
