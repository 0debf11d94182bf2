//! Stereo stacks of known disparity: Gaussian dots evaluated analytically on both images, so that
//! no interpolation stands between the truth and the samples. For tests and benchmarks.

use crate::{Image, SAMPLES_PER_DN8, Sample, StereoStack};
use rayon::prelude::*;

/// Electrons per 8-bit grey level at a full well of 10 000.
const ELECTRONS_PER_DN: f64 = 10_000.0 / 255.0;
/// Read noise in electrons.
const READ_NOISE: f64 = 3.0;

/// A function of the left image's x and y.
pub type Field<T> = Box<dyn Fn(f64, f64) -> T + Send + Sync>;

/// A surface with its own dots. Where several are present, the one of largest disparity is seen.
pub struct Layer {
    /// Disparity in px at a point of the left image.
    pub disparity_px: Field<f64>,
    /// Whether the surface is there.
    pub inside: Field<bool>,
    /// Change of the disparity from one frame to the next; the truth is the last frame's.
    pub rate_px_per_frame: f64,
}

impl Layer {
    /// A static surface that fills the image.
    pub fn everywhere(disparity_px: impl Fn(f64, f64) -> f64 + Send + Sync + 'static) -> Self {
        Self::patch(disparity_px, |_, _| true)
    }

    /// A static surface where `inside` holds.
    pub fn patch(
        disparity_px: impl Fn(f64, f64) -> f64 + Send + Sync + 'static,
        inside: impl Fn(f64, f64) -> bool + Send + Sync + 'static,
    ) -> Self {
        Self {
            disparity_px: Box::new(disparity_px),
            inside: Box::new(inside),
            rate_px_per_frame: 0.0,
        }
    }
}

/// What to render.
pub struct Scene {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Number of frames.
    pub frames: usize,
    /// Surfaces.
    pub layers: Vec<Layer>,
    /// Standard deviation of a dot in px, blur included.
    pub dot_sigma_px: f64,
    /// Dots per pixel of area.
    pub dots_per_px: f64,
    /// Mean peak of a dot in 8-bit grey levels; single dots vary by half of it.
    pub peak_dn: f64,
    /// Background light in 8-bit grey levels.
    pub ambient_dn: f64,
    /// The right image's gain over the left one's.
    pub right_gain: f64,
    /// The right image's offset in 8-bit grey levels.
    pub right_offset_dn: f64,
    /// Shot noise, read noise and rounding to 8 bits, or none of them.
    pub noise: bool,
    /// Seed of dots and noise.
    pub seed: u64,
}

impl Scene {
    /// A scene with the sensor's usual dots and noise.
    pub fn new(width: usize, height: usize, frames: usize, layers: Vec<Layer>) -> Self {
        Self {
            width,
            height,
            frames,
            layers,
            dot_sigma_px: 1.2,
            dots_per_px: 0.035,
            peak_dn: 130.0,
            ambient_dn: 6.0,
            right_gain: 0.85,
            right_offset_dn: 3.0,
            noise: true,
            seed: 1,
        }
    }

    /// The benchmark's field: slopes of 5 % and 3 %, a spherical cap, ridges of 0.3 px and one step
    /// of 6 px, around disparity `centre_px`.
    pub fn benchmark(width: usize, height: usize, frames: usize, centre_px: f64) -> Self {
        let (w, h) = (width as f64, height as f64);
        let base = move |x: f64, y: f64| {
            let (u, v) = (x - w / 2.0, y - h / 2.0);
            let r = h * 0.18;
            let (cx, cy) = (u + w * 0.2, v + h * 0.1);
            let rho2 = (cx * cx + cy * cy) / (r * r);
            let cap = if rho2 < 0.8 { 40.0 * ((1.0 - rho2).sqrt() - 0.2f64.sqrt()) } else { 0.0 };
            let ridge = if u > w * 0.1 && v < -h * 0.15 {
                0.3 * (std::f64::consts::TAU * u / 24.0).sin()
            } else {
                0.0
            };
            centre_px + 0.05 * u + 0.03 * v + cap + ridge
        };
        let step = move |x: f64, y: f64| base(x, y) + 6.0;
        let inside =
            move |x: f64, y: f64| x > w * 0.65 && x < w * 0.9 && y > h * 0.6 && y < h * 0.85;
        Self::new(width, height, frames, vec![Layer::everywhere(base), Layer::patch(step, inside)])
    }

    /// Renders both stacks and the truth.
    pub fn render(&self) -> Rendered {
        let (w, h) = (self.width, self.height);
        let truth_at = |x: f64, y: f64, frame: usize| -> Option<(usize, f64)> {
            let before = (self.frames - 1 - frame) as f64;
            (0..self.layers.len())
                .filter(|&i| (self.layers[i].inside)(x, y))
                .map(|i| {
                    let l = &self.layers[i];
                    (i, (l.disparity_px)(x, y) - before * l.rate_px_per_frame)
                })
                .max_by(|a, b| a.1.total_cmp(&b.1))
        };
        // For each pixel of both images: which layer is seen and at which left x.
        let see = |frame: usize| {
            let mut seen = [vec![None; w * h], vec![None; w * h]];
            let [left, right] = &mut seen;
            left.par_chunks_mut(w).zip(right.par_chunks_mut(w)).enumerate().for_each(
                |(y, (left, right))| {
                    for x in 0..w {
                        let (x_px, y_px) = (x as f64, y as f64);
                        left[x] = truth_at(x_px, y_px, frame).map(|(l, _)| (l, x_px));
                        right[x] = self.seen_by_right(x_px, y_px, frame);
                    }
                },
            );
            seen
        };
        let moving = self.layers.iter().any(|l| l.rate_px_per_frame != 0.0);
        let still = if moving { None } else { Some(see(self.frames - 1)) };
        let dark = self.ambient_dn * self.right_gain + self.right_offset_dn;
        let frames: Vec<(Image<Sample>, Image<Sample>)> = (0..self.frames)
            .into_par_iter()
            .map(|frame| {
                let own = if moving { Some(see(frame)) } else { None };
                let [left, right] = own.as_ref().or(still.as_ref()).expect("one of them is set");
                (
                    self.splat(frame, left, 1.0, self.ambient_dn, 0),
                    self.splat(frame, right, self.right_gain, dark, 1),
                )
            })
            .collect();
        let mut truth = Image::new(w, h, f32::NAN);
        let mut visible = Image::new(w, h, 0u8);
        let last = self.frames - 1;
        for y in 0..h {
            for x in 0..w {
                let Some((layer, d)) = truth_at(x as f64, y as f64, last) else { continue };
                truth.set(x, y, d as f32);
                let right = x as f64 - d;
                let hidden = right < 0.0
                    || right > (w - 1) as f64
                    || self
                        .seen_by_right(right, y as f64, last)
                        .is_none_or(|(l, at)| l != layer || (at - x as f64).abs() > 0.5);
                visible.set(x, y, u8::from(!hidden));
            }
        }
        let (left, right) = frames.into_iter().unzip();
        Rendered { left, right, truth_px: truth, visible }
    }

    /// Which layer the right camera sees at (`x_right`, `y`), and at which left x.
    fn seen_by_right(&self, x_right: f64, y: f64, frame: usize) -> Option<(usize, f64)> {
        let before = (self.frames - 1 - frame) as f64;
        let mut best: Option<(usize, f64)> = None;
        for (i, layer) in self.layers.iter().enumerate() {
            let d = |x: f64| (layer.disparity_px)(x, y) - before * layer.rate_px_per_frame;
            let mut x = x_right + d(x_right);
            for _ in 0..60 {
                let next = x_right + d(x);
                let done = (next - x).abs() < 1e-9;
                x = next;
                if done {
                    break;
                }
            }
            // The largest x is the largest disparity, hence the nearest surface.
            if (layer.inside)(x, y) && best.is_none_or(|(_, b)| x > b) {
                best = Some((i, x));
            }
        }
        best
    }

    fn splat(
        &self,
        frame: usize,
        seen: &[Option<(usize, f64)>],
        gain: f64,
        offset_dn: f64,
        side: u64,
    ) -> Image<Sample> {
        let (w, h) = (self.width, self.height);
        let mut light = vec![0.0f64; w * h];
        let reach = 4.0 * self.dot_sigma_px;
        let k = -0.5 / (self.dot_sigma_px * self.dot_sigma_px);
        for layer in 0..self.layers.len() {
            // Where each left x of this layer appears in the image: a search around the last hit.
            let mut random = Random::new(self.seed ^ (frame as u64) << 20 ^ (layer as u64) << 40);
            let margin = 700.0;
            let area = (w as f64 + 2.0 * margin) * h as f64;
            let dots = (area * self.dots_per_px) as usize;
            let mut by_row: Vec<Vec<(f64, f64)>> = vec![Vec::new(); h];
            for _ in 0..dots {
                let cx = random.unit() * (w as f64 + 2.0 * margin) - margin;
                let cy = random.unit() * h as f64;
                let peak = self.peak_dn * (0.5 + random.unit());
                let (y0, y1) = ((cy - reach).ceil().max(0.0), (cy + reach).floor());
                let last = (y1.min(h as f64 - 1.0)) as usize;
                for (y, row) in by_row.iter_mut().enumerate().take(last + 1).skip(y0 as usize) {
                    let dy = y as f64 - cy;
                    row.push((cx, peak * (k * dy * dy).exp()));
                }
            }
            for (y, dots) in by_row.iter_mut().enumerate() {
                dots.sort_by(|a, b| a.0.total_cmp(&b.0));
                for x in 0..w {
                    let Some((_, at)) = seen[y * w + x].filter(|s| s.0 == layer) else { continue };
                    let from = dots.partition_point(|d| d.0 < at - reach);
                    for d in dots[from..].iter().take_while(|d| d.0 <= at + reach) {
                        light[y * w + x] += d.1 * (k * (at - d.0) * (at - d.0)).exp();
                    }
                }
            }
        }
        let mut random = Random::new(self.seed.wrapping_mul(77) ^ (frame as u64) << 8 ^ side << 4);
        let data: Vec<Sample> = light
            .into_iter()
            .map(|dn| {
                let dn = dn * gain + offset_dn;
                let dn = if self.noise {
                    let electrons = dn * ELECTRONS_PER_DN;
                    let sigma = (electrons + READ_NOISE * READ_NOISE).sqrt();
                    ((electrons + sigma * random.normal()) / ELECTRONS_PER_DN).round()
                } else {
                    dn
                };
                (dn.clamp(0.0, 255.0) * f64::from(SAMPLES_PER_DN8)).round() as Sample
            })
            .collect();
        // Placed in memory as a rectifier's canvases are.
        let mut image = Image::new(w, h, 0);
        image.as_mut_slice().copy_from_slice(&data);
        image
    }
}

/// A rendered scene.
pub struct Rendered {
    /// Left images.
    pub left: Vec<Image<Sample>>,
    /// Right images.
    pub right: Vec<Image<Sample>>,
    /// True disparity of the last frame on the left canvas, NaN where there is no surface.
    pub truth_px: Image<f32>,
    /// Non-zero where both cameras see the point.
    pub visible: Image<u8>,
}

impl Rendered {
    /// Calls `work` with the stack.
    pub fn with_stack<T>(&self, work: impl FnOnce(&StereoStack<'_>) -> T) -> T {
        let left: Vec<&Image<Sample>> = self.left.iter().collect();
        let right: Vec<&Image<Sample>> = self.right.iter().collect();
        work(&StereoStack::new(&left, &right))
    }
}

/// SplitMix64: enough randomness for dots and noise without a dependency.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// A generator.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in 0..1.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let r = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        r * (std::f64::consts::TAU * self.unit()).cos()
    }
}
