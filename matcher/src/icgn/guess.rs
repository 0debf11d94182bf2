//! Which pixels of a subset share the centre's surface, and the initial shape function: the
//! least-squares surface through their coarse disparities (paper eq 18-19).

use super::{
    prepare::{MARGIN, Prepared},
    shape::Shape,
    solve::Cholesky,
    window::{ROWS_MAX, Window},
};
use crate::{Image, Level, bspline::LANES, check::STEP_PX, lanes::vectorised, regions::STEEP_PX};

/// Coarse disparities with margins of NaN, so that subsets at the border need no special case.
#[derive(Debug, Default)]
pub struct CoarseMap {
    pitch: usize,
    values: Vec<f32>,
}

impl CoarseMap {
    /// Sets one disparity.
    pub(super) fn set(&mut self, x: usize, y: usize, value: f32) {
        self.values[(MARGIN + y) * self.pitch + MARGIN + x] = value;
    }

    /// Copies `map`, reusing this one's memory.
    pub fn fill(&mut self, map: &Image<f32>) {
        self.pitch = map.width() + 2 * MARGIN;
        self.values.clear();
        self.values.resize(self.pitch * (map.height() + 2 * MARGIN) + LANES, f32::NAN);
        for y in 0..map.height() {
            let at = (MARGIN + y) * self.pitch + MARGIN;
            self.values[at..at + map.width()].copy_from_slice(map.row(y));
        }
    }

    /// Disparity at (x, y); NaN in the margins.
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.values[(MARGIN + y) * self.pitch + MARGIN + x]
    }

    /// From the first of the [`LANES`] columns of the square's first row to those of its last.
    fn square(&self, x: usize, y: usize, radius: usize) -> &[f32] {
        let at = (MARGIN + y - radius) * self.pitch + MARGIN + x - radius;
        &self.values[at..at + 2 * radius * self.pitch + LANES]
    }

    /// [`LANES`] columns from x - radius on, of row y + dy.
    fn lanes(&self, x: usize, y: usize, dy: isize, radius: usize) -> &[f32; LANES] {
        let row = (MARGIN + y).wrapping_add_signed(dy);
        let at = row * self.pitch + MARGIN + x - radius;
        self.values[at..at + LANES].try_into().expect("a slice of LANES values")
    }
}

/// Finds initial guesses for subsets of one radius and order.
#[derive(Debug)]
pub struct Guesser {
    level: Level,
    radius: usize,
    parameters: usize,
    surface_px: f32,
    /// Rows of the pseudo-inverse of the fit over the full square: parameter, subset row, lane.
    inverse: Vec<[[f32; LANES]; ROWS_MAX]>,
    full: Window,
}

/// The start of a subset.
pub enum Guess {
    /// All pixels of the square belong to the surface.
    Full(Shape),
    /// Only those selected into the window given.
    Part(Shape),
    /// There is no surface to start from.
    None,
}

impl Guesser {
    /// A guesser for subsets of `radius`, shape functions of 3 or 6 `parameters`, and pixels within
    /// `surface_px` of the fit.
    pub fn new(
        radius: usize,
        parameters: usize,
        surface_px: f32,
        prepared: &Prepared,
        level: Level,
    ) -> Self {
        let full = Window::full(radius, prepared);
        let mut inverse = vec![[[0.0; LANES]; ROWS_MAX]; parameters];
        let mut normal = [[0.0; 6]; 6];
        add_to_normal(&mut normal, square(radius));
        pad_normal(&mut normal, parameters);
        let factor = Cholesky::new(normal).expect("a square of pixels fixes the surface");
        for (dx, dy) in square(radius) {
            let solution = factor.solve(used(phi(dx, dy), parameters));
            let (row, lane) = ((dy + radius as i32) as usize, (dx + radius as i32) as usize);
            inverse.iter_mut().zip(solution).for_each(|(i, s)| i[row][lane] = s as f32);
        }
        Self { level: level.usable(), radius, parameters, surface_px, inverse, full }
    }

    /// Radius of the square.
    pub fn radius(&self) -> usize {
        self.radius
    }

    /// The full square.
    pub fn full(&self) -> &Window {
        &self.full
    }

    /// Selects into `part` the pixels of the square about (x, y) whose disparity is within the
    /// tolerance of `shape`, and the centre and its direct neighbours where they have none.
    pub(super) fn select_near(
        &self,
        map: &CoarseMap,
        prepared: &Prepared,
        (x, y): (usize, usize),
        shape: &Shape,
        part: &mut Window,
    ) {
        let (width, height) = (prepared.width as i64, prepared.height as i64);
        part.select(self.radius, prepared, |dx, dy| {
            let (px, py) = (x as i64 + dx as i64, y as i64 + dy as i64);
            if px < 0 || py < 0 || px >= width || py >= height {
                return false;
            }
            let warped = x as f64 + shape.warp(dx as f64, dy as f64);
            let known = map.at(px as usize, py as usize) as f64;
            let member = if known.is_nan() {
                dx.abs() <= 1 && dy.abs() <= 1
            } else {
                (known - (px as f64 - warped)).abs() <= self.surface_px as f64 || (dx, dy) == (0, 0)
            };
            member && prepared.right_sees(py as usize, warped)
        });
    }

    /// Whether the whole square about (x, y) belongs to the centre's surface and is seen by the right
    /// camera when warped by `shape`.
    pub(super) fn is_full(
        &self,
        map: &CoarseMap,
        prepared: &Prepared,
        (x, y): (usize, usize),
        shape: &Shape,
    ) -> bool {
        self.guess_full(map, x, y).is_some() && self.right_side_is_inside(prepared, shape, x, y)
    }

    /// Starts the subset about (x, y), whose coarse disparity is a number; selects into `part` when
    /// not all of the square belongs to the surface.
    pub fn guess(
        &self,
        map: &CoarseMap,
        prepared: &Prepared,
        x: usize,
        y: usize,
        part: &mut Window,
    ) -> Guess {
        if let Some(shape) = self.guess_full(map, x, y)
            && self.right_side_is_inside(prepared, &shape, x, y)
        {
            return Guess::Full(shape);
        }
        match self.guess_part(map, prepared, x, y, part) {
            Some(shape) => Guess::Part(shape),
            None => Guess::None,
        }
    }

    /// The fit over the whole square, if all of it is within the tolerance.
    fn guess_full(&self, map: &CoarseMap, x: usize, y: usize) -> Option<Shape> {
        let centre = map.at(x, y);
        let mut fit = Fit::default();
        vectorised!(
            self.level,
            fit_square(
                values: &[f32] = map.square(x, y, self.radius),
                pitch: usize = map.pitch,
                radius: usize = self.radius,
                inverse: &[[[f32; LANES]; ROWS_MAX]] = &self.inverse,
                fit: &mut Fit = &mut fit,
            )
        );
        // Not a number where a disparity is missing: no comparison holds then.
        let whole = fit.worst <= self.surface_px && fit.parameters.iter().all(|p| p.is_finite());
        whole.then(|| shape(fit.parameters.map(f64::from), centre))
    }

    /// Whether all right columns of the full square are inside the image and mask, with a pixel to
    /// spare on both sides. The extremes of a row are at its ends as long as the warp does not fold.
    fn right_side_is_inside(&self, prepared: &Prepared, shape: &Shape, x: usize, y: usize) -> bool {
        let r = self.radius as i32;
        (-r..=r).all(|dy| {
            let ends = [-r, r].map(|dx| x as f64 + shape.warp(dx as f64, dy as f64));
            let first = ends[0].min(ends[1]).floor() as i64 - 1;
            let last = ends[0].max(ends[1]).floor() as i64 + 2;
            prepared.right_is_inside((y as i64 + dy as i64) as usize, first, last)
        })
    }

    /// The fit over the pixels of the centre's surface.
    ///
    /// The surface is first what is connected to the centre by steps of at most [`STEP_PX`]: that
    /// follows most slopes but does not cross a depth step. Then it is all pixels within the tolerance
    /// of the fit through those. Where that comes to nothing, the same is tried with steps from the
    /// square's prevailing slope: a face seen edge on falls by more from row to row.
    fn guess_part(
        &self,
        map: &CoarseMap,
        prepared: &Prepared,
        x: usize,
        y: usize,
        part: &mut Window,
    ) -> Option<Shape> {
        let side = 2 * self.radius + 1;
        let centre = map.at(x, y);
        let mut values = [[f32::NAN; LANES]; ROWS_MAX];
        for (r, row) in values[..side].iter_mut().enumerate() {
            let from = map.lanes(x, y, r as isize - self.radius as isize, self.radius);
            for lane in 0..side {
                row[lane] = from[lane] - centre;
            }
        }
        let (fit, member) = self
            .surface_of(&values, self.connected(&values))
            .or_else(|| self.surface_of(&values, self.connected(&level(&values, side)?)))?;
        let shape = shape(fit, centre);
        part.select(self.radius, prepared, |dx, dy| {
            let (r, c) = self.index(dx, dy);
            member[r][c] && {
                let warped = x as f64 + shape.warp(dx as f64, dy as f64);
                prepared.right_sees((y as i64 + dy as i64) as usize, warped)
            }
        });
        (part.count() >= self.pixels_min()).then_some(shape)
    }

    /// The fit over `member` and then twice over what is within the tolerance of it, and those pixels;
    /// `None` where they are too few or the centre is not among them.
    fn surface_of(
        &self,
        values: &Square<f32>,
        mut member: Square<bool>,
    ) -> Option<([f64; 6], Square<bool>)> {
        let mut fit = [0.0; 6];
        for _ in 0..2 {
            fit = self.fit(values, &member)?;
            for (dx, dy) in square(self.radius) {
                let (r, c) = self.index(dx, dy);
                let error = values[r][c] - surface(&fit, dx, dy) as f32;
                member[r][c] = error.abs() <= self.surface_px;
            }
        }
        let (r, c) = self.index(0, 0);
        let count = member.as_flattened().iter().filter(|m| **m).count();
        (member[r][c] && count >= self.pixels_min()).then_some((fit, member))
    }

    /// Fewer pixels than this cannot carry the parameters.
    fn pixels_min(&self) -> usize {
        2 * self.parameters.max(self.radius)
    }

    fn index(&self, dx: i32, dy: i32) -> (usize, usize) {
        ((dy + self.radius as i32) as usize, (dx + self.radius as i32) as usize)
    }

    /// Pixels connected to the centre.
    fn connected(&self, values: &Square<f32>) -> Square<bool> {
        let side = 2 * self.radius + 1;
        let mut member = [[false; LANES]; ROWS_MAX];
        let mut stack = [(0u8, 0u8); LANES * ROWS_MAX];
        member[self.radius][self.radius] = true;
        stack[0] = (self.radius as u8, self.radius as u8);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (r, c) = (stack[depth].0 as usize, stack[depth].1 as usize);
            for (nr, nc) in [(r.wrapping_sub(1), c), (r + 1, c), (r, c.wrapping_sub(1)), (r, c + 1)]
            {
                if nr < side
                    && nc < side
                    && !member[nr][nc]
                    && (values[nr][nc] - values[r][c]).abs() <= STEP_PX
                {
                    member[nr][nc] = true;
                    stack[depth] = (nr as u8, nc as u8);
                    depth += 1;
                }
            }
        }
        member
    }

    /// Least squares over the members; of lower order where they are too few or lie in a line.
    fn fit(&self, values: &Square<f32>, member: &Square<bool>) -> Option<[f64; 6]> {
        let members = || {
            square(self.radius).filter(|&(dx, dy)| {
                let (r, c) = self.index(dx, dy);
                member[r][c]
            })
        };
        let count = members().count();
        let mut normal = [[0.0; 6]; 6];
        add_to_normal(&mut normal, members());
        let mut right = [0.0; 6];
        for (dx, dy) in members() {
            let (r, c) = self.index(dx, dy);
            let value = values[r][c] as f64;
            right.iter_mut().zip(phi(dx, dy)).for_each(|(s, p)| *s += p * value);
        }
        for parameters in [6, 3, 1] {
            if parameters > self.parameters || count < 3 * parameters {
                continue;
            }
            let mut normal = normal;
            pad_normal(&mut normal, parameters);
            if let Some(factor) = Cholesky::new(normal) {
                return Some(factor.solve(used(right, parameters)));
            }
        }
        None
    }
}

/// Radius of the square that a slope is taken from.
const SLOPE_RADIUS: usize = 2;

/// What a square's pixels are or have, by row and lane.
type Square<T> = [[T; LANES]; ROWS_MAX];

/// The first `side` rows and columns less the slope at their middle: the medians of the differences
/// between neighbours there. `None` where there are too few.
fn level(values: &Square<f32>, side: usize) -> Option<Square<f32>> {
    let from = (side / 2).saturating_sub(SLOPE_RADIUS);
    let to = (side / 2 + SLOPE_RADIUS + 1).min(side);
    let median = |step: (usize, usize)| {
        let mut differences = [0f32; (2 * SLOPE_RADIUS + 1).pow(2)];
        let mut count = 0;
        for r in from..to - step.1 {
            for c in from..to - step.0 {
                let difference = values[r + step.1][c + step.0] - values[r][c];
                if difference.abs() <= STEEP_PX {
                    differences[count] = difference;
                    count += 1;
                }
            }
        }
        let differences = &mut differences[..count];
        (count > SLOPE_RADIUS)
            .then(|| *differences.select_nth_unstable_by(count / 2, f32::total_cmp).1)
    };
    let (sx, sy) = (median((1, 0))?, median((0, 1))?);
    let mut out = *values;
    for (r, row) in out.iter_mut().enumerate() {
        row.iter_mut().enumerate().for_each(|(c, v)| *v -= sx * c as f32 + sy * r as f32);
    }
    Some(out)
}

/// A fit over a whole square.
#[derive(Debug, Default)]
struct Fit {
    /// Relative to the centre's disparity.
    parameters: [f32; 6],
    /// Largest distance of a pixel from it.
    worst: f32,
}

/// Fits the square whose rows start `pitch` apart, and finds the largest residual. NaN in the square
/// makes every parameter NaN.
#[inline(always)]
fn fit_square(
    values: &[f32],
    pitch: usize,
    radius: usize,
    inverse: &[[[f32; LANES]; ROWS_MAX]],
    fit: &mut Fit,
) {
    let side = 2 * radius + 1;
    let centre = values[radius * pitch + radius];
    let mut rows = [[0f32; LANES]; ROWS_MAX];
    let mut sums = [[0f32; LANES]; 6];
    for (r, row) in rows[..side].iter_mut().enumerate() {
        let values: &[f32; LANES] =
            values[r * pitch..][..LANES].try_into().expect("a slice of LANES values");
        for lane in 0..LANES {
            // Lanes beyond the square may hold anything.
            row[lane] = if lane < side { values[lane] - centre } else { 0.0 };
        }
        for (sum, inverse) in sums.iter_mut().zip(inverse) {
            for lane in 0..LANES {
                sum[lane] += inverse[r][lane] * row[lane];
            }
        }
    }
    let p = sums.map(|s| s.iter().sum::<f32>());
    let mut worst = [0f32; LANES];
    for (r, row) in rows[..side].iter().enumerate() {
        let dy = r as f32 - radius as f32;
        let constant = p[0] + dy * (p[2] + 0.5 * dy * p[4]);
        let slope = p[1] + dy * p[5];
        for lane in 0..LANES {
            let dx = lane as f32 - radius as f32;
            let error = (row[lane] - (constant + dx * (slope + 0.5 * dx * p[3]))).abs();
            let error = if lane < side { error } else { 0.0 };
            worst[lane] = if error > worst[lane] { error } else { worst[lane] };
        }
    }
    fit.parameters = p;
    fit.worst = worst.iter().fold(0.0, |a, &b| if b > a { b } else { a });
}

/// Offsets of a square of pixels.
fn square(radius: usize) -> impl Iterator<Item = (i32, i32)> {
    let r = radius as i32;
    (-r..=r).flat_map(move |dy| (-r..=r).map(move |dx| (dx, dy)))
}

/// Derivatives of the surface by its parameters, in the order of [`Shape`].
fn phi(dx: i32, dy: i32) -> [f64; 6] {
    let (x, y) = (dx as f64, dy as f64);
    [1.0, x, y, 0.5 * x * x, 0.5 * y * y, x * y]
}

/// The first values, and zeros.
fn used(mut values: [f64; 6], parameters: usize) -> [f64; 6] {
    values[parameters..].fill(0.0);
    values
}

/// Adds the lower half of sum phi phi^T.
fn add_to_normal(normal: &mut [[f64; 6]; 6], pixels: impl Iterator<Item = (i32, i32)>) {
    for (dx, dy) in pixels {
        let phi = phi(dx, dy);
        for k in 0..6 {
            for j in 0..=k {
                normal[k][j] += phi[k] * phi[j];
            }
        }
    }
}

/// Takes the parameters that are not used out of the system.
fn pad_normal(normal: &mut [[f64; 6]; 6], parameters: usize) {
    for (k, row) in normal.iter_mut().enumerate().skip(parameters) {
        *row = [0.0; 6];
        row[k] = 1.0;
    }
}

fn surface(fit: &[f64; 6], dx: i32, dy: i32) -> f64 {
    fit.iter().zip(phi(dx, dy)).map(|(f, p)| f * p).sum()
}

/// The shape function whose disparity is `fit` above `centre`.
fn shape(fit: [f64; 6], centre: f32) -> Shape {
    let mut shape = Shape(fit.map(|f| -f));
    shape.0[0] -= centre as f64;
    shape
}
