//! Board images in a folder: `left/` and `right/`, paired by file name.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::Board;
use super::detect::{Detection, Problem, detect};
use super::findings::Images;
use super::observations::{Observations, View};
use crate::RawImage;
use crate::image_io::{self, ImageError};
use crate::raw::RawPixels;
use crate::recording::StereoPair;

/// Why a folder's images cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FolderError {
    /// A folder is missing or cannot be listed.
    #[error("{}: expected a folder of PNG images: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// No file name is in both folders.
    #[error(
        "{}: expected left/ and right/ with images of the same names, got {left} and {right} images \
         without a pair", path.display()
    )]
    NoPairs {
        /// The folder.
        path: PathBuf,
        /// Images in `left/`.
        left: usize,
        /// Images in `right/`.
        right: usize,
    },
    /// An image cannot be read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// An image has another size than the first.
    #[error(
        "{}: expected {} x {} px as in the first image, got {} x {}",
        path.display(), expected[0], expected[1], got[0], got[1]
    )]
    Size {
        /// The image.
        path: PathBuf,
        /// The first image's size.
        expected: [usize; 2],
        /// Its own.
        got: [usize; 2],
    },
}

/// Pairs of images of the same name.
pub type Pairs = Vec<(String, [PathBuf; 2])>;

/// The pairs of a folder, by name. Images without a partner are left out.
///
/// # Errors
/// When there is no pair.
pub fn pairs(folder: &Path) -> Result<Pairs, FolderError> {
    let list = |side: &str| -> Result<BTreeMap<String, PathBuf>, FolderError> {
        let path = folder.join(side);
        let failed = |source| FolderError::Folder { path: path.clone(), source };
        let mut files = BTreeMap::new();
        for entry in std::fs::read_dir(&path).map_err(failed)? {
            let file = entry.map_err(failed)?.path();
            let is_png = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
            if let Some(stem) = file.file_stem().and_then(|s| s.to_str()).filter(|_| is_png) {
                files.insert(stem.to_owned(), file);
            }
        }
        Ok(files)
    };
    let (left, mut right) = (list("left")?, list("right")?);
    let counts = (left.len(), right.len());
    let pairs: Pairs = left
        .into_iter()
        .filter_map(|(name, file)| Some((name.clone(), [file, right.remove(&name)?])))
        .collect();
    if pairs.is_empty() {
        let (left, right) = counts;
        return Err(FolderError::NoPairs { path: folder.to_owned(), left, right });
    }
    Ok(pairs)
}

/// What was found in a set of images.
#[derive(Debug, Clone)]
pub struct Found {
    /// The points, view by view.
    pub observations: Observations,
    /// Quality or problem of each view's images.
    pub images: Vec<Images>,
}

/// What was found in one pair.
pub type PairDetections = [Result<Detection, Problem>; 2];

/// Finds the board in both images of a pair.
pub fn detect_pair(pair: &StereoPair, board: &Board) -> PairDetections {
    let (left, right) = rayon::join(|| detect(&pair.left, board), || detect(&pair.right, board));
    [left, right]
}

impl Found {
    /// Nothing yet.
    pub fn new(board: &Board, resolution_px: [usize; 2]) -> Self {
        let observations = Observations { board: *board, resolution_px, views: Vec::new() };
        Self { observations, images: Vec::new() }
    }

    /// Adds a view.
    pub fn push(&mut self, name: String, [left, right]: PairDetections) {
        let sightings = |d: &Result<Detection, Problem>| {
            d.as_ref().map(|d| d.sightings.clone()).unwrap_or_default()
        };
        let view = View { name, left: sightings(&left), right: sightings(&right) };
        self.observations.views.push(view);
        self.images.push([left.map(|d| d.quality), right.map(|d| d.quality)]);
    }

    /// Finds the board in pairs that are in memory already.
    pub fn of_pairs(board: &Board, pairs: &[StereoPair]) -> Self {
        let size = pairs.first().map_or([0, 0], |p| [p.left.width(), p.left.height()]);
        let mut found = Self::new(board, size);
        let detections: Vec<PairDetections> =
            pairs.par_iter().map(|pair| detect_pair(pair, board)).collect();
        for (k, pair) in detections.into_iter().enumerate() {
            found.push(format!("{k:02}"), pair);
        }
        found
    }
}

/// Files of 16 bits do not say how many of them the camera uses: the fewest that hold the brightest
/// pixel of the pair.
fn set_bits(pair: &mut StereoPair) {
    let brightest = |image: &RawImage| match &image.pixels {
        RawPixels::Gray8(_) => None,
        RawPixels::Gray16(pixels) => pixels.as_slice().iter().max().copied(),
    };
    let Some(most) = brightest(&pair.left).max(brightest(&pair.right)) else { return };
    let bits = [10, 12, 14].into_iter().find(|bits| most >> bits == 0).unwrap_or(16);
    for image in [&mut pair.left, &mut pair.right] {
        if matches!(image.pixels, RawPixels::Gray16(_)) {
            image.bits = bits;
        }
    }
}

/// Reads all pairs of a folder and finds the board in them. `progress` is told each pair that is done.
///
/// # Errors
/// When images cannot be read or differ in size.
pub fn find_in_folder(
    pairs: &Pairs,
    board: &Board,
    progress: &(dyn Fn() + Sync),
) -> Result<Found, FolderError> {
    let detections: Vec<(PairDetections, [usize; 2])> = pairs
        .par_iter()
        .map(|(_, [left_path, right_path])| {
            let read = |path: &Path| image_io::read_gray(path);
            let mut pair = StereoPair { left: read(left_path)?, right: read(right_path)? };
            set_bits(&mut pair);
            let size = [pair.left.width(), pair.left.height()];
            let right_size = [pair.right.width(), pair.right.height()];
            if size != right_size {
                let (path, expected, got) = (right_path.clone(), size, right_size);
                return Err(FolderError::Size { path, expected, got });
            }
            let detections = detect_pair(&pair, board);
            progress();
            Ok((detections, size))
        })
        .collect::<Result<_, FolderError>>()?;
    let size = detections.first().map_or([0, 0], |(_, size)| *size);
    let mut found = Found::new(board, size);
    for ((name, [left, _]), (detection, got)) in pairs.iter().zip(detections) {
        if got != size {
            return Err(FolderError::Size { path: left.clone(), expected: size, got });
        }
        found.push(name.clone(), detection);
    }
    Ok(found)
}
