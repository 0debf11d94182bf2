//! Which part of a cloud or a frame is measured.

use nalgebra::Point3;

use crate::DepthFrame;

/// A part of space or of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Region {
    /// Everything.
    All,
    /// A box of the left camera's frame by two opposite corners, metres.
    Box {
        /// Smallest coordinates.
        min_m: Point3<f64>,
        /// Largest coordinates.
        max_m: Point3<f64>,
    },
    /// A rectangle of the left rectified canvas.
    Rectangle {
        /// Left column and upper row, pixels.
        from_px: [usize; 2],
        /// Width and height, pixels.
        size_px: [usize; 2],
    },
}

/// Why a region is none.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// The numbers make no region.
    #[error("region `{text}`: expected {expected}")]
    Numbers {
        /// What was given.
        text: String,
        /// What is expected.
        expected: &'static str,
    },
    /// A rectangle of a source that has no pixels.
    #[error("a region in pixels needs a recording or a sensor: a cloud has no pixels; give a box")]
    NoPixels,
    /// Nothing of the source is in the region.
    #[error("no valid point in the region: choose another one; the source spans {span}")]
    Outside {
        /// What there is instead.
        span: String,
    },
}

fn numbers<const N: usize>(text: &str, expected: &'static str) -> Result<[f64; N], RegionError> {
    let wrong = || RegionError::Numbers { text: text.to_owned(), expected };
    let values: Vec<f64> = text
        .split(',')
        .map(|v| v.trim().parse().ok().filter(|v: &f64| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or_else(wrong)?;
    values.try_into().map_err(|_| wrong())
}

impl Region {
    /// Reads `x0,y0,z0,x1,y1,z1` in metres.
    ///
    /// # Errors
    /// [`RegionError::Numbers`].
    pub fn parse_box(text: &str) -> Result<Self, RegionError> {
        let expected = "x0,y0,z0,x1,y1,z1 in metres: two opposite corners of a box with a volume";
        let v = numbers::<6>(text, expected)?;
        let corner = |pick: fn(f64, f64) -> f64| {
            Point3::new(pick(v[0], v[3]), pick(v[1], v[4]), pick(v[2], v[5]))
        };
        let (min_m, max_m) = (corner(f64::min), corner(f64::max));
        if (0..3).any(|k| max_m[k] <= min_m[k]) {
            return Err(RegionError::Numbers { text: text.to_owned(), expected });
        }
        Ok(Self::Box { min_m, max_m })
    }

    /// Reads `x,y,width,height` in pixels.
    ///
    /// # Errors
    /// [`RegionError::Numbers`].
    pub fn parse_rectangle(text: &str) -> Result<Self, RegionError> {
        let expected = "x,y,width,height: whole pixels of the rectified left picture, not 0 x 0";
        let v = numbers::<4>(text, expected)?;
        let whole = v.map(|v| (v.fract() == 0.0 && (0.0..1e6).contains(&v)).then_some(v as usize));
        match whole {
            [Some(x), Some(y), Some(w), Some(h)] if w > 0 && h > 0 => {
                Ok(Self::Rectangle { from_px: [x, y], size_px: [w, h] })
            }
            _ => Err(RegionError::Numbers { text: text.to_owned(), expected }),
        }
    }

    /// Whether a point of the left camera's frame is in it; pixels are not looked at.
    pub fn holds(&self, point_m: &Point3<f64>) -> bool {
        match self {
            Self::Box { min_m, max_m } => {
                (0..3).all(|k| point_m[k] >= min_m[k] && point_m[k] <= max_m[k])
            }
            _ => true,
        }
    }

    /// The points of a cloud that are in it.
    ///
    /// # Errors
    /// [`RegionError::NoPixels`], [`RegionError::Outside`].
    pub fn of_cloud(&self, points_m: &[Point3<f64>]) -> Result<Vec<Point3<f64>>, RegionError> {
        if matches!(self, Self::Rectangle { .. }) {
            return Err(RegionError::NoPixels);
        }
        let inside: Vec<_> = points_m
            .iter()
            .copied()
            .filter(|p| super::robust::is_finite(p) && self.holds(p))
            .collect();
        if inside.is_empty() { Err(outside(points_m)) } else { Ok(inside) }
    }

    /// The columns and rows of a frame that are looked at.
    pub fn pixels(&self, frame: &DepthFrame) -> [std::ops::Range<usize>; 2] {
        let (w, h) = (frame.depth_m.width(), frame.depth_m.height());
        match self {
            Self::Rectangle { from_px: [x, y], size_px } => {
                [(*x).min(w)..(x + size_px[0]).min(w), (*y).min(h)..(y + size_px[1]).min(h)]
            }
            _ => [0..w, 0..h],
        }
    }

    /// The points of a frame that are in it.
    ///
    /// # Errors
    /// [`RegionError::Outside`].
    pub fn of_frame(&self, frame: &DepthFrame) -> Result<Vec<Point3<f64>>, RegionError> {
        let inside: Vec<_> = self.samples(frame).map(|(_, _, point_m)| point_m).collect();
        if inside.is_empty() {
            let all: Vec<_> = Self::All.samples(frame).map(|(_, _, point_m)| point_m).collect();
            return Err(outside(&all));
        }
        Ok(inside)
    }

    /// Column, row and point of the valid pixels in it.
    pub fn samples<'a>(
        &'a self,
        frame: &'a DepthFrame,
    ) -> impl Iterator<Item = (usize, usize, Point3<f64>)> + 'a {
        let [columns, rows] = self.pixels(frame);
        rows.flat_map(move |y| columns.clone().map(move |x| (x, y))).filter_map(move |(x, y)| {
            let d = f64::from(frame.disparity_px.row(y)[x]);
            let point_m = frame.geometry.point_left_m(x as f64, y as f64, d)?;
            self.holds(&point_m).then_some((x, y, point_m))
        })
    }

    /// The middle of a frame: the box of its valid pixels with the area halved (paper, Figure 5: "50 %
    /// of the valid areas"). `None` when nothing is valid.
    pub fn central_half(frame: &DepthFrame) -> Option<Self> {
        let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
        for y in 0..frame.depth_m.height() {
            for (x, z) in frame.depth_m.row(y).iter().enumerate() {
                if z.is_finite() {
                    (low, high) =
                        ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]);
                }
            }
        }
        if low[0] > high[0] {
            return None;
        }
        let margin = 0.5 - 0.5_f64.sqrt() / 2.0;
        let cut = [0, 1].map(|k| ((high[k] - low[k]) as f64 * margin) as usize);
        Some(Self::Rectangle {
            from_px: [low[0] + cut[0], low[1] + cut[1]],
            size_px: [0, 1].map(|k| (high[k] - low[k] + 1 - 2 * cut[k]).max(1)),
        })
    }
}

fn outside(points_m: &[Point3<f64>]) -> RegionError {
    let finite = || points_m.iter().filter(|p| super::robust::is_finite(p));
    let Some(first) = finite().next() else {
        return RegionError::Outside { span: "nothing: it has no valid point".into() };
    };
    let (low, high) = finite().fold((*first, *first), |(low, high), p| (low.inf(p), high.sup(p)));
    let axis = |name: &str, k: usize| format!("{name} {:.3} to {:.3} m", low[k], high[k]);
    let span = [axis("x", 0), axis("y", 1), axis("z", 2)].join(", ");
    RegionError::Outside { span }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_read_or_refused_with_what_is_expected() {
        let region = Region::parse_box("0.1, -0.2,1.2,-0.1,0.2,0.9").unwrap();
        assert!(region.holds(&Point3::new(0.0, 0.1, 1.0)));
        assert!(!region.holds(&Point3::new(0.0, 0.1, 1.3)));
        for text in ["", "1,2,3", "0,0,0,0,1,1", "0,0,0,1,1,nan", "a,b,c,d,e,f"] {
            assert!(Region::parse_box(text).is_err(), "{text}");
        }
        for text in ["1,2,0,4", "1,2,3", "1.5,2,3,4", "-1,2,3,4"] {
            assert!(Region::parse_rectangle(text).is_err(), "{text}");
        }
        let points = [Point3::new(0.0, 0.0, 1.0)];
        let rectangle = Region::parse_rectangle("1,2,3,4").unwrap();
        assert_eq!(rectangle.of_cloud(&points), Err(RegionError::NoPixels));
        let away = Region::parse_box("1,1,1,2,2,2").unwrap().of_cloud(&points).unwrap_err();
        assert!(away.to_string().contains("z 1.000 to 1.000 m"), "{away}");
    }
}
