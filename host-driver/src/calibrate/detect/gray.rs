//! Grey values of a raw image, whatever its depth: 0 is black, 255 full scale.

use nalgebra::Vector2;
use stspp_matcher::Image;

use crate::RawImage;
use crate::raw::RawPixels;

/// A grey image in units of an 8-bit camera.
pub struct Gray {
    /// The pixels.
    pub pixels: Image<f32>,
}

impl Gray {
    /// Converts a raw image.
    pub fn new(raw: &RawImage) -> Self {
        let scale = 255.0 / f32::from(raw.full_scale());
        let pixels = match &raw.pixels {
            RawPixels::Gray8(image) => image.map(|v| f32::from(v) * scale),
            RawPixels::Gray16(image) => image.map(|v| f32::from(v) * scale),
        };
        Self { pixels }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.pixels.width()
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.pixels.height()
    }

    /// The image with 8 bits.
    pub fn to_u8(&self) -> Vec<u8> {
        self.pixels.as_slice().iter().map(|v| (v + 0.5) as u8).collect()
    }

    /// Whether a pixel position is at least `margin` inside.
    pub fn contains(&self, p: Vector2<f64>, margin: f64) -> bool {
        p.x >= margin
            && p.y >= margin
            && p.x <= self.width() as f64 - 1.0 - margin
            && p.y <= self.height() as f64 - 1.0 - margin
    }

    /// Grey value between pixels, bilinear; the border's beyond the image.
    pub fn at(&self, p: Vector2<f64>) -> f64 {
        let (w, h) = (self.width(), self.height());
        let x = p.x.clamp(0.0, w as f64 - 1.0);
        let y = p.y.clamp(0.0, h as f64 - 1.0);
        let (x0, y0) = ((x as usize).min(w - 2), (y as usize).min(h - 2));
        let (fx, fy) = (x - x0 as f64, y - y0 as f64);
        let (top, bottom) = (self.pixels.row(y0), self.pixels.row(y0 + 1));
        let lerp = |a: f32, b: f32, f: f64| f64::from(a) * (1.0 - f) + f64::from(b) * f;
        lerp(top[x0], top[x0 + 1], fx) * (1.0 - fy) + lerp(bottom[x0], bottom[x0 + 1], fx) * fy
    }
}
