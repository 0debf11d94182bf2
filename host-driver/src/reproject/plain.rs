//! Plain Rust, from column `x` on: other levels' rows may end with it.

use nalgebra::Point3;

use super::{Part, Row, Sources};

/// Pixels that are reprojected before they are packed.
const RUN: usize = 256;

pub(super) fn pack_row(
    row: &Row,
    from: &Sources<'_>,
    part: &mut Part<'_>,
    x: usize,
    mut at: usize,
) -> usize {
    let mut xyz = [[0.0_f32; RUN]; 3];
    for (run, disparities) in from.disparity_px[x..].chunks(RUN).enumerate() {
        let first = x + run * RUN;
        for (k, out) in xyz.iter_mut().enumerate() {
            row.component(k, first, disparities, out);
        }
        let others = from.zncc[first..].iter().zip(&from.intensity[first..]);
        for (i, (_, (&zncc, &grey))) in disparities.iter().zip(others).enumerate() {
            let [x, y, z] = [xyz[0][i], xyz[1][i], xyz[2][i]];
            if !z.is_nan() {
                part.points[at] = Point3::new(x, y, z);
                part.zncc[at] = zncc;
                part.intensity[at] = grey;
                if let Some(rate) = from.rate {
                    part.rate[at] = rate[first + i];
                }
                at += 1;
            }
        }
    }
    at
}
