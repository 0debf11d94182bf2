//! The firmware's ELF: what goes into the flash, and where its symbols are.

use std::collections::HashMap;

use object::{Object, ObjectSection, ObjectSegment, ObjectSymbol};

use crate::soc::fmc::FLASH_BASE;
use crate::soc::{FLASH_BYTES, RAM_BYTES};

/// Start of the RAM in the address map.
pub const RAM_BASE: u32 = 0x2000_0000;

/// Why an ELF cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The file cannot be read.
    #[error("cannot read the firmware {path}: {source}. Build it with `cargo xtask firmware`.")]
    Read {
        /// Which file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// The file is no ELF for this chip.
    #[error("not a 32-bit Arm ELF: {0}")]
    Format(String),
    /// A part of the program lies outside the flash.
    #[error(
        "{bytes} bytes of the program at {address:#010x} lie outside the {FLASH_BYTES} bytes of flash at 0x08000000"
    )]
    OutsideFlash {
        /// Where.
        address: u64,
        /// How many.
        bytes: usize,
    },
    /// There is no vector table at the start of the flash.
    #[error(
        "no vector table at 0x08000000: the first word {stack_pointer:#010x} does not point into the RAM"
    )]
    NoVectors {
        /// The first word of the flash.
        stack_pointer: u32,
    },
}

/// A firmware image.
#[derive(Debug, Clone)]
pub struct Image {
    /// The ELF file's bytes.
    pub elf: Vec<u8>,
    /// Contents of the flash from its start, erased bytes as 0xff.
    pub flash: Vec<u8>,
    /// Bytes of flash that the program takes.
    pub flash_bytes: u32,
    /// Bytes of RAM that are allocated statically (.data, .bss, .uninit).
    pub static_ram_bytes: u32,
    symbols: HashMap<String, u32>,
}

impl Image {
    /// Reads an ELF file.
    ///
    /// # Errors
    /// As [`ImageError`] says.
    pub fn load(path: &std::path::Path) -> Result<Self, ImageError> {
        let elf = std::fs::read(path)
            .map_err(|source| ImageError::Read { path: path.display().to_string(), source })?;
        Self::parse(elf)
    }

    /// Takes an ELF from memory.
    ///
    /// # Errors
    /// As [`ImageError`] says.
    pub fn parse(elf: Vec<u8>) -> Result<Self, ImageError> {
        let format = |e: object::Error| ImageError::Format(e.to_string());
        let file = object::File::parse(&*elf).map_err(format)?;
        if file.architecture() != object::Architecture::Arm {
            return Err(ImageError::Format(format!("it is for {:?}", file.architecture())));
        }
        let mut flash = vec![0xff; FLASH_BYTES as usize];
        let mut flash_bytes = 0;
        for segment in load_segments(&elf).map_err(ImageError::Format)? {
            let (address, data) = segment;
            let start = address.wrapping_sub(u64::from(FLASH_BASE)) as usize;
            let Some(target) = flash.get_mut(start..start.saturating_add(data.len())) else {
                return Err(ImageError::OutsideFlash { address, bytes: data.len() });
            };
            target.copy_from_slice(data);
            flash_bytes += data.len() as u32;
        }
        let stack_pointer = u32::from_le_bytes([flash[0], flash[1], flash[2], flash[3]]);
        if !(RAM_BASE..=RAM_BASE + RAM_BYTES).contains(&stack_pointer) {
            return Err(ImageError::NoVectors { stack_pointer });
        }
        let ram = u64::from(RAM_BASE)..u64::from(RAM_BASE + RAM_BYTES);
        let static_ram_bytes = file
            .sections()
            .filter(|s| ram.contains(&s.address()) && s.name().is_ok_and(|n| !n.contains("stack")))
            .map(|s| s.size() as u32)
            .sum();
        let symbols = file
            .symbols()
            .filter_map(|s| Some((s.name().ok()?.to_string(), s.address() as u32)))
            .filter(|(name, _)| !name.is_empty())
            .collect();
        // Segments are checked above; `segments` also proves that the headers are sane.
        let _ = file.segments().map(|s| s.size()).sum::<u64>();
        Ok(Self { flash, flash_bytes, static_ram_bytes, symbols, elf })
    }

    /// An image from the flash's first words, without symbols: small programs for tests.
    #[must_use]
    pub fn from_words(words: &[u32]) -> Self {
        let mut flash = vec![0xff; FLASH_BYTES as usize];
        for (bytes, word) in flash.chunks_exact_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        Self {
            elf: Vec::new(),
            flash,
            flash_bytes: 4 * words.len() as u32,
            static_ram_bytes: 0,
            symbols: HashMap::new(),
        }
    }

    /// Address of a symbol.
    #[must_use]
    pub fn symbol(&self, name: &str) -> Option<u32> {
        self.symbols.get(name).copied()
    }

    /// Lowest address that the stack may reach: the end of the static RAM.
    #[must_use]
    pub fn stack_limit(&self) -> u32 {
        ["__euninit", "__ebss"]
            .iter()
            .find_map(|name| self.symbol(name))
            .unwrap_or(RAM_BASE + self.static_ram_bytes)
            .next_multiple_of(4)
    }

    /// Address of a `core::panic::Location` in the flash: a reference to a source file's name, its
    /// length, line and column. Panic functions take one as their argument.
    #[must_use]
    pub fn any_panic_location(&self) -> Option<u32> {
        let word = |offset: usize| {
            let bytes = self.flash.get(offset..offset + 4)?;
            Some(u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
        };
        (0..self.flash.len()).step_by(4).find_map(|offset| {
            let (name, length) =
                (word(offset)?.checked_sub(FLASH_BASE)? as usize, word(offset + 4)? as usize);
            let (line, column) = (word(offset + 8)?, word(offset + 12)?);
            let sound = (4..200).contains(&length)
                && (1..20_000).contains(&line)
                && (1..400).contains(&column);
            let path = if sound { self.flash.get(name..name + length)? } else { return None };
            let trimmed = path.strip_suffix(b"\0").unwrap_or(path);
            trimmed.ends_with(b".rs").then_some(FLASH_BASE + offset as u32)
        })
    }

    /// Address of the function whose name contains all of `parts` (mangled names keep their parts).
    #[must_use]
    pub fn symbol_containing(&self, parts: &[&str]) -> Option<u32> {
        self.symbols
            .iter()
            .find(|(name, _)| parts.iter().all(|p| name.contains(p)))
            .map(|(_, address)| *address)
    }
}

/// Physical address and bytes of every loaded segment.
fn load_segments(elf: &[u8]) -> Result<Vec<(u64, &[u8])>, String> {
    use object::read::elf::{FileHeader, ProgramHeader};
    let header =
        object::elf::FileHeader32::<object::Endianness>::parse(elf).map_err(|e| e.to_string())?;
    let endian = header.endian().map_err(|e| e.to_string())?;
    let mut segments = Vec::new();
    for program in header.program_headers(endian, elf).map_err(|e| e.to_string())? {
        if program.p_type(endian) == object::elf::PT_LOAD && program.p_filesz(endian) > 0 {
            let data = program
                .data(endian, elf)
                .map_err(|()| "a segment lies outside the file".to_string())?;
            segments.push((u64::from(program.p_paddr(endian)), data));
        }
    }
    Ok(segments)
}
