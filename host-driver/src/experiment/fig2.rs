//! Figure 2: a plane and a sphere, over the number of patterns.

use super::{Chart, ExperimentError, Figure, Good, Row, Section, Studio, pictures};
use crate::accuracy::score::{score, sphere_rms_mm};

/// Radius of the sphere, metres.
const RADIUS_M: f64 = 0.075;
/// Pixels around a fitted point that belong to the sphere: half a subset and one more.
const MARGIN_PX: usize = 5;
/// Numbers of patterns, with the paper's RMS and points where it prints them.
const COUNTS: [(usize, Option<f64>, Option<f64>); 5] = [
    (1, Some(0.6232), Some(1_015_087.0)),
    (3, Some(0.1942), Some(1_053_526.0)),
    (5, None, None),
    (7, None, None),
    (10, None, None),
];

/// Runs it.
///
/// # Errors
/// [`ExperimentError`].
pub fn run(studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
    let mut section = Section::new(
        Figure::Fig2,
        "Plane and sphere over the number of patterns",
        "The paper renders a ceramic plane and a standard sphere in Blender and fits the sphere. Ours is \
         a matt sphere of 75 mm radius, 0.95 m away, 0.15 m before a plane. The fit takes the whole \
         sphere that both cameras see, limb included; points count when they are valid, anywhere in the \
         picture.",
    );
    let take = studio.take("sphere", &[], 0)?;
    let truth = studio.truth(&take);
    let (mut ours, mut paper) = (Vec::new(), Vec::new());
    for (count, paper_rms, paper_points) in COUNTS {
        let frame = studio.matched(&take, count, |_| ())?;
        let (rms_mm, radius_mm) =
            sphere_rms_mm(&frame, &truth, &take.world, RADIUS_M, MARGIN_PX, 90.0)?;
        let scored = score(&frame, &truth);
        let x = count as f64;
        ours.push((x, rms_mm));
        paper.extend(paper_rms.map(|rms| (x, rms)));
        let patterns = if count == 1 { "1 pattern".into() } else { format!("{count} patterns") };
        section.rows.push(
            Row::error_mm(format!("{patterns}: RMS of the sphere fit"), paper_rms, rms_mm)
                .note(format!("radius off by {radius_mm:+.4} mm")),
        );
        section.rows.push(Row {
            quantity: format!("{patterns}: valid points"),
            paper: paper_points,
            ours: scored.points as f64,
            good: Good::Large,
            digits: 0,
            note: format!(
                "{:.2} % of what both cameras see is within 5 mm of the truth, {:.3} % of the points are \
                 farther off",
                100.0 * scored.completeness,
                100.0 * scored.outliers_visible
            ),
        });
        if matches!(count, 1 | 3 | 10) {
            let caption = format!("Depth error, {patterns}");
            section.pictures.push(pictures::error(&frame, &truth, 0.2, &caption)?);
        }
        if count == 10 {
            section
                .pictures
                .insert(0, pictures::raw(&frame.intensity, "The scene, mean of ten patterns")?);
            section.pictures.insert(1, pictures::depth(&frame, "Depth, ten patterns")?);
        }
    }
    section.charts.push(Chart::over_patterns(
        "Sphere fit over the number of patterns",
        ours,
        paper,
    ));
    Ok(section)
}
