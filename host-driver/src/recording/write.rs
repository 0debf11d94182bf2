//! Writing a recording folder.

use std::path::Path;

use super::labels::{self, FramesInfo};
use super::{RecordingError, StereoPair};
use crate::calibration::kalibr;
use crate::export::folder::OutputFolder;
use crate::image_io;
use crate::{SlotLabel, StereoCalibration};

/// Writes a recording folder, whole or not at all. `labels` has one entry per pair, or is empty.
///
/// `replace` allows overwriting a recording that is there.
///
/// # Errors
/// [`RecordingError::Write`]; [`RecordingError::Frames`] when there are no pairs, or labels for another
/// number of them.
pub fn write(
    folder: &Path,
    calibration: &StereoCalibration,
    pairs: &[StereoPair],
    labels: &[SlotLabel],
    replace: bool,
) -> Result<(), RecordingError> {
    let wrong = |expected: &str, got: String| {
        Err(RecordingError::Frames { path: folder.to_owned(), expected: expected.into(), got })
    };
    let Some(first) = pairs.first() else {
        return wrong("at least one pair", "none".into());
    };
    if !labels.is_empty() && labels.len() != pairs.len() {
        return wrong("a label for each pair", format!("{} labels", labels.len()));
    }
    let failed = |e: crate::export::folder::OutputError| {
        let (path, source) = e.into_parts();
        RecordingError::Write { path, source }
    };
    let digits = (pairs.len() - 1).to_string().len().max(2);
    let mut out = OutputFolder::create(folder, replace).map_err(failed)?;
    out.file("camchain.yaml", |w| w.write_all(kalibr::to_text(calibration).as_bytes()))
        .map_err(failed)?;
    for (index, pair) in pairs.iter().enumerate() {
        for (side, image) in [("left", &pair.left), ("right", &pair.right)] {
            let name = format!("{side}/{index:0digits$}.png");
            out.file(&name, |w| image_io::write_raw(w, image)).map_err(failed)?;
        }
    }
    let bits = Some(first.left.bits.max(8));
    if !labels.is_empty() || first.left.bits > 8 {
        let labels = if labels.is_empty() {
            (0..pairs.len())
                .map(|k| SlotLabel {
                    sequence: k as u32,
                    slot: k as u16,
                    projector_mask: 0,
                    floodlight: false,
                    trigger_time_us: 0,
                    exposure_us: 0,
                })
                .collect()
        } else {
            labels.to_vec()
        };
        let text = labels::to_text(&FramesInfo { bits, labels });
        out.file("frames.json", |w| w.write_all(text.as_bytes())).map_err(failed)?;
    }
    out.commit().map_err(failed)
}
