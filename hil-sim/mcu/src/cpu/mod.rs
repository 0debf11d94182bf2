//! The processor core behind a small interface, so that the instruction interpreter can be another
//! one.

mod rsemu_core;

pub use rsemu_core::{RsemuCpu, shared_memory};

/// Memory that the core and the rest of the chip share.
pub trait SharedMemory: Send + Sync {
    /// Size in bytes.
    fn bytes(&self) -> u32;

    /// Reads 1, 2 or 4 bytes, little-endian. Beyond the end: 0.
    fn read(&self, offset: u32, bytes: u32) -> u32;

    /// Writes 1, 2 or 4 bytes, little-endian. Beyond the end: nothing.
    fn write(&self, offset: u32, bytes: u32, value: u32);
}

/// The bus refused an access.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusFault;

/// What is on the core's bus besides memory.
pub trait Bus: Send {
    /// Reads 1, 2 or 4 bytes.
    ///
    /// # Errors
    /// Nothing answers at `address`.
    fn read(&mut self, address: u32, bytes: u32) -> Result<u32, BusFault>;

    /// Writes 1, 2 or 4 bytes.
    ///
    /// # Errors
    /// Nothing answers at `address`.
    fn write(&mut self, address: u32, bytes: u32, value: u32) -> Result<(), BusFault>;
}

/// A Cortex-M4F with its NVIC, SysTick and system control block.
pub trait Cpu: Send {
    /// Runs one instruction or one exception entry; returns the cycles it took.
    fn step(&mut self) -> u64;

    /// Sets the level of an interrupt input.
    fn set_irq(&mut self, irq: u16, high: bool);

    /// Raises the non-maskable interrupt.
    fn raise_nmi(&mut self);

    /// Sets the debug fault status register: bit 0 after a halt by a debugger. Only a power-on and the
    /// program itself clear it.
    fn set_debug_events(&mut self, events: u32);

    /// Whether the core sleeps and nothing is pending that would wake it.
    fn is_idle(&self) -> bool;

    /// Whether a fault inside a fault handler has stopped the core for good.
    fn is_locked_up(&self) -> bool;

    /// Lets `cycles` pass for the core's own timers while it sleeps or is stalled.
    fn skip(&mut self, cycles: u64);

    /// Cycles until SysTick would wake the core, if it runs.
    fn own_deadline(&self) -> Option<u64>;

    /// Whether the firmware asked for a system reset since the last call.
    fn take_reset_request(&mut self) -> bool;

    /// Resets the core: it starts from the vector table at address 0.
    fn reset(&mut self);

    /// The program counter.
    fn pc(&self) -> u32;

    /// Moves the program counter (fault injection).
    fn set_pc(&mut self, pc: u32);

    /// Writes one of r0 to r12 (fault injection).
    fn set_register(&mut self, index: u8, value: u32);

    /// Registers r0 to r15 and xPSR, for reports.
    fn registers(&self) -> [u32; 17];
}
