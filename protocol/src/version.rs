//! Versions, the handshake rule, and what a device says about itself.
//!
//! # Compatibility rule
//!
//! * The **major** numbers of host and device must be equal. The device refuses every request of a
//!   session whose [`Hello`](crate::request::Hello) named another major with
//!   [`RequestError::VersionMismatch`](crate::reply::RequestError::VersionMismatch).
//! * The **minor** numbers may differ either way. A minor only adds messages, and a
//!   [capability bit](Capabilities) with them; it never changes the layout of a message that exists. So
//!   a host sends an added message only where the device's bit is set; a device that is older than the
//!   host answers an id that it does not know with
//!   [`RequestError::UnknownMessage`](crate::reply::RequestError::UnknownMessage); a host that is older
//!   than the device skips events of unknown id and ignores unknown capability and fault bits. A new
//!   value of an enumeration is a change of layout: it goes only to a host whose `Hello` names a minor
//!   that has it ([`FaultReason::since_minor`](crate::fault::FaultReason::since_minor)), or in answer to
//!   a message of that minor.
//! * Frozen over all majors: the framing, the layout of `Hello`, and that of the two errors named above.

use serde::{Deserialize, Serialize};

use crate::fault::FaultSet;
use crate::timing::Limits;

/// The protocol that this crate speaks. Since 1.0: trigger-in ([`crate::trigger`]) and three fault
/// reasons.
pub const PROTOCOL_VERSION: ProtocolVersion = ProtocolVersion { major: 1, minor: 1 };

/// Version of the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ProtocolVersion {
    /// Raised when a message changes in a way that an older peer would misread.
    pub major: u16,
    /// Raised when messages or capability bits are added.
    pub minor: u16,
}

impl ProtocolVersion {
    /// Whether two peers can talk: the majors are equal, whatever the minors.
    #[must_use]
    pub const fn is_compatible_with(self, other: Self) -> bool {
        self.major == other.major
    }
}

impl core::fmt::Display for ProtocolVersion {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

/// Version of the firmware (semantic versioning).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FirmwareVersion {
    /// Major.
    pub major: u8,
    /// Minor.
    pub minor: u8,
    /// Patch.
    pub patch: u8,
}

impl core::fmt::Display for FirmwareVersion {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}.{}.{}", self.major, self.minor, self.patch)
    }
}

/// What hardware the device is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BoardKind {
    /// GD32F330, protocol over USART0 and a USB-UART bridge.
    F330,
    /// GD32F350, native USB device.
    F350,
}

impl BoardKind {
    /// The limits of this board. They are constants of the firmware: no message changes them.
    #[must_use]
    pub const fn limits(self) -> Limits {
        match self {
            BoardKind::F330 => Limits::F330,
            BoardKind::F350 => Limits::F350,
        }
    }
}

/// Serial number: the 96-bit unique id of the chip.
///
/// Shown as 24 hexadecimal digits, which is also the USB serial-number string.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SerialNumber(pub [u8; 12]);

impl SerialNumber {
    /// The 24 upper-case hexadecimal digits as ASCII.
    #[must_use]
    pub fn to_ascii(self) -> [u8; 24] {
        const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
        let mut ascii = [0; 24];
        for (pair, byte) in ascii.chunks_exact_mut(2).zip(self.0) {
            pair[0] = DIGITS[usize::from(byte >> 4)];
            pair[1] = DIGITS[usize::from(byte & 0x0F)];
        }
        ascii
    }

    /// Reads 24 hexadecimal digits of either case; `None` for anything else.
    #[must_use]
    pub fn from_ascii(ascii: &[u8]) -> Option<Self> {
        if ascii.len() != 24 {
            return None;
        }
        let mut bytes = [0; 12];
        for (byte, pair) in bytes.iter_mut().zip(ascii.chunks_exact(2)) {
            let high = (pair[0] as char).to_digit(16)?;
            let low = (pair[1] as char).to_digit(16)?;
            *byte = (high * 16 + low) as u8;
        }
        Some(Self(bytes))
    }
}

impl core::fmt::Display for SerialNumber {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        for byte in self.0 {
            write!(f, "{byte:02X}")?;
        }
        Ok(())
    }
}

impl core::fmt::Debug for SerialNumber {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "SerialNumber({self})")
    }
}

/// What a device can do beyond protocol 1.0's obligatory messages; unknown bits are kept and ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Capabilities(pub u32);

impl Capabilities {
    /// Trigger events carry the USB start-of-frame number.
    pub const USB_SOF: Self = Self(1 << 0);
    /// [`SaveSettings`](crate::request::SaveSettings) stores in memory that survives power loss.
    pub const SETTINGS_STORE: Self = Self(1 << 1);
    /// [`RebootToBootloader`](crate::request::RebootToBootloader) works.
    pub const BOOTLOADER: Self = Self(1 << 2);
    /// There is a floodlight.
    pub const FLOODLIGHT: Self = Self(1 << 3);
    /// The temperature at the projectors is measured.
    pub const TEMPERATURE: Self = Self(1 << 4);
    /// There is a trigger input: [`SetTriggerSource`](crate::request::SetTriggerSource) and
    /// [`GetTriggerSource`](crate::request::GetTriggerSource) are served. Since 1.1.
    pub const TRIGGER_IN: Self = Self(1 << 5);

    /// Whether every bit of `other` is set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Both sets together.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

/// Why the controller last started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ResetCause {
    /// Power came on, or dipped below the brown-out level.
    PowerOn,
    /// The reset pin.
    Pin,
    /// Asked for by [`Reset`](crate::request::Reset) or by firmware.
    Software,
    /// The independent watchdog.
    Watchdog,
    /// None of the above could be told apart.
    Unknown,
}

/// Answer to [`Hello`](crate::request::Hello) and [`GetInfo`](crate::request::GetInfo).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DeviceInfo {
    /// Protocol that the device speaks.
    pub protocol: ProtocolVersion,
    /// Firmware on the device.
    pub firmware: FirmwareVersion,
    /// Hardware.
    pub board: BoardKind,
    /// Unique per chip.
    pub serial: SerialNumber,
    /// Optional abilities.
    pub capabilities: Capabilities,
    /// Constants that every timing and light request is held against.
    pub limits: Limits,
    /// Why the controller last started.
    pub reset_cause: ResetCause,
    /// Faults that are latched now, those that survived the reset included.
    pub latched: FaultSet,
}
