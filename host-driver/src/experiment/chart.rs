//! Curves as SVG.

use std::fmt::Write;

/// Points of one curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its name.
    pub name: String,
    /// x and y.
    pub points: Vec<(f64, f64)>,
    /// Whether the points are joined; the paper's few are not.
    pub joined: bool,
}

/// A chart with a logarithmic y axis: errors span decades.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// What it shows.
    pub title: String,
    /// Name and unit of x.
    pub x: String,
    /// Name and unit of y.
    pub y: String,
    /// The curves.
    pub series: Vec<Series>,
}

impl Chart {
    /// RMS in mm over the number of patterns, ours and the paper's.
    pub fn over_patterns(title: &str, ours: Vec<(f64, f64)>, paper: Vec<(f64, f64)>) -> Self {
        Self {
            title: title.into(),
            x: "patterns".into(),
            y: "RMS, mm".into(),
            series: vec![
                Series { name: "ours".into(), points: ours, joined: true },
                Series { name: "paper".into(), points: paper, joined: false },
            ],
        }
    }
}

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 360.0;
/// Left, top, right and bottom of the plot.
const PLOT: [f64; 4] = [64.0, 34.0, 470.0, 312.0];
/// Most ticks of the x axis: with more values than that it has round ones.
const TICKS: usize = 8;
const COLOURS: [&str; 8] =
    ["#1f6fb4", "#d1495b", "#2a9d5c", "#8a5fbf", "#e08e2b", "#3aa6b9", "#7a6a58", "#111111"];

impl Chart {
    /// The chart as an SVG element.
    pub fn to_svg(&self) -> String {
        let all = || self.series.iter().flat_map(|s| s.points.iter()).filter(|p| p.1 > 0.0);
        let range = |of: fn(&(f64, f64)) -> f64| {
            all().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            })
        };
        let ((x0, x1), (y0, y1)) = (range(|p| p.0), range(|p| p.1));
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" class=\"chart\"><text x=\"{}\" y=\"20\" \
             class=\"title\">{}</text>",
            PLOT[0],
            escaped(&self.title)
        );
        if x0 > x1 || y0 > y1 {
            return svg + "</svg>";
        }
        let margin = 0.04 * (x1 - x0).max(1e-9);
        let (x0, x1) = (x0 - margin, x1 + margin);
        let (d0, d1) = (y0.log10() - 0.08, y1.log10() + 0.08);
        let at_x = |x: f64| PLOT[0] + (x - x0) / (x1 - x0) * (PLOT[2] - PLOT[0]);
        let at_y = |y: f64| PLOT[3] - (y.log10() - d0) / (d1 - d0) * (PLOT[3] - PLOT[1]);
        let _ = write!(
            svg,
            "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" class=\"frame\"/>",
            PLOT[0],
            PLOT[1],
            PLOT[2] - PLOT[0],
            PLOT[3] - PLOT[1]
        );
        for decade in -6..4 {
            for digit in [1.0, 2.0, 5.0] {
                let y = digit * 10_f64.powi(decade);
                if (d0..=d1).contains(&y.log10()) {
                    let at = at_y(y);
                    let _ = write!(
                        svg,
                        "<line x1=\"{}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\" class=\"grid\"/>\
                         <text x=\"{}\" y=\"{:.1}\" class=\"tick end\">{y}</text>",
                        PLOT[0],
                        PLOT[2],
                        PLOT[0] - 6.0,
                        at + 4.0
                    );
                }
            }
        }
        let mut xs: Vec<f64> = all().map(|p| p.0).collect();
        xs.sort_unstable_by(f64::total_cmp);
        xs.dedup();
        if xs.len() > TICKS {
            xs = round_ticks(x0, x1);
        }
        for x in &xs {
            let _ = write!(
                svg,
                "<text x=\"{:.1}\" y=\"{}\" class=\"tick middle\">{x:.4}</text>",
                at_x(*x),
                PLOT[3] + 16.0
            )
            .map(|()| trim_zeros(&mut svg));
        }
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{}\" class=\"label middle\">{}</text>\
             <text transform=\"translate(16 {}) rotate(-90)\" class=\"label middle\">{}</text>",
            (PLOT[0] + PLOT[2]) / 2.0,
            PLOT[3] + 36.0,
            escaped(&self.x),
            (PLOT[1] + PLOT[3]) / 2.0,
            escaped(&self.y)
        );
        for (k, series) in self.series.iter().enumerate() {
            let colour = COLOURS[k % COLOURS.len()];
            let points: Vec<(f64, f64)> = series
                .points
                .iter()
                .filter(|p| p.1 > 0.0)
                .map(|p| (at_x(p.0), at_y(p.1)))
                .collect();
            if series.joined {
                let path: Vec<String> =
                    points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
                let _ = write!(
                    svg,
                    "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>",
                    path.join(" ")
                );
            }
            for (x, y) in &points {
                let _ = if series.joined {
                    write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{colour}\"/>")
                } else {
                    let (a, b) = (x - 4.0, y - 4.0);
                    write!(
                        svg,
                        "<rect x=\"{a:.1}\" y=\"{b:.1}\" width=\"8\" height=\"8\" fill=\"none\" \
                         stroke=\"{colour}\" stroke-width=\"2\"/>"
                    )
                };
            }
            let y = PLOT[1] + 14.0 + 18.0 * k as f64;
            // As the points are drawn: joined ones full, others hollow.
            let fill = if series.joined { colour } else { "none" };
            let _ = write!(
                svg,
                "<rect x=\"{}\" y=\"{}\" width=\"9\" height=\"9\" fill=\"{fill}\" stroke=\"{colour}\" \
                 stroke-width=\"2\"/><text x=\"{}\" y=\"{}\" class=\"key\">{}</text>",
                PLOT[2] + 14.0,
                y - 9.0,
                PLOT[2] + 30.0,
                y,
                escaped(&series.name)
            );
        }
        svg + "</svg>"
    }
}

/// Multiples of 1, 2 or 5 times a power of ten, at most [`TICKS`] of them.
fn round_ticks(from: f64, to: f64) -> Vec<f64> {
    let decade = 10_f64.powf(((to - from) / TICKS as f64).log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|digit| digit * decade);
    let fits = |step: &f64| (to - from) / step <= TICKS as f64;
    let step = steps.into_iter().find(fits).unwrap_or(steps[3]);
    let (first, last) = ((from / step).ceil() as i64, (to / step).floor() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

/// Takes the zeros off the number before the last tag.
fn trim_zeros(svg: &mut String) {
    if let Some(tail) = svg.strip_suffix("</text>") {
        // There always is a point: four digits are written.
        let kept = tail.trim_end_matches('0').trim_end_matches('.').to_owned();
        *svg = kept + "</text>";
    }
}

/// Text for HTML.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charts_hold_every_point_and_survive_none() {
        let series = |name: &str, joined| Series {
            name: name.into(),
            points: vec![(1.0, 0.02), (1.5, 0.1), (2.0, 1.0), (2.5, 0.0)],
            joined,
        };
        let chart = Chart {
            title: "a < b".into(),
            x: "distance, m".into(),
            y: "RMS, mm".into(),
            series: vec![series("ours", true), series("paper", false)],
        };
        let svg = chart.to_svg();
        // A value of 0 has no place on a logarithmic axis.
        assert_eq!(svg.matches("<circle").count(), 3);
        assert!(
            svg.contains("a &lt; b") && svg.contains(">1.5</text>") && svg.contains(">0.05</text>")
        );
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        // Many values have round ticks: 0, 10 ... 40, and none of their own.
        let points = (0..10).map(|k| (4.63 * f64::from(k), 1.0 + f64::from(k))).collect();
        let many = Series { points, ..series("ours", true) };
        let svg = Chart { series: vec![many], ..chart.clone() }.to_svg();
        assert!(
            svg.contains(">10</text>") && svg.contains(">40</text>") && !svg.contains(">4.63<")
        );
        let empty = Chart { series: Vec::new(), ..chart };
        assert!(empty.to_svg().ends_with("</svg>"));
    }
}
