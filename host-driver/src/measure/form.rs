//! Form, size and spacing errors, named after VDI/VDE 2634 part 2.
//!
//! The guideline takes the form from the range of the deviations of the measured points from the
//! fitted shape, and lets at most 3 of 1000 points be left out as strays.

use serde::Serialize;

/// Share of the points that may be left out.
pub const STRAYS: f64 = 0.003;

/// The deviations of measured points from a fitted shape, in millimetres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Form {
    /// Points that the form is taken from.
    pub points: usize,
    /// Strays left out, at most 3 of 1000: those that deviate most.
    pub strays: usize,
    /// Range of the remaining deviations: probing error of form for a sphere, flatness for a plane.
    pub range_mm: f64,
    /// RMS of all deviations, strays included.
    pub rms_mm: f64,
}

/// The form from signed deviations in metres; `None` without any.
pub fn form(deviations_m: impl IntoIterator<Item = f64>) -> Option<Form> {
    let mut values: Vec<f64> = deviations_m.into_iter().filter(|d| d.is_finite()).collect();
    if values.is_empty() {
        return None;
    }
    let rms_mm = super::rms(values.iter().copied()) * 1e3;
    let points = values.len();
    let strays = (points as f64 * STRAYS).floor() as usize;
    values.sort_unstable_by(|a, b| a.abs().total_cmp(&b.abs()));
    let kept = &values[..points - strays];
    let low = kept.iter().copied().fold(f64::INFINITY, f64::min);
    let high = kept.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    Some(Form { points: kept.len(), strays, range_mm: (high - low) * 1e3, rms_mm })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_of_a_thousand_may_stray() {
        let deviation = |k: i32| if k < 3 { 0.5 } else { f64::from(k % 2) * 2e-4 - 1e-4 };
        let form_of = |strays: i32| form((3 - strays..1000).map(deviation)).unwrap();
        let clean = form_of(3);
        assert_eq!((clean.strays, clean.points), (3, 997));
        assert!((clean.range_mm - 0.2).abs() < 1e-9, "{clean:?}");
        // A fourth stray counts.
        let spoilt = form((0..1000).map(deviation).chain([0.5])).unwrap();
        assert!(spoilt.range_mm > 499.0, "{spoilt:?}");
        assert_eq!(form([f64::NAN]), None);
    }
}
