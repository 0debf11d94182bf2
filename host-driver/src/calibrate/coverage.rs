//! Which parts of the images and which depths had boards.

use serde::Serialize;

use super::observations::Observations;
use super::solve::Solution;

/// Parts of an image across and down.
pub const PARTS: usize = 3;
/// Depths between the near, middle and far band, in metres.
pub const BANDS_M: [f64; 2] = [1.0, 1.5];
/// Points below which a part counts as not covered.
const POINTS_MIN: usize = 3;

/// What had no board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum GapKind {
    /// A band of depth.
    Depth,
    /// A part of an image, at any depth.
    Image,
    /// A corner of an image, in one band of depth.
    ImageAtDepth,
}

/// Something that had no board.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Gap {
    /// What it is.
    pub kind: GapKind,
    /// The same in words.
    pub text: String,
}

/// Points seen in each part of each image, in each band of depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Coverage {
    /// `[camera][band][row][column]`, counted from the upper left, near to far.
    pub points: [[[[usize; PARTS]; PARTS]; 3]; 2],
}

impl Coverage {
    /// Counts the points of the used views.
    pub fn of(observations: &Observations, solution: &Solution) -> Self {
        let mut coverage = Self::default();
        let [width, height] = observations.resolution_px;
        for (view, seen) in observations.views.iter().enumerate() {
            if !solution.views[view].as_ref().is_some_and(|fit| fit.is_used) {
                continue;
            }
            for side in 0..2 {
                let state = &solution.adjusted.state;
                let Some(pose) = state.left_from_board[view] else { continue };
                for sighting in seen.side(side) {
                    let p = observations.board.point_m(sighting.point);
                    let depth_m = (pose * nalgebra::Point3::new(p.x, p.y, 0.0)).z;
                    let band = BANDS_M.iter().filter(|limit| depth_m > **limit).count();
                    let part = |at: f64, size: usize| {
                        ((at / size as f64 * PARTS as f64).max(0.0) as usize).min(PARTS - 1)
                    };
                    let (column, row) =
                        (part(sighting.pixel.x, width), part(sighting.pixel.y, height));
                    coverage.points[side][band][row][column] += 1;
                }
            }
        }
        coverage
    }

    fn is_seen(&self, side: usize, band: usize, row: usize, column: usize) -> bool {
        self.points[side][band][row][column] >= POINTS_MIN
    }

    /// Bands of depth without any board.
    pub fn missing_bands(&self) -> Vec<usize> {
        let count = |band: usize| {
            let of_band = |side: usize| self.points[side][band].iter().flatten().sum::<usize>();
            of_band(0) + of_band(1)
        };
        (0..3).filter(|&band| count(band) < POINTS_MIN).collect()
    }

    /// Parts of a camera's image without a board at any depth, as (row, column).
    pub fn missing_parts(&self, side: usize) -> Vec<(usize, usize)> {
        let parts = (0..PARTS).flat_map(|row| (0..PARTS).map(move |column| (row, column)));
        parts
            .filter(|&(row, column)| !(0..3).any(|band| self.is_seen(side, band, row, column)))
            .collect()
    }

    /// What is missing: the bands that no board was in, the parts of an image without a board, and the
    /// corners of an image without one at some depth.
    pub fn gaps(&self) -> Vec<Gap> {
        let mut gaps = Vec::new();
        let missing_bands = self.missing_bands();
        for &band in &missing_bands {
            let text = format!("no board {}", band_name(band));
            gaps.push(Gap { kind: GapKind::Depth, text });
        }
        for (side, camera) in ["left", "right"].into_iter().enumerate() {
            let parts = self.missing_parts(side);
            if !parts.is_empty() {
                let names: Vec<_> = parts.iter().map(|&(r, c)| part_name(r, c)).collect();
                let text = format!("no board in the {} of the {camera} image", joined(&names));
                gaps.push(Gap { kind: GapKind::Image, text });
            }
            for band in 0..3 {
                if missing_bands.contains(&band) {
                    continue;
                }
                let names: Vec<_> = [(0, 0), (0, 2), (2, 0), (2, 2)]
                    .into_iter()
                    .filter(|&(row, column)| {
                        !parts.contains(&(row, column)) && !self.is_seen(side, band, row, column)
                    })
                    .map(|(row, column)| part_name(row, column))
                    .collect();
                if !names.is_empty() {
                    let text = format!(
                        "no board in the {} of the {camera} image {}",
                        joined(&names),
                        band_name(band)
                    );
                    gaps.push(Gap { kind: GapKind::ImageAtDepth, text });
                }
            }
        }
        gaps
    }
}

fn band_name(band: usize) -> String {
    let [near, far] = BANDS_M;
    match band {
        0 => format!("nearer than {near} m"),
        1 => format!("between {near} and {far} m"),
        _ => format!("beyond {far} m"),
    }
}

fn part_name(row: usize, column: usize) -> &'static str {
    [
        ["upper left", "upper middle", "upper right"],
        ["left", "middle", "right"],
        ["lower left", "lower middle", "lower right"],
    ][row][column]
}

/// "a, b and c".
fn joined(names: &[&str]) -> String {
    match names {
        [] => String::new(),
        [one] => (*one).to_owned(),
        [most @ .., last] => format!("{} and {last}", most.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_said_in_words() {
        let mut coverage = Coverage { points: [[[[5; 3]; 3]; 3]; 2] };
        let texts = |c: &Coverage| c.gaps().into_iter().map(|gap| gap.text).collect::<Vec<_>>();
        assert!(texts(&coverage).is_empty());
        coverage.points[0][2][2][0] = 0;
        assert_eq!(texts(&coverage), ["no board in the lower left of the left image beyond 1.5 m"]);
        for band in 0..3 {
            for row in 0..3 {
                coverage.points[1][band][row][2] = 0;
            }
        }
        assert_eq!(
            texts(&coverage)[1],
            "no board in the upper right, right and lower right of the right image"
        );
        for side in 0..2 {
            coverage.points[side][0] = [[0; 3]; 3];
        }
        assert_eq!(texts(&coverage)[0], "no board nearer than 1 m");
    }
}
