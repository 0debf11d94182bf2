//! Bookkeeping of a self-feeding chain of timed port writes (see [`crate::sequence`] for the
//! hardware): which ring cells the producer may fill, and when it must arm the compare itself.
//!
//! Event `e` happens when the free-running counter equals its time `T[e]`. The timer then makes
//! two DMA requests: one moves `word[e]` to the port, one moves `T[e + 1]` into the compare
//! registers. So the chain feeds itself, the CPU takes no part in an edge, and a chain that is not
//! refilled stops by itself: the compare register then holds a time that has passed.
//!
//! The time ring is stored shifted by one (`T[e]` in cell `e - 1`), so that both DMA channels stand
//! at the same cell: that of the first event that has not happened.

/// A write to the port at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Edge {
    /// Low 32 bits of the tick count at which the write happens.
    pub at: u32,
    /// The word for the port's set/reset register.
    pub word: u32,
}

/// Why edges were not taken. None of the given edges is in the chain then.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ChainError {
    /// The ring has no room for all of them; wait for some to happen.
    Full,
    /// The first lies in the past or nearer than [`MARGIN_TICKS`].
    Late,
    /// Times do not rise by at least [`SPACING_TICKS`], or span half the counter or more.
    Order,
}

/// Earliest time at which an appended edge may lie, from now: covers the producer's own run time
/// between its look at the clock and its write to the compare register.
pub const MARGIN_TICKS: u32 = 20;

/// Least distance of two edges: the DMA must have loaded the next compare value before that time
/// comes (two transfers, 20 to 40 bus cycles; one tick is 84 or 96).
pub const SPACING_TICKS: u32 = 1;

/// Counts of the chain over rings of `RING` cells.
#[derive(Debug, Clone, Copy)]
pub struct Chain<const RING: usize> {
    appended: u32,
    happened: u32,
    last_at: u32,
}

impl<const RING: usize> Default for Chain<RING> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const RING: usize> Chain<RING> {
    /// An empty chain; both channels at cell 0.
    pub const fn new() -> Self {
        assert!(RING.is_power_of_two() && RING >= 4);
        Self { appended: 0, happened: 0, last_at: 0 }
    }

    /// Number of events so far, from the port channel's remaining count. To be called at least
    /// once per lap, which [`Chain::append`]'s limit of one lap ahead guarantees.
    pub const fn update(&mut self, remaining: u32) -> u32 {
        let cell = RING as u32 - remaining;
        let moved = cell.wrapping_sub(self.happened) & (RING as u32 - 1);
        self.happened = self.happened.wrapping_add(moved);
        self.happened
    }

    /// Events appended so far, those that have happened included.
    pub const fn appended(&self) -> u32 {
        self.appended
    }

    /// Free cells as of the last [`Chain::update`]. One cell always stays free, so that a full
    /// ring and an empty one differ.
    pub const fn free(&self) -> usize {
        RING - 1 - self.appended.wrapping_sub(self.happened) as usize
    }

    /// Checks `edges` and gives each its cells: `store(word_cell, time_cell, edge)`.
    pub fn append(
        &mut self,
        now: u32,
        edges: &[Edge],
        mut store: impl FnMut(usize, usize, Edge),
    ) -> Result<(), ChainError> {
        let Some(first) = edges.first() else { return Ok(()) };
        if edges.len() > self.free() {
            return Err(ChainError::Full);
        }
        let busy = self.appended != self.happened;
        let ahead = first.at.wrapping_sub(now) as i32;
        if ahead < MARGIN_TICKS as i32 {
            return Err(ChainError::Late);
        }
        if busy && (first.at.wrapping_sub(self.last_at) as i32) < SPACING_TICKS as i32 {
            return Err(ChainError::Order);
        }
        let mut previous = first.at;
        for edge in &edges[1..] {
            if (edge.at.wrapping_sub(previous) as i32) < SPACING_TICKS as i32
                || (edge.at.wrapping_sub(now) as i32) < 0
            {
                return Err(ChainError::Order);
            }
            previous = edge.at;
        }
        for &edge in edges {
            let event = self.appended as usize;
            store(event % RING, event.wrapping_sub(1) % RING, edge);
            self.appended = self.appended.wrapping_add(1);
        }
        self.last_at = previous;
        Ok(())
    }

    /// Takes back event `first` and all after it: `first` is due at `at`, the event before it at
    /// `previous_at`. Returns the time cell that must be overwritten with a passed time at once, so
    /// that the chain parks there; after that, [`Chain::must_arm`] for `first` tells whether the
    /// compare already holds `at` and must be parked by the CPU too.
    pub const fn retract(
        &mut self,
        now: u32,
        first: u32,
        at: u32,
        previous_at: u32,
    ) -> Result<usize, ChainError> {
        let kept = first.wrapping_sub(self.happened);
        if kept >= self.appended.wrapping_sub(self.happened) {
            return Err(ChainError::Late);
        }
        if (at.wrapping_sub(now) as i32) < MARGIN_TICKS as i32 {
            return Err(ChainError::Late);
        }
        self.appended = first;
        self.last_at = previous_at;
        Ok(first.wrapping_sub(1) as usize % RING)
    }

    /// Whether the compare must be armed by the CPU for event `event` (the first one just
    /// appended): true where everything before it has happened, because then the channel took a
    /// stale time. To be asked *after* the cells are stored, with a fresh remaining count: an
    /// event that happens in between has already loaded the stored time, and arming it again
    /// changes nothing.
    pub const fn must_arm(&mut self, event: u32, remaining: u32) -> bool {
        self.update(remaining) == event
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RING: usize = 16;

    /// The timer and both DMA channels, tick by tick, from the manual's description.
    struct Hardware {
        now: u32,
        compare: u32,
        words: [u32; RING],
        times: [u32; RING],
        cell: usize,
        port: Vec<(u32, u32)>,
    }

    impl Hardware {
        fn new(now: u32) -> Self {
            // Stale cells look like events of the past lap.
            let past = now.wrapping_sub(5);
            Self {
                now,
                compare: past,
                words: [0xdead; RING],
                times: [past; RING],
                cell: 0,
                port: vec![],
            }
        }

        fn tick(&mut self) {
            self.now = self.now.wrapping_add(1);
            if self.now == self.compare {
                self.port.push((self.now, self.words[self.cell]));
                self.compare = self.times[self.cell];
                self.cell = (self.cell + 1) % RING;
            }
        }

        fn remaining(&self) -> u32 {
            // CNT reloads at the end of a lap: it is never seen as 0 for long.
            (RING - self.cell) as u32
        }
    }

    /// What the driver does, with `delays` ticks passing between its steps.
    fn append(
        hw: &mut Hardware,
        chain: &mut Chain<RING>,
        edges: &[Edge],
        delays: [u32; 2],
    ) -> Result<(), ChainError> {
        chain.update(hw.remaining());
        let event = chain.appended();
        let (words, times) = (&mut hw.words, &mut hw.times);
        chain.append(hw.now, edges, |w, t, edge| {
            words[w] = edge.word;
            times[t] = edge.at;
        })?;
        (0..delays[0]).for_each(|_| hw.tick());
        if chain.must_arm(event, hw.remaining()) {
            (0..delays[1]).for_each(|_| hw.tick());
            hw.compare = edges[0].at;
        }
        Ok(())
    }

    /// What the driver does to take edges back.
    fn retract(
        hw: &mut Hardware,
        chain: &mut Chain<RING>,
        first: u32,
        at: u32,
        previous_at: u32,
        delays: [u32; 2],
    ) -> Result<(), ChainError> {
        chain.update(hw.remaining());
        let passed = hw.now.wrapping_sub(1);
        let cell = chain.retract(hw.now, first, at, previous_at)?;
        (0..delays[0]).for_each(|_| hw.tick());
        hw.times[cell] = passed;
        if chain.must_arm(first, hw.remaining()) {
            (0..delays[1]).for_each(|_| hw.tick());
            hw.compare = passed;
        }
        Ok(())
    }

    /// A small generator, so that the test needs no crate.
    struct Random(u64);
    impl Random {
        fn below(&mut self, limit: u32) -> u32 {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((self.0 >> 33) as u32) % limit
        }
    }

    #[test]
    fn every_edge_happens_once_and_on_time_across_the_counters_wrap() {
        for seed in 0..300 {
            let mut random = Random(seed);
            let mut hw = Hardware::new(0u32.wrapping_sub(2_000));
            let mut chain = Chain::<RING>::new();
            let mut wanted = vec![];
            let mut last = hw.now.wrapping_add(30);
            let mut word = 1;
            for _ in 0..200 {
                // Now and then the chain runs dry before it gets more.
                let wait = if random.below(5) == 0 { 120 } else { random.below(25) };
                (0..wait).for_each(|_| hw.tick());
                let soonest = hw.now.wrapping_add(MARGIN_TICKS);
                if (last.wrapping_sub(soonest) as i32) < 0 {
                    last = soonest;
                }
                let edges: Vec<Edge> = (0..1 + random.below(5))
                    .map(|_| {
                        last = last.wrapping_add(SPACING_TICKS + random.below(20));
                        word += 1;
                        Edge { at: last, word }
                    })
                    .collect();
                let delays = [random.below(8), random.below(8)];
                match append(&mut hw, &mut chain, &edges, delays) {
                    Ok(()) => wanted.extend(edges.iter().map(|e| (e.at, e.word))),
                    Err(error) => {
                        assert_eq!(error, ChainError::Full, "seed {seed}");
                        last = wanted.last().unwrap().0;
                    }
                }
            }
            (0..2_000).for_each(|_| hw.tick());
            assert_eq!(hw.port, wanted, "seed {seed}");
            assert_eq!(chain.update(hw.remaining()), wanted.len() as u32);
        }
    }

    #[test]
    fn what_is_retracted_never_happens_and_the_rest_does() {
        let mut taken_back = 0;
        for seed in 0..2_000 {
            let mut random = Random(seed);
            let mut hw = Hardware::new(0u32.wrapping_sub(150));
            let mut chain = Chain::<RING>::new();
            let mut wanted: Vec<(u32, u32)> = vec![];
            let mut last = hw.now.wrapping_add(40);
            let mut word = 0;
            for _ in 0..12 {
                let edges: Vec<Edge> = (0..4)
                    .map(|_| {
                        last = last.wrapping_add(10 + random.below(20));
                        word += 1;
                        Edge { at: last, word }
                    })
                    .collect();
                let first = chain.appended();
                append(&mut hw, &mut chain, &edges, [random.below(8), random.below(8)]).unwrap();
                wanted.extend(edges.iter().map(|e| (e.at, e.word)));
                (0..random.below(100)).for_each(|_| hw.tick());
                let keep = random.below(4) as usize;
                let victim = first + keep as u32;
                let previous = wanted[..victim as usize].last().map_or(0, |e| e.0);
                let delays = [random.below(8), random.below(8)];
                let at = edges[keep].at;
                let margin = at.wrapping_sub(hw.now) as i32;
                let answer = retract(&mut hw, &mut chain, victim, at, previous, delays);
                assert_eq!(answer.is_ok(), margin >= MARGIN_TICKS as i32, "seed {seed}");
                if answer.is_ok() {
                    taken_back += 1;
                    wanted.truncate(victim as usize);
                }
                let soonest = hw.now.wrapping_add(MARGIN_TICKS);
                last = wanted.last().map_or(soonest, |e| e.0);
                if (last.wrapping_sub(soonest) as i32) < 0 {
                    last = soonest;
                }
                while chain.free() < 4 {
                    hw.tick();
                    chain.update(hw.remaining());
                }
            }
            (0..2_000).for_each(|_| hw.tick());
            assert_eq!(hw.port, wanted, "seed {seed}");
        }
        assert!(taken_back > 1_000);
    }

    #[test]
    fn a_chain_that_is_not_refilled_stops() {
        let mut hw = Hardware::new(0);
        let mut chain = Chain::<RING>::new();
        let edges = [Edge { at: 50, word: 1 }, Edge { at: 60, word: 2 }];
        for lap in 0..20 {
            let shifted = edges.map(|e| Edge { at: e.at + lap * 100, word: e.word });
            append(&mut hw, &mut chain, &shifted, [0, 0]).unwrap();
            (0..100).for_each(|_| hw.tick());
        }
        let count = hw.port.len();
        assert_eq!(count, 40);
        (0..1_000_000).for_each(|_| hw.tick());
        assert_eq!(hw.port.len(), count);
    }

    #[test]
    fn refused_edges_leave_the_chain_as_it_was() {
        let mut chain = Chain::<RING>::new();
        let mut refuse = |now, edges: &[Edge], error| {
            let before = chain.appended();
            let answer = chain.append(now, edges, |_, _, _| panic!("stored"));
            assert_eq!(answer, Err(error));
            assert_eq!(chain.appended(), before);
        };
        let edge = |at| Edge { at, word: 0 };
        refuse(100, &[edge(100)], ChainError::Late);
        refuse(100, &[edge(90)], ChainError::Late);
        refuse(100, &[edge(200), edge(200)], ChainError::Order);
        refuse(100, &[edge(200), edge(199)], ChainError::Order);
        refuse(100, &[edge(200), edge(100u32.wrapping_sub(9))], ChainError::Order);
        refuse(100, &[edge(200); RING], ChainError::Full);
    }
}
