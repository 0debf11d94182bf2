//! Constants of the native USB interface (board F350): what the host looks for and the firmware says.
//!
//! One configuration, one vendor-specific interface, three endpoints, full speed. Bytes on the bulk
//! endpoints are the same COBS frames as on the serial link; a frame may span packets and a packet may
//! hold several frames. Events come over the interrupt endpoint, whole frames, several in a transfer where
//! they have queued up, so that a host waiting for a reply is never delayed by events and the other way
//! round.

/// Vendor id: pid.codes, the registry for open-source hardware.
pub const VENDOR_ID: u16 = 0x1209;

/// Product id from pid.codes' range for tests (0x0001..=0x0010). Boards that are handed on need a
/// registered one; the host therefore also checks the interface triple below.
pub const PRODUCT_ID: u16 = 0x000A;

/// Manufacturer string.
pub const MANUFACTURER: &str = "stspp";

/// Product string.
pub const PRODUCT: &str = "stspp 3D sensor";

/// Vendor-specific interface class.
pub const INTERFACE_CLASS: u8 = 0xFF;

/// Interface subclass (`'S'`), to tell the control interface from other vendor interfaces.
pub const INTERFACE_SUBCLASS: u8 = 0x53;

/// Interface protocol: the protocol's major version.
pub const INTERFACE_PROTOCOL: u8 = 1;

/// Interface number of the control interface.
pub const INTERFACE_NUMBER: u8 = 0;

/// Bulk OUT: requests.
pub const ENDPOINT_REQUESTS: u8 = 0x01;

/// Bulk IN: replies.
pub const ENDPOINT_REPLIES: u8 = 0x81;

/// Interrupt IN: events.
pub const ENDPOINT_EVENTS: u8 = 0x82;

/// Largest packet of every endpoint, bytes (full speed).
pub const MAX_PACKET_LEN: usize = 64;

/// Polling interval of the interrupt endpoint, milliseconds.
pub const EVENT_INTERVAL_MS: u8 = 1;

/// Most current drawn from the bus, milliamperes (the projectors have a supply of their own).
pub const MAX_POWER_MA: u16 = 250;

/// Vendor request code of the Microsoft OS 2.0 descriptor set.
pub const MS_OS_VENDOR_CODE: u8 = 0x20;

/// Device interface GUID that Windows registers the interface under (WinUSB needs no driver then).
pub const MS_OS_INTERFACE_GUID: &str = "{5F0C7E0A-3B7C-4A44-9E55-7A0D2C3B9F16}";

/// USB start-of-frame numbers count modulo this.
pub const SOF_MODULUS: u16 = 2048;

/// Baud rate of the serial link (board F330), 8N1.
pub const SERIAL_BAUD: u32 = 2_000_000;
