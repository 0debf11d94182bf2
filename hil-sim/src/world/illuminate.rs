//! Light on surfaces: the image that one light makes in one camera, per second.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::gbuffer::{GBuffer, Sample};
use super::geometry::Ray;
use super::material::reflectance;
use super::pattern::{BLOCK, DirectionBlock};
use super::projector::Light;
use super::raster::ShadowGrid;
use super::scene::PosedScene;

/// Side of the square of cells that is lit together; a block of the pattern sum.
const TILE: usize = 8;
/// Shadow rays start this far above the surface, so that rounding does not put them under it.
const LIFT_M: f64 = 2e-5;
/// Samples of one surface nearer than this share a shadow ray at edges.
const SHARED_SHADOW_M: f64 = 1.5e-3;

/// Electrons per second of each cell, per pixel area and without vignetting. `shadows` are the scene's
/// for this light.
pub(crate) fn illuminate(
    light: &Light,
    gbuffer: &GBuffer,
    scene: &PosedScene<'_>,
    shadows: &[Option<ShadowGrid>],
    camera_centre: &Vector3<f64>,
) -> Vec<f32> {
    let light_centre = light.origin();
    let shader = Shader { light, scene, camera_centre, light_centre, shadows };
    let columns = gbuffer.columns;
    let mut rates = vec![0.0_f32; gbuffer.cells.len()];
    rates.par_chunks_mut(columns * TILE).enumerate().for_each(|(stripe, out)| {
        let mut block = Block::new();
        let top = stripe * TILE;
        let height = out.len() / columns;
        for left in (0..columns).step_by(TILE) {
            let width = TILE.min(columns - left);
            block.clear();
            for y in 0..height {
                for x in 0..width {
                    block.push(gbuffer.cells[(top + y) * columns + left + x]);
                }
            }
            shader.shadow_tile(&mut block, width, height);
            shader.shade(&mut block);
            for y in 0..height {
                out[y * columns + left..][..width]
                    .copy_from_slice(&block.rates[y * width..][..width]);
            }
        }
    });
    let refined: Vec<f32> = gbuffer
        .fine
        .par_chunks(gbuffer.fine_per_cell)
        .map_init(Block::new, |block, samples| {
            block.clear();
            samples.iter().for_each(|s| block.push(*s));
            shader.shadow_edge(block);
            shader.shade(block);
            block.rates.iter().sum::<f32>() / samples.len() as f32
        })
        .collect();
    for (&index, rate) in gbuffer.refined.iter().zip(refined) {
        rates[index as usize] = rate;
    }
    rates
}

/// Ambient light: even from everywhere, so it shows the albedo.
pub(crate) fn ambient(gbuffer: &GBuffer, e_per_s: f64) -> Vec<f32> {
    let mut rates: Vec<f32> =
        gbuffer.cells.par_iter().map(|s| (s.albedo() * e_per_s) as f32).collect();
    for (&index, samples) in gbuffer.refined.iter().zip(gbuffer.fine.chunks(gbuffer.fine_per_cell))
    {
        let sum: f64 = samples.iter().map(Sample::albedo).sum();
        rates[index as usize] = (sum / samples.len() as f64 * e_per_s) as f32;
    }
    rates
}

/// Samples that are lit together.
struct Block {
    samples: Vec<Sample>,
    is_lit: Vec<bool>,
    rates: Vec<f32>,
    directions: DirectionBlock,
    /// Index and factor of the samples in `directions`.
    lit: Vec<(usize, f32)>,
}

impl Block {
    fn new() -> Self {
        Self {
            samples: Vec::with_capacity(BLOCK),
            is_lit: Vec::with_capacity(BLOCK),
            rates: Vec::with_capacity(BLOCK),
            directions: DirectionBlock {
                origin: [0.0; 2],
                x: [0.0; BLOCK],
                y: [0.0; BLOCK],
                inverse_two_sigma2: [0.0; BLOCK],
                sum: [0.0; BLOCK],
            },
            lit: Vec::with_capacity(BLOCK),
        }
    }

    fn clear(&mut self) {
        self.samples.clear();
        self.is_lit.clear();
    }

    fn push(&mut self, sample: Sample) {
        self.samples.push(sample);
        self.is_lit.push(false);
    }
}

struct Shader<'a> {
    light: &'a Light,
    scene: &'a PosedScene<'a>,
    camera_centre: &'a Vector3<f64>,
    light_centre: Vector3<f64>,
    shadows: &'a [Option<ShadowGrid>],
}

impl Shader<'_> {
    /// Whether light reaches a sample: it faces the light and nothing is between.
    fn is_reached(&self, sample: &Sample) -> bool {
        if !sample.is_surface() {
            return false;
        }
        let (point, normal) = (sample.point(), sample.normal());
        let to_light = self.light_centre - point;
        if to_light.dot(&normal) <= 0.0 {
            return false;
        }
        let origin = point + normal * LIFT_M;
        let to_light = self.light_centre - origin;
        let distance = to_light.norm();
        let ray = Ray { origin, direction: to_light / distance };
        !self.scene.is_shadowed(self.shadows, &ray, distance)
    }

    /// Shadows of a tile of cells: one ray a pixel, and one a cell where pixels disagree.
    fn shadow_tile(&self, block: &mut Block, width: usize, height: usize) {
        let (across, down) = (width.div_ceil(2), height.div_ceil(2));
        let cells_of = |px: usize, py: usize| {
            [(0, 0), (1, 0), (0, 1), (1, 1)]
                .into_iter()
                .map(move |(dx, dy)| (2 * px + dx, 2 * py + dy))
                .filter(move |&(x, y)| x < width && y < height)
                .map(move |(x, y)| y * width + x)
        };
        let mut is_split = [false; (TILE / 2) * (TILE / 2)];
        for py in 0..down {
            for px in 0..across {
                let first = 2 * py * width + 2 * px;
                let sample = block.samples[first];
                if cells_of(px, py).all(|i| !block.samples[i].is_edge()) {
                    let is_lit = self.is_reached(&sample);
                    cells_of(px, py).for_each(|i| block.is_lit[i] = is_lit);
                } else {
                    is_split[py * across + px] = true;
                }
            }
        }
        let lit_of = |block: &Block, px: usize, py: usize| block.is_lit[2 * py * width + 2 * px];
        let mut is_border = is_split;
        for py in 0..down {
            for px in 0..across {
                let here = lit_of(block, px, py);
                if px + 1 < across && lit_of(block, px + 1, py) != here {
                    is_border[py * across + px] = true;
                    is_border[py * across + px + 1] = true;
                }
                if py + 1 < down && lit_of(block, px, py + 1) != here {
                    is_border[py * across + px] = true;
                    is_border[(py + 1) * across + px] = true;
                }
            }
        }
        for py in 0..down {
            for px in 0..across {
                if is_border[py * across + px] {
                    for i in cells_of(px, py) {
                        block.is_lit[i] = self.is_reached(&block.samples[i]);
                    }
                }
            }
        }
    }

    /// Shadows of a refined cell's samples: one ray for each piece of surface.
    fn shadow_edge(&self, block: &mut Block) {
        let mut tested: Vec<usize> = Vec::with_capacity(4);
        for i in 0..block.samples.len() {
            let sample = block.samples[i];
            let known = tested.iter().find(|&&t| {
                let other = &block.samples[t];
                other.object() == sample.object()
                    && (other.point() - sample.point()).norm_squared() < SHARED_SHADOW_M.powi(2)
                    && other.normal().dot(&sample.normal()) > 0.9
            });
            block.is_lit[i] = match known {
                Some(&t) => block.is_lit[t],
                None => {
                    tested.push(i);
                    self.is_reached(&sample)
                }
            };
        }
    }

    /// Fills `rates` from samples and shadows.
    fn shade(&self, block: &mut Block) {
        block.rates.clear();
        block.rates.resize(block.samples.len(), 0.0);
        match self.light {
            Light::Flood { pose, peak, exponent } => {
                for i in (0..block.samples.len()).filter(|&i| block.is_lit[i]) {
                    let arrival = self.arrival(&block.samples[i]);
                    let beam = pose.rotation.column(2).dot(&-arrival.to_light).max(0.0);
                    block.rates[i] = (peak * beam.powf(*exponent) * arrival.factor) as f32;
                }
            }
            Light::Speckle { pose, dots, divergence, aperture_m } => {
                block.lit.clear();
                let d = &mut block.directions;
                for i in (0..block.samples.len()).filter(|&i| block.is_lit[i]) {
                    let arrival = self.arrival(&block.samples[i]);
                    let cosines = pose.inverse_vector(&-arrival.to_light);
                    if cosines.z <= 0.0 {
                        continue;
                    }
                    let n = block.lit.len();
                    if n == 0 {
                        d.origin = [cosines.x, cosines.y];
                    }
                    d.x[n] = (cosines.x - d.origin[0]) as f32;
                    d.y[n] = (cosines.y - d.origin[1]) as f32;
                    let sigma2 = divergence.powi(2) + (aperture_m / arrival.distance_m).powi(2);
                    d.inverse_two_sigma2[n] = (0.5 / sigma2) as f32;
                    // The dots' peaks are stated at 1 m; a wider beam spreads the same power.
                    let spread = (divergence.powi(2) + aperture_m.powi(2)) / sigma2;
                    block.lit.push((i, (arrival.factor * spread * cosines.z) as f32));
                }
                dots.sum(d, block.lit.len());
                for (n, &(i, factor)) in block.lit.iter().enumerate() {
                    block.rates[i] = d.sum[n] * factor;
                }
            }
        }
    }

    fn arrival(&self, sample: &Sample) -> Arrival {
        let (point, normal) = (sample.point(), sample.normal());
        let to_light = self.light_centre - point;
        let distance2 = to_light.norm_squared();
        let distance_m = distance2.sqrt();
        let to_light = to_light / distance_m;
        let gloss = self.scene.scene.objects[sample.object()].material.gloss;
        let reflected = match gloss {
            None => sample.albedo(),
            Some(_) => {
                let to_viewer = (self.camera_centre - point).normalize();
                reflectance(sample.albedo(), gloss, &normal, &to_light, &to_viewer)
            }
        };
        let factor = reflected * normal.dot(&to_light).max(0.0) / distance2;
        Arrival { to_light, distance_m, factor }
    }
}

/// Light arriving at a sample.
struct Arrival {
    to_light: Vector3<f64>,
    distance_m: f64,
    /// Reflectance times cosine over squared distance.
    factor: f64,
}
