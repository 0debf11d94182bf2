//! Settings in two flash pages.
//!
//! A record carries a count. Saving erases the page of the older record and writes there, so that at
//! every moment the newer valid record is whole: power lost half-way leaves the old settings.
//!
//! ```text
//! magic u32 | format u16 | body length u16 | count u32 | body (postcard) ... 0xFF ... | crc32
//! ```
//! Little endian; the CRC-32 (ISO-HDLC) covers everything before it.

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};
use serde::{Deserialize, Serialize};
use stspp_protocol::reply::StorageError;
use stspp_protocol::timing::ProjectionTiming;

use crate::hardware::{Page, SettingsStore};

/// Length of a record in flash.
pub const RECORD_LEN: usize = HEADER_LEN + BODY_LEN + CRC_LEN;

const HEADER_LEN: usize = 12;
const BODY_LEN: usize = 128;
const CRC_LEN: usize = 4;
const MAGIC: u32 = 0x5053_5453;
const FORMAT: u16 = 1;

// The table would cost a kilobyte of flash, and this runs once per boot and save.
const CRC: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// What survives power loss.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Settings {
    /// Timing at start.
    pub timing: ProjectionTiming,
}

struct Record {
    count: u32,
    settings: Settings,
}

/// Reads the newest valid settings.
///
/// # Errors
///
/// [`StorageError::Empty`] where both pages are erased; [`StorageError::Read`] where what they hold is
/// damaged, or neither can be read.
pub fn load<S: SettingsStore>(store: &S) -> Result<Settings, StorageError> {
    match newest(store)? {
        Some((_, record)) => Ok(record.settings),
        None if is_erased(store, Page::A) && is_erased(store, Page::B) => Err(StorageError::Empty),
        None => Err(StorageError::Read),
    }
}

fn is_erased<S: SettingsStore>(store: &S, page: Page) -> bool {
    let mut bytes = [0; RECORD_LEN];
    store.read(page, &mut bytes).is_ok() && bytes.iter().all(|byte| *byte == 0xFF)
}

/// Stores settings; on failure the ones stored before are still there.
///
/// # Errors
///
/// [`StorageError::Write`] where the page does not read back as it was written.
pub fn save<S: SettingsStore>(store: &mut S, settings: &Settings) -> Result<(), StorageError> {
    let (page, count) = match newest(store)? {
        Some((page, record)) => (page.other(), record.count.wrapping_add(1)),
        None => (Page::A, 1),
    };
    let record = encode(count, settings).ok_or(StorageError::Write)?;
    store.erase(page).map_err(|_| StorageError::Write)?;
    store.write(page, &record).map_err(|_| StorageError::Write)?;
    let mut written = [0; RECORD_LEN];
    store.read(page, &mut written).map_err(|_| StorageError::Write)?;
    if written == record { Ok(()) } else { Err(StorageError::Write) }
}

fn newest<S: SettingsStore>(store: &S) -> Result<Option<(Page, Record)>, StorageError> {
    let read = |page| {
        let mut bytes = [0; RECORD_LEN];
        store.read(page, &mut bytes).map(|()| decode(&bytes))
    };
    match (read(Page::A), read(Page::B)) {
        (Err(_), Err(_)) => Err(StorageError::Read),
        (a, b) => Ok(match (a.ok().flatten(), b.ok().flatten()) {
            (Some(a), Some(b)) => {
                // Counts wrap: the newer one is less than half the range ahead.
                let b_is_newer = (b.count.wrapping_sub(a.count) as i32) > 0;
                Some(if b_is_newer { (Page::B, b) } else { (Page::A, a) })
            }
            (Some(a), None) => Some((Page::A, a)),
            (None, Some(b)) => Some((Page::B, b)),
            (None, None) => None,
        }),
    }
}

fn encode(count: u32, settings: &Settings) -> Option<[u8; RECORD_LEN]> {
    let mut record = [0xFF; RECORD_LEN];
    let (content, crc) = record.split_last_chunk_mut::<CRC_LEN>()?;
    let (header, body) = content.split_first_chunk_mut::<HEADER_LEN>()?;
    let body_len = u16::try_from(postcard::to_slice(settings, body).ok()?.len()).ok()?;
    let fields = MAGIC
        .to_le_bytes()
        .into_iter()
        .chain(FORMAT.to_le_bytes())
        .chain(body_len.to_le_bytes())
        .chain(count.to_le_bytes());
    for (place, byte) in header.iter_mut().zip(fields) {
        *place = byte;
    }
    *crc = CRC.checksum(content).to_le_bytes();
    Some(record)
}

fn decode(bytes: &[u8; RECORD_LEN]) -> Option<Record> {
    let (content, crc) = bytes.split_last_chunk::<CRC_LEN>()?;
    if CRC.checksum(content) != u32::from_le_bytes(*crc) {
        return None;
    }
    let (magic, rest) = content.split_first_chunk::<4>()?;
    let (format, rest) = rest.split_first_chunk::<2>()?;
    let (body_len, rest) = rest.split_first_chunk::<2>()?;
    let (count, body) = rest.split_first_chunk::<4>()?;
    if u32::from_le_bytes(*magic) != MAGIC || u16::from_le_bytes(*format) != FORMAT {
        return None;
    }
    let body = body.get(..usize::from(u16::from_le_bytes(*body_len)))?;
    match postcard::take_from_bytes(body) {
        Ok((settings, [])) => Some(Record { count: u32::from_le_bytes(*count), settings }),
        _ => None,
    }
}
