//! Sizes of a 32-bit little-endian ELF, from its program headers: what is programmed into flash,
//! and what is taken of RAM.

const FLASH: std::ops::Range<u64> = 0x0800_0000..0x1000_0000;
const RAM: std::ops::Range<u64> = 0x2000_0000..0x3000_0000;
const PT_LOAD: u64 = 1;
const SHT_SYMTAB: u64 = 2;

fn word(bytes: &[u8], at: usize, length: usize) -> Result<u64, String> {
    let field = bytes.get(at..at + length).ok_or("cut short")?;
    Ok(field.iter().rev().fold(0, |value, &byte| value << 8 | u64::from(byte)))
}

/// A loaded segment.
struct Segment {
    virtual_at: u64,
    physical_at: u64,
    in_file: u64,
    in_memory: u64,
}

fn segments(bytes: &[u8]) -> Result<Vec<Segment>, String> {
    if bytes.get(..6) != Some(b"\x7fELF\x01\x01".as_slice()) {
        return Err("no 32-bit little-endian ELF".into());
    }
    let table = word(bytes, 28, 4)? as usize;
    let entry_size = word(bytes, 42, 2)? as usize;
    let count = word(bytes, 44, 2)? as usize;
    let mut found = Vec::new();
    for index in 0..count {
        let at = table + index * entry_size;
        bytes.get(at..at + entry_size).ok_or("cut short")?;
        if word(bytes, at, 4)? == PT_LOAD {
            found.push(Segment {
                virtual_at: word(bytes, at + 8, 4)?,
                physical_at: word(bytes, at + 12, 4)?,
                in_file: word(bytes, at + 16, 4)?,
                in_memory: word(bytes, at + 20, 4)?,
            });
        }
    }
    Ok(found)
}

/// Bytes of flash and of static RAM.
///
/// # Errors
/// When it is no ELF for a 32-bit little-endian machine.
pub fn sizes(bytes: &[u8]) -> Result<(u64, u64), String> {
    let segments = segments(bytes)?;
    let flash = segments.iter().filter(|s| FLASH.contains(&s.physical_at)).map(|s| s.in_file);
    let ram = segments.iter().filter(|s| RAM.contains(&s.virtual_at)).map(|s| s.in_memory);
    Ok((flash.sum(), ram.sum()))
}

/// Address and length of everything that is programmed.
///
/// # Errors
/// As [`sizes`].
pub fn flash_segments(bytes: &[u8]) -> Result<Vec<(u64, u64)>, String> {
    let programmed = segments(bytes)?.into_iter().filter(|s| s.in_file > 0);
    Ok(programmed.map(|s| (s.physical_at, s.in_file)).collect())
}

/// Whether the symbol table has `name`; no table is a table without it.
pub fn has_symbol(bytes: &[u8], name: &str) -> bool {
    symbol_names(bytes).is_ok_and(|names| names.contains(&name.as_bytes()))
}

fn symbol_names(bytes: &[u8]) -> Result<Vec<&[u8]>, String> {
    let (table, entry_size) = (word(bytes, 32, 4)? as usize, word(bytes, 46, 2)? as usize);
    let field =
        |section: u64, at: usize| word(bytes, table + section as usize * entry_size + at, 4);
    let mut names = Vec::new();
    for section in 0..word(bytes, 48, 2)? {
        if field(section, 4)? != SHT_SYMTAB {
            continue;
        }
        let (start, length) = (field(section, 16)? as usize, field(section, 20)? as usize);
        let strings = field(field(section, 24)?, 16)? as usize;
        for symbol in (start..start + length).step_by(16) {
            let name =
                bytes.get(strings + word(bytes, symbol, 4)? as usize..).ok_or("cut short")?;
            names.extend(name.split(|byte| *byte == 0).next());
        }
    }
    Ok(names)
}

#[cfg(test)]
pub(super) mod tests {
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

    /// The same with a section table of a symbol table and its strings behind it.
    pub fn elf_with_symbols(segments: &[[u32; 8]], names: &[&str]) -> Vec<u8> {
        let mut bytes = elf(segments);
        let strings_at = bytes.len() as u32;
        let mut symbols = Vec::new();
        for name in names {
            symbols.extend((bytes.len() as u32 - strings_at).to_le_bytes());
            symbols.extend([0; 12]);
            bytes.extend(name.as_bytes());
            bytes.push(0);
        }
        let symbols_at = bytes.len() as u32;
        let length = symbols.len() as u32;
        bytes.extend(symbols);
        let table = bytes.len() as u32;
        let section = |kind: u32, at: u32, length: u32, link: u32| {
            [0, kind, 0, 0, at, length, link, 0, 0, 16].map(u32::to_le_bytes).concat()
        };
        bytes.extend(section(SHT_SYMTAB as u32, symbols_at, length, 1));
        bytes.extend(section(3, strings_at, symbols_at - strings_at, 0));
        bytes[32..36].copy_from_slice(&table.to_le_bytes());
        bytes[46] = 40;
        bytes[48] = 2;
        bytes
    }

    #[test]
    fn symbols_are_found_by_their_whole_name() {
        let image = elf_with_symbols(&[], &["main", "stspp_board_f330"]);
        assert!(has_symbol(&image, "stspp_board_f330") && has_symbol(&image, "main"));
        assert!(!has_symbol(&image, "stspp_board_f33") && !has_symbol(&image, "board_f330"));
        assert!(!has_symbol(&elf(&[]), "main"));
        for length in 0..image.len() {
            let _ = has_symbol(&image[..length], "main");
        }
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
