//! The ArUco markers of ChArUco boards: the first hundred codes of the predefined 4x4 dictionary, of
//! which `DICT_4X4_50` and `DICT_4X4_100` are made. Boards printed by other tools are found too.

/// Modules of a marker along one side: four bits and a black border.
pub const MARKER_MODULES: usize = 6;

/// Bits of a marker, row by row from the upper left, most significant first; a set bit is white.
pub const CODES: [u16; 100] = [
    0xb532, 0x0f9a, 0x332d, 0x9946, 0x549e, 0x79cd, 0x9e2e, 0xc4f2, 0xfeda, 0xcf56, //
    0xf991, 0x11a7, 0x0eb7, 0x2a0f, 0x24b1, 0x263e, 0x4665, 0x6600, 0x6c5e, 0x76af, //
    0x868b, 0xb02b, 0xccd5, 0xdd82, 0xfe47, 0x9471, 0xace4, 0xa554, 0x2123, 0x346f, //
    0x4415, 0x57b2, 0x9ecf, 0xf0cb, 0x08ae, 0x0929, 0x1875, 0x04ff, 0x0df6, 0x1c5a, //
    0x1718, 0x2a28, 0x328c, 0x38b2, 0x24e8, 0x2eeb, 0x2d3f, 0x4b64, 0x502e, 0x5013, //
    0x5194, 0x5568, 0x5d41, 0x5f97, 0x6801, 0x6867, 0x6124, 0x61e9, 0x6b12, 0x6fe5, //
    0x67df, 0x7e1b, 0x80a0, 0x8344, 0x8ba2, 0x937a, 0x846c, 0x852a, 0x859c, 0x9c89, //
    0x9fa1, 0xbb7c, 0xbc04, 0xb65b, 0xbfc8, 0xb7ab, 0xca1f, 0xc962, 0xd958, 0xd3d5, //
    0xcc98, 0xc7a0, 0xc537, 0xe95d, 0xf925, 0xfbbb, 0xee2a, 0xf74d, 0x3575, 0x8aad, //
    0x7617, 0x0acf, 0x064b, 0x2dc1, 0x49d8, 0x43f4, 0x4f36, 0x4fd3, 0x69e4, 0x70c7,
];

/// Whether module (`column`, `row`) of marker `id` is white, the border included.
pub fn is_white(id: usize, column: usize, row: usize) -> bool {
    let bit = |index: usize| (1..MARKER_MODULES - 1).contains(&index).then(|| index - 1);
    match (bit(column), bit(row)) {
        (Some(x), Some(y)) => CODES[id] >> (15 - (4 * y + x)) & 1 == 1,
        _ => false,
    }
}

/// A marker's code turned by a quarter clockwise.
pub fn turned(code: u16) -> u16 {
    remapped(code, |x, y| (y, 3 - x))
}

/// A marker's code seen in a mirror, left and right exchanged.
pub fn mirrored(code: u16) -> u16 {
    remapped(code, |x, y| (3 - x, y))
}

/// The code whose bit at (x, y) is `code`'s at `from(x, y)`.
fn remapped(code: u16, from: impl Fn(usize, usize) -> (usize, usize)) -> u16 {
    (0..16).fold(0, |out, index| {
        let (x, y) = from(index % 4, index / 4);
        out << 1 | code >> (15 - (4 * y + x)) & 1
    })
}

/// The marker that `code` is when turned by the given number of quarters clockwise, with at most
/// `errors_max` wrong bits. Among the first `markers` of the dictionary; (id, quarters).
pub fn decode(code: u16, markers: usize, errors_max: u32) -> Option<(usize, usize)> {
    let mut best: Option<(u32, usize, usize)> = None;
    let mut seen = code;
    for quarters in 0..4 {
        for (id, &known) in CODES.iter().enumerate().take(markers) {
            let errors = (known ^ seen).count_ones();
            if errors <= errors_max && best.is_none_or(|(least, ..)| errors < least) {
                best = Some((errors, id, quarters));
            }
        }
        seen = turned(seen);
    }
    best.map(|(_, id, quarters)| (id, quarters))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_differ_in_three_bits_however_they_are_turned() {
        for (i, &a) in CODES.iter().enumerate() {
            let mut b_turned = CODES;
            for quarters in 0..4 {
                for (j, &b) in b_turned.iter().enumerate() {
                    assert!((i, 0) == (j, quarters) || (a ^ b).count_ones() >= 3, "{i} {j}");
                }
                b_turned = b_turned.map(turned);
            }
        }
    }

    #[test]
    fn four_quarters_and_two_mirrors_change_nothing() {
        for code in CODES {
            assert_eq!(turned(turned(turned(turned(code)))), code);
            assert_eq!(mirrored(mirrored(code)), code);
            assert_eq!(turned(mirrored(turned(code))), mirrored(code));
        }
    }

    #[test]
    fn a_turned_marker_with_a_wrong_bit_is_known() {
        for id in [0, 17, 99] {
            let seen = turned(CODES[id]) ^ 0x0100;
            // Three more quarters bring it back upright.
            assert_eq!(decode(seen, 100, 1), Some((id, 3)));
            assert_eq!(decode(seen, 100, 0), None);
        }
    }
}
