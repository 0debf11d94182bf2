//! Grey pixels out of the formats in which cameras pack them.

use super::ioctl::PixelLayout;
use crate::RawImage;
use stspp_matcher::Image;

const fn code(letters: &[u8; 4]) -> u32 {
    u32::from_le_bytes(*letters)
}

/// A pixel format that holds grey values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    /// 8 bits.
    Grey,
    /// 10 bits in 16.
    Y10,
    /// 12 bits in 16.
    Y12,
    /// 16 bits.
    Y16,
    /// 8 bits of luma, each followed by a byte of colour.
    Yuyv,
}

impl PixelFormat {
    /// In order of preference: most bits for the fewest bytes lost, colour last.
    pub const ALL: [Self; 5] = [Self::Y12, Self::Y10, Self::Grey, Self::Y16, Self::Yuyv];

    /// Its V4L2 code.
    pub fn fourcc(self) -> u32 {
        match self {
            Self::Grey => code(b"GREY"),
            Self::Y10 => code(b"Y10 "),
            Self::Y12 => code(b"Y12 "),
            Self::Y16 => code(b"Y16 "),
            Self::Yuyv => code(b"YUYV"),
        }
    }

    /// The format of a V4L2 code, if it holds grey values.
    pub fn from_fourcc(fourcc: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|format| format.fourcc() == fourcc)
    }

    /// Bytes of a pixel.
    pub fn bytes(self) -> usize {
        if self == Self::Grey { 1 } else { 2 }
    }

    /// Significant bits of a pixel.
    pub fn bits(self) -> u8 {
        match self {
            Self::Grey | Self::Yuyv => 8,
            Self::Y10 => 10,
            Self::Y12 => 12,
            Self::Y16 => 16,
        }
    }
}

/// The part of a delivered picture that one camera fills: columns from `first_column`, `width` of
/// them. `None` when the bytes are fewer than the layout says, that is, when the picture is damaged.
pub fn image(
    format: PixelFormat,
    layout: &PixelLayout,
    bytes: &[u8],
    first_column: usize,
    width: usize,
) -> Option<RawImage> {
    let (height, pixel) = (layout.height as usize, format.bytes());
    let line = (layout.bytes_per_line as usize).max(layout.width as usize * pixel);
    if first_column + width > layout.width as usize
        || bytes.len() < line * height.saturating_sub(1) + layout.width as usize * pixel
    {
        return None;
    }
    let row = |y: usize| &bytes[y * line + first_column * pixel..][..width * pixel];
    // By rows: a picture is copied once, as fast as memory goes.
    Some(match format {
        PixelFormat::Grey => {
            RawImage::gray8(rows(width, height, |y, pixels| pixels.copy_from_slice(row(y))))
        }
        PixelFormat::Yuyv => RawImage::gray8(rows(width, height, |y, pixels| {
            for (luma, pair) in pixels.iter_mut().zip(row(y).chunks_exact(2)) {
                *luma = pair[0];
            }
        })),
        PixelFormat::Y10 | PixelFormat::Y12 | PixelFormat::Y16 => {
            let words = rows(width, height, |y, pixels: &mut [u16]| {
                for (word, pair) in pixels.iter_mut().zip(row(y).chunks_exact(2)) {
                    *word = u16::from_le_bytes([pair[0], pair[1]]);
                }
            });
            RawImage::gray16(words, format.bits())
        }
    })
}

/// An image whose rows `fill` writes.
fn rows<T: Copy + Default>(
    width: usize,
    height: usize,
    mut fill: impl FnMut(usize, &mut [T]),
) -> Image<T> {
    let mut image = Image::new(width, height, T::default());
    (0..height).for_each(|y| fill(y, image.row_mut(y)));
    image
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raw::RawPixels;

    fn layout(width: u32, height: u32, bytes_per_line: u32) -> PixelLayout {
        PixelLayout { width, height, bytes_per_line, ..Default::default() }
    }

    #[test]
    fn padding_at_the_end_of_lines_is_left_out() {
        let bytes = [1, 2, 3, 99, 4, 5, 6, 99];
        let image = image(PixelFormat::Grey, &layout(3, 2, 4), &bytes, 0, 3).unwrap();
        let RawPixels::Gray8(pixels) = image.pixels else { panic!("8 bits") };
        assert_eq!(pixels.as_slice(), [1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn side_by_side_pictures_are_cut() {
        let bytes = [1, 0, 2, 0, 0xff, 3, 4, 0, 5, 0, 6, 0, 7, 0, 8, 0];
        let layout = layout(4, 2, 8);
        let half = |first| match image(PixelFormat::Y10, &layout, &bytes, first, 2).unwrap() {
            RawImage { pixels: RawPixels::Gray16(pixels), bits: 10 } => pixels.into_vec(),
            other => panic!("{other:?}"),
        };
        assert_eq!(half(0), [1, 2, 5, 6]);
        assert_eq!(half(2), [0x3ff, 4, 7, 8]);
    }

    #[test]
    fn luma_is_taken_from_colour() {
        let bytes = [10, 128, 20, 128, 30, 128, 40, 128];
        let image = image(PixelFormat::Yuyv, &layout(2, 2, 4), &bytes, 0, 2).unwrap();
        let RawPixels::Gray8(pixels) = image.pixels else { panic!("8 bits") };
        assert_eq!(pixels.as_slice(), [10, 20, 30, 40]);
    }

    #[test]
    fn short_pictures_are_damaged() {
        assert!(image(PixelFormat::Grey, &layout(3, 2, 4), &[0; 6], 0, 3).is_none());
        assert!(image(PixelFormat::Grey, &layout(3, 2, 4), &[0; 7], 0, 3).is_some());
        assert!(image(PixelFormat::Grey, &layout(3, 2, 4), &[0; 8], 2, 2).is_none());
    }
}
