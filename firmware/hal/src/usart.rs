//! USART with DMA (user manual, "Universal synchronous/asynchronous receiver/transmitter
//! (USART)"): a writer that sends by DMA, a reader whose DMA fills a ring without end.
//!
//! The reader wakes on the idle line, on the ring's half and on its end, so a message is seen as
//! soon as the sender pauses, and a continuous stream at least twice a lap.

use crate::Peri;
use crate::calc::baud::{self, BaudError};
use crate::calc::ring::RingReader;
use crate::dma::{self, Control, Transfer};
use crate::gpio::{self, Pin, Pull, Speed};
use crate::interrupt::typelevel::{self, Binding, Handler};
use crate::regs::{self, RegExt};
use core::future::poll_fn;
use core::marker::PhantomData;
use core::sync::atomic::{AtomicU32, Ordering, fence};
use core::task::Poll;
use embassy_hal_internal::PeripheralType;
use embassy_sync::waitqueue::AtomicWaker;

// USART_CTL0.
const UEN: u32 = 1 << 0;
const REN: u32 = 1 << 2;
const TEN: u32 = 1 << 3;
const IDLEIE: u32 = 1 << 4;
const TCIE: u32 = 1 << 6;
const OVSMOD: u32 = 1 << 15;
// USART_CTL2.
const ERRIE: u32 = 1 << 0;
const DENR: u32 = 1 << 6;
const DENT: u32 = 1 << 7;
// USART_STAT and USART_INTC.
const ERRORS: u32 = 0b1111; // PERR FERR NERR ORERR
const IDLEF: u32 = 1 << 4;
const TC: u32 = 1 << 6;

/// Line settings; 8 data bits, no parity, one stop bit.
#[non_exhaustive]
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// Bits per second.
    pub baud: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self { baud: 115_200 }
    }
}

/// What can go wrong on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Error {
    /// The ring was overwritten before it was read.
    Overrun {
        /// Bytes lost.
        lost: u32,
    },
    /// The DMA met a bus error.
    Dma,
}

impl core::fmt::Display for Error {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Overrun { .. } => "receive ring overwritten before it was read",
            Self::Dma => "bus error of the DMA",
        })
    }
}

impl core::error::Error for Error {}

impl embedded_io::Error for Error {
    fn kind(&self) -> embedded_io::ErrorKind {
        embedded_io::ErrorKind::Other
    }
}

mod sealed {
    pub trait Instance {
        const INDEX: u8;
        fn enable_clock();
        fn state() -> &'static super::State;
    }
}

/// What the interrupt and the futures share.
pub struct State {
    receive: AtomicWaker,
    transmit: AtomicWaker,
    line_errors: AtomicU32,
}

impl State {
    const fn new() -> Self {
        Self {
            receive: AtomicWaker::new(),
            transmit: AtomicWaker::new(),
            line_errors: AtomicU32::new(0),
        }
    }
}

/// A USART.
pub trait Instance: PeripheralType + sealed::Instance + 'static {
    /// Its interrupt.
    type Interrupt: typelevel::Interrupt;
    /// DMA channel of its transmitter.
    type TransmitDma: dma::Channel;
    /// DMA channel of its receiver.
    type ReceiveDma: dma::Channel;
}

macro_rules! usarts {
    ($($name:ident = $index:literal, $enable:ident, $bit:ident, $tx:ident, $rx:ident;)*) => {
        $(
            impl sealed::Instance for crate::peripherals::$name {
                const INDEX: u8 = $index;
                fn enable_clock() {
                    regs::rcu().$enable.modify(|_, w| w.$bit().set_bit());
                }
                fn state() -> &'static State {
                    static STATE: State = State::new();
                    &STATE
                }
            }
            impl Instance for crate::peripherals::$name {
                type Interrupt = typelevel::$name;
                type TransmitDma = crate::peripherals::$tx;
                type ReceiveDma = crate::peripherals::$rx;
            }
        )*
    };
}
// Channels without remapping (user manual, "DMA request mapping"; SYSCFG_CFG0).
usarts! {
    USART0 = 0, apb2en, usart0en, DMA_CH1, DMA_CH2;
    USART1 = 1, apb1en, usart1en, DMA_CH3, DMA_CH4;
}

/// A pin that can be the transmitter's output of `T`.
pub trait TxPin<T>: Pin {
    /// Alternate function number.
    const FUNCTION: u8;
}
/// A pin that can be the receiver's input of `T`.
pub trait RxPin<T>: Pin {
    /// Alternate function number.
    const FUNCTION: u8;
}
macro_rules! line_pins {
    ($($trait:ident $pin:ident: $usart:ident = AF $function:literal;)*) => {
        $(
            impl $trait<crate::peripherals::$usart> for crate::peripherals::$pin {
                const FUNCTION: u8 = $function;
            }
        )*
    };
}
line_pins! {
    TxPin PA9: USART0 = AF 1; RxPin PA10: USART0 = AF 1; TxPin PB6: USART0 = AF 0;
    RxPin PB7: USART0 = AF 0; TxPin PA2: USART1 = AF 1; RxPin PA3: USART1 = AF 1;
}

/// Sets a USART up and returns both ends. `ring` is filled by DMA for ever.
///
/// # Errors
/// [`BaudError`] where the clock cannot make the rate.
#[allow(clippy::too_many_arguments)]
pub fn new<T: Instance>(
    _usart: Peri<'static, T>,
    tx: Peri<'static, impl TxPin<T>>,
    rx: Peri<'static, impl RxPin<T>>,
    tx_dma: Peri<'static, T::TransmitDma>,
    rx_dma: Peri<'static, T::ReceiveDma>,
    ring: &'static mut [u8],
    irq: impl Binding<T::Interrupt, InterruptHandler<T>>,
    config: Config,
) -> Result<(Writer<T>, Reader<T>), BaudError> {
    let _ = irq;
    let (divisor, over8) = baud::divisor(crate::rcu::clocks().apb_hz, config.baud)?;
    T::enable_clock();
    let block = regs::usart(T::INDEX);
    block.ctl0.set(0);
    block.baud.set(u32::from(divisor));
    block.ctl1.set(0);
    block.ctl2.set(DENT | DENR | ERRIE);
    set_pin_tx::<T, _>(&*tx);
    set_pin_rx::<T, _>(&*rx);
    let over8 = if over8 { OVSMOD } else { 0 };
    block.ctl0.set(over8 | TEN | REN);
    block.ctl0.set(over8 | TEN | REN | IDLEIE | UEN);

    let number = <T::ReceiveDma as dma::Channel>::number();
    let control = Control::new(
        Control::CIRCULAR
            | Control::MEMORY_INCREMENT
            | Control::HALF_INTERRUPT
            | Control::FULL_INTERRUPT
            | Control::ERROR_INTERRUPT
            | Control::HIGH,
    );
    dma::start(number, control, block.rdata.as_ptr(), ring.as_ptr(), ring.len() as u16);
    let _ = rx_dma;
    // SAFETY: bound, by the parameter.
    unsafe { <T::Interrupt as typelevel::Interrupt>::enable() };
    let reader = RingReader::new(ring.len());
    Ok((Writer { dma: tx_dma, _usart: PhantomData }, Reader { reader, ring, _usart: PhantomData }))
}

fn set_pin_tx<T, P: TxPin<T>>(pin: &P) {
    gpio::set_alternate(pin, P::FUNCTION, Pull::Up, Speed::High);
}

fn set_pin_rx<T, P: RxPin<T>>(pin: &P) {
    gpio::set_alternate(pin, P::FUNCTION, Pull::Up, Speed::High);
}

/// The sending end.
pub struct Writer<T: Instance> {
    dma: Peri<'static, T::TransmitDma>,
    _usart: PhantomData<T>,
}

impl<T: Instance> Writer<T> {
    /// Sends all of `bytes`. Dropping the future stops sending after the byte on the line.
    ///
    /// # Errors
    /// [`Error::Dma`] where the bytes are not in memory that the DMA reaches.
    pub async fn write(&mut self, bytes: &[u8]) -> Result<(), Error> {
        if bytes.is_empty() {
            return Ok(());
        }
        let block = regs::usart(T::INDEX);
        let transfer = Transfer::write(&mut self.dma, bytes, block.tdata.as_ptr());
        if transfer.finish().await { Ok(()) } else { Err(Error::Dma) }
    }

    /// Waits until the last bit has left.
    pub async fn flush(&mut self) {
        let block = regs::usart(T::INDEX);
        poll_fn(|cx| {
            T::state().transmit.register(cx.waker());
            if block.stat.get() & TC != 0 {
                return Poll::Ready(());
            }
            critical_section::with(|_| block.ctl0.update(|bits| bits | TCIE));
            Poll::Pending
        })
        .await;
    }
}

impl<T: Instance> embedded_io::ErrorType for Writer<T> {
    type Error = Error;
}

impl<T: Instance> embedded_io_async::Write for Writer<T> {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Error> {
        Writer::write(self, bytes).await?;
        Ok(bytes.len())
    }

    async fn flush(&mut self) -> Result<(), Error> {
        Writer::flush(self).await;
        Ok(())
    }
}

/// The receiving end.
pub struct Reader<T: Instance> {
    reader: RingReader,
    ring: &'static mut [u8],
    _usart: PhantomData<T>,
}

impl<T: Instance> Reader<T> {
    /// Reads what has come, at least one byte. Dropping the future loses nothing.
    ///
    /// # Errors
    /// [`Error::Overrun`] once after bytes were lost; reading goes on after it.
    pub async fn read(&mut self, into: &mut [u8]) -> Result<usize, Error> {
        let number = <T::ReceiveDma as dma::Channel>::number();
        poll_fn(|cx| {
            T::state().receive.register(cx.waker());
            dma::register(number, cx.waker());
            if dma::failed(number) {
                return Poll::Ready(Err(Error::Dma));
            }
            let written = critical_section::with(|_| {
                let remaining = dma::remaining(number);
                let (laps, pending) = dma::laps(number);
                self.reader.written(laps, remaining, pending)
            });
            fence(Ordering::SeqCst);
            let range = match self.reader.available(written) {
                Ok(range) => range,
                Err(overrun) => return Poll::Ready(Err(Error::Overrun { lost: overrun.lost })),
            };
            if range.is_empty() {
                return Poll::Pending;
            }
            let count = range.len().min(into.len());
            for (offset, byte) in into[..count].iter_mut().enumerate() {
                // SAFETY: in range; volatile, because the DMA writes the ring behind the
                // compiler's back.
                *byte = unsafe { self.ring.as_ptr().add(range.start + offset).read_volatile() };
            }
            self.reader.consume(count);
            Poll::Ready(Ok(count))
        })
        .await
    }

    /// Framing, noise, parity and overrun errors of the line since the last call. The bytes in
    /// question were delivered as they came.
    pub fn take_line_errors(&mut self) -> u32 {
        critical_section::with(|_| {
            let errors = &T::state().line_errors;
            let count = errors.load(Ordering::Relaxed);
            errors.store(0, Ordering::Relaxed);
            count
        })
    }
}

impl<T: Instance> embedded_io::ErrorType for Reader<T> {
    type Error = Error;
}

impl<T: Instance> embedded_io_async::Read for Reader<T> {
    async fn read(&mut self, into: &mut [u8]) -> Result<usize, Error> {
        Reader::read(self, into).await
    }
}

/// Handler of the interrupt of `T`.
pub struct InterruptHandler<T: Instance> {
    _usart: PhantomData<T>,
}

impl<T: Instance> Handler<T::Interrupt> for InterruptHandler<T> {
    unsafe fn on_interrupt() {
        let block = regs::usart(T::INDEX);
        let stat = block.stat.get();
        let state = T::state();
        if stat & ERRORS != 0 {
            block.intc.set(stat & ERRORS);
            let count = state.line_errors.load(Ordering::Relaxed);
            state.line_errors.store(count.wrapping_add(1), Ordering::Relaxed);
        }
        if stat & IDLEF != 0 {
            block.intc.set(IDLEF);
            state.receive.wake();
        }
        if stat & TC != 0 && block.ctl0.get() & TCIE != 0 {
            critical_section::with(|_| block.ctl0.update(|bits| bits & !TCIE));
            state.transmit.wake();
        }
    }
}
