//! The paper's evaluation, repeated on the simulated sensor: Figures 2 to 8, each with the paper's own
//! numbers beside ours.
//!
//! ```text
//! figure ─► studio (scene rendered once, kept as a recording) ─► matched, measured ─► Section
//! Sections ─► report: one HTML page, one Markdown table
//! ```
//! The paper's scenes are real objects before real hardware (but for Figure 2, which it renders in
//! Blender); ours are models of such objects before a model of such hardware. What can be compared is
//! how large errors are, not how two sensors see the same thing.

mod chart;
pub mod fig2;
pub mod fig3;
pub mod fig4;
pub mod fig5;
pub mod fig6;
pub mod fig7;
pub mod fig8;
mod pictures;
pub mod report;
pub mod studio;
mod turn;

use std::path::PathBuf;

use serde::Serialize;
use stspp_hil_sim::world::WorldError;
use stspp_matcher::{Error as MatchError, Method, ShapeFunction};

pub use chart::{Chart, Series};
pub use studio::Studio;

use crate::cpu_time::process_cpu_ms;
use crate::fuse::FuseError;
use crate::measure::FitError;
use crate::recording::RecordingError;
use crate::rectify::RectifyError;
use crate::register::RegisterError;

/// A figure of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Figure {
    /// Plane and sphere over the number of patterns.
    Fig2,
    /// Statue: parabola and DIC.
    Fig3,
    /// Statue over the number of patterns.
    Fig4,
    /// Planes over distance and number of patterns.
    Fig5,
    /// Turning statue, moving plane.
    Fig6,
    /// Industrial part.
    Fig7,
    /// Large panel.
    Fig8,
}

impl Figure {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Fig2, Self::Fig3, Self::Fig4, Self::Fig5, Self::Fig6, Self::Fig7, Self::Fig8];

    /// "fig2" ...
    pub fn name(self) -> &'static str {
        match self {
            Self::Fig2 => "fig2",
            Self::Fig3 => "fig3",
            Self::Fig4 => "fig4",
            Self::Fig5 => "fig5",
            Self::Fig6 => "fig6",
            Self::Fig7 => "fig7",
            Self::Fig8 => "fig8",
        }
    }

    /// How it is matched when the user does not say: the paper's way where the paper is about that or
    /// edges count (the fast way's errors at depth steps are several times larger), the fast way where it
    /// is about what is made of depth.
    pub fn way(self) -> (Method, ShapeFunction) {
        match self {
            Self::Fig2 | Self::Fig3 | Self::Fig4 | Self::Fig7 => {
                (Method::IcGn, ShapeFunction::Second)
            }
            _ => (Method::Dense, ShapeFunction::Auto),
        }
    }

    /// Repeats the figure's experiment.
    ///
    /// # Errors
    /// [`ExperimentError`].
    pub fn run(self, studio: &mut Studio<'_>) -> Result<Section, ExperimentError> {
        let begun = std::time::Instant::now();
        let cpu_ms = process_cpu_ms();
        studio.use_way(self.way());
        let mut section = match self {
            Self::Fig2 => fig2::run(studio),
            Self::Fig3 => fig3::run(studio),
            Self::Fig4 => fig4::run(studio),
            Self::Fig5 => fig5::run(studio),
            Self::Fig6 => fig6::run(studio),
            Self::Fig7 => fig7::run(studio),
            Self::Fig8 => fig8::run(studio),
        }?;
        let params = studio.params();
        section.about += match (params.method, params.shape) {
            (Method::Dense, _) => " Matched by dense least squares (`--method dense`).",
            (Method::Parabola, _) => " Matched by census and parabola alone.",
            _ => " Matched by IC-GN, point by point, as the paper does (`--method icgn`).",
        };
        section.seconds = begun.elapsed().as_secs_f64();
        section.cpu_seconds = process_cpu_ms().zip(cpu_ms).map(|(now, then)| (now - then) * 1e-3);
        Ok(section)
    }
}

/// Why an experiment could not be done.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExperimentError {
    /// The scene cannot be simulated.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The recording kept from before cannot be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The images cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// The images cannot be matched.
    #[error(transparent)]
    Match(#[from] MatchError),
    /// A shape cannot be fitted.
    #[error(transparent)]
    Fit(#[from] FitError),
    /// Clouds cannot be registered.
    #[error(transparent)]
    Register(#[from] RegisterError),
    /// Views cannot be fused.
    #[error(transparent)]
    Fuse(#[from] FuseError),
    /// A picture cannot be made.
    #[error("a picture: {0}")]
    Picture(#[from] std::io::Error),
    /// A file cannot be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A figure lacks what it is about.
    #[error("{figure}: {what}")]
    Missing {
        /// The figure.
        figure: &'static str,
        /// What is missing.
        what: String,
    },
}

/// Whether small or large figures are good.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Good {
    /// Errors.
    Small,
    /// Completeness.
    Large,
    /// Neither: a quantity for orientation.
    Neither,
}

/// A quantity, the paper's and ours.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// What is measured, with its unit.
    pub quantity: String,
    /// The paper's figure, where it prints one.
    pub paper: Option<f64>,
    /// Ours.
    pub ours: f64,
    /// What is good.
    pub good: Good,
    /// Digits after the point.
    pub digits: usize,
    /// Anything that has to be said of the comparison.
    pub note: String,
}

impl Row {
    /// A row of an error in millimetres, with four digits.
    pub fn error_mm(quantity: impl Into<String>, paper: Option<f64>, ours: f64) -> Self {
        let quantity = format!("{}, mm", quantity.into());
        Self { quantity, paper, ours, good: Good::Small, digits: 4, note: String::new() }
    }

    /// Adds a note.
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }

    /// Whether ours is better; `None` where there is nothing to compare.
    pub fn is_better(&self) -> Option<bool> {
        let paper = self.paper?;
        match self.good {
            Good::Small => Some(self.ours <= paper),
            Good::Large => Some(self.ours >= paper),
            Good::Neither => None,
        }
    }
}

/// A picture of a section.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// What it shows.
    pub caption: String,
    /// The PNG file.
    pub png: Vec<u8>,
}

/// A figure's results.
#[derive(Debug, Clone)]
pub struct Section {
    /// The figure.
    pub figure: Figure,
    /// Its title.
    pub title: &'static str,
    /// What the paper did, and what ours is instead.
    pub about: String,
    /// Quantities.
    pub rows: Vec<Row>,
    /// Curves.
    pub charts: Vec<Chart>,
    /// Pictures.
    pub pictures: Vec<Picture>,
    /// Time that it took, seconds.
    pub seconds: f64,
    /// CPU time of all threads, seconds, where known: what a busy machine does not falsify.
    pub cpu_seconds: Option<f64>,
}

impl Section {
    /// A section without results yet.
    pub fn new(figure: Figure, title: &'static str, about: &str) -> Self {
        Self {
            figure,
            title,
            about: about.to_owned(),
            rows: Vec::new(),
            charts: Vec::new(),
            pictures: Vec::new(),
            seconds: 0.0,
            cpu_seconds: None,
        }
    }
}
