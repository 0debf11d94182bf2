//! A statue: a plaster bust of 0.7 m on a fluted plinth, with curls, carved eyes, drapery and
//! everything else that is hard to measure: fine ridges, steep flanks, depth steps, shadows.

use std::f64::consts::TAU;
use std::sync::{Arc, OnceLock};

use nalgebra::{Rotation3, Vector3};

use super::isosurface::{Solid, mesh};
use super::material::value_noise;
use super::noise::KeyedRng;
use super::trimesh::TriangleMesh;

/// Height of the statue.
pub(crate) const HEIGHT_M: f64 = 0.7;
/// Largest distance of its surface from its vertical axis.
pub(crate) const REACH_M: f64 = 0.21;
/// Grid pitch of its triangles.
const PITCH_M: f64 = 0.0018;
/// Middle of the head.
const HEAD: Vector3<f64> = Vector3::new(0.0, 0.552, 0.0);

/// The statue's surface: x to the viewer's right, y up, z to the front, origin at half its height
/// on its axis. Made once and shared.
pub(crate) fn statue() -> Arc<TriangleMesh> {
    static STATUE: OnceLock<Arc<TriangleMesh>> = OnceLock::new();
    STATUE
        .get_or_init(|| {
            let half = Vector3::new(0.215, 0.362, 0.155);
            Arc::new(mesh(&Statue::new(), -half, half, PITCH_M))
        })
        .clone()
}

type V = Vector3<f64>;

fn v(x: f64, y: f64, z: f64) -> V {
    Vector3::new(x, y, z)
}

/// Union with a fillet of about `k`.
fn join(a: f64, b: f64, k: f64) -> f64 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// `a` without `b`, with a fillet of about `k`.
fn cut(a: f64, b: f64, k: f64) -> f64 {
    -join(-a, b, k)
}

fn ellipsoid(p: &V, centre: V, radii: V) -> f64 {
    let q = p - centre;
    let k0 = q.component_div(&radii).norm();
    let k1 = q.component_div(&radii.component_mul(&radii)).norm();
    if k1 < 1e-9 { -radii.min() } else { k0 * (k0 - 1.0) / k1 }
}

fn ball(p: &V, centre: V, radius: f64) -> f64 {
    (p - centre).norm() - radius
}

/// A rod with round ends whose radius changes from `ra` to `rb`.
fn rod(p: &V, a: V, b: V, ra: f64, rb: f64) -> f64 {
    let ab = b - a;
    let t = ((p - a).dot(&ab) / ab.norm_squared()).clamp(0.0, 1.0);
    (p - a - ab * t).norm() - (ra + (rb - ra) * t)
}

/// A bent rod.
fn arch(p: &V, points: [V; 3], radius: f64) -> f64 {
    let [a, b, c] = points;
    rod(p, a, b, radius * 0.75, radius).min(rod(p, b, c, radius, radius * 0.75))
}

/// The same point on the right side of the face.
fn folded(p: &V) -> V {
    v(p.x.abs(), p.y, p.z)
}

/// A ring of hair.
struct Curl {
    centre: V,
    /// Columns: two axes in the ring's plane and its normal.
    from_head: Rotation3<f64>,
    radius: f64,
    tube: f64,
    phase: f64,
}

struct Statue {
    head_from_body: Rotation3<f64>,
    curls: Vec<Curl>,
}

impl Statue {
    fn new() -> Self {
        Self { head_from_body: Rotation3::from_euler_angles(0.06, -0.30, 0.04), curls: curls() }
    }

    fn head(&self, p: &V) -> f64 {
        let outside = p.norm() - 0.155;
        if outside > 0.03 {
            return outside;
        }
        let skull = ellipsoid(p, v(0.0, 0.025, -0.012), v(0.074, 0.088, 0.092));
        let f = folded(p);
        let mut d = join(skull, ellipsoid(p, v(0.0, -0.022, 0.020), v(0.056, 0.084, 0.066)), 0.03);
        d = join(d, ellipsoid(p, v(0.0, -0.084, 0.056), v(0.025, 0.021, 0.022)), 0.025);
        d = join(d, ball(&f, v(0.040, -0.010, 0.056), 0.022), 0.03);
        // Jaw angle, and a hollow below the cheekbone.
        d = join(d, rod(&f, v(0.050, -0.060, 0.005), v(0.022, -0.090, 0.048), 0.012, 0.012), 0.03);
        d = cut(d, ball(&f, v(0.072, -0.045, 0.072), 0.028), 0.02);
        d = self.face(&f, d);
        d = join(d, self.ear(&f), 0.006);
        d.min(self.hair(p, d))
    }

    /// Brow, eyes, nose and mouth; `p` has x >= 0.
    fn face(&self, p: &V, mut d: f64) -> f64 {
        if (p - v(0.02, -0.02, 0.075)).norm() > 0.085 {
            return d;
        }
        d = join(d, rod(p, v(0.006, 0.031, 0.083), v(0.046, 0.033, 0.060), 0.008, 0.007), 0.014);
        d = cut(d, ellipsoid(p, v(0.031, 0.013, 0.092), v(0.019, 0.013, 0.018)), 0.012);
        // The eye: ball, drilled pupil with a ring around, lids.
        let eye = v(0.031, 0.012, 0.0655);
        d = join(d, ball(p, eye, 0.0135), 0.002);
        let on_eye = p - eye;
        let off_axis = on_eye.x.hypot(on_eye.y);
        let iris = (off_axis - 0.0062).abs() - 0.0006;
        d = cut(d, iris.max((on_eye.norm() - 0.0135).abs() - 0.0012), 0.0008);
        d = cut(d, ball(p, eye + v(0.0, 0.0, 0.0135), 0.0033), 0.001);
        let upper = [v(0.016, 0.014, 0.0755), v(0.030, 0.0215, 0.0785), v(0.046, 0.012, 0.0690)];
        let lower = [v(0.017, 0.009, 0.0755), v(0.031, 0.0030, 0.0770), v(0.045, 0.009, 0.0690)];
        d = join(d, arch(p, upper, 0.0036), 0.003);
        d = join(d, arch(p, lower, 0.0028), 0.003);
        // Nose.
        d = join(d, rod(p, v(0.0, 0.026, 0.084), v(0.0, -0.022, 0.1035), 0.0075, 0.0115), 0.012);
        d = join(d, ball(p, v(0.0125, -0.027, 0.0915), 0.0078), 0.006);
        d = cut(d, ball(p, v(0.0068, -0.0345, 0.0985), 0.0038), 0.002);
        // Mouth.
        d = join(d, ellipsoid(p, v(0.0, -0.056, 0.074), v(0.026, 0.020, 0.016)), 0.01);
        let above = [v(0.0, -0.0500, 0.0895), v(0.008, -0.0485, 0.0890), v(0.022, -0.0555, 0.0785)];
        let below = [v(0.0, -0.0630, 0.0890), v(0.008, -0.0630, 0.0880), v(0.020, -0.0580, 0.0785)];
        d = join(d, arch(p, above, 0.0052), 0.003);
        d = join(d, arch(p, below, 0.0058), 0.003);
        let parting = rod(p, v(0.0, -0.0562, 0.0935), v(0.023, -0.0570, 0.0815), 0.0014, 0.0010);
        cut(d, parting, 0.0015)
    }

    fn ear(&self, p: &V) -> f64 {
        let centre = v(0.074, -0.004, -0.012);
        if (p - centre).norm() > 0.06 {
            return 0.05;
        }
        let shell = ellipsoid(p, centre, v(0.010, 0.031, 0.019));
        let hollow = ellipsoid(p, v(0.083, 0.002, -0.008), v(0.008, 0.021, 0.011));
        let lobe = ball(p, v(0.074, -0.032, -0.004), 0.0075);
        let bridge = rod(p, v(0.077, 0.012, -0.010), v(0.078, -0.012, -0.014), 0.003, 0.003);
        join(join(cut(shell, hollow, 0.004), lobe, 0.006), bridge, 0.003)
    }

    /// A cap of hair under rings with strands.
    fn hair(&self, p: &V, bald: f64) -> f64 {
        let cap = ellipsoid(p, v(0.0, 0.030, -0.016), v(0.079, 0.090, 0.094));
        if cap > 0.05 {
            return bald.min(cap - 0.03);
        }
        let hairline = hairline(p);
        let mut d = join(bald, cap.max(hairline), 0.006);
        for curl in &self.curls {
            let q = p - curl.centre;
            if q.norm_squared() > 0.034 * 0.034 {
                continue;
            }
            let q = curl.from_head * q;
            let around = q.x.hypot(q.y) - curl.radius;
            let angle = q.y.atan2(q.x);
            let across = q.z.atan2(around);
            // Strands wind along the ring.
            let strands = 0.0009 * (6.0 * across + 2.0 * angle + curl.phase).cos();
            let ring = around.hypot(q.z) - curl.tube - strands;
            let core = q.norm() - 0.0062 - 0.0007 * (5.0 * angle + 40.0 * curl.radius).cos();
            d = join(d, ring.min(core), 0.0022);
        }
        d
    }

    fn neck(&self, p: &V) -> f64 {
        let f = folded(p);
        let column = rod(p, v(0.0, 0.34, -0.014), v(0.0, 0.51, -0.012), 0.056, 0.048);
        let tendon = rod(&f, v(0.046, 0.50, -0.012), v(0.010, 0.352, 0.042), 0.010, 0.009);
        let larynx = ball(p, v(0.0, 0.425, 0.036), 0.012);
        join(join(column, tendon, 0.015), larynx, 0.02)
    }

    fn torso(&self, p: &V) -> f64 {
        let f = folded(p);
        let mut d = ellipsoid(p, v(0.0, 0.262, -0.008), v(0.150, 0.120, 0.082));
        d = join(d, ellipsoid(&f, v(0.132, 0.292, -0.016), v(0.060, 0.064, 0.056)), 0.05);
        d = join(d, rod(&f, v(0.03, 0.385, -0.022), v(0.125, 0.335, -0.020), 0.030, 0.028), 0.04);
        d = join(d, ellipsoid(&f, v(0.062, 0.262, 0.050), v(0.062, 0.046, 0.034)), 0.03);
        d = join(d, rod(&f, v(0.014, 0.345, 0.050), v(0.128, 0.352, 0.020), 0.008, 0.007), 0.014);
        // The cut below the chest.
        let below = (0.168 + 0.9 * p.x * p.x - p.y) * 0.9;
        cut(d, -below.min(0.05), 0.006)
    }

    /// Cloth over one shoulder: a thick layer in folds with a free edge.
    fn drapery(&self, p: &V, torso: f64) -> f64 {
        if torso > 0.05 {
            return torso - 0.03;
        }
        let across = v(0.74, 0.52, 0.10).dot(p);
        let along = v(-0.55, 0.80, 0.22).dot(p);
        let sway = 0.006 * value_noise(&(p * 16.0)) + 0.010 * (along * 19.0).sin();
        let wave = ((across + sway) * TAU / 0.031).sin();
        let folds = 0.0075 * (0.5 + 0.5 * wave).powf(1.4) + 0.0012 * (across * TAU / 0.006).sin();
        let edge = 0.165 + 0.008 * (along * 32.0).sin() - across;
        (torso - 0.006 - folds).max(edge).max(p.y - 0.372)
    }

    fn plinth(&self, p: &V) -> f64 {
        let r = p.x.hypot(p.z);
        let angle = p.z.atan2(p.x);
        let slab = |radius: f64, low: f64, high: f64| {
            let (dr, dy) = (r - radius, (p.y - 0.5 * (low + high)).abs() - 0.5 * (high - low));
            dr.max(dy).min(0.0) + dr.max(0.0).hypot(dy.max(0.0)) - 0.0015
        };
        let ring = |radius: f64, y: f64, tube: f64| (r - radius).hypot(p.y - y) - tube;
        let waist = 0.058 + 5.5 * (p.y - 0.098).powi(2);
        let flutes = 0.0022 * (20.0 * angle).cos();
        let shaft = ((r - waist - flutes) * 0.8).max((p.y - 0.098).abs() - 0.062);
        // Steps carved into the base: small beads around it.
        let step = TAU / 48.0;
        let bead_angle = (angle / step).round() * step;
        let (bx, bz) = (0.1035 * bead_angle.cos(), 0.1035 * bead_angle.sin());
        let beads = ball(p, v(bx, 0.0185, bz), 0.0042);
        slab(0.102, 0.0015, 0.035)
            .min(ring(0.086, 0.046, 0.010))
            .min(shaft)
            .min(ring(0.072, 0.150, 0.010))
            .min(slab(0.080, 0.160, 0.172))
            .min(beads)
    }
}

impl Solid for Statue {
    fn distance(&self, p: &V) -> f64 {
        let p = p + v(0.0, HEIGHT_M / 2.0, 0.0);
        let plinth = if p.y < 0.26 { self.plinth(&p) } else { p.y - 0.18 };
        if p.y < 0.10 {
            return plinth;
        }
        let torso = self.torso(&p);
        let mut d = join(torso, self.neck(&p), 0.035);
        d = d.min(self.drapery(&p, torso));
        let head = self.head(&(self.head_from_body * (p - HEAD)));
        d = join(d, head, 0.012);
        join(d, plinth, 0.006)
    }
}

/// Negative where hair grows: everywhere but on face and neck.
fn hairline(p: &V) -> f64 {
    let face = 0.058 - p.y - 0.35 * p.x.abs() + 0.004 * (p.x * 170.0).sin();
    let front = (p.z - 0.012 + 0.25 * p.x.abs()).min(face);
    front.max(-0.062 - p.y)
}

fn curls() -> Vec<Curl> {
    const COUNT: usize = 150;
    let mut rng = KeyedRng::new(0xda51d);
    let golden = TAU * (1.0 - 1.0 / 1.618_033_988_75);
    (0..COUNT)
        .filter_map(|i| {
            let y = 1.0 - 2.0 * (i as f64 + 0.5) / COUNT as f64;
            let angle = golden * i as f64 + 0.25 * rng.symmetric();
            let flat = (1.0 - y * y).sqrt();
            let direction = v(flat * angle.cos(), y, flat * angle.sin());
            let radii = v(0.0805, 0.0915, 0.0955);
            let centre = v(0.0, 0.030, -0.016) + direction.component_mul(&radii);
            let jitter = v(rng.symmetric(), rng.symmetric(), rng.symmetric()) * 0.35;
            let axis = direction.component_div(&radii).normalize() + jitter;
            let curl = Curl {
                centre,
                from_head: Rotation3::rotation_between(&axis, &Vector3::z())
                    .unwrap_or_else(Rotation3::identity),
                radius: 0.0098 + 0.0022 * rng.uniform(),
                tube: 0.0044 + 0.0010 * rng.uniform(),
                phase: TAU * rng.uniform(),
            };
            (hairline(&centre) < -0.002).then_some(curl)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::shapes::Shape;

    #[test]
    fn the_statue_is_one_closed_piece_of_the_stated_size() {
        let statue = statue();
        let t = statue.triangles().expect("a mesh");
        let (mut min, mut max) = (Vector3::repeat(1.0), Vector3::repeat(-1.0));
        for vertex in &t.vertices {
            min = min.inf(vertex);
            max = max.sup(vertex);
            assert!(vertex.x.hypot(vertex.z) < REACH_M);
        }
        let size = max - min;
        assert!((size.y - HEIGHT_M).abs() < 0.03, "{size:?}");
        assert!((0.34..0.42).contains(&size.x) && (0.18..0.30).contains(&size.z), "{size:?}");
        // Closed: every edge has its opposite.
        let mut edges: Vec<(u32, u32)> =
            t.indices.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
        edges.sort_unstable();
        let open = edges.iter().filter(|&&(a, b)| edges.binary_search(&(b, a)).is_err()).count();
        assert_eq!(open, 0);
    }
}
