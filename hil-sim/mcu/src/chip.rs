//! The whole chip in virtual time: the core, the peripherals, and what the world does to them.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::clock::Clocks;
use crate::cpu::{Cpu, RsemuCpu, SharedMemory, shared_memory};
use crate::image::{Image, RAM_BASE};
use crate::soc::access_log::Unmodelled;
use crate::soc::fmc::FLASH_BASE;
use crate::soc::peripheral::{Cx, ResetCause};
use crate::soc::pins::{Level, Pin, PinChange};
use crate::soc::{FLASH_BYTES, RAM_BYTES, Shared, Soc, Variant};

/// Cycles that the reset pin stays low before the core starts (datasheet: about 20 us at 8 MHz).
const RESET_CYCLES: u64 = 160;
/// What [`Chip::paint_stack`] writes.
const PAINT: u32 = 0xa5c3_5a3c;
/// How often the loop looks whether the core sleeps, in one-cycle steps.
const IDLE_CHECK_STEPS: u32 = 4;

/// What stopped the core other than a reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stop {
    Running,
    /// A debugger halted it.
    Halted,
    /// It loops without making progress, whatever its program says (fault injection).
    Hung,
    /// No supply.
    Off,
}

/// A reset that happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResetEvent {
    /// Nanoseconds since the first power-on.
    pub time_ns: u64,
    /// Why.
    pub cause: ResetCause,
}

/// A GD32F3x0 with a firmware in its flash.
pub struct Chip {
    cpu: Box<dyn Cpu>,
    soc: Arc<Mutex<Soc>>,
    shared: Arc<Shared>,
    flash: Arc<dyn SharedMemory>,
    ram: Arc<dyn SharedMemory>,
    clocks: Clocks,
    now: u64,
    applied_irqs: u128,
    stop: Stop,
    resets: Vec<ResetEvent>,
    instructions: u64,
    lockup_seen: bool,
    noise: u64,
    fault_limit: Option<u64>,
}

impl Chip {
    /// Powers a chip that has `image` in its flash. RAM holds noise, as after power-on.
    #[must_use]
    pub fn new(variant: Variant, image: &Image) -> Self {
        let (flash_store, flash) = shared_memory(FLASH_BYTES);
        let (ram_store, ram) = shared_memory(RAM_BYTES);
        for (offset, word) in image.flash.chunks_exact(4).enumerate() {
            flash.write(
                4 * offset as u32,
                4,
                u32::from_le_bytes([word[0], word[1], word[2], word[3]]),
            );
        }
        let shared = Arc::new(Shared::default());
        let soc = Soc::new(variant, Arc::clone(&shared), Arc::clone(&flash), Arc::clone(&ram));
        let clocks = soc.clocks;
        let soc = Arc::new(Mutex::new(soc));
        let cpu = Box::new(RsemuCpu::new(flash_store, ram_store, &soc));
        let mut chip = Self {
            cpu,
            soc,
            shared,
            flash,
            ram,
            clocks,
            now: 0,
            applied_irqs: 0,
            stop: Stop::Running,
            resets: Vec::new(),
            instructions: 0,
            lockup_seen: false,
            noise: 0x9e37_79b9_7f4a_7c15,
            fault_limit: None,
        };
        chip.fill_ram_with_noise();
        chip.reset(ResetCause::Power);
        chip
    }

    fn fill_ram_with_noise(&mut self) {
        for word in 0..RAM_BYTES / 4 {
            self.noise ^= self.noise << 13;
            self.noise ^= self.noise >> 7;
            self.noise ^= self.noise << 17;
            self.ram.write(4 * word, 4, self.noise as u32);
        }
    }

    /// The peripherals. The lock is free whenever the chip does not run.
    pub fn soc(&self) -> MutexGuard<'_, Soc> {
        self.soc.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets the world act on the peripherals now.
    pub fn act<T>(&mut self, act: impl FnOnce(&mut Soc, &mut Cx<'_>) -> T) -> T {
        let now = self.now;
        let result = self.soc().act(now, act);
        self.attend();
        result
    }

    /// Nanoseconds since the first power-on.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.clocks.ns_at(self.now)
    }

    /// HCLK cycles since the first power-on.
    #[must_use]
    pub fn now_cycles(&self) -> u64 {
        self.now
    }

    /// Core clock in hertz.
    #[must_use]
    pub fn hclk_hz(&self) -> u32 {
        self.clocks.hclk_hz
    }

    /// Instructions executed so far.
    #[must_use]
    pub fn instructions(&self) -> u64 {
        self.instructions
    }

    /// Resets so far, power-on included.
    #[must_use]
    pub fn resets(&self) -> &[ResetEvent] {
        &self.resets
    }

    /// What the firmware touched that is not modelled.
    #[must_use]
    pub fn unmodelled(&self) -> Vec<Unmodelled> {
        self.soc().log.list()
    }

    /// Takes the pin changes so far, in time order.
    pub fn take_pin_changes(&mut self) -> Vec<PinChange> {
        self.soc().take_pin_changes()
    }

    /// What the chip does to a pin now.
    #[must_use]
    pub fn pin_level(&self, pin: Pin) -> Level {
        self.soc().pin_level(pin)
    }

    /// Drives an input pin from outside, or lets go of it.
    pub fn drive_pin(&mut self, pin: Pin, level: Option<bool>) {
        let now = self.now;
        self.soc().drive_pin(pin, level, now);
        self.attend();
    }

    /// Lets virtual time pass up to `time_ns`.
    pub fn run_until_ns(&mut self, time_ns: u64) {
        loop {
            let limit = self.clocks.cycle_at(time_ns);
            if self.now >= limit {
                return;
            }
            self.run_until_cycle(limit);
        }
    }

    /// Lets virtual time pass by `ns`.
    pub fn run_for_ns(&mut self, ns: u64) {
        self.run_until_ns(self.now_ns() + ns);
    }

    /// Runs until `done` or for at most `ns`; whether it was done. `done` is asked every `step_ns`.
    pub fn run_until(
        &mut self,
        ns: u64,
        step_ns: u64,
        mut done: impl FnMut(&mut Chip) -> bool,
    ) -> bool {
        let end = self.now_ns() + ns;
        while self.now_ns() < end {
            if done(self) {
                return true;
            }
            self.run_until_ns((self.now_ns() + step_ns).min(end));
        }
        done(self)
    }

    /// Runs to `limit`, or to the next change of the clocks.
    fn run_until_cycle(&mut self, limit: u64) {
        let clocks = self.clocks;
        let mut short_steps = 0;
        while self.now < limit {
            if self.shared.next_event.load(Ordering::Relaxed) <= self.now {
                let now = self.now;
                self.soc().advance(now);
            }
            if self.shared.attention.load(Ordering::Relaxed) {
                self.attend();
                if self.clocks != clocks {
                    return;
                }
            }
            if self.stop != Stop::Running {
                self.now = limit.min(self.shared.next_event.load(Ordering::Relaxed));
                continue;
            }
            self.shared.now.store(self.now, Ordering::Relaxed);
            let cycles = self.cpu.step();
            self.instructions += 1;
            self.now += cycles;
            short_steps = if cycles == 1 { short_steps + 1 } else { 0 };
            if short_steps >= IDLE_CHECK_STEPS {
                short_steps = 0;
                self.skip_idle(limit);
            } else if self.instructions & 0x3ff == 0 {
                self.look_after_core(limit);
            }
        }
    }

    /// Jumps over the time in which the core sleeps.
    fn skip_idle(&mut self, limit: u64) {
        if self.cpu.is_locked_up() {
            self.look_after_core(limit);
            return;
        }
        if self.cpu.is_idle() && !self.shared.attention.load(Ordering::Relaxed) {
            let mut until = limit.min(self.shared.next_event.load(Ordering::Relaxed));
            if let Some(own) = self.cpu.own_deadline() {
                until = until.min(self.now + own);
            }
            if until > self.now {
                self.cpu.skip(until - self.now);
                self.now = until;
            }
        }
    }

    /// Resets that the core asked for, and lock-ups.
    fn look_after_core(&mut self, limit: u64) {
        if self.cpu.take_reset_request() {
            self.reset(ResetCause::Software);
        }
        if self.cpu.is_locked_up() {
            if !self.lockup_seen {
                self.lockup_seen = true;
                let now = self.now;
                self.soc().core_locked_up(now);
                self.attend();
            }
            let until = limit.min(self.shared.next_event.load(Ordering::Relaxed));
            self.now = self.now.max(until);
        }
    }

    /// Applies interrupt lines, resets, clock changes and flash waits.
    fn attend(&mut self) {
        self.shared.attention.store(false, Ordering::Relaxed);
        let (levels, reset, nmi, clocks) = {
            let mut soc = self.soc();
            (soc.irq_levels(), soc.take_reset(), soc.take_nmi(), soc.clocks)
        };
        self.clocks = clocks;
        if nmi {
            self.cpu.raise_nmi();
        }
        if let Some(cause) = reset {
            self.reset(cause);
            return;
        }
        let mut changed = levels ^ self.applied_irqs;
        while changed != 0 {
            let irq = changed.trailing_zeros();
            self.cpu.set_irq(irq as u16, levels >> irq & 1 != 0);
            changed &= changed - 1;
        }
        self.applied_irqs = levels;
        self.wait_for_flash();
    }

    /// While the flash is programmed or erased, a core that executes from it waits.
    fn wait_for_flash(&mut self) {
        let busy = self.soc().fmc.busy_until();
        if let Some(until) = busy
            && self.stop == Stop::Running
            && self.executes_from_flash()
            && self.fault_limit.is_none_or(|limit| until < limit)
            && until > self.now
        {
            self.cpu.skip(until - self.now);
            self.now = until;
            self.soc().advance(until);
        }
    }

    fn executes_from_flash(&self) -> bool {
        let pc = self.cpu.pc();
        pc < FLASH_BYTES || pc.wrapping_sub(FLASH_BASE) < FLASH_BYTES
    }

    /// Resets the chip.
    pub fn reset(&mut self, cause: ResetCause) {
        let time_ns = self.now_ns();
        self.resets.push(ResetEvent { time_ns, cause });
        self.cpu.reset();
        if cause == ResetCause::Power {
            self.cpu.set_debug_events(0);
        }
        self.applied_irqs = 0;
        self.lockup_seen = false;
        self.stop = Stop::Running;
        let now = self.now;
        let clocks = {
            let mut soc = self.soc();
            soc.reset(cause, now);
            soc.clocks
        };
        self.clocks = clocks;
        self.now += RESET_CYCLES;
        self.shared.attention.store(true, Ordering::Relaxed);
    }

    /// A debugger halts the core, or lets it go on.
    pub fn set_debug_halt(&mut self, halted: bool) {
        self.stop = if halted { Stop::Halted } else { Stop::Running };
        if halted {
            // DFSR.HALTED.
            self.cpu.set_debug_events(1);
        }
        let now = self.now;
        self.soc().set_halted(halted, now);
        self.attend();
    }

    /// The board's crystal stops, or works (again).
    pub fn set_crystal(&mut self, works: bool) {
        let now = self.now;
        self.soc().set_crystal(works, now);
        self.attend();
    }

    /// The core stops making progress, with all interrupts masked, until a reset.
    pub fn hang(&mut self) {
        self.stop = Stop::Hung;
    }

    /// Sets a timer's counter, as if so much time had passed (the firmware is not asked).
    pub fn advance_timer(&mut self, timer: crate::soc::peripheral::TimerId, count: u32) {
        self.act(|soc, cx| {
            use crate::soc::peripheral::Peripheral;
            soc.timers[timer.index()].write(0x24, count, cx);
        });
    }

    /// Lets time pass until the core executes (at most 100 ms): a sleeping core cannot go astray.
    pub fn run_until_awake(&mut self) {
        for _ in 0..100_000 {
            if !self.cpu.is_idle() {
                return;
            }
            self.run_for_ns(1_000);
        }
    }

    /// The program goes astray: the core continues at `address`.
    pub fn jump_to(&mut self, address: u32) {
        self.cpu.set_pc(address & !1);
    }

    /// The program calls the function at `address` with `argument`, which is not expected to return.
    pub fn call(&mut self, address: u32, argument: u32) {
        self.cpu.set_register(0, argument);
        self.cpu.set_pc(address & !1);
    }

    /// Fills the unused part of the stack with a pattern, for [`Chip::stack_used`].
    pub fn paint_stack(&mut self, image: &Image) {
        let end = RAM_BASE + RAM_BYTES;
        // Before the first instruction the stack pointer is not loaded yet.
        let top =
            Some(self.cpu.registers()[13]).filter(|sp| (RAM_BASE..end).contains(sp)).unwrap_or(end);
        let mut address = image.stack_limit();
        // The words just below the stack pointer may be in use by an exception entry.
        while address + 64 < top {
            self.poke(address, PAINT);
            address += 4;
        }
    }

    /// Bytes of stack that were ever used since [`Chip::paint_stack`].
    #[must_use]
    pub fn stack_used(&self, image: &Image) -> u32 {
        let mut address = image.stack_limit();
        while address < RAM_BASE + RAM_BYTES && self.peek(address) == PAINT {
            address += 4;
        }
        RAM_BASE + RAM_BYTES - address
    }

    /// The supply fails: pins float, a flash operation in progress is torn.
    pub fn power_off(&mut self) {
        let noise = self.noise | 1;
        let now = self.now;
        {
            let mut soc = self.soc();
            soc.advance(now);
            soc.fmc.power_cut(noise);
            soc.reset(ResetCause::Power, now);
            soc.take_reset();
        }
        self.attend();
        self.stop = Stop::Off;
    }

    /// The supply comes back: RAM holds noise, the flash what it held.
    pub fn power_on(&mut self) {
        self.fill_ram_with_noise();
        self.reset(ResetCause::Power);
    }

    /// The supply dips below the power-on-reset level for `ns` (datasheet: VPOR): the outputs float
    /// at once, RAM is lost.
    pub fn brown_out(&mut self, ns: u64) {
        self.power_off();
        self.run_for_ns(ns);
        self.power_on();
    }

    /// Reads RAM or flash without side effects.
    #[must_use]
    pub fn peek(&self, address: u32) -> u32 {
        self.memory_at(address).map_or(0, |(memory, offset)| memory.read(offset, 4))
    }

    /// Reads bytes of RAM or flash.
    #[must_use]
    pub fn peek_bytes(&self, address: u32, count: usize) -> Vec<u8> {
        (0..count as u32)
            .map(|n| {
                self.memory_at(address + n)
                    .map_or(0, |(memory, offset)| memory.read(offset, 1) as u8)
            })
            .collect()
    }

    /// Writes RAM or flash without side effects.
    pub fn poke(&mut self, address: u32, value: u32) {
        if let Some((memory, offset)) = self.memory_at(address) {
            memory.write(offset, 4, value);
        }
    }

    fn memory_at(&self, address: u32) -> Option<(&dyn SharedMemory, u32)> {
        let (flash, ram) = (address.wrapping_sub(FLASH_BASE), address.wrapping_sub(RAM_BASE));
        if flash < FLASH_BYTES {
            Some((&*self.flash, flash))
        } else if ram < RAM_BYTES {
            Some((&*self.ram, ram))
        } else {
            None
        }
    }

    /// The core's registers r0 to r15 and xPSR.
    #[must_use]
    pub fn registers(&self) -> [u32; 17] {
        self.cpu.registers()
    }
}
