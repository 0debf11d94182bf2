//! How the chip's timers differ (datasheet, "Timers and PWM generation"; SVD; trigger connections
//! after the identical STM32F0, inferred).

use super::super::peripheral::TimerId;

/// What one timer has.
#[derive(Debug)]
pub struct TimerKind {
    /// Counter and compare registers are 32 bits wide.
    pub bits32: bool,
    /// Compare channels.
    pub channels: usize,
    /// Channels with a complementary output.
    pub complements: usize,
    /// Has a break input, a protection register and repetition.
    pub break_input: bool,
    /// Has a slave controller and a trigger output.
    pub slave: bool,
    /// Has DMA requests.
    pub dma: bool,
    /// On the APB2 bus.
    pub apb2: bool,
    /// Interrupt of everything, or of everything but the channels.
    pub irq: u16,
    /// Interrupt of the channels where they have their own.
    pub irq_channels: Option<u16>,
    /// ITI0..=ITI3.
    pub internal_triggers: [Option<TimerId>; 4],
}

const NO_TRIGGERS: [Option<TimerId>; 4] = [None; 4];

const ADVANCED: TimerKind = TimerKind {
    bits32: false,
    channels: 4,
    complements: 3,
    break_input: true,
    slave: true,
    dma: true,
    apb2: true,
    irq: 13,
    irq_channels: Some(14),
    internal_triggers: [
        Some(TimerId::T14),
        Some(TimerId::T1),
        Some(TimerId::T2),
        Some(TimerId::T16),
    ],
};

const GENERAL_32: TimerKind = TimerKind {
    bits32: true,
    complements: 0,
    break_input: false,
    apb2: false,
    irq: 15,
    irq_channels: None,
    internal_triggers: [Some(TimerId::T0), Some(TimerId::T14), Some(TimerId::T2), None],
    ..ADVANCED
};

const GENERAL_16: TimerKind = TimerKind {
    bits32: false,
    irq: 16,
    internal_triggers: [Some(TimerId::T0), Some(TimerId::T1), Some(TimerId::T14), None],
    ..GENERAL_32
};

const ONE_CHANNEL: TimerKind = TimerKind {
    channels: 1,
    slave: false,
    dma: false,
    irq: 19,
    internal_triggers: NO_TRIGGERS,
    ..GENERAL_16
};

const TWO_CHANNELS: TimerKind = TimerKind {
    channels: 2,
    complements: 1,
    irq: 20,
    irq_channels: None,
    internal_triggers: [
        Some(TimerId::T1),
        Some(TimerId::T2),
        Some(TimerId::T15),
        Some(TimerId::T16),
    ],
    ..ADVANCED
};

const ONE_WITH_BREAK: TimerKind = TimerKind {
    channels: 1,
    slave: false,
    irq: 21,
    internal_triggers: NO_TRIGGERS,
    ..TWO_CHANNELS
};

const ONE_WITH_BREAK_16: TimerKind = TimerKind { irq: 22, ..ONE_WITH_BREAK };

impl TimerKind {
    /// What timer `id` has.
    #[must_use]
    pub const fn of(id: TimerId) -> &'static TimerKind {
        match id {
            TimerId::T0 => &ADVANCED,
            TimerId::T1 => &GENERAL_32,
            TimerId::T2 => &GENERAL_16,
            TimerId::T13 => &ONE_CHANNEL,
            TimerId::T14 => &TWO_CHANNELS,
            TimerId::T15 => &ONE_WITH_BREAK,
            TimerId::T16 => &ONE_WITH_BREAK_16,
        }
    }

    /// Largest counter value.
    #[must_use]
    pub const fn max(&self) -> u32 {
        if self.bits32 { u32::MAX } else { 0xffff }
    }

    /// Bits of the register at `offset` that the model honours.
    #[must_use]
    pub fn modelled(&self, offset: u32) -> Option<u32> {
        let channels = (1u32 << self.channels) - 1;
        let channel_flags = channels << 1;
        let brk = if self.break_input { 1 << 7 } else { 0 };
        let trigger = if self.slave { 1 << 6 } else { 0 };
        match offset {
            // Down and centre-aligned counting (DIR, CAM) and the dead-time clock are not.
            0x00 => Some(0x008f),
            // Master mode, idle states; DMAS, CCSE, CCUC and TI0S are not.
            0x04 if self.slave || self.break_input => {
                Some(if self.slave { 0x70 } else { 0 } | if self.break_input { 0x7f00 } else { 0 })
            }
            // Gated, encoder and external modes are not; nor is TRGS beyond ITI3.
            0x08 if self.slave => Some(0x0037),
            0x0c => {
                let dma = if self.dma { 1 << 8 | channels << 9 | trigger << 8 } else { 0 };
                Some(1 | channel_flags | trigger | brk | dma)
            }
            0x10 => Some(u32::MAX),
            0x14 => Some(1 | channel_flags | trigger | brk),
            // Fast enable (bits 2, 10) has no effect without a trigger input; clear-by-external is not
            // modelled. As inputs: neither filter nor prescaler.
            0x18 => Some(if self.channels > 1 { 0x7f7f } else { 0x7f }),
            0x1c if self.channels > 2 => Some(0x7f7f),
            0x20 => Some(0xffff),
            0x24 | 0x2c | 0x34 => Some(self.max()),
            0x28 => Some(0xffff),
            0x30 if self.break_input => Some(0xff),
            0x38 if self.channels > 1 => Some(self.max()),
            0x3c | 0x40 if self.channels > 2 => Some(self.max()),
            // Dead time is not modelled.
            0x44 if self.break_input => Some(0xff00),
            0x48 if self.dma => Some(0x1f1f),
            0x4c if self.dma => Some(u32::MAX),
            _ => None,
        }
    }
}
