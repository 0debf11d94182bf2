//! DMA controller (user manual, "Direct memory access controller (DMA)").
//!
//! Which peripheral requests which channel is fixed ("DMA request mapping"); drivers name the
//! channel that theirs uses.

use crate::interrupt::typelevel::{self, Handler};
use crate::interrupt::{Interrupt, InterruptExt};
use crate::regs::{self, RegExt};
use core::future::poll_fn;
use core::sync::atomic::{AtomicU32, Ordering, fence};
use core::task::Poll;
use embassy_hal_internal::{Peri, PeripheralType};
use embassy_sync::waitqueue::AtomicWaker;

/// DMA_CHxCTL.
#[derive(Clone, Copy)]
pub(crate) struct Control(u32);

impl Control {
    pub(crate) const ENABLE: u32 = 1 << 0;
    pub(crate) const FULL_INTERRUPT: u32 = 1 << 1;
    pub(crate) const HALF_INTERRUPT: u32 = 1 << 2;
    pub(crate) const ERROR_INTERRUPT: u32 = 1 << 3;
    pub(crate) const TO_PERIPHERAL: u32 = 1 << 4;
    pub(crate) const CIRCULAR: u32 = 1 << 5;
    pub(crate) const MEMORY_INCREMENT: u32 = 1 << 7;
    pub(crate) const WORDS: u32 = 0b10 << 8 | 0b10 << 10;
    /// PRIO = ultra high.
    pub(crate) const ULTRA: u32 = 0b11 << 12;
    /// PRIO = high.
    pub(crate) const HIGH: u32 = 0b10 << 12;

    pub(crate) const fn new(bits: u32) -> Self {
        Self(bits)
    }
}

mod sealed {
    pub trait Channel {
        const NUMBER: u8;
    }
}

/// A DMA channel singleton.
pub trait Channel: PeripheralType + sealed::Channel + 'static {
    /// Its number.
    fn number() -> u8 {
        Self::NUMBER
    }
}

macro_rules! channels {
    ($($name:ident = $number:literal;)*) => {
        $(
            impl sealed::Channel for crate::peripherals::$name {
                const NUMBER: u8 = $number;
            }
            impl Channel for crate::peripherals::$name {}
        )*
    };
}
channels! {
    DMA_CH0 = 0; DMA_CH1 = 1; DMA_CH2 = 2; DMA_CH3 = 3; DMA_CH4 = 4; DMA_CH5 = 5; DMA_CH6 = 6;
}

static WAKERS: [AtomicWaker; 7] = [const { AtomicWaker::new() }; 7];
/// Full transfers per channel, counted by the interrupt.
static LAPS: [AtomicU32; 7] = [const { AtomicU32::new(0) }; 7];
/// One bit per channel: a transfer error since [`start`].
static ERRORS: AtomicU32 = AtomicU32::new(0);

// DMA_INTF / DMA_INTC, four bits a channel.
const FULL_FLAG: u32 = 1 << 1;
const ERROR_FLAG: u32 = 1 << 3;

fn irq_of(channel: u8) -> Interrupt {
    match channel {
        0 => Interrupt::DMA_CHANNEL0,
        1..=2 => Interrupt::DMA_CHANNEL1_2,
        3..=4 => Interrupt::DMA_CHANNEL3_4,
        _ => Interrupt::DMA_CHANNEL5_6,
    }
}

/// Sets a channel up and starts it.
pub(crate) fn start(
    channel: u8,
    control: Control,
    peripheral: *mut u32,
    memory: *const u8,
    count: u16,
) {
    stop(channel);
    // What the CPU wrote to the buffer must be in memory before the channel reads it.
    fence(Ordering::SeqCst);
    ERRORS.fetch_and(!(1 << channel), Ordering::Relaxed);
    LAPS[channel as usize].store(0, Ordering::Relaxed);
    let regs = regs::dma_channel(channel);
    regs::dma().intc.set(0xf << (4 * channel));
    regs.paddr.set(peripheral as u32);
    regs.maddr.set(memory as u32);
    regs.cnt.set(u32::from(count));
    if control.0 & (Control::FULL_INTERRUPT | Control::HALF_INTERRUPT | Control::ERROR_INTERRUPT)
        != 0
    {
        // SAFETY: drivers demand the binding of the channel's interrupt.
        unsafe { irq_of(channel).enable() };
    }
    regs.ctl.set(control.0);
    regs.ctl.set(control.0 | Control::ENABLE);
}

/// Stops a channel. A transfer on the bus ends first.
#[inline(always)]
pub(crate) fn stop(channel: u8) {
    let regs = regs::dma_channel(channel);
    regs.ctl.set(0);
    cortex_m::asm::dsb();
}

/// Items that a channel has still to move (in this lap).
#[inline(always)]
pub(crate) fn remaining(channel: u8) -> u32 {
    regs::dma_channel(channel).cnt.get()
}

/// Laps of a circular channel whose interrupt is on, and whether one is not counted yet.
pub(crate) fn laps(channel: u8) -> (u32, bool) {
    let pending = regs::dma().intf.get() & FULL_FLAG << (4 * channel) != 0;
    (LAPS[channel as usize].load(Ordering::Relaxed), pending)
}

/// Whether the channel met a bus error since it was started.
pub(crate) fn failed(channel: u8) -> bool {
    ERRORS.load(Ordering::Relaxed) & 1 << channel != 0
}

/// Registers for the channel's next half, full or error interrupt.
pub(crate) fn register(channel: u8, waker: &core::task::Waker) {
    WAKERS[channel as usize].register(waker);
}

/// A running transfer. Dropping it stops the channel.
pub(crate) struct Transfer<'d> {
    channel: u8,
    _buffer: core::marker::PhantomData<&'d [u8]>,
}

impl<'d> Transfer<'d> {
    /// Moves bytes to a peripheral register.
    pub(crate) fn write<C: Channel>(
        _channel: &mut Peri<'_, C>,
        buffer: &'d [u8],
        register: *mut u32,
    ) -> Self {
        let control = Control::new(
            Control::TO_PERIPHERAL
                | Control::MEMORY_INCREMENT
                | Control::FULL_INTERRUPT
                | Control::ERROR_INTERRUPT,
        );
        let count = buffer.len().min(0xffff) as u16;
        start(C::NUMBER, control, register, buffer.as_ptr(), count);
        Self { channel: C::NUMBER, _buffer: core::marker::PhantomData }
    }

    /// Waits for the end; false after a bus error.
    pub(crate) async fn finish(self) -> bool {
        poll_fn(|cx| {
            register(self.channel, cx.waker());
            if failed(self.channel) {
                Poll::Ready(false)
            } else if remaining(self.channel) == 0 {
                Poll::Ready(true)
            } else {
                Poll::Pending
            }
        })
        .await
    }
}

impl Drop for Transfer<'_> {
    fn drop(&mut self) {
        stop(self.channel);
    }
}

/// Handler of the interrupts of all channels.
pub struct InterruptHandler;

fn on_interrupt(channels: core::ops::RangeInclusive<u8>) {
    let flags = regs::dma().intf.get();
    for channel in channels {
        let own = flags >> (4 * channel) & 0xf;
        if own == 0 {
            continue;
        }
        regs::dma().intc.set(own << (4 * channel));
        if own & FULL_FLAG != 0 {
            let laps = &LAPS[channel as usize];
            laps.store(laps.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
        }
        if own & ERROR_FLAG != 0 {
            ERRORS.fetch_or(1 << channel, Ordering::Relaxed);
        }
        WAKERS[channel as usize].wake();
    }
}

macro_rules! handler {
    ($irq:ident, $channels:expr) => {
        impl Handler<typelevel::$irq> for InterruptHandler {
            unsafe fn on_interrupt() {
                on_interrupt($channels);
            }
        }
    };
}
handler!(DMA_CHANNEL0, 0..=0);
handler!(DMA_CHANNEL1_2, 1..=2);
handler!(DMA_CHANNEL3_4, 3..=4);
handler!(DMA_CHANNEL5_6, 5..=6);
