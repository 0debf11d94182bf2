//! Pairs of a recording as a stream.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::Sender;

use super::LabelledPair;
use super::depth::Cycle;
use super::stats::{Mark, Progress};
use super::stream::StopHandle;
use crate::error::Error;
use crate::reconstruct::{FRAMES_DEFAULT, FRAMES_MAX};
use crate::sync::window::SlotLight;
use crate::{Recording, SlotLabel};

pub(crate) struct Replay {
    pub recording: Arc<Recording>,
    pub out: Sender<Result<LabelledPair, Error>>,
    pub progress: Arc<Progress>,
    pub stop: StopHandle,
    pub first: usize,
}

impl Replay {
    /// Runs to the recording's end.
    pub fn run(self) {
        for index in self.first..self.recording.len() {
            if self.stop.is_stopped() {
                return;
            }
            let label = label(&self.recording, index, self.first);
            let pair = self.recording.read_pair(index).map(|pair| LabelledPair {
                label,
                timing_generation: 0,
                left: pair.left,
                right: pair.right,
                stamps: None,
                arrival_delay: Duration::ZERO,
                paired_at: Instant::now(),
            });
            self.progress.mark(Mark::Pair, index as u64);
            self.progress.begin_work();
            let ended = pair.is_err();
            self.progress.count(|s| s.pairs += u64::from(!ended));
            if ended {
                self.progress.end_work();
            }
            if self.out.send(pair.map_err(Error::from)).is_err() || ended {
                return;
            }
        }
    }
}

/// The label of a pair: the recording's or, without any, its number in time order.
fn label(recording: &Recording, index: usize, first: usize) -> SlotLabel {
    match &recording.labels {
        Some(labels) => labels[index],
        None => SlotLabel {
            sequence: index as u32,
            slot: ((index - first) % unlabelled_slots(recording, first)) as u16,
            projector_mask: 0,
            floodlight: false,
            trigger_time_us: index as u64 + 1,
            exposure_us: 0,
        },
    }
}

/// Slots of a recording without labels: all pairs, or the paper's ten of a long recording.
fn unlabelled_slots(recording: &Recording, first: usize) -> usize {
    match recording.len().saturating_sub(first) {
        0 => 1,
        pairs if pairs <= FRAMES_MAX => pairs,
        _ => FRAMES_DEFAULT,
    }
}

/// The slot cycle of a recording, by its labels. All pairs are matched but those lit by the floodlight
/// alone.
pub(crate) fn cycle(recording: &Recording, first: usize) -> Cycle {
    let labels = (first..recording.len()).map(|index| label(recording, index, first));
    let mut slots: Vec<Option<SlotLight>> = Vec::new();
    for label in labels {
        let slot = usize::from(label.slot);
        if slot >= slots.len() {
            slots.resize(slot + 1, None);
        }
        slots[slot].get_or_insert(SlotLight {
            projector_mask: label.projector_mask,
            floodlight: label.floodlight,
        });
    }
    let dark = SlotLight { projector_mask: 0, floodlight: false };
    let used = slots
        .iter()
        .map(|slot| slot.is_some_and(|s| !(s.floodlight && s.projector_mask == 0)))
        .collect();
    let slots = slots.into_iter().map(|slot| slot.unwrap_or(dark)).collect();
    Cycle { slots, used, period: Duration::ZERO }
}
