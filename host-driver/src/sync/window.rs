//! The sliding window: the last N speckle pairs, complete and consistent, or not at all.

use std::collections::VecDeque;

use crate::SlotLabel;

/// Light of one slot of the timing in force.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotLight {
    /// Projectors that are on.
    pub projector_mask: u16,
    /// Whether the floodlight is on.
    pub floodlight: bool,
}

impl SlotLight {
    /// Whether a frame of this slot shows speckle and nothing else: the matcher's input.
    pub fn is_speckle(self) -> bool {
        self.projector_mask != 0 && !self.floodlight
    }
}

/// What became of a pair that was given to the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// The window is complete with this pair.
    Complete,
    /// Some pairs are still to come.
    Filling,
    /// A pair was missing before this one: the window starts over with it.
    Gap {
        /// Pairs that were in the window and are not used again.
        dropped: usize,
    },
    /// The pair's light is not what the timing says of its slot: it is rejected and the window starts
    /// over after it.
    Mislabelled,
    /// The slot is not for matching (floodlight, or dark): kept out of the window.
    NotSpeckle,
}

/// The last N speckle pairs of consecutive triggers. `P` is what is kept of a pair.
#[derive(Debug, Clone)]
pub struct Window<P> {
    slots: Vec<SlotLight>,
    used: Vec<bool>,
    length: usize,
    pairs: VecDeque<(SlotLabel, P)>,
    last: Option<SlotLabel>,
}

impl<P> Window<P> {
    /// A window of `length` speckle pairs over the cycle `slots`. `length` is limited to the speckle
    /// slots of a cycle, so that no slot is in it twice.
    pub fn new(slots: Vec<SlotLight>, length: usize) -> Self {
        let used = slots.iter().map(|slot| slot.is_speckle()).collect();
        Self::with_used(slots, used, length)
    }

    /// As [`Window::new`], where `used` says which slots are matched.
    pub fn with_used(slots: Vec<SlotLight>, used: Vec<bool>, length: usize) -> Self {
        let length = length.min(used.iter().filter(|used| **used).count());
        Self { slots, used, length, pairs: VecDeque::new(), last: None }
    }

    /// Number of pairs of a complete window; 0 when the timing has no speckle slot.
    pub fn length(&self) -> usize {
        self.length
    }

    /// The pairs that are in the window, oldest first.
    pub fn pairs(&self) -> impl ExactSizeIterator<Item = &(SlotLabel, P)> {
        self.pairs.iter()
    }

    /// Whether the window has all its pairs.
    pub fn is_complete(&self) -> bool {
        self.length > 0 && self.pairs.len() == self.length
    }

    /// Forgets all pairs.
    pub fn clear(&mut self) {
        self.pairs.clear();
        self.last = None;
    }

    /// What [`Window::push`] would make of a pair with this label.
    pub fn check(&self, label: &SlotLabel) -> Step {
        let Some(slot) = self.slots.get(usize::from(label.slot)) else { return Step::Mislabelled };
        let light =
            SlotLight { projector_mask: label.projector_mask, floodlight: label.floodlight };
        if *slot != light {
            return Step::Mislabelled;
        }
        if let Some(last) = &self.last {
            let cycle = self.slots.len() as u64;
            let ahead = u64::from(label.sequence).wrapping_sub(u64::from(last.sequence));
            let forward = label.sequence > last.sequence
                && label.trigger_time_us >= last.trigger_time_us
                && (u64::from(last.slot) + ahead) % cycle == u64::from(label.slot);
            if !forward {
                return Step::Mislabelled;
            }
            if ahead != 1 {
                return Step::Gap { dropped: self.pairs.len() };
            }
        }
        match self.used.get(usize::from(label.slot)).copied().unwrap_or(false) {
            false => Step::NotSpeckle,
            true if self.pairs.len() + 1 >= self.length => Step::Complete,
            true => Step::Filling,
        }
    }

    /// Takes a pair. A window is complete only after [`Step::Complete`].
    pub fn push(&mut self, label: SlotLabel, pair: P) -> Step {
        let step = self.check(&label);
        match step {
            Step::Mislabelled => {
                self.clear();
                return step;
            }
            Step::Gap { .. } => self.pairs.clear(),
            Step::NotSpeckle => {
                self.last = Some(label);
                return step;
            }
            Step::Complete | Step::Filling => {}
        }
        self.last = Some(label);
        if !self.used[usize::from(label.slot)] || self.length == 0 {
            return step;
        }
        if self.pairs.len() == self.length {
            self.pairs.pop_front();
        }
        self.pairs.push_back((label, pair));
        // A window of one pair is complete right after a gap too.
        if matches!(step, Step::Gap { .. }) && self.is_complete() { Step::Complete } else { step }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn speckle(slots: usize) -> Vec<SlotLight> {
        (0..slots).map(|k| SlotLight { projector_mask: 1 << k, floodlight: false }).collect()
    }

    fn label(slots: &[SlotLight], sequence: u32) -> SlotLabel {
        let slot = sequence as usize % slots.len();
        SlotLabel {
            sequence,
            slot: slot as u16,
            projector_mask: slots[slot].projector_mask,
            floodlight: slots[slot].floodlight,
            trigger_time_us: 1000 + 33_333 * u64::from(sequence),
            exposure_us: 32_000,
        }
    }

    #[test]
    fn slides_once_full() {
        let slots = speckle(3);
        let mut window = Window::new(slots.clone(), 3);
        let steps: Vec<_> = (0..5).map(|k| window.push(label(&slots, k), k)).collect();
        assert_eq!(
            steps,
            [Step::Filling, Step::Filling, Step::Complete, Step::Complete, Step::Complete]
        );
        assert_eq!(window.pairs().map(|(_, p)| *p).collect::<Vec<_>>(), [2, 3, 4]);
    }

    #[test]
    fn a_gap_or_a_wrong_mask_starts_over() {
        let slots = speckle(3);
        let mut window = Window::new(slots.clone(), 3);
        assert!((0..3).map(|k| window.push(label(&slots, k), ())).all(|s| s != Step::Mislabelled));
        assert_eq!(window.push(label(&slots, 4), ()), Step::Gap { dropped: 3 });
        assert!(!window.is_complete());
        let mut wrong = label(&slots, 5);
        wrong.projector_mask = 1 << 9;
        assert_eq!(window.push(wrong, ()), Step::Mislabelled);
        assert_eq!(window.pairs().len(), 0);
        assert_eq!(window.push(label(&slots, 6), ()), Step::Filling);
        assert_eq!(window.push(label(&slots, 6), ()), Step::Mislabelled, "a repeated trigger");
    }

    #[test]
    fn floodlight_slots_stay_out() {
        let mut slots = speckle(2);
        slots.push(SlotLight { projector_mask: 0, floodlight: true });
        let mut window = Window::new(slots.clone(), 16);
        assert_eq!(window.length(), 2);
        let steps: Vec<_> = (0..5).map(|k| window.push(label(&slots, k), k)).collect();
        assert_eq!(
            steps,
            [Step::Filling, Step::Complete, Step::NotSpeckle, Step::Complete, Step::Complete]
        );
        assert_eq!(window.pairs().map(|(_, p)| *p).collect::<Vec<_>>(), [3, 4]);
    }

    proptest! {
        /// Whatever is pushed, a complete window holds consecutive speckle triggers of distinct slots.
        #[test]
        fn complete_windows_are_consistent(
            slots in 1usize..12,
            length in 1usize..17,
            pushes in proptest::collection::vec((0u32..3, 0u16..14, 0u16..3), 1..80),
        ) {
            let cycle = speckle(slots);
            let mut window = Window::new(cycle.clone(), length);
            let mut sequence = 0u32;
            for (skip, slot, kind) in pushes {
                let mut pushed = label(&cycle, sequence);
                match kind {
                    1 => pushed.slot = slot,
                    2 => pushed.projector_mask ^= 1 << slot,
                    _ => {}
                }
                let step = window.push(pushed, ());
                if step == Step::Complete {
                    let labels: Vec<_> = window.pairs().map(|(l, ())| *l).collect();
                    prop_assert_eq!(labels.len(), window.length());
                    for (k, l) in labels.iter().enumerate() {
                        prop_assert_eq!(*l, label(&cycle, labels[0].sequence + k as u32));
                    }
                }
                sequence += skip;
            }
        }
    }
}
