//! Sizes of a 32-bit little-endian ELF, from its program headers: what is programmed into flash,
//! and what is taken of RAM.

const FLASH: std::ops::Range<u64> = 0x0800_0000..0x1000_0000;
const RAM: std::ops::Range<u64> = 0x2000_0000..0x3000_0000;
const PT_LOAD: u64 = 1;

fn word(bytes: &[u8], at: usize, length: usize) -> Result<u64, String> {
    let field = bytes.get(at..at + length).ok_or("cut short")?;
    Ok(field.iter().rev().fold(0, |value, &byte| value << 8 | u64::from(byte)))
}

/// Bytes of flash and of static RAM.
///
/// # Errors
/// When it is no ELF for a 32-bit little-endian machine.
pub fn sizes(bytes: &[u8]) -> Result<(u64, u64), String> {
    if bytes.get(..6) != Some(b"\x7fELF\x01\x01".as_slice()) {
        return Err("no 32-bit little-endian ELF".into());
    }
    let table = word(bytes, 28, 4)? as usize;
    let entry_size = word(bytes, 42, 2)? as usize;
    let count = word(bytes, 44, 2)? as usize;
    let (mut flash, mut ram) = (0, 0);
    for index in 0..count {
        let at = table + index * entry_size;
        bytes.get(at..at + entry_size).ok_or("cut short")?;
        if word(bytes, at, 4)? != PT_LOAD {
            continue;
        }
        let (virtual_at, physical_at) = (word(bytes, at + 8, 4)?, word(bytes, at + 12, 4)?);
        let (in_file, in_memory) = (word(bytes, at + 16, 4)?, word(bytes, at + 20, 4)?);
        if FLASH.contains(&physical_at) {
            flash += in_file;
        }
        if RAM.contains(&virtual_at) {
            ram += in_memory;
        }
    }
    Ok((flash, ram))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn elf(segments: &[[u32; 8]]) -> Vec<u8> {
        let mut bytes = vec![0; 52];
        bytes[..6].copy_from_slice(b"\x7fELF\x01\x01");
        bytes[28] = 52;
        bytes[42] = 32;
        bytes[44] = segments.len() as u8;
        bytes.extend(segments.iter().flatten().flat_map(|field| field.to_le_bytes()));
        bytes
    }

    #[test]
    fn code_data_and_bss() {
        let text = [1, 0, 0x0800_0000, 0x0800_0000, 5000, 5000, 5, 4];
        let data = [1, 0, 0x2000_0000, 0x0800_1388, 88, 88, 6, 4];
        let bss = [1, 0, 0x2000_0058, 0x2000_0058, 0, 1136, 6, 4];
        let stack = [0x6474_e551, 0, 0, 0, 0, 0, 6, 0];
        assert_eq!(sizes(&elf(&[text, data, bss, stack])), Ok((5088, 1224)));
    }

    #[test]
    fn what_is_no_elf_is_an_error() {
        assert!(sizes(b"").is_err());
        assert!(sizes(&[0x7f; 100]).is_err());
        let whole = elf(&[[1, 0, 0x0800_0000, 0x0800_0000, 5000, 5000, 5, 4]]);
        for length in 0..whole.len() {
            assert!(sizes(&whole[..length]).is_err(), "{length}");
        }
    }
}
