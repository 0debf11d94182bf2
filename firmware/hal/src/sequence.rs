//! Timed writes to a GPIO port, without the CPU: TIMER1's compare channels 2 and 3 and two DMA
//! channels.
//!
//! ```text
//!   TIMER1 CNT ==CH3CV --request--> DMA 3 --word[e]--> GPIOx_BOP         (the edge)
//!   TIMER1 CNT ==CH2CV --request--> DMA 0 --T[e+1]---> TIMER1_DMATB -.
//!        ^------------------ CH2CV, CH3CV <--------------------------'   (arms the next one)
//! ```
//!
//! Both compare registers hold the same time. Channel 2's request moves the next time into both
//! with a two-beat burst through TIMERx_DMATB (user manual, "General level0 timer": "Timer DMA
//! mode", TIMERx_DMACFG). The port's DMA channel has the highest priority, so an edge lags its
//! tick by the same few bus cycles every time. BOP switches any number of pins of the port at once
//! and leaves the others alone. Times are absolute, in the time driver's microseconds: no error
//! adds up, a chain that is not refilled stops, and 2^32 is crossed like any other value. The
//! bookkeeping is [`crate::calc::chain`], tested on the host against a model of this hardware.
//!
//! That the DMA reaches the ports is taken from the bus matrix and from published examples (user
//! manual, "System architecture"); channels 0 and 3 for TIMER1_CH2 and TIMER1_CH3 are inferred
//! from the identical map of a sibling family. Neither is proven on hardware here.

use crate::calc::chain::{Chain, ChainError, Edge};
use crate::dma::{self, Control};
use crate::gpio::Output;
use crate::interrupt::typelevel::{self, Binding, Handler};
use crate::peripherals::{DMA_CH0, DMA_CH3, TIMER1};
use crate::regs::{self, RegExt};
use crate::{Peri, time_driver};
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicU32, Ordering, fence};

/// Cells of the ring: how far ahead the producer can be.
pub const RING: usize = 64;

const PORT_CHANNEL: u8 = 3;
const TIME_CHANNEL: u8 = 0;

// TIMERx_DMAINTEN.
const CH3_INTERRUPT: u32 = 1 << 4;
const CH2_DMA: u32 = 1 << 11;
const CH3_DMA: u32 = 1 << 12;
/// TIMERx_INTF: CH3IF.
const CH3_FLAG: u32 = 1 << 4;
/// TIMERx_DMACFG: a burst of two beats (DMATC = 1) from CH2CV on (DMATA = 0x3C / 4).
const BURST_CH2CV_CH3CV: u32 = 1 << 8 | 0x3c / 4;

/// What the DMA channels read. Only the driver writes it, cells that no channel is about to read.
struct Rings {
    words: UnsafeCell<[u32; RING]>,
    times: UnsafeCell<[[u32; 2]; RING]>,
}
// SAFETY: written by the one `Sequence` (the singletons guarantee that there is one), read by DMA.
unsafe impl Sync for Rings {}

static RINGS: Rings =
    Rings { words: UnsafeCell::new([0; RING]), times: UnsafeCell::new([[0; 2]; RING]) };

/// Called from TIMER1's interrupt after each edge, with the number of edges since start. A plain
/// function pointer in an atomic, because the interrupt must not wait for anything.
static ON_EDGE: AtomicU32 = AtomicU32::new(0);

/// The driver.
pub struct Sequence<'d> {
    chain: Chain<RING>,
    port: u8,
    running: bool,
    _timer: Peri<'d, TIMER1>,
    _port_channel: Peri<'d, DMA_CH3>,
    _time_channel: Peri<'d, DMA_CH0>,
}

impl<'d> Sequence<'d> {
    /// Takes the timer's free channels and the DMA channels that serve them. `pins` names the port:
    /// all the outputs that the words will switch must be on it.
    ///
    /// # Panics
    /// When the outputs are not all on one port, or there are none.
    pub fn new(
        timer: Peri<'d, TIMER1>,
        port_channel: Peri<'d, DMA_CH3>,
        time_channel: Peri<'d, DMA_CH0>,
        pins: &[&Output<'_>],
        _irq: impl Binding<typelevel::TIMER1, InterruptHandler>,
    ) -> Self {
        let port = pins[0].identity().0;
        assert!(pins.iter().all(|pin| pin.identity().0 == port), "outputs on different ports");
        Self {
            chain: Chain::new(),
            port,
            running: false,
            _timer: timer,
            _port_channel: port_channel,
            _time_channel: time_channel,
        }
    }

    /// Sets the function that the interrupt calls after every edge.
    pub fn on_edge(&mut self, hook: fn()) {
        ON_EDGE.store(hook as usize as u32, Ordering::Relaxed);
    }

    /// Starts an empty chain.
    pub fn start(&mut self) {
        self.stop();
        self.chain = Chain::new();
        let timer = regs::timer1();
        // A time just passed: nothing happens until the first edge is appended.
        let passed = time_driver::counter().wrapping_sub(1);
        timer.ch2cv.set(passed);
        timer.ch3cv.set(passed);
        // SAFETY: both channels are stopped.
        unsafe {
            RINGS.times.get().write([[passed; 2]; RING]);
            RINGS.words.get().write([0; RING]);
        }
        timer.dmacfg.set(BURST_CH2CV_CH3CV);
        let common =
            Control::TO_PERIPHERAL | Control::CIRCULAR | Control::MEMORY_INCREMENT | Control::WORDS;
        dma::start(
            PORT_CHANNEL,
            Control::new(common | Control::ULTRA),
            regs::gpio(self.port).bop.as_ptr(),
            RINGS.words.get().cast(),
            RING as u16,
        );
        dma::start(
            TIME_CHANNEL,
            Control::new(common | Control::HIGH),
            timer.dmatb.as_ptr(),
            RINGS.times.get().cast(),
            2 * RING as u16,
        );
        timer.intf.set(!(CH3_FLAG | 1 << 3));
        critical_section::with(|_| {
            timer.dmainten.update(|bits| bits | CH2_DMA | CH3_DMA | CH3_INTERRUPT);
        });
        self.running = true;
    }

    /// Stops the chain; the port keeps its levels.
    pub fn stop(&mut self) {
        halt();
        self.running = false;
    }

    /// Whether [`Sequence::start`] was called, and nothing has halted the chain since.
    pub fn is_running(&self) -> bool {
        let on = |channel| regs::dma_channel(channel).ctl.get() & Control::ENABLE != 0;
        self.running && on(PORT_CHANNEL) && on(TIME_CHANNEL)
    }

    /// Appends edges, all of them or none.
    pub fn append(&mut self, edges: &[Edge]) -> Result<(), ChainError> {
        if edges.is_empty() {
            return Ok(());
        }
        // From the look at the clock to the compare register nothing may come between but the
        // interrupt of priority 0, which takes a few microseconds of the margin of 20.
        critical_section::with(|_| {
            self.chain.update(dma::remaining(PORT_CHANNEL));
            let event = self.chain.appended();
            self.chain.append(time_driver::counter(), edges, |word, time, edge| {
                // SAFETY: `Chain` gives out cells that the channels are not about to read.
                unsafe {
                    RINGS.words.get().cast::<u32>().add(word).write_volatile(edge.word);
                    RINGS.times.get().cast::<[u32; 2]>().add(time).write_volatile([edge.at; 2]);
                }
            })?;
            fence(Ordering::SeqCst);
            if self.chain.must_arm(event, dma::remaining(PORT_CHANNEL)) {
                let timer = regs::timer1();
                timer.ch2cv.set(edges[0].at);
                timer.ch3cv.set(edges[0].at);
            }
            Ok(())
        })
    }

    /// Takes back edge number `first` (counted since [`Sequence::start`]) and all after it.
    pub fn retract(&mut self, first: u32) -> Result<(), ChainError> {
        let time_cell = |event: u32| event.wrapping_sub(1) as usize % RING;
        critical_section::with(|_| {
            self.chain.update(dma::remaining(PORT_CHANNEL));
            // SAFETY: cells in range; only this driver writes them.
            let time = |event| unsafe {
                RINGS.times.get().cast::<[u32; 2]>().add(time_cell(event)).read_volatile()[0]
            };
            let now = time_driver::counter();
            let cell = self.chain.retract(now, first, time(first), time(first.wrapping_sub(1)))?;
            let passed = now.wrapping_sub(1);
            // SAFETY: as above; the channel reads either the old time, which lies ahead, or this.
            unsafe {
                RINGS.times.get().cast::<[u32; 2]>().add(cell).write_volatile([passed; 2]);
            }
            fence(Ordering::SeqCst);
            if self.chain.must_arm(first, dma::remaining(PORT_CHANNEL)) {
                let timer = regs::timer1();
                timer.ch2cv.set(passed);
                timer.ch3cv.set(passed);
            }
            Ok(())
        })
    }

    /// Number of edges that have happened since [`Sequence::start`].
    pub fn happened(&mut self) -> u32 {
        self.chain.update(dma::remaining(PORT_CHANNEL))
    }

    /// Edges appended since [`Sequence::start`].
    pub fn appended(&self) -> u32 {
        self.chain.appended()
    }

    /// Edges for which there is room.
    pub fn free(&mut self) -> usize {
        self.happened();
        self.chain.free()
    }
}

/// Stops the chain from anywhere: interrupts of priority 0, fault handlers. No transfer starts
/// after it returns.
#[inline(always)]
pub fn halt() {
    dma::stop(PORT_CHANNEL);
    dma::stop(TIME_CHANNEL);
}

/// Position of the chain in its ring, for the interrupt hook: cell of the next edge.
#[inline(always)]
pub fn cell() -> usize {
    (RING as u32 - dma::remaining(PORT_CHANNEL)) as usize & (RING - 1)
}

/// Word stored in a cell of the ring.
#[inline(always)]
pub fn word(cell: usize) -> u32 {
    // SAFETY: in range by the mask; a cell is written only while no edge of it is due.
    unsafe { RINGS.words.get().cast::<u32>().add(cell & (RING - 1)).read_volatile() }
}

/// Handler of TIMER1's interrupt for edges.
pub struct InterruptHandler;

impl Handler<typelevel::TIMER1> for InterruptHandler {
    unsafe fn on_interrupt() {
        let timer = regs::timer1();
        if timer.intf.get() & CH3_FLAG == 0 {
            return;
        }
        timer.intf.set(!CH3_FLAG);
        let hook = ON_EDGE.load(Ordering::Relaxed);
        if hook != 0 {
            // SAFETY: only `on_edge` writes it, from a `fn()`.
            let hook: fn() = unsafe { core::mem::transmute(hook as usize) };
            hook();
        }
    }
}
