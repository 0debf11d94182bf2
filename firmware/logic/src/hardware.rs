//! The traits between the logic and a board, and what a board reports.
//!
//! The edge path has no software in it: a [`GateEngine`] is a timer that counts `0..period` and whose
//! four compare matches move words from tables to the ports (DMA), plus one interrupt per slot that
//! reports what was done. The simulator computes the same edges from the same plan.

use stspp_protocol::trigger::TriggerSource;

use crate::timing::{GateWord, SlotPlan};

/// Drives gates and camera triggers on its own once started.
///
/// The engine works off a [`SlotPlan`], slot after slot, cycle after cycle. For every slot whose gate
/// has gone off, its owner hands a [`SlotDone`] to
/// [`Controller::on_slot_done`](crate::controller::Controller::on_slot_done), in order, and hands over
/// all of a run before the next request is served.
pub trait GateEngine {
    /// Timer ticks in a microsecond, a constant of the board.
    fn ticks_per_us(&self) -> u32;

    /// Takes a plan. Stopped: the next start runs it. Running: it takes over at the next cycle
    /// boundary that can still be met; one loaded earlier that has not begun is dropped.
    fn load(&mut self, plan: &SlotPlan);

    /// Starts slot 0 of the plan as soon as it can; ends on its own after `slots` slots, or runs on
    /// until [`stop`](Self::stop) where `None`. Returns the device time of slot 0's start.
    ///
    /// Called only when stopped, with a plan loaded.
    fn start(&mut self, slots: Option<u32>) -> u64;

    /// Ends the run after the slot under way (or the next, when it is too late to hold that one).
    /// Returns how many slots this run will have had in all.
    fn stop(&mut self) -> u32;

    /// All outputs low at once, run or not. Returns how far the run got; where outputs had been
    /// forced off before (by an interrupt, say), as far as it got then.
    fn force_off(&mut self) -> Aborted;

    /// Floodlight on now for `duration_us`, ended by a hardware timer; 0 switches it off. Called only
    /// when no run is under way.
    fn set_floodlight(&mut self, duration_us: u32);

    /// Level of the floodlight's output outside of a run.
    fn floodlight_is_on(&self) -> bool;

    /// Chooses what starts the slots of the runs to come. Called only when stopped.
    ///
    /// With an external source, [`start`](Self::start) returns the time from which edges count, and an
    /// edge at `e` starts the next slot at `e + delay_us`; one whose slot would begin less than the
    /// plan's period after the slot before is ignored and counted.
    fn set_trigger_source(&mut self, source: TriggerSource);

    /// Edges at trigger-in during runs since reset: those that started a slot, those ignored.
    fn trigger_edges(&self) -> TriggerEdges;
}

/// Edges seen at trigger-in; the counts wrap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TriggerEdges {
    /// Started a slot.
    pub taken: u32,
    /// Came too soon.
    pub ignored: u32,
    /// Start of the slot that the last of them began, where that is not reported yet: device time.
    pub slot_under_way_us: Option<u64>,
}

/// What the engine did in one slot: its own account, not a look-up in what was asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SlotDone {
    /// Counts slots of the run, from 0.
    pub slot_number: u32,
    /// Entry in the plan's table.
    pub slot_index: u8,
    /// What was lit.
    pub gates: GateWord,
    /// [`SlotPlan::timing_generation`] of the plan that was run.
    pub timing_generation: u16,
    /// Rise of the trigger, device time.
    pub trigger_time_us: u64,
    /// How long the gates were on.
    pub on_time_us: u32,
    /// USB start-of-frame number current at the rise; `None` without USB.
    pub usb_sof: Option<u16>,
}

/// Where a run was when the outputs were forced off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Aborted {
    /// Slots of the run whose trigger had risen, the one cut short included.
    pub slots_triggered: u32,
    /// What was lit when it was cut short.
    pub gates: GateWord,
    /// For how long that had been lit.
    pub on_time_us: u32,
}

/// One of the two pages (erase units) that hold settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Page {
    /// The first.
    A,
    /// The second.
    B,
}

impl Page {
    /// The other page.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Page::A => Page::B,
            Page::B => Page::A,
        }
    }
}

/// The flash would not do it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StoreError;

/// Two erasable pages of at least [`RECORD_LEN`](crate::settings::RECORD_LEN) bytes.
///
/// Erasing may stall the processor: it is only asked for while no light is allowed.
pub trait SettingsStore {
    /// Copies the front of a page to `out`.
    ///
    /// # Errors
    ///
    /// [`StoreError`] where the page cannot be read.
    fn read(&self, page: Page, out: &mut [u8]) -> Result<(), StoreError>;

    /// Sets every byte of a page to 0xFF.
    ///
    /// # Errors
    ///
    /// [`StoreError`] where that fails.
    fn erase(&mut self, page: Page) -> Result<(), StoreError>;

    /// Writes `bytes` to the front of an erased page. The length is a multiple of four.
    ///
    /// # Errors
    ///
    /// [`StoreError`] where that fails.
    fn write(&mut self, page: Page, bytes: &[u8]) -> Result<(), StoreError>;
}

/// What the board must do once the reply to the request is out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SystemAction {
    /// Restart; latched faults are carried over.
    Reset,
    /// Restart into the bootloader.
    Bootloader,
}
