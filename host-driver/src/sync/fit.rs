//! A camera's clock as a line over the device's clock, fitted to the last matched frames.

use std::collections::VecDeque;

/// Points kept: at 30 Hz two seconds, over which a crystal's drift is a line.
const POINTS: usize = 64;

/// Below this many points the slope is taken as 1: jitter would tilt a short line.
const POINTS_FOR_SLOPE: usize = 16;

/// No two crystals differ by more than this; a steeper fit is jitter or a fault.
const SLOPE_ERROR_MAX: f64 = 1e-3;

/// A running, outlier-trimmed fit of camera time over device time, both in nanoseconds.
#[derive(Debug, Clone, Default)]
pub struct ClockFit {
    points_ns: VecDeque<(u64, u64)>,
    line: Option<Line>,
}

/// `y = y0 + offset + slope * (x - x0)`: integers carry the magnitude, floats the rest.
#[derive(Debug, Clone, Copy)]
struct Line {
    x0_ns: u64,
    y0_ns: u64,
    offset_ns: f64,
    slope: f64,
    rms_ns: f64,
}

impl Line {
    fn at(&self, x_ns: u64) -> f64 {
        self.y0_ns as f64 + self.relative(x_ns)
    }

    fn relative(&self, x_ns: u64) -> f64 {
        self.offset_ns + self.slope * difference(x_ns, self.x0_ns)
    }

    fn residual_ns(&self, (x_ns, y_ns): (u64, u64)) -> f64 {
        difference(y_ns, self.y0_ns) - self.relative(x_ns)
    }
}

fn difference(a_ns: u64, b_ns: u64) -> f64 {
    a_ns.wrapping_sub(b_ns) as i64 as f64
}

impl ClockFit {
    /// Adds a frame whose trigger is known, and fits again.
    pub fn add(&mut self, device_ns: u64, camera_ns: u64) {
        if self.points_ns.len() == POINTS {
            self.points_ns.pop_front();
        }
        self.points_ns.push_back((device_ns, camera_ns));
        let all: Vec<(u64, u64)> = self.points_ns.iter().copied().collect();
        let first = fit(&all);
        // One round of trimming: points beyond three times the median residual (and the timestamps'
        // own granularity) do not bend the line.
        let mut residuals: Vec<f64> = all.iter().map(|&p| first.residual_ns(p).abs()).collect();
        residuals.sort_by(f64::total_cmp);
        let limit_ns = (3.0 * residuals[residuals.len() / 2]).max(10_000.0);
        let kept: Vec<_> =
            all.iter().copied().filter(|&p| first.residual_ns(p).abs() <= limit_ns).collect();
        self.line =
            Some(if kept.len() < all.len() && !kept.is_empty() { fit(&kept) } else { first });
    }

    /// The camera's time of a frame triggered at `device_ns`; `None` before the first point.
    pub fn camera_ns(&self, device_ns: u64) -> Option<f64> {
        self.line.map(|line| line.at(device_ns))
    }

    /// How far `camera_ns` is from the line at `device_ns`, in nanoseconds.
    pub fn residual_ns(&self, device_ns: u64, camera_ns: u64) -> Option<f64> {
        self.line.map(|line| line.residual_ns((device_ns, camera_ns)))
    }

    /// Rate of the camera's clock against the device's, as a deviation from 1.
    pub fn drift(&self) -> Option<f64> {
        self.line.map(|line| line.slope - 1.0)
    }

    /// RMS of the fit's residuals in nanoseconds.
    pub fn rms_ns(&self) -> Option<f64> {
        self.line.map(|line| line.rms_ns)
    }
}

/// Least squares; `points` is not empty.
fn fit(points: &[(u64, u64)]) -> Line {
    let (x0_ns, y0_ns) = points[0];
    let n = points.len() as f64;
    let relative = || points.iter().map(|&(x, y)| (difference(x, x0_ns), difference(y, y0_ns)));
    let (sum_x, sum_y) = relative().fold((0.0, 0.0), |(a, b), (x, y)| (a + x, b + y));
    let (mean_x, mean_y) = (sum_x / n, sum_y / n);
    let (mut sxx, mut sxy) = (0.0, 0.0);
    for (x, y) in relative() {
        sxx += (x - mean_x) * (x - mean_x);
        sxy += (x - mean_x) * (y - mean_y);
    }
    let slope = if points.len() < POINTS_FOR_SLOPE || sxx <= 0.0 {
        1.0
    } else {
        (sxy / sxx).clamp(1.0 - SLOPE_ERROR_MAX, 1.0 + SLOPE_ERROR_MAX)
    };
    let mut line = Line { x0_ns, y0_ns, offset_ns: mean_y - slope * mean_x, slope, rms_ns: 0.0 };
    let squares: f64 = points.iter().map(|&p| line.residual_ns(p).powi(2)).sum();
    line.rms_ns = (squares / n).sqrt();
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drifting_clock_is_predicted_to_a_microsecond() {
        let mut fit = ClockFit::default();
        let camera = |device_ns: u64| 7_000_000_123 + device_ns + device_ns / 20_000; // +50 ppm
        for k in 0..100u64 {
            fit.add(k * 33_333_000, camera(k * 33_333_000));
        }
        let next_ns = 101 * 33_333_000;
        assert!((fit.camera_ns(next_ns).unwrap() - camera(next_ns) as f64).abs() < 1000.0);
        assert!((fit.drift().unwrap() - 5e-5).abs() < 1e-6);
        assert!(fit.rms_ns().unwrap() < 10.0);
    }

    #[test]
    fn jitter_averages_and_an_outlier_is_trimmed() {
        let mut fit = ClockFit::default();
        for k in 0..64u64 {
            let jitter_ns = (k * 7919 % 41) * 1000; // 0..40 us, mean 20
            let outlier_ns = if k == 40 { 9_000_000 } else { 0 };
            fit.add(k * 33_333_000, 500_000_000 + k * 33_333_000 + jitter_ns + outlier_ns);
        }
        let at_ns = 64 * 33_333_000;
        let error_ns = fit.camera_ns(at_ns).unwrap() - (500_000_000 + at_ns + 20_000) as f64;
        assert!(error_ns.abs() < 10_000.0, "{error_ns}");
    }

    #[test]
    fn a_short_line_has_slope_one() {
        let mut fit = ClockFit::default();
        fit.add(0, 1_000_000);
        fit.add(1_000_000, 2_400_000);
        assert_eq!(fit.drift(), Some(0.0));
        assert!(ClockFit::default().camera_ns(5).is_none());
    }
}
