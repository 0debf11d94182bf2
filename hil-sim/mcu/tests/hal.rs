//! The parts of the HAL that the sensor's firmware does not use, by a small program of their own
//! (`firmware/exercise`), against the emulated pins and lines.

mod common;

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::controller::firmware_elf;
use stspp_hil_mcu::image::Image;
use stspp_hil_mcu::soc::Variant;
use stspp_hil_mcu::soc::pins::{Level, Pin, PinChange};

const fn pin(port: u8, number: u8) -> Pin {
    Pin { port, number }
}

fn running(variant: Variant) -> Option<Chip> {
    let elf = firmware_elf(variant);
    let name = format!("exercise-{}", elf.file_name()?.to_str()?);
    let elf = elf.with_file_name(name);
    if !elf.exists() {
        println!(
            "SKIPPED for {variant:?}: {} is not there; `cargo xtask firmware --exercise` builds it",
            elf.display()
        );
        return None;
    }
    let image = Image::load(&elf).unwrap_or_else(|error| panic!("{error}"));
    let mut chip = Chip::new(variant, &image);
    for input in [pin(1, 5), pin(0, 7), pin(0, 6)] {
        chip.drive_pin(input, Some(false));
    }
    chip.soc().usarts[1].set_host_baud(115_200);
    chip.run_for_ns(20_000_000);
    chip.take_pin_changes();
    Some(chip)
}

fn changes(chip: &mut Chip, of: Pin) -> Vec<PinChange> {
    chip.take_pin_changes().into_iter().filter(|change| change.pin == of).collect()
}

/// Length of the high part and of the whole of the periods in `changes`, in nanoseconds.
fn periods(changes: &[PinChange]) -> Vec<(u64, u64)> {
    let start = usize::from(changes.first().is_some_and(|c| c.level != Level::High));
    changes[start..]
        .windows(3)
        .step_by(2)
        .map(|w| (w[1].time_ns - w[0].time_ns, w[2].time_ns - w[0].time_ns))
        .collect()
}

#[test]
fn pwm_makes_the_frequency_and_the_duty_cycle() {
    for variant in common::BOARDS {
        let Some(mut chip) = running(variant) else { continue };
        chip.run_for_ns(50_000_000);
        let quarter = periods(&changes(&mut chip, pin(1, 14)));
        assert!(quarter.len() >= 48, "{variant:?}: {}", quarter.len());
        for (high_ns, period_ns) in quarter {
            assert!(period_ns.abs_diff(1_000_000) <= 20, "{variant:?}: {period_ns} ns");
            assert!(high_ns.abs_diff(250_000) <= 40, "{variant:?}: {high_ns} ns");
        }
        // The other one follows what comes over USART1.
        for byte in [64u8, 200, 0, 255] {
            chip.act(|soc, cx| soc.usarts[1].host_send(&[byte], cx));
            chip.run_for_ns(2_000_000);
            chip.take_pin_changes();
            chip.run_for_ns(2_000_000);
            let dimmed = periods(&changes(&mut chip, pin(1, 4)));
            if byte == 0 {
                assert_eq!(dimmed, [], "{variant:?}: off");
                continue;
            }
            assert!(dimmed.len() >= 38, "{variant:?}, {byte}: {}", dimmed.len());
            let wanted_ns = 50_000 * u64::from(byte) / 256;
            for (high_ns, period_ns) in dimmed {
                assert!(period_ns.abs_diff(50_000) <= 20, "{variant:?}: {period_ns} ns");
                assert!(high_ns.abs_diff(wanted_ns) <= 40, "{variant:?}, {byte}: {high_ns} ns");
            }
        }
        println!("{variant:?}: PWM of 1 kHz and 20 kHz to 40 ns");
        common::assert_chip_modelled(&chip);
    }
}

#[test]
fn usart1_echoes_every_byte() {
    for variant in common::BOARDS {
        let Some(mut chip) = running(variant) else { continue };
        let sent: Vec<u8> = (0..=255).collect();
        for part in sent.chunks(40) {
            chip.act(|soc, cx| soc.usarts[1].host_send(part, cx));
            chip.run_for_ns(10_000_000);
        }
        let echoed: Vec<u8> =
            chip.soc().usarts[1].take_sent().into_iter().map(|sent| sent.byte).collect();
        let expected: Vec<u8> = sent.iter().map(|byte| byte.wrapping_add(1)).collect();
        assert_eq!(echoed, expected, "{variant:?}");
        common::assert_chip_modelled(&chip);
    }
}

#[test]
fn inputs_are_awaited_and_delays_kept() {
    for variant in common::BOARDS {
        let Some(mut chip) = running(variant) else { continue };
        let mut slowest_ns = 0;
        for n in 0..50u64 {
            let high = n % 2 == 0;
            let at_ns = chip.now_ns();
            chip.drive_pin(pin(1, 5), Some(high));
            chip.run_for_ns(100_000 + 777 * n);
            let followed = changes(&mut chip, pin(1, 6));
            let [change] = &followed[..] else { panic!("{variant:?}: {followed:?}") };
            assert_eq!(change.level == Level::High, high);
            slowest_ns = slowest_ns.max(change.time_ns - at_ns);
        }
        println!("{variant:?}: an awaited edge is followed within {slowest_ns} ns");
        assert!(slowest_ns < 20_000);

        for n in 0..10u64 {
            chip.drive_pin(pin(0, 7), Some(true));
            chip.run_for_ns(50_000);
            chip.drive_pin(pin(0, 7), Some(false));
            chip.run_for_ns(50_000);
            let toggled = changes(&mut chip, pin(1, 7));
            assert_eq!(toggled.len(), 1, "{variant:?}: rising edges only");
            assert_eq!(toggled[0].level == Level::High, n % 2 == 0);
        }

        chip.drive_pin(pin(0, 6), Some(true));
        chip.run_for_ns(20_000_000);
        chip.drive_pin(pin(0, 6), Some(false));
        chip.run_for_ns(5_000_000);
        let pulses = periods(&changes(&mut chip, pin(1, 8)));
        assert!(pulses.len() >= 14, "{variant:?}: {}", pulses.len());
        // A delay lasts at least its time, and a tick and the executor's time more at most.
        assert!(pulses.iter().all(|(high_ns, _)| (250_000..270_000).contains(high_ns)));
        common::assert_chip_modelled(&chip);
    }
}
