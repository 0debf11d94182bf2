//! Synthetic rectified stacks with exact ground truth.
//!
//! Dots are Gaussians at continuous positions. A pixel's grey value is the analytic sum of the dots at
//! the exact point that the disparity field gives, on both sides: there is no resampling anywhere, and
//! so nothing that an interpolation kernel could profit from.

#![allow(dead_code)]

use rayon::prelude::*;
use stspp_matcher::{Image, SAMPLES_PER_DN8, Sample, StereoStack};

/// SplitMix64.
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in 0..1.
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

type Field = Box<dyn Fn(f64, f64) -> f64 + Sync>;
type Support = Box<dyn Fn(f64, f64) -> bool + Sync>;

/// A surface: its disparity over left coordinates, and where on the left image it is.
pub struct Layer {
    pub disparity: Field,
    pub support: Support,
}

impl Layer {
    /// A surface that covers the whole image.
    pub fn everywhere(disparity: impl Fn(f64, f64) -> f64 + Sync + 'static) -> Self {
        Self { disparity: Box::new(disparity), support: Box::new(|_, _| true) }
    }
}

/// What to render; layers are in order from the nearest.
pub struct Scene {
    pub width: usize,
    pub height: usize,
    pub frames: usize,
    pub layers: Vec<Layer>,
    /// Standard deviation of a dot in pixels.
    pub sigma_px: f64,
    /// Mean distance between dots in pixels.
    pub spacing_px: f64,
    /// Electrons at 255 DN; no shot noise when infinite.
    pub full_well_e: f64,
    pub read_noise_e: f64,
    /// Gain and offset in DN of the right camera against the left one.
    pub right_gain: f64,
    pub right_offset_dn: f64,
    pub ambient_dn: f64,
    /// Rounds to whole grey levels of 8 bits, or keeps the sample's own resolution.
    pub quantise: bool,
    pub seed: u64,
}

impl Scene {
    /// The sensor of the other figures in this crate: dots of sigma 1.0 px, full well 10 000 e-, read
    /// noise 3 e-, 8 bit, unequal gains.
    pub fn new(width: usize, height: usize, frames: usize, layers: Vec<Layer>) -> Self {
        Self {
            width,
            height,
            frames,
            layers,
            sigma_px: 1.0,
            spacing_px: 5.0,
            full_well_e: 10_000.0,
            read_noise_e: 3.0,
            right_gain: 0.88,
            right_offset_dn: 4.0,
            ambient_dn: 12.0,
            quantise: true,
            seed: 1,
        }
    }

    pub fn render(&self) -> Rendered {
        let patterns: Vec<Pattern> = (0..self.frames)
            .map(|t| Pattern::new(self, self.seed.wrapping_mul(1000) + t as u64))
            .collect();
        let side = |right: bool| -> Vec<Image<Sample>> {
            patterns.iter().enumerate().map(|(t, p)| self.image(p, t, right)).collect()
        };
        let (left, right) = (side(false), side(true));
        let mut truth_px = Image::new(self.width, self.height, f32::NAN);
        let mut surface = Image::new(self.width, self.height, u8::MAX);
        for y in 0..self.height {
            for x in 0..self.width {
                let Some(k) = self.left_layer(x as f64, y as f64) else { continue };
                surface.set(x, y, k as u8);
                let d = (self.layers[k].disparity)(x as f64, y as f64);
                let column = x as f64 - d;
                let seen = self.right_point(column, y as f64).is_some_and(|(r, _)| r == k);
                if seen && column >= 0.0 && column <= self.width as f64 - 1.0 {
                    truth_px.set(x, y, d as f32);
                }
            }
        }
        Rendered { left, right, truth_px, surface }
    }

    fn left_layer(&self, x: f64, y: f64) -> Option<usize> {
        self.layers.iter().position(|l| (l.support)(x, y))
    }

    /// The surface that right column `column` sees, and the left column of that point.
    fn right_point(&self, column: f64, y: f64) -> Option<(usize, f64)> {
        self.layers.iter().enumerate().find_map(|(k, layer)| {
            let mut x = column + (layer.disparity)(column, y);
            for _ in 0..60 {
                x += 0.7 * (column + (layer.disparity)(x, y) - x);
            }
            (layer.support)(x, y).then_some((k, x))
        })
    }

    fn image(&self, pattern: &Pattern, t: usize, right: bool) -> Image<Sample> {
        let mut image = Image::new(self.width, self.height, 0);
        image.as_mut_slice().par_chunks_mut(self.width).enumerate().for_each(|(y, row)| {
            let mut random = Random(
                self.seed
                    ^ ((y as u64) << 32)
                    ^ ((t as u64) << 8)
                    ^ ((right as u64) << 50)
                    ^ 0xabcd,
            );
            random.bits();
            for (x, sample) in row.iter_mut().enumerate() {
                let point = if right {
                    self.right_point(x as f64, y as f64)
                } else {
                    self.left_layer(x as f64, y as f64).map(|k| (k, x as f64))
                };
                // Each surface is lit by another part of the pattern.
                let light = point.map_or(0.0, |(k, x)| pattern.at(x + 1777.0 * k as f64, y as f64));
                let gain = if right { self.right_gain } else { 1.0 };
                let offset = if right { self.right_offset_dn } else { 0.0 };
                let dn = gain * (self.ambient_dn + 200.0 * light) + offset;
                *sample = self.expose(dn, &mut random);
            }
        });
        image
    }

    fn expose(&self, dn: f64, random: &mut Random) -> Sample {
        let mut dn = dn;
        if self.full_well_e.is_finite() {
            let electrons = dn * self.full_well_e / 255.0;
            let sigma = (electrons.max(0.0) + self.read_noise_e * self.read_noise_e).sqrt();
            dn = (electrons + sigma * random.normal()) * 255.0 / self.full_well_e;
        }
        let dn = dn.clamp(0.0, 255.0);
        let dn = if self.quantise { dn.round() } else { dn };
        (dn * SAMPLES_PER_DN8 as f64).round() as Sample
    }
}

/// One frame's dots, in bins for quick look-up; repeats with a period far beyond the image.
struct Pattern {
    sigma_px: f64,
    bin_px: f64,
    seed: u64,
    per_bin: f64,
}

impl Pattern {
    fn new(scene: &Scene, seed: u64) -> Self {
        let bin_px = (4.5 * scene.sigma_px).max(2.0);
        let per_bin = bin_px * bin_px / (scene.spacing_px * scene.spacing_px);
        Self { sigma_px: scene.sigma_px, bin_px, seed, per_bin }
    }

    /// Light at a point, about 0..=1.2.
    fn at(&self, x: f64, y: f64) -> f64 {
        let (bx, by) = ((x / self.bin_px).floor(), (y / self.bin_px).floor());
        let scale = -0.5 / (self.sigma_px * self.sigma_px);
        let mut sum = 0.0;
        for by in [by - 1.0, by, by + 1.0] {
            for bx in [bx - 1.0, bx, bx + 1.0] {
                // A bin's dots are drawn from its own seed: the pattern has no edge.
                let mut random = Random(
                    self.seed ^ ((bx as i64 as u64) << 40) ^ ((by as i64 as u64 & 0xffff) << 16),
                );
                random.bits();
                let count = (self.per_bin + random.uniform()).floor() as usize;
                for _ in 0..count {
                    let dx = x - (bx + random.uniform()) * self.bin_px;
                    let dy = y - (by + random.uniform()) * self.bin_px;
                    let amplitude = 0.55 + 0.45 * random.uniform();
                    let exponent = scale * (dx * dx + dy * dy);
                    if exponent > -10.0 {
                        sum += amplitude * exponent.exp();
                    }
                }
            }
        }
        sum
    }
}

/// A rendered stack and its truth.
pub struct Rendered {
    pub left: Vec<Image<Sample>>,
    pub right: Vec<Image<Sample>>,
    /// Disparity where both cameras see the point, NaN elsewhere.
    pub truth_px: Image<f32>,
    /// Layer of each left pixel.
    pub surface: Image<u8>,
}

impl Rendered {
    pub fn with_stack<T>(&self, run: impl FnOnce(&StereoStack<'_>) -> T) -> T {
        let left: Vec<&Image<Sample>> = self.left.iter().collect();
        let right: Vec<&Image<Sample>> = self.right.iter().collect();
        run(&StereoStack::new(&left, &right))
    }

    /// Compares a disparity map with the truth, over the pixels for which `use_pixel` holds.
    pub fn compare(&self, map: &Image<f32>, use_pixel: impl Fn(usize, usize) -> bool) -> Score {
        let mut score = Score::default();
        let mut squares = 0.0;
        let mut sum = 0.0;
        for y in 0..map.height() {
            for x in 0..map.width() {
                if !use_pixel(x, y) {
                    continue;
                }
                let (got, truth) = (map.row(y)[x] as f64, self.truth_px.row(y)[x] as f64);
                if truth.is_nan() {
                    score.hidden += 1;
                    score.hidden_matched += got.is_finite() as usize;
                    continue;
                }
                score.visible += 1;
                if !got.is_finite() {
                    continue;
                }
                score.matched += 1;
                let error = got - truth;
                if error.abs() > 1.0 {
                    score.wrong += 1;
                } else {
                    squares += error * error;
                    sum += error;
                }
            }
        }
        let good = (score.matched - score.wrong).max(1) as f64;
        score.rms_px = (squares / good).sqrt();
        score.bias_px = sum / good;
        score
    }
}

/// How a map compares with the truth; `wrong` is off by more than 1 px.
#[derive(Debug, Default, Clone)]
pub struct Score {
    pub visible: usize,
    pub matched: usize,
    pub wrong: usize,
    pub hidden: usize,
    pub hidden_matched: usize,
    pub rms_px: f64,
    pub bias_px: f64,
}

impl Score {
    /// Visible pixels matched within 1 px.
    pub fn completeness(&self) -> f64 {
        (self.matched - self.wrong) as f64 / self.visible.max(1) as f64
    }
}
