//! Small hand-assembled programs: what the emulator does without any firmware of ours.

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::image::Image;
use stspp_hil_mcu::soc::Variant;
use stspp_hil_mcu::soc::peripheral::ResetCause;
use stspp_hil_mcu::soc::pins::{Level, Pin};

/// Vector table of 16 words (stack at the end of RAM, all exceptions to a loop), then `code` at 0x40
/// and `literals` at 0x80.
fn program(code: &[u16], literals: &[u32]) -> Image {
    let mut words = vec![0x2000_4000, 0x0800_0041];
    // b . at 0x78.
    words.resize(16, 0x0800_0079);
    for pair in code.chunks(2) {
        words.push(u32::from(pair[0]) | u32::from(*pair.get(1).unwrap_or(&0xbf00)) << 16);
    }
    assert!(words.len() <= 30, "code is too long");
    words.resize(30, 0xbf00_bf00);
    words.push(0xbf00_e7fe);
    words.push(0xbf00_bf00);
    words.extend(literals);
    Image::from_words(&words)
}

/// `ldr rN, [literal]` at `address` for literal `index`.
fn load(register: u16, address: u16, index: u16) -> u16 {
    0x4800 | register << 8 | ((0x80 + 4 * index - ((address + 4) & !3)) / 4)
}

/// Toggles PB0 for ever: set, clear, branch back.
fn blinker() -> Image {
    let code = [
        load(0, 0x40, 0),
        load(1, 0x42, 1),
        0x6001, // str r1, [r0]: port clock
        load(0, 0x46, 2),
        0x2201, // movs r2, #1
        0x6002, // str r2, [r0]: PB0 is an output
        0x0413, // lsls r3, r2, #16
        0x6182, // str r2, [r0, #0x18]
        0x6183, // str r3, [r0, #0x18]
        0xe7fc, // b to the first of the two
    ];
    program(&code, &[0x4002_1014, 0x0004_0014, 0x4800_0400])
}

#[test]
fn edges_carry_the_cycle_of_their_store() {
    let mut chip = Chip::new(Variant::F330, &blinker());
    chip.run_until_ns(100_000);
    let pin = Pin { port: 1, number: 0 };
    let changes: Vec<_> = chip.take_pin_changes().into_iter().filter(|c| c.pin == pin).collect();
    assert!(changes.len() > 100);
    // Two stores of two cycles, a taken branch of three.
    for pair in changes[1..].chunks_exact(2) {
        assert_eq!(pair[0].level, Level::High);
        assert_eq!(pair[1].cycle - pair[0].cycle, 2);
    }
    let period = changes[3].cycle - changes[1].cycle;
    assert_eq!(period, 7);
    assert_eq!(chip.unmodelled(), []);
}

#[test]
fn a_register_without_a_model_is_named() {
    // Writes 1 to TIMER5.CTL0 and 0x300 to GPIOB.OSPD1's neighbour, with all clocks on.
    let code = [
        load(0, 0x40, 0),
        load(1, 0x42, 1),
        0x6001,
        load(0, 0x46, 2),
        load(1, 0x48, 3),
        0x6001, // str: RCU.CFG0 with CKOUTSEL
        load(0, 0x4c, 4),
        0x6001, // str: TIMER5.CTL0
        0xe7fe,
    ];
    let image = program(&code, &[0x4002_1014, 0x0004_0014, 0x4002_1004, 0x0400_0000, 0x4000_1000]);
    let mut chip = Chip::new(Variant::F330, &image);
    chip.run_until_ns(100_000);
    let names: Vec<String> = chip.unmodelled().into_iter().map(|entry| entry.what).collect();
    assert_eq!(
        names,
        [
            "RCU.CFG0 field CKOUTSEL written: not modelled",
            "TIMER5.CTL0 accessed: no model of that peripheral"
        ]
    );
}

#[test]
fn a_jump_into_nothing_locks_up_or_faults_and_power_cycles_recover() {
    let mut chip = Chip::new(Variant::F330, &blinker());
    chip.run_until_ns(50_000);
    chip.jump_to(0x6000_0000);
    chip.run_until_ns(100_000);
    // The fault handler is the endless loop at 0x78.
    assert_eq!(chip.registers()[15] & !1, 0x0800_0078);
    chip.brown_out(1_000_000);
    chip.run_for_ns(100_000);
    assert_eq!(chip.resets().iter().map(|r| r.cause).collect::<Vec<_>>(), [ResetCause::Power; 2]);
    assert!(chip.take_pin_changes().last().is_some_and(|c| c.time_ns > 1_050_000));
}
