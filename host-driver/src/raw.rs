//! A camera image as it left the sensor: unrectified, distorted, grey.

use stspp_matcher::Image;

/// Pixels of a raw image, in the container that the camera or file used.
#[derive(Debug, Clone, PartialEq)]
pub enum RawPixels {
    /// Up to 8 bits a pixel.
    Gray8(Image<u8>),
    /// 9 to 16 bits a pixel, right-aligned.
    Gray16(Image<u16>),
}

/// A raw grey image and the number of bits that its pixels use.
#[derive(Debug, Clone, PartialEq)]
pub struct RawImage {
    /// The pixels.
    pub pixels: RawPixels,
    /// Significant bits of a pixel: full scale is `2^bits - 1`. 8 or less for [`RawPixels::Gray8`],
    /// 16 or less for [`RawPixels::Gray16`].
    pub bits: u8,
}

impl RawImage {
    /// An 8-bit image.
    pub fn gray8(pixels: Image<u8>) -> Self {
        Self { pixels: RawPixels::Gray8(pixels), bits: 8 }
    }

    /// An image of `bits` significant bits, right-aligned in 16.
    pub fn gray16(pixels: Image<u16>, bits: u8) -> Self {
        Self { pixels: RawPixels::Gray16(pixels), bits }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        match &self.pixels {
            RawPixels::Gray8(image) => image.width(),
            RawPixels::Gray16(image) => image.width(),
        }
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        match &self.pixels {
            RawPixels::Gray8(image) => image.height(),
            RawPixels::Gray16(image) => image.height(),
        }
    }

    /// Mean of all pixels, 0 for an empty image.
    pub fn mean_grey(&self) -> f64 {
        fn mean<T: Copy + Into<u64>>(pixels: &[T]) -> f64 {
            let sum: u64 = pixels.iter().map(|&v| v.into()).sum();
            sum as f64 / pixels.len().max(1) as f64
        }
        match &self.pixels {
            RawPixels::Gray8(image) => mean(image.as_slice()),
            RawPixels::Gray16(image) => mean(image.as_slice()),
        }
    }

    /// The largest value a pixel can have.
    pub fn full_scale(&self) -> u16 {
        u16::MAX >> (16 - self.bits.clamp(1, 16))
    }
}
