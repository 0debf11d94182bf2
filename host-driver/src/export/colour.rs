//! The colours of depth pictures: even in perceived difference, from dark blue over green to red.
//!
//! Built in Oklab (Ottosson, 2020), whose distances follow what people see.

/// Colour of invalid pixels.
pub const INVALID: [u8; 3] = [12, 12, 14];

/// Colour of a signed value from -1 (blue) over 0 (white) to 1 (red); beyond, the ends.
pub fn diverging(t: f64) -> [u8; 3] {
    let t = t.clamp(-1.0, 1.0);
    let other = ((1.0 - t.abs()) * 255.0) as u8;
    if t < 0.0 { [other, other, 255] } else { [255, other, other] }
}

/// 256 colours: 0 is far (blue), 255 near (red).
pub fn table() -> [[u8; 3]; 256] {
    std::array::from_fn(|k| {
        let t = k as f64 / 255.0;
        // Lightness rises to the middle and falls a little towards red, where the gamut ends.
        let lightness = 0.40 + 0.95 * t - 0.70 * t * t;
        let hue = (268.0 - 242.0 * t).to_radians();
        let chroma = 0.13 + 0.07 * (2.0 * t - 1.0).powi(2);
        srgb_of_oklab(lightness, chroma * hue.cos(), chroma * hue.sin())
    })
}

fn srgb_of_oklab(lightness: f64, a: f64, b: f64) -> [u8; 3] {
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548_0 * b).powi(3);
    let linear = [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701_0 * s,
    ];
    linear.map(|c| {
        let c = c.clamp(0.0, 1.0);
        let encoded = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
        (encoded * 255.0).round() as u8
    })
}
