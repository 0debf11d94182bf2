//! Figure 3: the statue by parabola and by DIC, and the share of similar points.

use nalgebra::{Isometry3, Point3};
use stspp_matcher::{Method, ShapeFunction};

use super::turn::{distances, surface_of, surface_rms_mm};
use super::{ExperimentError, Figure, Good, Row, Section, Studio, pictures};
use crate::DepthFrame;
use crate::accuracy::score::score;
use crate::measure::deviation::deviations;
use crate::measure::rms;
use crate::register::icp::{self, IcpParams};
use crate::register::mesh_surface::MeshSurface;
use crate::register::thin::thinned;

/// Runs it.
///
/// # Errors
/// [`ExperimentError`].
pub fn run(studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
    let mut section = Section::new(
        Figure::Fig3,
        "Statue: parabola and DIC",
        "The paper measures a plaster David of 0.7 m and compares with a scan by a fringe projection \
         instrument. Ours is a plaster bust of 0.7 m by formula, 1.2 m away, compared with the surface \
         that was rendered, without any alignment that could hide an error. RMS is of \
         the points' distances from the surface, as the paper's comparison by ICP has it, over points within \
         5 mm; how many are farther off is said beside it.",
    );
    let take = studio.take("statue", &[], 0)?;
    let truth = studio.truth(&take);
    let surface = surface_of(&take, take.centre_ns, "fig3")?;
    let rms_mm = |frame: &DepthFrame| {
        let cloud = frame.point_cloud();
        let points: Vec<_> = cloud.points_left_m.iter().map(|p| p.cast::<f64>()).collect();
        surface_rms_mm(&points, &surface)
    };
    let parabola = studio.matched(&take, 10, |p| p.method = Method::Parabola)?;
    let dic = studio.matched(&take, 10, |p| {
        p.method = Method::IcGn;
        p.shape = ShapeFunction::Second;
    })?;
    // All points with whatever similarity they have: the matcher drops those below 0.8 otherwise.
    let all = studio.matched(&take, 10, |p| {
        p.method = Method::IcGn;
        p.shape = ShapeFunction::Second;
        p.zncc_min = -1.0;
    })?;
    let fast = studio.matched(&take, 10, |p| {
        p.method = Method::Dense;
        p.shape = ShapeFunction::Auto;
    })?;
    let [of_parabola, of_dic, of_fast] = [&parabola, &dic, &fast].map(|frame| score(frame, &truth));
    let completeness = |s: &crate::accuracy::Score| {
        format!(
            "{:.2} % complete within 5 mm, {:.2} % of the points farther off; along the line of sight RMS \
             {:.4} mm, median {:.4} mm",
            100.0 * s.completeness,
            100.0 * s.outliers_visible,
            s.surface_rms_mm,
            s.surface_median_mm
        )
    };
    section.rows.push(
        Row::error_mm("RMS, parabola", Some(0.4582), rms_mm(&parabola)).note(format!(
            "{}; {}",
            completeness(&of_parabola),
            tail(&parabola, &surface)?
        )),
    );
    section.rows.push(
        Row::error_mm(
            "RMS, DIC with second order (paper: 0.3324 in the text, 0.3533 in its summary)",
            Some(0.3324),
            rms_mm(&dic),
        )
        .note(completeness(&of_dic)),
    );
    section.rows.push(
        Row::error_mm("RMS, dense least squares, order by pixel", Some(0.3324), rms_mm(&fast))
            .note(completeness(&of_fast)),
    );
    let valid = all.zncc.as_slice().iter().filter(|z| !z.is_nan()).count();
    let similar = all.zncc.as_slice().iter().filter(|z| **z > 0.8).count();
    section.rows.push(Row {
        quantity: "points with ZNCC above 0.8, % of the valid ones".into(),
        paper: Some(86.24),
        ours: 100.0 * similar as f64 / valid.max(1) as f64,
        good: Good::Large,
        digits: 2,
        note: "with the threshold of 0.8 off; on, all are above it".into(),
    });
    section.pictures.push(pictures::depth(&dic, "Depth by DIC")?);
    section.pictures.push(pictures::zncc(&all, "ZNCC")?);
    section.pictures.push(pictures::error(&parabola, &truth, 1.0, "Depth error, parabola")?);
    section.pictures.push(pictures::error(&dic, &truth, 1.0, "Depth error, DIC")?);
    explain(&mut section, &of_dic);
    Ok(section)
}

/// Points of the cloud that the alignment uses.
const ALIGNED_BY: usize = 20_000;

/// Of what an RMS consists that does not come from the bulk of the points: its far points, and what an
/// alignment takes away.
fn tail(frame: &DepthFrame, surface: &MeshSurface) -> Result<String, ExperimentError> {
    let cloud = frame.point_cloud();
    let points: Vec<Point3<f64>> = cloud.points_left_m.iter().map(|p| p.cast()).collect();
    let rms_mm = |values: &[f64], limit_m: f64| {
        rms(values.iter().copied().filter(|d| d.abs() <= limit_m)) * 1e3
    };
    let found = distances(&points, surface).signed_m;
    let squares = |limit_m: f64| {
        found
            .iter()
            .filter(|d| d.abs() > limit_m)
            .fold((0.0, 0), |(sum, n), d| (sum + d * d, n + 1))
    };
    let ((all, matched), (far, few)) = (squares(-1.0), squares(1e-3));
    let params = IcpParams { max_distance_m: 5e-3, ..IcpParams::default() };
    let aligned =
        icp::register(&thinned(&points, ALIGNED_BY), surface, Isometry3::identity(), &params)?;
    let aligned = deviations(&points, surface, &aligned.target_from_source, 5e-3).signed_m;
    Ok(format!(
        "the {:.1} % of the points that are off by more than 1 mm make {:.0} % of its square: within 3 mm \
         (where the paper says its major errors are) the RMS is {:.4} mm, within 1 mm {:.4} mm; laid on the \
         surface by ICP first, as the paper does, {:.4} mm and within 3 mm {:.4} mm",
        100.0 * f64::from(few) / f64::from(matched.max(1)),
        100.0 * far / all,
        rms_mm(&found, 3e-3),
        rms_mm(&found, 1e-3),
        rms_mm(&aligned, 5e-3),
        rms_mm(&aligned, 3e-3),
    ))
}

/// Says of what the RMS consists, where it is not below the paper's.
fn explain(section: &mut Section, dic: &crate::accuracy::Score) {
    section.about += &format!(
        " The RMS is made by few points: half of all are within {:.3} mm. What adds up are subsets across \
         depth steps and folds, which this statue, with its undercut curls and drapery, has more of than \
         a scan to compare with usually keeps.",
        dic.surface_median_mm
    );
}
