//! A USB device as its host sees it: control, bulk and interrupt transfers that are answered, refused
//! or not yet ready.

/// The eight bytes that begin a control transfer (USB 2.0 section 9.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setup {
    /// Direction (bit 7), type (bits 5-6) and recipient (bits 0-4).
    pub request_type: u8,
    /// bRequest.
    pub request: u8,
    /// wValue.
    pub value: u16,
    /// wIndex.
    pub index: u16,
    /// wLength.
    pub length: u16,
}

impl Setup {
    /// Reads the packet as it is on the wire.
    pub fn parse(bytes: [u8; 8]) -> Self {
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        Self {
            request_type: bytes[0],
            request: bytes[1],
            value: word(2),
            index: word(4),
            length: word(6),
        }
    }

    /// The packet as it is on the wire.
    pub fn to_bytes(self) -> [u8; 8] {
        let [v, i, l] = [self.value, self.index, self.length].map(u16::to_le_bytes);
        [self.request_type, self.request, v[0], v[1], i[0], i[1], l[0], l[1]]
    }

    /// Whether the data stage goes to the host.
    pub fn is_in(&self) -> bool {
        self.request_type & 0x80 != 0
    }

    /// Type of the request: standard, class or vendor.
    pub fn kind(&self) -> Kind {
        match (self.request_type >> 5) & 3 {
            0 => Kind::Standard,
            1 => Kind::Class,
            2 => Kind::Vendor,
            _ => Kind::Reserved,
        }
    }

    /// Recipient: 0 device, 1 interface, 2 endpoint.
    pub fn recipient(&self) -> u8 {
        self.request_type & 0x1f
    }
}

/// Type of a control request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// USB 2.0 chapter 9.
    Standard,
    /// A device class's.
    Class,
    /// The vendor's.
    Vendor,
    /// Not defined.
    Reserved,
}

/// How a device answers a transfer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer<T> {
    /// Done.
    Done(T),
    /// Not now: the host tries again until it gives up.
    Nak,
    /// Refused; a halted endpoint stays so until the host clears it.
    Stall,
    /// The transfer went wrong on the bus.
    Broken(BusError),
}

/// What goes wrong on a bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusError {
    /// No handshake came in three attempts.
    NoAnswer,
    /// The device sent more than the host had asked for.
    Babble,
    /// The device is unplugged, or has let go of the bus.
    Gone,
}

/// Bus speed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speed {
    /// 12 Mbit/s.
    Full,
    /// 480 Mbit/s.
    High,
}

/// What a host learns of a device before it opens it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Bus speed.
    pub speed: Speed,
    /// The 18 bytes of the device descriptor.
    pub device_descriptor: [u8; 18],
    /// Class, subclass and protocol of each interface.
    pub interfaces: Vec<[u8; 3]>,
}

impl Identity {
    /// Reads what a configuration descriptor says of its interfaces (alternate setting 0).
    pub fn new(speed: Speed, device_descriptor: [u8; 18], configuration: &[u8]) -> Self {
        let interfaces = descriptors(configuration)
            .filter(|d| d.len() >= 9 && d[1] == 4 && d[3] == 0)
            .map(|d| [d[5], d[6], d[7]])
            .collect();
        Self { speed, device_descriptor, interfaces }
    }
}

/// The descriptors in a configuration, each with its length and type bytes; ends at the first that
/// does not fit.
pub fn descriptors(mut bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let length = usize::from(*bytes.first()?);
        if length < 2 || length > bytes.len() {
            return None;
        }
        let (descriptor, rest) = bytes.split_at(length);
        bytes = rest;
        Some(descriptor)
    })
}

/// A USB device behind a port.
pub trait UsbFunction: Send {
    /// What it is.
    fn identity(&self) -> Identity;

    /// The port is reset: back to the default state.
    fn reset(&mut self);

    /// A control transfer with its data stage: `data` from the host, or the answer to it.
    fn control(&mut self, setup: Setup, data: &[u8]) -> Answer<Vec<u8>>;

    /// A bulk or interrupt IN transfer of at most `length` bytes; a shorter answer ends it.
    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>>;

    /// A bulk or interrupt OUT transfer.
    fn transfer_out(&mut self, endpoint: u8, data: &[u8]) -> Answer<usize>;

    /// Lets the device do what is due. Called at least every millisecond or so of the server's time.
    fn poll(&mut self);

    /// The host gives up the transfer that was offered last on this pipe and not answered.
    fn unlinked(&mut self, _endpoint: u8, _is_in: bool) {}

    /// Whether the device is still the one that was [`reset`](UsbFunction::reset) last: false once it
    /// was unplugged or has left the bus on its own, until the next reset.
    fn is_attached(&self) -> bool {
        true
    }

    /// The host has let go of the device: unplugged, as far as the device can tell.
    fn detach(&mut self) {}
}

/// Numbers of the standard requests (USB 2.0, table 9-4).
pub(super) mod request {
    pub const GET_STATUS: u8 = 0;
    pub const CLEAR_FEATURE: u8 = 1;
    pub const SET_FEATURE: u8 = 3;
    pub const GET_DESCRIPTOR: u8 = 6;
    pub const GET_CONFIGURATION: u8 = 8;
    pub const SET_CONFIGURATION: u8 = 9;
    pub const GET_INTERFACE: u8 = 10;
    pub const SET_INTERFACE: u8 = 11;
}
