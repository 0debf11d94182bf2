//! What is measured: clouds, recordings, sensors, and the region of them.

use std::path::{Path, PathBuf};

use nalgebra::Point3;
use stspp::measure::camera::{Temporal, TemporalNoise};
use stspp::measure::mesh_file::{self, Reference};
use stspp::measure::region::{Region, RegionError};
use stspp::measure::robust::Trim;
use stspp::measure::units;
use stspp::reconstruct::{self, Options, ReconstructError};
use stspp::{DepthFrame, Recording, SourceUri};

use crate::exit::{Failure, Kind};
use crate::interrupt;
use crate::output::Output;
use crate::reconstruct::{Matching, reconstruct_failure};
use crate::source::{Source, failure, stream_options};

/// Options of all that is measured.
#[derive(clap::Args)]
pub struct Input {
    /// Point cloud (.ply), recording folder, folder of a result, or source (sim:SCENE, usb:, replay:FOLDER).
    pub input: String,
    /// Measure in a box only: x0,y0,z0,x1,y1,z1 in metres of the left camera's frame.
    #[arg(
        long = "box",
        value_name = "CORNERS",
        conflicts_with = "rect",
        allow_hyphen_values = true
    )]
    pub corners: Option<String>,
    /// Measure in a rectangle only: x,y,width,height in pixels of the rectified left picture.
    #[arg(long, value_name = "PIXELS")]
    pub rect: Option<String>,
    /// Metres per unit of a cloud: 0.001 for millimetres.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Frames of a recording or a source to measure; the noise over time needs two or more.
    #[arg(long, short = 'n', default_value_t = 1, value_name = "N")]
    pub count: usize,
    /// Largest share of outliers that fits cope with, 0 (none are left out) to 0.8.
    #[arg(long, default_value_t = 0.4, value_name = "SHARE")]
    pub outliers: f64,
    #[command(flatten)]
    pub matching: Matching,
}

/// What was loaded.
pub enum Loaded {
    /// A cloud without pixels.
    Cloud(Vec<Point3<f64>>),
    /// The last frame of a sequence, and the noise over it.
    Frame(Box<DepthFrame>, Option<TemporalNoise>),
}

impl Input {
    /// The trimming that was asked for.
    pub fn trim(&self) -> Result<Trim, Failure> {
        if (0.0..=0.8).contains(&self.outliers) {
            return Ok(Trim { outliers_max: self.outliers, ..Trim::default() });
        }
        let what = format!("--outliers {}: expected a share from 0 to 0.8", self.outliers);
        Err(Failure::new(Kind::Usage, what))
    }

    /// The region that was asked for.
    pub fn region(&self) -> Result<Option<Region>, Failure> {
        let failed = |e: RegionError| Failure::new(Kind::Usage, e);
        match (&self.corners, &self.rect) {
            (Some(text), _) => Region::parse_box(text).map(Some).map_err(failed),
            (_, Some(text)) => Region::parse_rectangle(text).map(Some).map_err(failed),
            _ => Ok(None),
        }
    }

    /// Reads the cloud, or computes the frames.
    pub fn load(&self, output: &Output) -> Result<Loaded, Failure> {
        if self.count == 0 {
            return Err(Failure::new(Kind::Usage, "--count is 0: expected at least 1"));
        }
        let path = &cloud_of_result(Path::new(&self.input));
        if path.is_dir() {
            return self.recording(path, output);
        }
        if path.is_file() || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply")) {
            return cloud(path, self.scale, "--scale").map(Loaded::Cloud);
        }
        if self.input.parse::<SourceUri>().is_err() {
            let what = format!("{}: no such file, recording folder or source", self.input);
            let remedy = "give a .ply file, a recording folder, or sim:, usb:, serial:, replay:";
            return Err(Failure::new(Kind::Input, what).remedy(remedy));
        }
        self.source(output)
    }

    fn region_of(&self, frame: &DepthFrame) -> Result<Region, Failure> {
        Ok(self.region()?.or_else(|| Region::central_half(frame)).unwrap_or(Region::All))
    }

    fn recording(&self, folder: &Path, output: &Output) -> Result<Loaded, Failure> {
        let recording = Recording::open(folder)
            .map_err(|e| reconstruct_failure(&ReconstructError::Recording(e)))?;
        let progress = output.progress(self.count as u64, "matching");
        let mut temporal = Temporal::default();
        let mut first = 0;
        let mut last = None;
        for _ in 0..self.count {
            let options = Options { first, ..self.matching.options() };
            let found = reconstruct::reconstruct(&recording, &options, &mut |_| ());
            let found = match found {
                Ok(found) => found,
                // A sequence ends where the recording does.
                Err(ReconstructError::Window { .. }) if last.is_some() => break,
                Err(e) => return Err(reconstruct_failure(&e)),
            };
            interrupt::check()?;
            let whole = last.as_ref().is_none_or(|(_, pairs)| *pairs == found.pairs.len());
            if !whole {
                break;
            }
            temporal.add(&found.frame, &self.region_of(&found.frame)?);
            first = found.pairs.last().map_or(first + 1, |k| k + 1);
            let pairs = found.pairs.len();
            last = Some((found.frame, pairs));
            progress.inc(1);
            if first >= recording.len() {
                break;
            }
        }
        progress.finish_and_clear();
        let Some((frame, _)) = last else {
            return Err(Failure::new(Kind::Input, format!("{}: no frame", folder.display())));
        };
        Ok(Loaded::Frame(Box::new(frame), temporal.noise()))
    }

    fn source(&self, output: &Output) -> Result<Loaded, Failure> {
        let source = Source::new(self.input.clone(), None);
        let mut sensor = source.open()?;
        let options = stream_options(Some(&source), Some(&self.matching));
        let mut stream = sensor.stream_with(&options).map_err(|e| failure(&e))?;
        interrupt::stops(stream.stop_handle());
        let progress = output.progress(self.count as u64, "measuring");
        let mut temporal = Temporal::default();
        let mut last = None;
        while progress.position() < self.count as u64 {
            let Some(frame) = stream.next() else { break };
            interrupt::check()?;
            let frame = frame.map_err(|e| failure(&e))?;
            temporal.add(&frame, &self.region_of(&frame)?);
            last = Some(frame);
            progress.inc(1);
        }
        stream.stop_handle().stop();
        progress.finish_and_clear();
        interrupt::check()?;
        let Some(frame) = last else {
            return Err(Failure::new(Kind::Other, "the source ended without a depth frame"));
        };
        Ok(Loaded::Frame(Box::new(frame), temporal.noise()))
    }
}

impl Loaded {
    /// The points of a region; of all when `None`.
    pub fn points(&self, region: Option<&Region>) -> Result<Vec<Point3<f64>>, Failure> {
        let region = region.copied().unwrap_or(Region::All);
        let points = match self {
            Self::Cloud(points) => region.of_cloud(points),
            Self::Frame(frame, _) => region.of_frame(frame),
        };
        points.map_err(|e| Failure::new(Kind::Input, e))
    }
}

/// The cloud in a folder that `reconstruct`, `capture` or `demo` wrote; any other path as it is. Such a
/// folder has no calibration of the raw pictures: it is no recording.
pub fn cloud_of_result(path: &Path) -> PathBuf {
    let cloud = path.join("cloud.ply");
    if cloud.is_file() && !path.join("camchain.yaml").exists() { cloud } else { path.to_owned() }
}

/// Reads a cloud, refuses empty ones and other units.
pub fn cloud(path: &Path, scale: f64, option: &'static str) -> Result<Vec<Point3<f64>>, Failure> {
    match reference(path, scale, option)? {
        Reference::Cloud(points) => Ok(points),
        Reference::Mesh(triangles) => Ok(triangles.into_iter().flatten().collect()),
    }
}

/// Reads a cloud or a mesh, refuses empty ones and other units.
pub fn reference(path: &Path, scale: f64, option: &'static str) -> Result<Reference, Failure> {
    if !(scale.is_finite() && scale > 0.0) {
        let what = format!("{option} {scale}: expected metres per unit, such as 0.001");
        return Err(Failure::new(Kind::Usage, what));
    }
    let path: PathBuf = path.to_owned();
    let read = mesh_file::read(&path, scale).map_err(|e| Failure::new(Kind::Input, e))?;
    let name = path.display().to_string();
    let checked = match &read {
        Reference::Cloud(points) => units::check(&name, points, option),
        Reference::Mesh(triangles) => units::check(&name, triangles.as_flattened(), option),
    };
    checked.map_err(|e| Failure::new(Kind::Input, e))?;
    Ok(read)
}
