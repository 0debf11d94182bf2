//! Clouds that look as if they were in other units, or as if they held nothing.

use nalgebra::{Point3, Vector3};

/// Why a cloud cannot be measured as it is.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum UnitsError {
    /// No finite points.
    #[error(
        "{what} has no usable points ({given} given, none of them finite): was anything measured, and is \
         it the right file?"
    )]
    Empty {
        /// Which cloud.
        what: String,
        /// Points given.
        given: usize,
    },
    /// Larger than any scene of this sensor.
    #[error(
        "{what} spans {extent} units: as metres that is too large for this sensor; if it is in \
         millimetres, give {option} 0.001 (inches: 0.0254)"
    )]
    Large {
        /// Which cloud.
        what: String,
        /// Diagonal of the bulk of the points.
        extent: f64,
        /// The option that scales it.
        option: &'static str,
    },
    /// Smaller than any scene of this sensor.
    #[error(
        "{what} spans {extent} units: as metres that is too small for this sensor; was {option} given \
         for a cloud that is in metres already, or are all its points in one place?"
    )]
    Small {
        /// Which cloud.
        what: String,
        /// Diagonal of the bulk of the points.
        extent: f64,
        /// The option that scales it.
        option: &'static str,
    },
}

/// Extents that make sense: from a screw's head to a hall.
const EXTENTS_M: std::ops::RangeInclusive<f64> = 0.002..=30.0;

/// The diagonal of the box that holds the middle 98 % of the points along each axis, and the number
/// of finite points.
pub fn bulk_extent(points: &[Point3<f64>]) -> (f64, usize) {
    let finite: Vec<&Point3<f64>> =
        points.iter().filter(|p| p.coords.iter().all(|c| c.is_finite())).collect();
    if finite.is_empty() {
        return (0.0, 0);
    }
    let stride = finite.len().div_ceil(50_000);
    let sides = [0, 1, 2].map(|axis| {
        let mut values: Vec<f64> = finite.iter().step_by(stride).map(|p| p[axis]).collect();
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len() - 1;
        values[(last as f64 * 0.99).ceil() as usize] - values[(last as f64 * 0.01) as usize]
    });
    (Vector3::from(sides).norm(), finite.len())
}

/// Refuses clouds without points and clouds whose extent says that they are not in metres.
///
/// # Errors
/// [`UnitsError`]; `what` names the cloud, `option` is the option that would scale it.
pub fn check(what: &str, points: &[Point3<f64>], option: &'static str) -> Result<(), UnitsError> {
    let (extent, finite) = bulk_extent(points);
    let what = what.to_owned();
    if finite == 0 {
        return Err(UnitsError::Empty { what, given: points.len() });
    }
    if EXTENTS_M.contains(&extent) || finite < 3 {
        return Ok(());
    }
    let large = extent > *EXTENTS_M.end();
    let extent = (extent * 1e6).round() / 1e6;
    Err(if large {
        UnitsError::Large { what, extent, option }
    } else {
        UnitsError::Small { what, extent, option }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn millimetres_and_nothing_are_noticed() {
        let metres: Vec<_> = (0..1000)
            .map(|k| Point3::new(f64::from(k % 40) * 0.01, f64::from(k / 40) * 0.01, 1.0))
            .collect();
        assert_eq!(check("cloud", &metres, "--scale"), Ok(()));
        let scaled = |by: f64| -> Vec<_> { metres.iter().map(|p| p * by).collect() };
        let large = check("a.ply", &scaled(1000.0), "--scale").unwrap_err().to_string();
        assert!(large.contains("a.ply") && large.contains("--scale 0.001"), "{large}");
        let small = check("a.ply", &scaled(1e-3), "--scale").unwrap_err();
        assert!(matches!(small, UnitsError::Small { .. }), "{small}");
        // A stray far away does not make a scene large.
        let mut stray = metres.clone();
        stray.push(Point3::new(1e6, 0.0, 0.0));
        assert_eq!(check("cloud", &stray, "--scale"), Ok(()));
        let nan = vec![Point3::new(f64::NAN, 0.0, 0.0); 7];
        assert!(matches!(check("c", &nan, "--scale"), Err(UnitsError::Empty { given: 7, .. })));
    }
}
