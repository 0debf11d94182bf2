//! Target points of a board in an image.

mod charuco;
mod circles;
mod fit;
mod gray;
mod lattice;
mod refine;

use serde::Serialize;

use super::findings::CONTRAST_MIN;
use super::observations::Sighting;
use super::{Board, Pattern};
use crate::RawImage;
use gray::Gray;
use refine::Refined;

/// Blur of the edges, in px, above which images are out of focus or smeared: a sharp lens and the
/// pixel's own square give 0.6 to 0.8.
pub(super) const BLUR_MAX_PX: f64 = 1.5;

/// Grey value, of 255, below which the brightest parts of an image are dark.
const BRIGHT_MIN: u8 = 64;
/// Grey value, of 255, at which white counts as cut off.
const SATURATED: f64 = 252.0;

/// What was found in an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// The points.
    pub sightings: Vec<Sighting>,
    /// How good the image is.
    pub quality: Quality,
}

/// How good an image of a board is, from the refined points.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Quality {
    /// Median blur of the edges (standard deviation), in px.
    pub blur_px: f64,
    /// Median grey value of white next to the points, 255 is full scale.
    pub white: f64,
    /// Median grey value of black.
    pub black: f64,
    /// Share of the points next to which white is cut off.
    pub saturated: f64,
    /// Markers or discs in places where this board has others, or none.
    pub strays: usize,
}

impl Quality {
    fn of<'a>(points: impl Iterator<Item = &'a Refined>) -> Self {
        let points: Vec<&Refined> = points.collect();
        let median = |value: &dyn Fn(&Refined) -> f64| {
            let mut values: Vec<f64> = points.iter().map(|p| value(p)).collect();
            values.sort_unstable_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
        };
        let saturated = points.iter().filter(|p| p.white >= SATURATED).count();
        Self {
            blur_px: median(&|p| p.blur_px),
            white: median(&|p| p.white),
            black: median(&|p| p.black),
            saturated: saturated as f64 / points.len().max(1) as f64,
            strays: 0,
        }
    }
}

/// Why an image gave no points.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// No grid of corners or discs.
    #[error("no board found among {corners} corners or spots")]
    NoBoard {
        /// Corners or spots found.
        corners: usize,
    },
    /// A chessboard, but too few of its markers can be read.
    #[error("a chessboard of {corners} corners whose markers cannot be read")]
    NoMarkers {
        /// Corners found.
        corners: usize,
    },
    /// A grid of discs without its three hollow ones, nor a plain grid that is seen whole.
    #[error(
        "a grid of discs with {hollow} hollow ones in view: expected three in an L, or none and the whole grid"
    )]
    NoOrigin {
        /// Hollow discs found.
        hollow: usize,
    },
    /// Discs that are so blurred that hollow ones cannot be told from full ones.
    #[error("the discs are blurred by {blur_px:.1} px")]
    Blurred {
        /// Width of their edges in px.
        blur_px: f64,
    },
    /// The board is seen, or printed, mirrored.
    #[error("the board is mirrored")]
    Mirrored,
    /// Markers or discs are where this board has others.
    #[error("another board: {markers} markers or discs are not where this board has them")]
    OtherBoard {
        /// How many.
        markers: usize,
    },
    /// There is hardly any light in the image.
    #[error("the image is dark: its brightest parts are {contrast} of 255 above its darkest")]
    Dark {
        /// Grey values between dark and bright, of 255.
        contrast: u8,
    },
    /// The image cannot be searched.
    #[error("the image cannot be searched: {0}")]
    Detector(String),
}

/// Finds the points of `board` in a raw image.
///
/// # Errors
/// When there is no such board in it.
pub fn detect(raw: &RawImage, board: &Board) -> Result<Detection, Problem> {
    if raw.width() < 32 || raw.height() < 32 {
        return Err(Problem::NoBoard { corners: 0 });
    }
    let gray = Gray::new(raw);
    let found = match board.pattern {
        Pattern::Charuco => charuco::detect(&gray, board),
        Pattern::Circles => circles::detect(&gray, board),
    };
    // In the dark nothing can be said of the board.
    found.map_err(|problem| {
        let (dark, bright) = extremes(&gray);
        let contrast = bright.saturating_sub(dark);
        // A bright image without contrast shows a wall, not a want of light.
        let is_dark = f64::from(contrast) < CONTRAST_MIN && bright < BRIGHT_MIN;
        if is_dark { Problem::Dark { contrast } } else { problem }
    })
}

/// Grey values, of 255, of the darkest and the brightest hundredth of an image.
fn extremes(gray: &Gray) -> (u8, u8) {
    let mut counts = [0_usize; 256];
    gray.to_u8().into_iter().for_each(|value| counts[usize::from(value)] += 1);
    let hundredth = gray.pixels.as_slice().len() / 100;
    // The first value, counted from one end, beyond a hundredth of the pixels.
    let beyond = |value_at: fn(usize) -> usize| {
        let mut passed = 0;
        (0..256)
            .map(value_at)
            .find(|value| {
                passed += counts[*value];
                passed > hundredth
            })
            .unwrap_or(0)
    };
    (beyond(|k| k) as u8, beyond(|k| 255 - k) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dark_image_is_said_to_be_dark_and_a_blank_one_not_to_hold_a_board() {
        let board = Board::default();
        let image = |bright: u8| {
            let pixels = (0..200 * 150).map(|k| if k / 20 % 2 == 0 { 3 } else { bright }).collect();
            RawImage::gray8(stspp_matcher::Image::from_vec(200, 150, pixels).expect("size"))
        };
        assert_eq!(detect(&image(8), &board), Err(Problem::Dark { contrast: 5 }));
        assert!(!matches!(detect(&image(120), &board), Err(Problem::Dark { .. })));
    }
}
