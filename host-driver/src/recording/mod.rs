//! Recording folders: `camchain.yaml`, `left/00.png`... and `right/00.png`..., optional `frames.json`.
//!
//! The images are raw (unrectified, distorted), grey, 8 or 16 bits (right-aligned); the number is the
//! frame's place in time; as many left as right ones. [`labels`] describes `frames.json`.

pub mod labels;
mod write;

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use crate::calibration::CalibrationError;
use crate::image_io::{self, ImageError};
use crate::raw::RawPixels;
use crate::{RawImage, SlotLabel, StereoCalibration};
pub use write::write;

/// Most digits of a frame number.
const DIGITS_MAX: usize = 9;

/// Why a recording cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The folder, or one in it, is missing or cannot be listed.
    #[error("{}: expected {expected}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What it should be.
        expected: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// The calibration is wrong.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// An image is wrong.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The images do not form a recording.
    #[error("{}: expected {expected}, got {got}", path.display())]
    Frames {
        /// The file or folder.
        path: PathBuf,
        /// What it has to be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// `frames.json` is wrong.
    #[error("{}: {field}: expected {expected}, got {got}", path.display())]
    Labels {
        /// The file.
        path: PathBuf,
        /// The field.
        field: String,
        /// What it has to be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// The recording cannot be written; nothing of it is left.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}

/// One instant seen by both cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct StereoPair {
    /// Camera 0.
    pub left: RawImage,
    /// Camera 1.
    pub right: RawImage,
}

/// An opened recording folder: calibration, labels and the files; images are read when asked for.
#[derive(Debug, Clone)]
pub struct Recording {
    folder: PathBuf,
    /// The rig's calibration.
    pub calibration: StereoCalibration,
    /// What lit each pair, in the pairs' order; `None` without `frames.json`.
    pub labels: Option<Vec<SlotLabel>>,
    pairs: Vec<[PathBuf; 2]>,
    container_bits: u8,
    bits: u8,
}

impl Recording {
    /// Opens a recording and checks all that can be checked without decoding the images: calibration,
    /// labels, numbers, sizes and types of the images.
    ///
    /// # Errors
    /// Names file, field and expectation.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self, RecordingError> {
        let folder = folder.as_ref();
        std::fs::read_dir(folder).map_err(|source| RecordingError::Folder {
            path: folder.to_owned(),
            expected: "a recording folder",
            source,
        })?;
        let calibration = StereoCalibration::read(folder.join("camchain.yaml"))?;
        let left = numbered(&folder.join("left"))?;
        let right = numbered(&folder.join("right"))?;
        let pairs = paired(folder, left, right)?;
        let container_bits = check_headers(&pairs, calibration.left.resolution_px)?;
        let info = labels::read(&folder.join("frames.json"), pairs.len())?;
        let (labels, stated_bits) = info.map_or((None, None), |i| (Some(i.labels), i.bits));
        let mut recording =
            Self { folder: folder.to_owned(), calibration, labels, pairs, container_bits, bits: 8 };
        if container_bits == 16 {
            recording.bits = match stated_bits {
                Some(bits) => bits,
                None => recording.guess_bits()?,
            };
        }
        Ok(recording)
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Number of pairs; at least one.
    pub fn len(&self) -> usize {
        self.pairs.len()
    }

    /// Never: a recording without images does not open.
    pub fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// Significant bits of a pixel: what `frames.json` states or, for 16-bit files without that, the
    /// smallest of 10, 12, 14 and 16 that holds the brightest pixel of the first pairs.
    pub fn bits(&self) -> u8 {
        self.bits
    }

    /// The files of pair `index`: left, right.
    pub fn paths(&self, index: usize) -> Option<&[PathBuf; 2]> {
        self.pairs.get(index)
    }

    /// Reads pair `index`.
    ///
    /// # Errors
    /// When an image is damaged or has changed since the recording was opened.
    ///
    /// # Panics
    /// When `index` is not below [`Self::len`].
    pub fn read_pair(&self, index: usize) -> Result<StereoPair, RecordingError> {
        let [left, right] = &self.pairs[index];
        Ok(StereoPair { left: self.read_image(left)?, right: self.read_image(right)? })
    }

    fn read_image(&self, path: &Path) -> Result<RawImage, RecordingError> {
        let mut image = image_io::read_gray(path)?;
        let container_bits = if matches!(image.pixels, RawPixels::Gray8(_)) { 8 } else { 16 };
        let size_px = [image.width(), image.height()];
        let header = image_io::GrayHeader { size_px, container_bits };
        check_header(path, &header, self.container_bits, self.calibration.left.resolution_px)?;
        image.bits = self.bits;
        Ok(image)
    }

    /// Reads pairs `range` and makes sure that no image is a copy of another: a repeated exposure adds
    /// nothing and hides a lost one.
    ///
    /// # Errors
    /// As [`Self::read_pair`], and when two images of a side are equal.
    ///
    /// # Panics
    /// When `range` reaches beyond [`Self::len`].
    pub fn read_window(
        &self,
        range: std::ops::Range<usize>,
    ) -> Result<Vec<StereoPair>, RecordingError> {
        let first = range.start;
        let mut pairs: Vec<StereoPair> = Vec::with_capacity(range.len());
        for index in range {
            let pair = self.read_pair(index)?;
            for (k, earlier) in pairs.iter().enumerate() {
                let same = [pair.left == earlier.left, pair.right == earlier.right];
                if let Some(side) = same.iter().position(|same| *same) {
                    return Err(RecordingError::Frames {
                        path: self.pairs[index][side].clone(),
                        expected: "another exposure than the ones before".into(),
                        got: format!("a copy of {}", self.pairs[first + k][side].display()),
                    });
                }
            }
            pairs.push(pair);
        }
        Ok(pairs)
    }

    /// Bits that hold the brightest pixel of up to four pairs.
    fn guess_bits(&self) -> Result<u8, RecordingError> {
        let mut brightest = 0;
        for path in self.pairs.iter().take(4).flatten() {
            if let RawPixels::Gray16(image) = image_io::read_gray(path)?.pixels {
                brightest = image.as_slice().iter().copied().fold(brightest, u16::max);
            }
        }
        Ok([10, 12, 14].into_iter().find(|bits| brightest >> bits == 0).unwrap_or(16))
    }
}

/// The numbered PNG files of a folder; other files are none of ours.
fn numbered(folder: &Path) -> Result<BTreeMap<u32, PathBuf>, RecordingError> {
    let failed = |source| RecordingError::Folder {
        path: folder.to_owned(),
        expected: "a folder of images 00.png, 01.png ...",
        source,
    };
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let is_png = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
        let stem = path.file_stem().and_then(|s| s.to_str()).unwrap_or("");
        let is_number =
            (1..=DIGITS_MAX).contains(&stem.len()) && stem.bytes().all(|b| b.is_ascii_digit());
        let Some(number) = stem.parse().ok().filter(|_| is_png && is_number) else { continue };
        if let Some(other) = files.insert(number, path.clone()) {
            return Err(RecordingError::Frames {
                path,
                expected: format!("one image with number {number}"),
                got: format!("also {}", other.display()),
            });
        }
    }
    Ok(files)
}

/// Pairs left and right files, which must have the same numbers, from 0 without a gap.
fn paired(
    folder: &Path,
    left: BTreeMap<u32, PathBuf>,
    right: BTreeMap<u32, PathBuf>,
) -> Result<Vec<[PathBuf; 2]>, RecordingError> {
    let error = |path: PathBuf, expected: String, got: String| {
        Err(RecordingError::Frames { path, expected, got })
    };
    for (side, files) in [("left", &left), ("right", &right)] {
        if files.is_empty() {
            let expected = "images 00.png, 01.png ...".into();
            return error(folder.join(side), expected, "none".into());
        }
    }
    if left.len() != right.len() {
        let expected = format!("as many images as in left/ ({})", left.len());
        return error(folder.join("right"), expected, right.len().to_string());
    }
    for (side, files) in [("left", &left), ("right", &right)] {
        let gap = (0_u32..).zip(files.keys()).find(|(expected, number)| expected != *number);
        if let Some((expected, number)) = gap {
            let text = format!("image {expected:02}.png (numbers from 0 without a gap)");
            return error(folder.join(side), text, format!("{number:02}.png next"));
        }
    }
    Ok(left.into_values().zip(right.into_values()).map(|(l, r)| [l, r]).collect())
}

/// Checks all headers; gives the container's bits.
fn check_headers(pairs: &[[PathBuf; 2]], size_px: [usize; 2]) -> Result<u8, RecordingError> {
    let mut bits = None;
    for path in pairs.iter().flatten() {
        let header = image_io::read_gray_header(path)?;
        let bits = *bits.get_or_insert(header.container_bits);
        check_header(path, &header, bits, size_px)?;
    }
    Ok(bits.unwrap_or(8))
}

fn check_header(
    path: &Path,
    header: &image_io::GrayHeader,
    bits: u8,
    size_px: [usize; 2],
) -> Result<(), RecordingError> {
    let field = |field, expected, got| {
        Err(ImageError::Field { path: path.to_owned(), field, expected, got }.into())
    };
    if header.size_px != size_px {
        let ([w, h], [got_w, got_h]) = (size_px, header.size_px);
        let expected = format!("{w} x {h} px as in camchain.yaml");
        return field("size", expected, format!("{got_w} x {got_h}"));
    }
    if header.container_bits != bits {
        let expected = format!("{bits} as in the recording's first image");
        return field("bit depth", expected, header.container_bits.to_string());
    }
    Ok(())
}
