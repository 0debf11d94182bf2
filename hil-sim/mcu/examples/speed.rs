//! How fast the emulator is: instructions per second of CPU time in a loop that computes in registers
//! and RAM, and virtual seconds per second for a sleeping chip.

use stspp_hil_mcu::chip::Chip;
use stspp_hil_mcu::image::Image;
use stspp_hil_mcu::soc::Variant;

fn main() {
    // adds r0, #1; str r0, [sp, #-4 via r1]; ldr; b: a loop over RAM.
    let mut words = vec![0x2000_4000, 0x0800_0041];
    words.resize(16, 0x0800_0041);
    // 0x40: mov r1, sp; subs r1, #4; loop: adds r0, #1; str r0, [r1]; ldr r2, [r1]; b loop
    words.extend([0x3904_4669, 0x6008_3001, 0xe7fb_680a]);
    let mut chip = Chip::new(Variant::F330, &Image::from_words(&words));
    let start = std::time::Instant::now();
    chip.run_until_ns(2_000_000_000);
    let seconds = start.elapsed().as_secs_f64();
    println!("{:.1} million instructions a second", chip.instructions() as f64 / seconds / 1e6);
}
