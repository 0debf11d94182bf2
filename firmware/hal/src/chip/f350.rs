//! GD32F350xB (data sheet, "General description" and "Electrical characteristics").

/// Fastest system clock in hertz.
pub const AHB_MAX_HZ: u32 = 108_000_000;
/// Fastest APB1 and APB2 clock in hertz.
pub const APB_MAX_HZ: u32 = 54_000_000;
/// Flash size in bytes.
pub const FLASH_BYTES: u32 = 128 * 1024;
/// Erase unit in bytes.
pub const FLASH_PAGE_BYTES: u32 = 1024;
/// Name as printed on the package, without the package letter.
pub const NAME: &str = "GD32F350xB";
/// Words of the USB core's FIFO memory (1.25 KiB).
pub const USB_FIFO_WORDS: u16 = 320;
/// USB endpoints per direction, endpoint 0 included.
pub const USB_ENDPOINTS: usize = 4;
