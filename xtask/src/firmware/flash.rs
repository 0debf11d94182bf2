//! `cargo xtask firmware flash BOARD [ELF]`: looks at an image before a debug probe writes it.
//!
//! A refused image leaves the chip as it was: nothing is written before every check has passed. What
//! no tool can see from the file, the chip that is really there, the firmware checks itself when it
//! starts (docs/hardware.md, "An image of another board").

use super::{BOARDS, FLASH_BUDGET, elf};
use crate::workspace;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Start of the flash, and of the program in it.
const FLASH_START: u64 = 0x0800_0000;

/// What probe-rs calls a board's chip.
fn chip(board: &str) -> &'static str {
    if board == "f330" { "GD32F330CB" } else { "GD32F350CB" }
}

/// Runs the task.
///
/// # Errors
/// Says what is wrong with the image, or that there is no probe; nothing was written then.
pub fn run(arguments: &[&str]) -> Result<String, String> {
    let usage = "cargo xtask firmware flash f330|f350 [--check] [ELF]\n\
                 writes the board's image (target/firmware/BOARD.elf) with a debug probe; \
                 --check only looks at it";
    let (mut board, mut elf, mut check_only) = (None, None, false);
    for &argument in arguments {
        match argument {
            "--check" => check_only = true,
            name if BOARDS.contains(&name) && board.is_none() => board = Some(name),
            _ if argument.starts_with('-') || board.is_none() || elf.is_some() => {
                return Err(format!("flash: `{argument}` is not understood\n{usage}"));
            }
            path => elf = Some(PathBuf::from(path)),
        }
    }
    let board = board.ok_or_else(|| format!("flash: which board?\n{usage}"))?;
    let elf = elf
        .unwrap_or_else(|| workspace::root().join("target/firmware").join(format!("{board}.elf")));
    let bytes = std::fs::read(&elf).map_err(|e| {
        format!("flash: {}: {e}\nbuild it with `cargo xtask firmware {board}`", elf.display())
    })?;
    let flash = check(board, &bytes)
        .map_err(|why| format!("flash: {}: {why}\nnothing was written", elf.display()))?;
    let said = format!("{}: {flash} bytes for board {board}", elf.display());
    if check_only {
        return Ok(said);
    }
    write(board, &elf)?;
    Ok(format!("{said}: written and verified"))
}

/// Holds an image against a board; returns its size in flash.
fn check(board: &str, bytes: &[u8]) -> Result<u64, String> {
    let (flash, _) = elf::sizes(bytes)?;
    let is_for = |board: &&str| elf::has_symbol(bytes, &format!("stspp_board_{board}"));
    match BOARDS.iter().find(|board| is_for(board)) {
        Some(found) if *found == board => {}
        Some(found) => {
            return Err(format!("this image is for the board {found}, not for {board}"));
        }
        None => {
            return Err(
                "this is not an image of this firmware: it does not say which board it is \
                        for (was it stripped?)"
                    .into(),
            );
        }
    }
    if flash > FLASH_BUDGET {
        return Err(format!(
            "{flash} bytes are {} too many for the {FLASH_BUDGET} of the program's flash",
            flash - FLASH_BUDGET
        ));
    }
    let program = FLASH_START..FLASH_START + FLASH_BUDGET;
    for (start, length) in elf::flash_segments(bytes)? {
        if !program.contains(&start) || start + length > program.end {
            return Err(format!(
                "{length} bytes at {start:#010x} lie outside of the program's flash \
                 ({:#010x}..{:#010x}); the settings are kept behind it",
                program.start, program.end
            ));
        }
    }
    Ok(flash)
}

fn write(board: &str, elf: &Path) -> Result<(), String> {
    for verb in ["download", "verify"] {
        let mut command = Command::new("probe-rs");
        command.args([verb, "--chip", chip(board)]).arg(elf);
        match command.status() {
            Ok(status) if status.success() => {}
            Ok(status) => {
                return Err(format!(
                    "flash: {command:?} ended with {status}. Where writing had begun, the chip has \
                     no program now and its outputs float: repeat it, or use BOOT0 \
                     (docs/hardware.md, \"Without a probe\")"
                ));
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                return Err("flash: probe-rs is not on PATH: `cargo install probe-rs-tools` (or \
                            https://probe.rs); nothing was written"
                    .into());
            }
            Err(e) => return Err(format!("flash: {command:?} could not be run: {e}")),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::elf::tests::elf_with_symbols;
    use super::*;

    const TEXT: [u32; 8] = [1, 0, 0x0800_0000, 0x0800_0000, 5000, 5000, 5, 4];

    #[test]
    fn an_image_of_the_board_passes() {
        assert_eq!(
            check("f330", &elf_with_symbols(&[TEXT], &["main", "stspp_board_f330"])),
            Ok(5000)
        );
    }

    #[test]
    fn another_boards_image_is_refused_by_name() {
        let image = elf_with_symbols(&[TEXT], &["stspp_board_f350"]);
        assert_eq!(
            check("f330", &image),
            Err("this image is for the board f350, not for f330".into())
        );
        let stranger = elf_with_symbols(&[TEXT], &["main"]);
        assert!(check("f330", &stranger).unwrap_err().contains("not an image of this firmware"));
    }

    #[test]
    fn what_is_too_large_or_in_the_settings_pages_is_refused() {
        let large = [1, 0, 0x0800_0000, 0x0800_0000, 70_000, 70_000, 5, 4];
        let image = elf_with_symbols(&[large], &["stspp_board_f350"]);
        assert!(check("f350", &image).unwrap_err().contains("4464 too many"));
        let settings = [1, 0, 0x0801_f800, 0x0801_f800, 64, 64, 5, 4];
        let image = elf_with_symbols(&[TEXT, settings], &["stspp_board_f350"]);
        assert!(check("f350", &image).unwrap_err().contains("outside of the program's flash"));
        assert!(check("f350", b"\x7fELF").is_err());
    }

    #[test]
    fn what_is_asked_for_is_understood_or_explained() {
        for wrong in [&[][..], &["f331"], &["f330", "a", "b"], &["f330", "--chekc"]] {
            assert!(run(wrong).unwrap_err().contains("cargo xtask firmware flash"), "{wrong:?}");
        }
        let missing = run(&["f330", "/nowhere/f330.elf"]).unwrap_err();
        assert!(missing.contains("cargo xtask firmware f330"), "{missing}");
    }
}
