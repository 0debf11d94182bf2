//! Edges at pins (user manual, "Interrupt/event controller (EXTI)", "System configuration
//! (SYSCFG)": SYSCFG_EXTISSx).

use crate::gpio::Input;
use crate::interrupt::typelevel::{self, Handler};
use crate::interrupt::{Interrupt, InterruptExt};
use crate::regs::{self, RegExt};
use core::future::poll_fn;
use core::task::Poll;
use embassy_sync::waitqueue::AtomicWaker;

/// Which edges count.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edge {
    /// Low to high.
    Rising,
    /// High to low.
    Falling,
    /// Both.
    Both,
}

static WAKERS: [AtomicWaker; 16] = [const { AtomicWaker::new() }; 16];

/// Connects `input`'s line (the line number is the pin's number) and enables its interrupt.
/// The interrupt itself must be enabled in the NVIC by the caller.
fn arm(input: &Input<'_>, edge: Edge) -> u8 {
    let (port, line) = input.identity();
    let syscfg = regs::syscfg();
    let shift = 4 * (line as u32 % 4);
    let route = |bits: u32| bits & !(0xf << shift) | u32::from(port) << shift;
    critical_section::with(|_| {
        match line / 4 {
            0 => syscfg.extiss0.update(route),
            1 => syscfg.extiss1.update(route),
            2 => syscfg.extiss2.update(route),
            _ => syscfg.extiss3.update(route),
        }
        let exti = regs::exti();
        let bit = 1u32 << line;
        select(bit, edge);
        exti.pd.set(bit); // cleared by writing one
        exti.inten.update(|bits| bits | bit);
    });
    line
}

/// Sets which edges of a line count (EXTI_RTEN, EXTI_FTEN).
fn select(bit: u32, edge: Edge) {
    let with = |on: bool| move |bits: u32| if on { bits | bit } else { bits & !bit };
    critical_section::with(|_| {
        let exti = regs::exti();
        exti.rten.update(with(edge != Edge::Falling));
        exti.ften.update(with(edge != Edge::Rising));
    });
}

/// An input whose edges can be awaited.
pub struct ExtiInput<'d> {
    input: Input<'d>,
}

impl<'d> ExtiInput<'d> {
    /// Takes an input and enables the interrupt of its line.
    ///
    /// # Safety
    /// That interrupt (EXTI0_1, EXTI2_3 or EXTI4_15) must be bound to [`InterruptHandler`]; which
    /// one it is depends on the pin's number, so the type system does not check it here.
    pub unsafe fn new(input: Input<'d>) -> Self {
        let irq = match input.identity().1 {
            0..=1 => Interrupt::EXTI0_1,
            2..=3 => Interrupt::EXTI2_3,
            _ => Interrupt::EXTI4_15,
        };
        // SAFETY: the handler is bound, by this function's contract.
        unsafe { irq.enable() };
        Self { input }
    }

    /// Whether the pin is high.
    pub fn is_high(&self) -> bool {
        self.input.is_high()
    }

    /// Waits for an edge. Dropping the future disarms the line.
    pub async fn wait_for(&mut self, edge: Edge) {
        self.wait_until(edge, |_| false).await;
    }

    /// Waits for an edge or, looked at after the line is armed so that none slips through, for
    /// `done`.
    async fn wait_until(&mut self, edge: Edge, done: impl Fn(&Input<'d>) -> bool) {
        let line = arm(&self.input, edge);
        let _disarm = Disarm { bit: 1 << line };
        poll_fn(|cx| {
            WAKERS[line as usize].register(cx.waker());
            // The handler clears the enable bit of a line that fired.
            if regs::exti().inten.get() & 1 << line == 0 || done(&self.input) {
                Poll::Ready(())
            } else {
                Poll::Pending
            }
        })
        .await;
    }
}

struct Disarm {
    bit: u32,
}

impl Drop for Disarm {
    fn drop(&mut self) {
        critical_section::with(|_| regs::exti().inten.update(|bits| bits & !self.bit));
    }
}

impl embedded_hal::digital::ErrorType for ExtiInput<'_> {
    type Error = core::convert::Infallible;
}

impl embedded_hal_async::digital::Wait for ExtiInput<'_> {
    async fn wait_for_high(&mut self) -> Result<(), Self::Error> {
        self.wait_until(Edge::Rising, |input| input.is_high()).await;
        Ok(())
    }

    async fn wait_for_low(&mut self) -> Result<(), Self::Error> {
        self.wait_until(Edge::Falling, |input| input.is_low()).await;
        Ok(())
    }

    async fn wait_for_rising_edge(&mut self) -> Result<(), Self::Error> {
        self.wait_for(Edge::Rising).await;
        Ok(())
    }

    async fn wait_for_falling_edge(&mut self) -> Result<(), Self::Error> {
        self.wait_for(Edge::Falling).await;
        Ok(())
    }

    async fn wait_for_any_edge(&mut self) -> Result<(), Self::Error> {
        self.wait_for(Edge::Both).await;
        Ok(())
    }
}

/// A line whose edges call the application's own interrupt handler, at any priority (also 0, where
/// wakers must not be used). The handler must call [`RawLine::acknowledge`].
pub struct RawLine {
    bit: u32,
}

impl RawLine {
    /// Arms the line for good.
    pub fn new(input: &Input<'_>, edge: Edge) -> Self {
        Self { bit: 1 << arm(input, edge) }
    }

    /// Clears the pending flag of line `line`.
    #[inline(always)]
    pub fn acknowledge(line: u8) {
        regs::exti().pd.set(1 << line);
    }

    /// Whether the edge has come at line `line` since the last [`RawLine::acknowledge`].
    #[inline(always)]
    pub fn is_pending(line: u8) -> bool {
        regs::exti().pd.get() & 1 << line != 0
    }

    /// Stops the interrupts of line `line`. Also for its own handler, at whatever priority, as long
    /// as everyone else changes enable bits only while the line is masked.
    #[inline(always)]
    pub fn mask(line: u8) {
        regs::exti().inten.update(|bits| bits & !(1 << line));
    }

    /// Lets interrupts happen again; an edge in between is forgotten.
    pub fn unmask(line: u8) {
        critical_section::with(|_| {
            let exti = regs::exti();
            if exti.inten.get() & 1 << line == 0 {
                exti.pd.set(1 << line);
                exti.inten.update(|bits| bits | 1 << line);
            }
        });
    }

    /// Changes which edges count.
    pub fn select(&self, edge: Edge) {
        select(self.bit, edge);
    }

    /// Makes the interrupt happen as if the edge had come (EXTI_SWIEV).
    pub fn trigger(&self) {
        regs::exti().swiev.set(self.bit);
    }
}

/// Handler for all three EXTI interrupts.
pub struct InterruptHandler;

fn on_interrupt(lines: u32) {
    let exti = regs::exti();
    let fired = exti.pd.get() & exti.inten.get() & lines;
    critical_section::with(|_| exti.inten.update(|bits| bits & !fired));
    exti.pd.set(fired);
    for line in 0..16 {
        if fired & 1 << line != 0 {
            WAKERS[line].wake();
        }
    }
}

macro_rules! handler {
    ($irq:ident, $lines:literal) => {
        impl Handler<typelevel::$irq> for InterruptHandler {
            unsafe fn on_interrupt() {
                on_interrupt($lines);
            }
        }
    };
}
handler!(EXTI0_1, 0x0003);
handler!(EXTI2_3, 0x000c);
handler!(EXTI4_15, 0xfff0);
