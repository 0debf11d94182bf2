//! The only file that turns addresses into references: every driver gets its registers here.
//!
//! The PAC has one Rust type per port, timer or channel even where the hardware blocks are the
//! same; here each family has one type, taken from its largest member.

use crate::pac;
use pac::generic::{Reg, RegisterSpec};

/// Whole-register access for the places where a field is computed.
pub(crate) trait RegExt {
    /// Reads the register.
    fn get(&self) -> u32;
    /// Writes the register.
    fn set(&self, bits: u32);
    /// Reads, changes, writes. Not atomic: the caller owns the register.
    fn update(&self, change: impl FnOnce(u32) -> u32) {
        self.set(change(self.get()));
    }
}

impl<R> RegExt for Reg<R>
where
    R: RegisterSpec<Ux = u32>,
{
    #[inline(always)]
    fn get(&self) -> u32 {
        // SAFETY: `as_ptr` is the register's own address, valid for as long as `self`.
        unsafe { self.as_ptr().read_volatile() }
    }

    #[inline(always)]
    fn set(&self, bits: u32) {
        // SAFETY: as above; drivers write only what the manual allows for the register.
        unsafe { self.as_ptr().write_volatile(bits) }
    }
}

macro_rules! block {
    ($(#[$doc:meta] $name:ident: $module:ident at $peripheral:ident;)*) => {
        $(
            #[$doc]
            #[inline(always)]
            pub(crate) fn $name() -> &'static pac::$module::RegisterBlock {
                // SAFETY: the PAC's constant address of a peripheral that exists on both chips;
                // all its registers are volatile cells.
                unsafe { &*pac::$peripheral::PTR }
            }
        )*
    };
}

block! {
    /// Clocks and resets.
    rcu: rcu at RCU;
    /// DMA requests, EXTI sources.
    syscfg: syscfg at SYSCFG;
    /// Edge detector.
    exti: exti at EXTI;
    /// DMA flags.
    dma: dma at DMA;
    /// Converter.
    adc: adc at ADC;
    /// Flash controller.
    fmc: fmc at FMC;
    /// Watchdog.
    fwdgt: fwdgt at FWDGT;
    /// Debug hold bits and device id.
    dbg: dbg at DBG;
    /// 16-bit advanced timer.
    timer0: timer0 at TIMER0;
    /// 32-bit general timer.
    timer1: timer1 at TIMER1;
    /// Trim of IRC48M.
    ctc: ctc at CTC;
}

/// A GPIO port by number (A = 0 ... D = 3, F = 5).
#[inline(always)]
pub(crate) fn gpio(port: u8) -> &'static pac::gpioa::RegisterBlock {
    debug_assert!(port < 6 && port != 4);
    // SAFETY: ports lie 0x400 apart from GPIOA's address (memory map); those without LOCK and
    // AFSEL have reserved words there, which no driver touches for them.
    unsafe { &*pac::GPIOA::PTR.byte_add(0x400 * port as usize) }
}

/// The four registers of a DMA channel.
#[repr(C)]
pub(crate) struct DmaChannel {
    pub(crate) ctl: Reg<pac::dma::ch0ctl::CH0CTL_SPEC>,
    pub(crate) cnt: Reg<pac::dma::ch0cnt::CH0CNT_SPEC>,
    pub(crate) paddr: Reg<pac::dma::ch0paddr::CH0PADDR_SPEC>,
    pub(crate) maddr: Reg<pac::dma::ch0maddr::CH0MADDR_SPEC>,
}

/// A DMA channel by number.
#[inline(always)]
pub(crate) fn dma_channel(channel: u8) -> &'static DmaChannel {
    debug_assert!(channel < 7);
    // SAFETY: channel blocks lie 0x14 apart from CH0CTL at 0x08 (manual, "DMA registers"), in this
    // order.
    unsafe { &*pac::DMA::PTR.byte_add(0x08 + 0x14 * channel as usize).cast() }
}

/// A USART by its base address.
#[inline(always)]
pub(crate) fn usart(index: u8) -> &'static pac::usart0::RegisterBlock {
    // SAFETY: USART0 and USART1 have the same register block.
    unsafe { if index == 0 { &*pac::USART0::PTR } else { &*pac::USART1::PTR.cast() } }
}

/// A 16-bit timer with compare outputs, by number (0, 2, 13..=16): the general register layout is
/// the advanced timer's, with reserved words where a smaller timer lacks a register.
#[inline(always)]
pub(crate) fn timer(number: u8) -> &'static pac::timer0::RegisterBlock {
    // SAFETY: PAC addresses; see the layout argument above.
    unsafe {
        match number {
            0 => &*pac::TIMER0::PTR,
            2 => &*pac::TIMER2::PTR.cast(),
            13 => &*pac::TIMER13::PTR.cast(),
            14 => &*pac::TIMER14::PTR.cast(),
            15 => &*pac::TIMER15::PTR.cast(),
            16 => &*pac::TIMER16::PTR.cast(),
            _ => unreachable!(),
        }
    }
}

/// TIMERx_CHCTL0 or 1 of a timer: the PAC has them only as unions of input and output mode, under
/// names that differ by timer; the access is the same 32-bit one as to CTL0.
#[inline(always)]
pub(crate) fn timer_chctl(number: u8, index: u8) -> &'static Reg<pac::timer0::ctl0::CTL0_SPEC> {
    // SAFETY: CHCTL0 at 0x18, CHCTL1 at 0x1C of the timer's block; plain read/write registers.
    unsafe { &*core::ptr::from_ref(timer(number)).byte_add(0x18 + 4 * index as usize).cast() }
}
