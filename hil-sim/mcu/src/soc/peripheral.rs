//! What a peripheral model is, and the signals by which models reach each other.

use crate::clock::Clocks;

/// No event is due.
pub const NEVER: u64 = u64::MAX;

/// What a model sees of the chip while it handles an access or an event.
pub struct Cx<'a> {
    /// The cycle of the access or the event.
    pub now: u64,
    /// The clocks at that cycle.
    pub clocks: &'a Clocks,
    /// Signals to the rest of the chip.
    pub out: &'a mut Vec<Signal>,
}

/// A memory-mapped unit. Reads take `&mut self`: some registers change when they are read.
pub trait Peripheral: Send {
    /// Reads the register at `offset` (a multiple of 4).
    fn read(&mut self, offset: u32, cx: &mut Cx<'_>) -> u32;

    /// Writes the register at `offset` (a multiple of 4).
    fn write(&mut self, offset: u32, value: u32, cx: &mut Cx<'_>);

    /// Bits of the register at `offset` that the model honours; `None` where it has no such register.
    fn modelled(&self, offset: u32) -> Option<u32>;

    /// The cycle of the next event, or [`NEVER`].
    fn next_event(&self) -> u64 {
        NEVER
    }

    /// Called at the cycle that [`Peripheral::next_event`] named.
    fn event(&mut self, _cx: &mut Cx<'_>) {}

    /// The clocks are about to change at `cx.now`: settle what was counted so far.
    fn before_clock_change(&mut self, _cx: &mut Cx<'_>) {}

    /// The clocks have changed: `cx.clocks` holds the new ones.
    fn after_clock_change(&mut self, _cx: &mut Cx<'_>) {}
}

/// A timer of the chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum TimerId {
    /// 16-bit advanced timer.
    T0,
    /// 32-bit general timer.
    T1,
    /// 16-bit general timer.
    T2,
    /// 16-bit timer, one channel.
    T13,
    /// 16-bit timer, two channels, break.
    T14,
    /// 16-bit timer, one channel, break.
    T15,
    /// 16-bit timer, one channel, break.
    T16,
}

impl TimerId {
    /// All timers, in the order of [`TimerId::index`].
    pub const ALL: [TimerId; 7] = [
        TimerId::T0,
        TimerId::T1,
        TimerId::T2,
        TimerId::T13,
        TimerId::T14,
        TimerId::T15,
        TimerId::T16,
    ];

    /// Position in [`TimerId::ALL`].
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }
}

/// What can ask the DMA controller for a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DmaSource {
    /// Update event of a timer.
    TimerUpdate(TimerId),
    /// Compare or capture of a timer's channel.
    TimerChannel(TimerId, u8),
    /// Trigger event of a timer.
    TimerTrigger(TimerId),
    /// Transmit register empty.
    UsartTx(u8),
    /// Receive register not empty.
    UsartRx(u8),
    /// End of conversion.
    Adc,
}

/// Why the chip was reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ResetCause {
    /// Power-on or brown-out.
    Power,
    /// The reset pin.
    Pin,
    /// `SYSRESETREQ`.
    Software,
    /// The free watchdog.
    Watchdog,
}

/// A signal from one model to the rest of the chip, with the event's own cycle where that matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Signal {
    /// Level of an interrupt line.
    Irq(u16, bool),
    /// One DMA request.
    DmaPulse(DmaSource),
    /// The DMA channel that just served a burst access is asked again.
    DmaBurst,
    /// A DMA request that stays until it is served.
    DmaLevel(DmaSource, bool),
    /// A timer drives an output (0..=3 channels, 4..=6 complements), or leaves it floating.
    TimerOutput(TimerId, u8, Option<bool>),
    /// Rising trigger output of a timer.
    Trgo(TimerId),
    /// A port's pins may have changed.
    PortChanged(u8),
    /// The EXTI line sources changed.
    ExtiRouting,
    /// The DMA request remap bits changed.
    DmaRemap(u32),
    /// The clock tree changed.
    ClocksChanged,
    /// A peripheral reset bit was set.
    PeripheralReset(PeripheralId),
    /// The non-maskable interrupt is raised.
    Nmi,
    /// The core is to be reset.
    Reset(ResetCause),
}

/// A peripheral with a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PeripheralId {
    /// Reset and clock unit.
    Rcu,
    /// Port A=0, B=1, C=2, D=3, F=5.
    Gpio(u8),
    /// External interrupts.
    Exti,
    /// System configuration.
    Syscfg,
    /// DMA controller.
    Dma,
    /// A timer.
    Timer(TimerId),
    /// USART0 or USART1.
    Usart(u8),
    /// Analog to digital converter.
    Adc,
    /// Flash memory controller.
    Fmc,
    /// Free watchdog.
    Fwdgt,
    /// Power management.
    Pmu,
    /// Clock trim controller.
    Ctc,
    /// CRC unit.
    Crc,
    /// Debug unit.
    Dbg,
    /// USB device.
    Usbfs,
}
