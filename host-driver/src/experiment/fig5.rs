//! Figure 5: planes at 0.8 to 2 m, over the number of patterns.

use super::{Chart, ExperimentError, Figure, Row, Section, Series, Studio, pictures};
use crate::accuracy::score::central_plane_mm;
use crate::measure::camera::flat_target;
use crate::measure::region::Region;
use crate::rectify::DepthRange;

/// Distances with the paper's RMS at ten patterns.
const DISTANCES: [(&str, f64, Option<f64>); 6] = [
    ("0.85", 0.85, None),
    ("1", 1.0, Some(0.2376)),
    ("1.25", 1.25, None),
    ("1.5", 1.5, Some(0.4365)),
    ("1.75", 1.75, None),
    ("2", 2.0, Some(0.8482)),
];
/// Numbers of patterns.
const COUNTS: [usize; 5] = [1, 3, 5, 7, 10];

/// Runs it.
///
/// # Errors
/// [`ExperimentError`].
pub fn run(studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
    let mut section = Section::new(
        Figure::Fig5,
        "Planes over distance and number of patterns",
        "The paper fits planes to 50 % of the valid area of planar targets. Ours are matt planes that \
         fill the field; the fit takes the middle half. The simulated planes are flat to rounding and \
         the simulated calibration is exact: what remains is the matcher's noise, where the paper's \
         figures also hold its targets' flatness and its calibration. Wrong matches are not left out: those \
         that a single pattern leaves make its curve jump.",
    );
    // Planes of 2 m reach beyond it at the picture's edge, and those of 0.85 m come nearer.
    studio.depths(DepthRange { min_m: 0.75, max_m: 2.15 });
    let mut series: Vec<Series> = COUNTS
        .iter()
        .map(|n| {
            let name = if *n == 1 { "1 pattern".into() } else { format!("{n} patterns") };
            Series { name, points: Vec::new(), joined: true }
        })
        .collect();
    let mut paper = Vec::new();
    for (text, distance_m, paper_rms) in DISTANCES {
        let take = studio.take("plane", &[("distance_m", text)], 0)?;
        let truth = studio.truth(&take);
        paper.extend(paper_rms.map(|rms| (distance_m, rms)));
        for (count, series) in COUNTS.into_iter().zip(&mut series) {
            let frame = studio.matched(&take, count, |_| ())?;
            let (rms_mm, _) = central_plane_mm(&frame, &truth)?;
            series.points.push((distance_m, rms_mm));
            if count == 3 && paper_rms.is_some() {
                section.rows.push(
                    Row::error_mm(
                        format!("{text} m, 3 patterns: RMS of the plane fit"),
                        None,
                        rms_mm,
                    )
                    .note(
                        "the paper shows a curve, and says that 0.05 % holds with three patterns",
                    ),
                );
            }
            if count == 10 {
                let region = Region::central_half(&frame).unwrap_or(Region::All);
                let target = flat_target(&frame, &region, None)?;
                section.rows.push(
                    Row::error_mm(
                        format!("{text} m, 10 patterns: RMS of the plane fit"),
                        paper_rms,
                        rms_mm,
                    )
                    .note(format!(
                        "{:.4} % of the distance; fill rate {:.2} %, sub-pixel RMS {:.4} px",
                        target.plane_rms_percent,
                        100.0 * target.fill_rate,
                        target.subpixel_rms_px
                    )),
                );
                if paper_rms.is_some() {
                    let caption = format!("Depth error of the plane at {text} m");
                    section.pictures.push(pictures::error(&frame, &truth, 0.1, &caption)?);
                }
            }
        }
    }
    studio.depths(DepthRange::default());
    series.push(Series { name: "paper, 10 patterns".into(), points: paper, joined: false });
    section.charts.push(Chart {
        title: "Plane fit over distance".into(),
        x: "distance, m".into(),
        y: "RMS, mm".into(),
        series,
    });
    Ok(section)
}
