//! An industrial part of 0.30 x 0.26 x 0.26 m (paper, Figure 7): plates, steps, holes and bosses, all
//! by formula, so that its circles are exact.

use nalgebra::Vector3;

use super::geometry::{Aabb, Hit, Ray};
use super::shapes::{Feature, Shape};

/// A flat face at constant depth: a rectangle or a disc, with round holes.
struct Face {
    z: f64,
    outline: Outline,
    holes: Vec<Circle>,
}

enum Outline {
    Rectangle { min: [f64; 2], max: [f64; 2] },
    Disc(Circle),
}

#[derive(Clone, Copy)]
struct Circle {
    centre: [f64; 2],
    radius: f64,
}

impl Circle {
    fn contains(&self, p: &Vector3<f64>) -> bool {
        let (dx, dy) = (p.x - self.centre[0], p.y - self.centre[1]);
        dx * dx + dy * dy < self.radius * self.radius
    }
}

/// The wall of a hole or a boss.
struct Wall {
    circle: Circle,
    z: [f64; 2],
}

/// A parallelogram, or the half of it next to its corner.
struct Side {
    corner: Vector3<f64>,
    edges: [Vector3<f64>; 2],
    normal: Vector3<f64>,
    is_triangle: bool,
}

/// The part: x to the right, y down, z away from the viewer, its base plate's front in z = 0.
pub(crate) struct Part {
    faces: Vec<Face>,
    walls: Vec<Wall>,
    sides: Vec<Side>,
    bounds: Aabb,
}

impl Part {
    pub fn new() -> Self {
        let mut part =
            Self { faces: Vec::new(), walls: Vec::new(), sides: Vec::new(), bounds: Aabb::EMPTY };
        let circle =
            |x: f64, y: f64, r: f64| Circle { centre: [x * 1e-3, y * 1e-3], radius: r * 1e-3 };
        // Base block with two holes of 15 and 10 mm, and two of 3 mm.
        let holes = [
            (circle(18.0, 72.0, 15.0), 0.040),
            (circle(-48.0, 82.0, 10.0), 0.030),
            (circle(20.0, 22.0, 3.0), 0.012),
            (circle(-14.0, 108.0, 3.0), 0.012),
        ];
        part.block([-0.15, -0.13], [0.15, 0.13], [0.15, 0.0], &holes);
        // Round platform of 50 mm with a hole of 15 mm and four of 3 mm around it.
        let centre = [-75.0, -55.0];
        let mut holes = vec![(circle(centre[0], centre[1], 15.0), 0.025)];
        for (dx, dy) in [(35.0, 0.0), (0.0, 35.0), (-35.0, 0.0), (0.0, -35.0)] {
            holes.push((circle(centre[0] + dx, centre[1] + dy, 3.0), 0.010));
        }
        part.boss(circle(centre[0], centre[1], 50.0), [0.0, -0.040], &holes);
        // Raised block with a hole of 10 mm and a boss of 15 mm.
        part.block(
            [0.05, -0.12],
            [0.14, 0.015],
            [0.0, -0.09],
            &[(circle(95.0, -85.0, 10.0), 0.04)],
        );
        part.boss(circle(95.0, -25.0, 15.0), [-0.09, -0.11], &[]);
        // Low boss of 10 mm.
        part.boss(circle(-112.0, 80.0, 10.0), [0.0, -0.015], &[]);
        part.ramp([0.055, 0.035], [0.14, 0.12], 0.05);
        part
    }

    /// A block from `z[0]` (back) to `z[1]` (front) with holes (circle, depth) in its front.
    fn block(&mut self, min: [f64; 2], max: [f64; 2], z: [f64; 2], holes: &[(Circle, f64)]) {
        let [x0, y0] = min;
        let [x1, y1] = max;
        let [back, front] = z;
        let (dx, dy, dz) = (
            Vector3::new(x1 - x0, 0.0, 0.0),
            Vector3::new(0.0, y1 - y0, 0.0),
            Vector3::new(0.0, 0.0, back - front),
        );
        for (corner, edge) in [
            (Vector3::new(x0, y0, front), dx),
            (Vector3::new(x0, y1, front), dx),
            (Vector3::new(x0, y0, front), dy),
            (Vector3::new(x1, y0, front), dy),
        ] {
            self.side(corner, [edge, dz], false);
        }
        self.front(Outline::Rectangle { min, max }, front, holes);
        self.bounds.include(&Vector3::new(x0, y0, front));
        self.bounds.include(&Vector3::new(x1, y1, back));
    }

    fn boss(&mut self, circle: Circle, z: [f64; 2], holes: &[(Circle, f64)]) {
        self.walls.push(Wall { circle, z: [z[1], z[0]] });
        self.front(Outline::Disc(circle), z[1], holes);
        self.bounds.include(&Vector3::new(circle.centre[0], circle.centre[1], z[1]));
    }

    fn front(&mut self, outline: Outline, z: f64, holes: &[(Circle, f64)]) {
        for &(circle, depth) in holes {
            self.walls.push(Wall { circle, z: [z, z + depth] });
            let floor = Face { z: z + depth, outline: Outline::Disc(circle), holes: Vec::new() };
            self.faces.push(floor);
        }
        let holes = holes.iter().map(|(circle, _)| *circle).collect();
        self.faces.push(Face { z, outline, holes });
    }

    /// A wedge on the base plate that rises towards its right edge.
    fn ramp(&mut self, min: [f64; 2], max: [f64; 2], rise: f64) {
        let low = Vector3::new(min[0], min[1], 0.0);
        let along = Vector3::new(max[0] - min[0], 0.0, 0.0);
        let down = Vector3::new(0.0, max[1] - min[1], 0.0);
        let up = Vector3::new(0.0, 0.0, -rise);
        self.side(low, [along + up, down], false);
        self.side(low + along, [up, down], false);
        for corner in [low + along, low + along + down] {
            self.side(corner, [-along, up], true);
        }
    }

    fn side(&mut self, corner: Vector3<f64>, edges: [Vector3<f64>; 2], is_triangle: bool) {
        let normal = edges[0].cross(&edges[1]).normalize();
        self.sides.push(Side { corner, edges, normal, is_triangle });
    }
}

impl Shape for Part {
    fn intersect(&self, ray: &Ray, max_m: f64) -> Option<Hit> {
        if !self.bounds.is_crossed_by(ray, max_m) {
            return None;
        }
        let mut best: Option<Hit> = None;
        let mut limit = max_m;
        let mut keep = |hit: Option<Hit>| {
            if let Some(hit) = hit.filter(|h| h.distance_m > 0.0 && h.distance_m < limit) {
                limit = hit.distance_m;
                best = Some(hit);
            }
        };
        self.faces.iter().for_each(|f| keep(f.cross(ray)));
        self.walls.iter().for_each(|w| w.cross(ray).into_iter().for_each(&mut keep));
        self.sides.iter().for_each(|s| keep(s.cross(ray)));
        best
    }

    fn features(&self) -> Vec<Feature> {
        let normal = -Vector3::z();
        let mut features = Vec::new();
        for face in &self.faces {
            let at = |c: &Circle| Vector3::new(c.centre[0], c.centre[1], face.z);
            let is_floor = self.walls.iter().any(|w| w.z[1] == face.z && w.z[0] < face.z)
                && matches!(face.outline, Outline::Disc(_))
                && face.holes.is_empty();
            // A hole's floor is not measurable; its rim belongs to the face that it is in.
            if is_floor {
                continue;
            }
            let point = match &face.outline {
                Outline::Rectangle { min, max } => {
                    Vector3::new((min[0] + max[0]) / 2.0, (min[1] + max[1]) / 2.0, face.z)
                }
                Outline::Disc(circle) => at(circle),
            };
            features.push(Feature::Plane { point, normal });
            let rim = if let Outline::Disc(circle) = &face.outline { Some(circle) } else { None };
            features.extend(rim.into_iter().chain(&face.holes).map(|circle| Feature::Circle {
                centre: at(circle),
                normal,
                radius_m: circle.radius,
            }));
        }
        features
    }
}

impl Face {
    fn cross(&self, ray: &Ray) -> Option<Hit> {
        let distance_m = (self.z - ray.origin.z) / ray.direction.z;
        if !distance_m.is_finite() {
            return None;
        }
        let p = ray.at(distance_m);
        let is_inside = match &self.outline {
            Outline::Rectangle { min, max } => {
                p.x >= min[0] && p.x <= max[0] && p.y >= min[1] && p.y <= max[1]
            }
            Outline::Disc(circle) => circle.contains(&p),
        };
        (is_inside && !self.holes.iter().any(|hole| hole.contains(&p)))
            .then(|| Hit { distance_m, normal: -Vector3::z() })
    }
}

impl Wall {
    /// Both crossings: a hole's wall is seen from inside.
    fn cross(&self, ray: &Ray) -> [Option<Hit>; 2] {
        let d = [ray.direction.x, ray.direction.y];
        let o = [ray.origin.x - self.circle.centre[0], ray.origin.y - self.circle.centre[1]];
        let a = d[0] * d[0] + d[1] * d[1];
        let along = (o[0] * d[0] + o[1] * d[1]) / a;
        let closest = [o[0] - d[0] * along, o[1] - d[1] * along];
        let radius = self.circle.radius;
        let half2 = (radius * radius - closest[0] * closest[0] - closest[1] * closest[1]) / a;
        if half2.is_nan() || half2 < 0.0 || a == 0.0 {
            return [None, None];
        }
        [-1.0, 1.0].map(|sign| {
            let distance_m = -along + sign * half2.sqrt();
            let z = ray.origin.z + ray.direction.z * distance_m;
            let normal = Vector3::new(o[0] + d[0] * distance_m, o[1] + d[1] * distance_m, 0.0);
            (distance_m > 0.0 && z >= self.z[0] && z <= self.z[1])
                .then(|| Hit { distance_m, normal: normal / radius })
        })
    }
}

impl Side {
    fn cross(&self, ray: &Ray) -> Option<Hit> {
        let [e1, e2] = &self.edges;
        let p = ray.direction.cross(e2);
        let inverse = 1.0 / e1.dot(&p);
        let s = ray.origin - self.corner;
        let u = s.dot(&p) * inverse;
        let q = s.cross(e1);
        let v = ray.direction.dot(&q) * inverse;
        let is_inside = u >= 0.0
            && v >= 0.0
            && if self.is_triangle { u + v <= 1.0 } else { u <= 1.0 && v <= 1.0 };
        is_inside.then(|| Hit { distance_m: e2.dot(&q) * inverse, normal: self.normal })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn circles_of_all_four_radii_are_where_rays_find_their_rims() {
        let part = Part::new();
        let circles: Vec<_> = part
            .features()
            .into_iter()
            .filter_map(|f| match f {
                Feature::Circle { centre, radius_m, .. } => Some((centre, radius_m)),
                _ => None,
            })
            .collect();
        for radius in [0.003, 0.010, 0.015, 0.050] {
            assert!(circles.iter().any(|c| (c.1 - radius).abs() < 1e-12), "no circle of {radius}");
        }
        let depth = |x: f64, y: f64| {
            let ray = Ray { origin: Vector3::new(x, y, -1.0), direction: Vector3::z() };
            part.intersect(&ray, 5.0).map(|h| h.distance_m - 1.0)
        };
        for (centre, radius) in circles {
            for k in 0..24 {
                let (sin, cos) = (f64::from(k) * 0.2618 + 0.01).sin_cos();
                let inside =
                    depth(centre.x + cos * (radius - 1e-6), centre.y + sin * (radius - 1e-6));
                let outside =
                    depth(centre.x + cos * (radius + 1e-6), centre.y + sin * (radius + 1e-6));
                let (a, b) = (inside.expect("the part"), outside.expect("the part"));
                assert!((a - b).abs() > 0.009, "no step at radius {radius}: {a} {b}");
                assert!((a - centre.z).abs() < 1e-12 || (b - centre.z).abs() < 1e-12);
            }
        }
    }
}
