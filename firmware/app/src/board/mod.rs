//! Pins and constants of the boards. All outputs lie on port B, so that one write switches any of
//! them together; what differs is in the sibling files.

#[cfg(feature = "board-f330")]
mod f330;
#[cfg(feature = "board-f330")]
pub(crate) use f330::{BOARD, CAPABILITIES, HAS_USB, spawn_link, usb_sof};
#[cfg(feature = "board-f350")]
mod f350;
#[cfg(feature = "board-f350")]
pub(crate) use f350::{BOARD, CAPABILITIES, HAS_USB, spawn_link, usb_sof};

#[cfg(not(any(feature = "board-f330", feature = "board-f350")))]
compile_error!("choose a board: feature `board-f330` or `board-f350`");
#[cfg(all(feature = "board-f330", feature = "board-f350"))]
compile_error!("choose one board only: feature `board-f330` or `board-f350`");

use embassy_gd32f3x0::reset;
use stspp_firmware_logic::controller::Identity;
use stspp_firmware_logic::runner::Effect;
use stspp_firmware_logic::timing::GateWord;
use stspp_protocol::version::{FirmwareVersion, SerialNumber};

/// Projectors on PB0 to PB9, floodlight on PB10.
pub(crate) const LIGHT_MASK: u32 = 0x07ff;
const FLOODLIGHT_PIN: u32 = 1 << 10;
/// Camera triggers on PB12 (left) and PB13 (right).
const TRIGGER_MASK: u32 = 0x3000;
/// GPIOB_BOP word that makes every output low.
pub(crate) const OFF_WORD: u32 = (LIGHT_MASK | TRIGGER_MASK) << 16;
/// Port B.
const GPIOB: usize = 0x4800_0400;

/// Pull-up of the thermistor divider, ohms; the thermistor is 10 kOhm at 25 degrees, B = 3950 K.
pub(crate) const NTC_PULL_UP_OHM: u32 = 10_000;

/// The settings' two pages: the last of the flash, beyond the program's area.
pub(crate) const SETTINGS_PAGES: [u32; 2] = [126 * 1024, 127 * 1024];

/// What the flashing tool looks for in the image: which board it is for.
#[used]
#[cfg_attr(feature = "board-f330", unsafe(export_name = "stspp_board_f330"))]
#[cfg_attr(feature = "board-f350", unsafe(export_name = "stspp_board_f350"))]
static BOARD_MARK: u32 = 0x5753_7453;

/// EXTI line of trigger-in, PA1. Line 0 is the interlock's.
pub(crate) const TRIGGER_LINE: u8 = 1;

/// Makes all outputs low and driven; evaluates to the drivers. Before this, since reset, the pins
/// float and the gates' pull-downs keep them off.
macro_rules! outputs {
    ($p:ident) => {{
        use embassy_gd32f3x0::gpio::{Level, Output, Speed};
        let output = |pin| Output::new(pin, Level::Low, Speed::High);
        [
            output(embassy_gd32f3x0::Peri::<embassy_gd32f3x0::gpio::AnyPin>::from($p.PB0.into())),
            output($p.PB1.into()),
            output($p.PB2.into()),
            output($p.PB3.into()),
            output($p.PB4.into()),
            output($p.PB5.into()),
            output($p.PB6.into()),
            output($p.PB7.into()),
            output($p.PB8.into()),
            output($p.PB9.into()),
            output($p.PB10.into()),
            output($p.PB12.into()),
            output($p.PB13.into()),
        ]
    }};
}
pub(crate) use outputs;

/// The port word of an effect: sets and resets exactly what the effect names.
pub(crate) fn port_word(effect: Effect) -> u32 {
    let mut word = 0;
    if let Some(gates) = effect.gates {
        let set = light_pins(gates);
        word |= set | (LIGHT_MASK & !set) << 16;
    }
    match effect.triggers {
        Some(true) => word |= TRIGGER_MASK,
        Some(false) => word |= TRIGGER_MASK << 16,
        None => {}
    }
    word
}

fn light_pins(gates: GateWord) -> u32 {
    let floodlight = if gates.floodlight() { FLOODLIGHT_PIN } else { 0 };
    u32::from(gates.projector_mask()) & 0x03ff | floodlight
}

/// All outputs low, from anywhere.
#[inline(always)]
pub(crate) fn outputs_off() {
    // SAFETY: GPIOB_BOP; a write to it is atomic and needs no owner.
    unsafe { ((GPIOB + 0x18) as *mut u32).write_volatile(OFF_WORD) }
}

/// Gates that are on, as the port's output register says.
#[inline(always)]
pub(crate) fn lit_pins() -> u32 {
    // SAFETY: GPIOB_OCTL, read only.
    unsafe { ((GPIOB + 0x14) as *const u32).read_volatile() & LIGHT_MASK }
}

/// Whether the floodlight is on.
pub(crate) fn floodlight_is_on() -> bool {
    lit_pins() & FLOODLIGHT_PIN != 0
}

/// Who this device is.
pub(crate) fn identity() -> Identity {
    let number =
        |text: &str| text.bytes().fold(0, |n: u8, b| n.wrapping_mul(10).wrapping_add(b - b'0'));
    Identity {
        board: BOARD,
        serial: SerialNumber(reset::unique_id()),
        firmware: FirmwareVersion {
            major: number(env!("CARGO_PKG_VERSION_MAJOR")),
            minor: number(env!("CARGO_PKG_VERSION_MINOR")),
            patch: number(env!("CARGO_PKG_VERSION_PATCH")),
        },
        capabilities: CAPABILITIES,
    }
}
