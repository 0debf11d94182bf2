//! From camera frames to depth frames: threads joined by bounded queues.
//!
//! ```text
//!  control link ─┐
//!                ├─► capture ──► pair ──► match ──► DepthStream
//!  cameras ──────┘                │        (rectify the newest, window,
//!  recording ────────► replay ────┤         match, reproject, publish)
//!                                 └──► PairStream
//! ```
//!
//! - [`capture`] moves trigger events and camera frames to the host and watches for silence;
//! - [`pair`] labels frames by events and makes pairs ([`crate::sync`]);
//! - [`replay`] reads pairs of a recording instead of these two;
//! - [`depth`] rectifies the newest pair, keeps the window, matches;
//! - [`stream`] starts and ends the threads and hands out results;
//! - [`budget`] decides what gives when the machine is too slow;
//! - [`stats`] counts.
//!
//! With hardware a thread never waits for the next one: what finds its queue full is dropped, counted
//! and reported, and the matcher skips to the newest window. A simulated or recorded source waits
//! instead, so that nothing is dropped. Frames belong to who takes them: holding them starves nothing.
//!
//! Whatever ends a stream (drop, error, panic), its capture thread stops the device and disarms it.

pub mod budget;
pub mod capture;
pub mod depth;
pub mod pair;
pub mod replay;
pub mod stats;
pub mod stream;

use std::time::Duration;

use crate::reconstruct::Options as MatchOptions;
use crate::sync::FrameStamp;
use crate::{RawImage, SlotLabel};

pub use budget::BudgetPolicy;
pub use depth::MatchInfo;
pub use stats::StreamStats;
pub use stream::{DepthStream, PairStream, StopHandle};

/// Frames and events between capture and pairing: half a second at 30 Hz.
pub(crate) const CAPTURE_QUEUE: usize = 32;

/// Pairs between pairing and matching: a whole window, so that a slow match loses no pair.
pub(crate) const PAIR_QUEUE: usize = 20;

/// The same two where the source waits: no longer than keeps the threads busy.
pub(crate) const LOSSLESS_QUEUE: usize = 3;

/// Depth frames that wait for the user. Older ones make room for newer ones.
pub(crate) const DEPTH_QUEUE: usize = 2;

/// How a stream is made. The defaults suit the sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamOptions {
    /// Depth range and matching. `frames` is the window's length: all speckle slots of the timing when
    /// `None`. `first` counts for recordings only.
    pub matching: MatchOptions,
    /// Without a complete window for this long, on the source's clock, the stream yields a
    /// [`crate::error::Timeout`] that names what is missing.
    pub timeout: Duration,
    /// What gives when matching takes longer than the camera's period. Of no effect where the source
    /// waits for the matcher (`sim:`, `replay:`).
    pub budget: BudgetPolicy,
}

impl Default for StreamOptions {
    fn default() -> Self {
        Self {
            matching: MatchOptions::default(),
            timeout: Duration::from_secs(3),
            budget: BudgetPolicy::default(),
        }
    }
}

/// Two raw images of one trigger.
#[derive(Debug, Clone)]
pub struct LabelledPair {
    /// What lit them, and when.
    pub label: SlotLabel,
    /// Generation of the timing that lit them: patterns of different generations are never matched.
    pub timing_generation: u16,
    /// Left image, unrectified.
    pub left: RawImage,
    /// Right image, unrectified.
    pub right: RawImage,
    /// Counts and times of the camera frames, left first; `None` for recorded pairs.
    pub stamps: Option<[FrameStamp; 2]>,
    /// Time from the exposure's end to the pair's arrival at the host; zero for recorded pairs.
    pub arrival_delay: Duration,
    /// When the pair was complete on this machine.
    pub paired_at: std::time::Instant,
}
