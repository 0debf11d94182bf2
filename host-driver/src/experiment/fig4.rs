//! Figure 4: the statue over the number of patterns.

use super::turn::{surface_of, surface_rms_mm};
use super::{Chart, ExperimentError, Figure, Good, Row, Section, Studio, pictures};
use crate::DepthFrame;
use crate::accuracy::score::score;

/// Numbers of patterns with the paper's RMS.
const COUNTS: [(usize, Option<f64>); 5] =
    [(1, None), (3, Some(0.4361)), (5, Some(0.3457)), (7, Some(0.3382)), (10, Some(0.3324))];

/// Runs it.
///
/// # Errors
/// [`ExperimentError`].
pub fn run(studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
    let mut section = Section::new(
        Figure::Fig4,
        "Statue over the number of patterns",
        "The statue of Figure 3 from 1, 3, 5, 7 and 10 patterns. The paper's 45.41 % at one pattern are \
         the points that it gets, of the valid points that it gets with ten; ours are points within 5 mm \
         of the truth, of all that both cameras see.",
    );
    let take = studio.take("statue", &[], 0)?;
    let truth = studio.truth(&take);
    let surface = surface_of(&take, take.centre_ns, "fig4")?;
    let rms_mm = |frame: &DepthFrame| {
        let cloud = frame.point_cloud();
        let points: Vec<_> = cloud.points_left_m.iter().map(|p| p.cast::<f64>()).collect();
        surface_rms_mm(&points, &surface)
    };
    let (mut ours, mut paper) = (Vec::new(), Vec::new());
    for (count, paper_rms) in COUNTS {
        let frame = studio.matched(&take, count, |_| ())?;
        let scored = score(&frame, &truth);
        let rms = rms_mm(&frame);
        let patterns = if count == 1 { "1 pattern".into() } else { format!("{count} patterns") };
        section.rows.push(Row::error_mm(format!("{patterns}: RMS"), paper_rms, rms).note(format!(
            "median {:.4} mm, {:.2} % of the points off by more than 5 mm",
            scored.surface_median_mm,
            100.0 * scored.outliers_visible
        )));
        section.rows.push(Row {
            quantity: format!("{patterns}: complete, %"),
            paper: (count == 1).then_some(45.41),
            ours: 100.0 * scored.completeness,
            good: Good::Large,
            digits: 2,
            note: String::new(),
        });
        ours.push((count as f64, rms));
        paper.extend(paper_rms.map(|rms| (count as f64, rms)));
        if matches!(count, 1 | 3 | 5 | 10) {
            section.pictures.push(pictures::error(
                &frame,
                &truth,
                1.0,
                &format!("Depth error, {patterns}"),
            )?);
        }
    }
    section.charts.push(Chart::over_patterns("Statue over the number of patterns", ours, paper));
    Ok(section)
}
