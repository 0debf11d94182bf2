//! How surfaces reflect: matt and glossy paint, with or without a texture.

use std::f64::consts::PI;

use nalgebra::Vector3;

use super::board::BoardTexture;
use super::noise::mix;

/// A surface's reflectance.
#[derive(Debug, Clone)]
pub(crate) struct Material {
    pub texture: Texture,
    pub gloss: Option<Gloss>,
}

/// The diffuse albedo over the surface.
#[derive(Debug, Clone)]
pub(crate) enum Texture {
    /// The same everywhere.
    Plain(f64),
    /// Uneven paint or stone: smooth random albedo, mean +- amplitude, of this grain size.
    Mottled { mean: f64, amplitude: f64, grain_m: f64 },
    /// A printed target in the object's xy plane.
    Board(Box<BoardTexture>),
}

/// A clear coat or a polished surface: microfacets of GGX distribution (Walter et al. 2007).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Gloss {
    /// Reflectance at normal incidence: 0.04 for paint and plastic, 0.5 and more for metal.
    pub normal_reflectance: f64,
    /// GGX width alpha: 0.1 is polished, 0.4 is satin.
    pub roughness: f64,
}

impl Material {
    pub fn matt(albedo: f64) -> Self {
        Self { texture: Texture::Plain(albedo), gloss: None }
    }

    /// Diffuse albedo at a point of the object's own frame.
    pub fn albedo(&self, point: &Vector3<f64>) -> f64 {
        match &self.texture {
            Texture::Plain(albedo) => *albedo,
            Texture::Mottled { mean, amplitude, grain_m } => {
                mean + amplitude * value_noise(&(point / *grain_m))
            }
            Texture::Board(board) => board.albedo(point.x, point.y),
        }
    }
}

/// pi times the BRDF (so 1 for a white matt surface) towards the viewer for light from `to_light`.
/// All vectors are of unit length; `normal` is on the viewer's side.
pub(crate) fn reflectance(
    albedo: f64,
    gloss: Option<Gloss>,
    normal: &Vector3<f64>,
    to_light: &Vector3<f64>,
    to_viewer: &Vector3<f64>,
) -> f64 {
    let Some(Gloss { normal_reflectance, roughness }) = gloss else {
        return albedo;
    };
    let n_l = normal.dot(to_light).max(1e-6);
    let n_v = normal.dot(to_viewer).max(1e-6);
    let half = (to_light + to_viewer).normalize();
    let n_h = normal.dot(&half).max(0.0);
    let v_h = to_viewer.dot(&half).max(0.0);
    let a2 = roughness * roughness;
    let d = a2 / (PI * (n_h * n_h * (a2 - 1.0) + 1.0).powi(2));
    // Height-correlated Smith visibility, which contains the 4 (n.l) (n.v) of the denominator.
    let visibility = 0.5
        / (n_l * (n_v * n_v * (1.0 - a2) + a2).sqrt() + n_v * (n_l * n_l * (1.0 - a2) + a2).sqrt());
    let fresnel = normal_reflectance + (1.0 - normal_reflectance) * (1.0 - v_h).powi(5);
    albedo * (1.0 - fresnel) + PI * d * visibility * fresnel
}

/// Smooth noise in [-1, 1] with one random value per integer lattice point.
pub(crate) fn value_noise(p: &Vector3<f64>) -> f64 {
    let base = p.map(f64::floor);
    let f = (p - base).map(|t| t * t * (3.0 - 2.0 * t));
    let lattice = |dx: i64, dy: i64, dz: i64| {
        let [x, y, z] = [base.x as i64 + dx, base.y as i64 + dy, base.z as i64 + dz];
        let h = mix(mix(mix(x as u64) ^ y as u64) ^ z as u64);
        (h >> 11) as f64 * (2.0 / (1_u64 << 53) as f64) - 1.0
    };
    let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let edge = |dy, dz| lerp(lattice(0, dy, dz), lattice(1, dy, dz), f.x);
    let face = |dz| lerp(edge(0, dz), edge(1, dz), f.y);
    lerp(face(0), face(1), f.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::noise::KeyedRng;

    #[test]
    fn gloss_reflects_no_more_than_it_receives_and_is_reciprocal() {
        let normal = Vector3::z();
        for roughness in [0.15, 0.3, 0.6] {
            let gloss = Some(Gloss { normal_reflectance: 0.5, roughness });
            for tilt in [0.0_f64, 0.5, 1.0] {
                let viewer = Vector3::new(tilt.sin(), 0.0, tilt.cos());
                // Directional albedo by cosine-weighted sampling of the hemisphere.
                let mut rng = KeyedRng::new(4);
                let n = 40_000;
                let mut sum = 0.0;
                for _ in 0..n {
                    let (r, phi) = (rng.uniform().sqrt(), 2.0 * PI * rng.uniform());
                    let light = Vector3::new(r * phi.cos(), r * phi.sin(), (1.0 - r * r).sqrt());
                    let there = reflectance(0.4, gloss, &normal, &light, &viewer);
                    let back = reflectance(0.4, gloss, &normal, &viewer, &light);
                    // The diffuse part under the coat is not reciprocal in this model; the lobe is.
                    assert!((there - back).abs() < 1e-9);
                    sum += there;
                }
                let albedo = sum / f64::from(n);
                assert!(albedo > 0.3 && albedo < 1.05, "{roughness} {tilt}: {albedo}");
            }
        }
    }

    #[test]
    fn gloss_peaks_in_the_mirror_direction() {
        let gloss = Some(Gloss { normal_reflectance: 0.05, roughness: 0.2 });
        let light = Vector3::new(0.5, 0.0, 0.75_f64.sqrt());
        let at = |angle: f64| {
            let viewer = Vector3::new(-angle.sin(), 0.0, angle.cos());
            reflectance(0.5, gloss, &Vector3::z(), &light, &viewer)
        };
        let mirror = 30.0_f64.to_radians();
        assert!(at(mirror) > 1.3 * at(mirror - 0.5) && at(mirror) > 1.3 * at(mirror + 0.5));
    }
}
