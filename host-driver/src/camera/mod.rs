//! The data path: camera frames with the camera's own sequence number and timestamp.

#[cfg(target_os = "linux")]
pub mod live;
#[cfg(target_os = "linux")]
pub mod v4l2;

use std::time::Duration;

use crate::RawImage;
use crate::sync::{FrameStamp, Side};

/// One image of one camera.
#[derive(Debug, Clone)]
pub struct CameraFrame {
    /// Which camera, its count and its time.
    pub stamp: FrameStamp,
    /// The pixels, unrectified.
    pub image: RawImage,
}

/// Both cameras of a sensor. Every wait is bounded.
///
/// A source must not label frames: which trigger a frame belongs to is found by pairing.
pub trait CameraSource: Send {
    /// Starts both cameras: they expose on triggers from now on, and count from 0.
    ///
    /// # Errors
    /// When a camera is gone or busy.
    fn start(&mut self) -> Result<(), CameraError>;

    /// Stops both cameras and forgets frames that were not fetched.
    fn stop(&mut self);

    /// The next frame of either camera, waiting up to `timeout`; `None` when none came.
    ///
    /// # Errors
    /// When a camera is gone.
    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError>;

    /// Frames of the left and right camera that arrived damaged and were dropped, since the source was
    /// made.
    fn damaged(&self) -> [u64; 2] {
        [0; 2]
    }

    /// Whether the source waits for its consumer instead of losing frames.
    fn is_lossless(&self) -> bool {
        false
    }
}

/// Why the cameras do not work.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// A camera was unplugged.
    #[error("the {side} camera is gone; plug it in again")]
    Gone {
        /// Which.
        side: Side,
    },
    /// There are none, or too many to choose from.
    #[error(
        "{found} cameras where the sensor is plugged in, expected one or two; check their cables, or \
         name the nodes: `?left=/dev/video0&right=/dev/video2`"
    )]
    NotFound {
        /// How many.
        found: usize,
    },
    /// A frame has another size than the calibration.
    #[error(
        "the {side} camera delivers {}x{} pixels; the calibration is for {}x{}",
        .got[0], .got[1], .expected[0], .expected[1]
    )]
    Size {
        /// Which.
        side: Side,
        /// [width, height] of the calibration.
        expected: [usize; 2],
        /// [width, height] of the frame.
        got: [usize; 2],
    },
    /// The device node may not be opened.
    #[error(
        "the {side} camera's node {} may not be opened; install the udev rule (`stspp doctor`)",
        .path.display()
    )]
    Permission {
        /// Which.
        side: Side,
        /// The node.
        path: std::path::PathBuf,
    },
    /// Another program streams from the camera.
    #[error("the {side} camera ({}) is in use by another program; close it", .path.display())]
    Busy {
        /// Which.
        side: Side,
        /// The node.
        path: std::path::PathBuf,
    },
    /// No pixel format of the camera holds grey values.
    #[error("the {side} camera ({}) offers neither GREY, Y10, Y12, Y16 nor YUYV", .path.display())]
    NoGreyFormat {
        /// Which.
        side: Side,
        /// The node.
        path: std::path::PathBuf,
    },
    /// The camera lacks a control that was asked for.
    #[error("the {side} camera has no {name} control; leave that setting out")]
    NoControl {
        /// Which.
        side: Side,
        /// The control.
        name: &'static str,
    },
    /// A control cannot have that value.
    #[error("{name} of the {side} camera is {value}, allowed is {} to {}", .allowed[0], .allowed[1])]
    ControlRange {
        /// Which.
        side: Side,
        /// The control.
        name: &'static str,
        /// What was asked for, in the camera's units.
        value: i32,
        /// Least and largest value.
        allowed: [i32; 2],
    },
    /// The operating system reports an error.
    #[error("{side} camera: {source}")]
    Io {
        /// Which.
        side: Side,
        /// The error.
        source: std::io::Error,
    },
}

/// Fingerprint of an image by which a frame that is delivered twice is recognised, or `None` for an
/// image without noise (dark or saturated), of which two may be equal by right.
pub fn fingerprint(image: &RawImage) -> Option<u64> {
    // FNV-1a over a grid that is coprime to usual widths.
    const STEP: usize = 37;
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut values = [0u32; 2];
    let mut mix = |value: u16| {
        hash = (hash ^ u64::from(value)).wrapping_mul(0x0100_0000_01b3);
        values = [values[0] + u32::from(value != 0), values[1] + 1];
    };
    match &image.pixels {
        crate::raw::RawPixels::Gray8(pixels) => {
            pixels.as_slice().iter().step_by(STEP).for_each(|&p| mix(u16::from(p)));
        }
        crate::raw::RawPixels::Gray16(pixels) => {
            pixels.as_slice().iter().step_by(STEP).for_each(|&p| mix(p));
        }
    }
    // A tenth of the samples lit is thousands of noisy bits in any image of useful size.
    (values[1] >= 1000 && values[0] * 10 > values[1]).then_some(hash)
}
