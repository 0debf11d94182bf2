//! Reads USB descriptors and holds them against the specification (USB 2.0 chapter 9, USB 3.2 9.6.2
//! for the BOS, Microsoft OS 2.0 Descriptors Specification).

use std::fmt;

/// A descriptor that breaks a rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{descriptor} descriptor: {what}")]
pub struct DescriptorError {
    /// Which kind.
    pub descriptor: &'static str,
    /// What is wrong.
    pub what: String,
}

fn fail<T>(descriptor: &'static str, what: impl Into<String>) -> Result<T, DescriptorError> {
    Err(DescriptorError { descriptor, what: what.into() })
}

fn word(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

/// Device descriptor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceDescriptor {
    /// bcdUSB.
    pub usb_version: u16,
    /// Class, subclass, protocol.
    pub class: [u8; 3],
    /// bMaxPacketSize0.
    pub max_packet_0: u8,
    /// idVendor.
    pub vendor_id: u16,
    /// idProduct.
    pub product_id: u16,
    /// bcdDevice.
    pub device_version: u16,
    /// Indices of the manufacturer, product and serial number strings.
    pub strings: [u8; 3],
}

impl DeviceDescriptor {
    /// Reads the 18 bytes.
    ///
    /// # Errors
    /// A broken rule.
    pub fn parse(bytes: &[u8]) -> Result<Self, DescriptorError> {
        if bytes.len() != 18 || bytes[0] != 18 || bytes[1] != 1 {
            return fail("device", format!("18 bytes of type 1 expected, got {bytes:02x?}"));
        }
        if ![8, 16, 32, 64].contains(&bytes[7]) {
            return fail("device", format!("bMaxPacketSize0 is {}", bytes[7]));
        }
        if bytes[17] != 1 {
            return fail("device", format!("{} configurations, one expected", bytes[17]));
        }
        let version = word(bytes, 2);
        if !(0x0200..=0x0210).contains(&version) {
            return fail("device", format!("bcdUSB is {version:#06x}"));
        }
        Ok(Self {
            usb_version: version,
            class: [bytes[4], bytes[5], bytes[6]],
            max_packet_0: bytes[7],
            vendor_id: word(bytes, 8),
            product_id: word(bytes, 10),
            device_version: word(bytes, 12),
            strings: [bytes[14], bytes[15], bytes[16]],
        })
    }
}

/// Transfer type of an endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransferType {
    /// Control.
    Control,
    /// Isochronous.
    Isochronous,
    /// Bulk.
    Bulk,
    /// Interrupt.
    Interrupt,
}

/// Endpoint descriptor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EndpointDescriptor {
    /// Number, with bit 7 for IN.
    pub address: u8,
    /// Transfer type.
    pub transfer: TransferType,
    /// wMaxPacketSize.
    pub max_packet: u16,
    /// bInterval in frames.
    pub interval: u8,
}

/// Interface descriptor with its endpoints.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InterfaceDescriptor {
    /// bInterfaceNumber.
    pub number: u8,
    /// Class, subclass, protocol.
    pub class: [u8; 3],
    /// Index of its string.
    pub string: u8,
    /// Endpoints.
    pub endpoints: Vec<EndpointDescriptor>,
}

/// Configuration descriptor with its interfaces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigurationDescriptor {
    /// bConfigurationValue.
    pub value: u8,
    /// bmAttributes.
    pub attributes: u8,
    /// Most current in mA.
    pub max_power_ma: u16,
    /// Interfaces.
    pub interfaces: Vec<InterfaceDescriptor>,
}

impl ConfigurationDescriptor {
    /// Reads a full-speed configuration with all that belongs to it.
    ///
    /// # Errors
    /// A broken rule: lengths, counts, packet sizes that full speed does not have, an endpoint twice.
    pub fn parse(bytes: &[u8]) -> Result<Self, DescriptorError> {
        const KIND: &str = "configuration";
        if bytes.len() < 9 || bytes[0] != 9 || bytes[1] != 2 {
            return fail(KIND, "too short, or not of type 2");
        }
        if usize::from(word(bytes, 2)) != bytes.len() {
            return fail(
                KIND,
                format!("wTotalLength is {}, {} bytes came", word(bytes, 2), bytes.len()),
            );
        }
        if bytes[7] & 0x80 == 0 {
            return fail(KIND, "bit 7 of bmAttributes must be set");
        }
        let mut configuration = Self {
            value: bytes[5],
            attributes: bytes[7],
            max_power_ma: 2 * u16::from(bytes[8]),
            interfaces: Vec::new(),
        };
        let mut expected = Vec::new();
        let mut rest = &bytes[9..];
        while !rest.is_empty() {
            let length = usize::from(rest[0]);
            if length < 2 || length > rest.len() {
                return fail(
                    KIND,
                    format!("a part of {length} bytes where {} are left", rest.len()),
                );
            }
            let (part, tail) = rest.split_at(length);
            rest = tail;
            match part[1] {
                4 if length == 9 => {
                    expected.push(usize::from(part[4]));
                    configuration.interfaces.push(InterfaceDescriptor {
                        number: part[2],
                        class: [part[5], part[6], part[7]],
                        string: part[8],
                        endpoints: Vec::new(),
                    });
                }
                5 if length == 7 => {
                    let endpoint = parse_endpoint(part)?;
                    let known = configuration
                        .interfaces
                        .iter()
                        .flat_map(|i| &i.endpoints)
                        .any(|e| e.address == endpoint.address);
                    if known {
                        return fail(
                            "endpoint",
                            format!("address {:#04x} twice", endpoint.address),
                        );
                    }
                    match configuration.interfaces.last_mut() {
                        Some(interface) => interface.endpoints.push(endpoint),
                        None => return fail("endpoint", "before any interface"),
                    }
                }
                4 | 5 => {
                    return fail(KIND, format!("a part of type {} with {length} bytes", part[1]));
                }
                _ => {}
            }
        }
        if configuration.interfaces.len() != usize::from(bytes[4]) {
            return fail(
                KIND,
                format!("bNumInterfaces is {}, found {}", bytes[4], configuration.interfaces.len()),
            );
        }
        for (interface, count) in configuration.interfaces.iter().zip(expected) {
            if interface.endpoints.len() != count {
                return fail(
                    "interface",
                    format!("bNumEndpoints is {count}, found {}", interface.endpoints.len()),
                );
            }
        }
        Ok(configuration)
    }
}

fn parse_endpoint(part: &[u8]) -> Result<EndpointDescriptor, DescriptorError> {
    let transfer = match part[3] & 3 {
        0 => TransferType::Control,
        1 => TransferType::Isochronous,
        2 => TransferType::Bulk,
        _ => TransferType::Interrupt,
    };
    let max_packet = word(part, 4);
    let allowed = match transfer {
        TransferType::Bulk | TransferType::Control => [8, 16, 32, 64].contains(&max_packet),
        TransferType::Interrupt => (1..=64).contains(&max_packet),
        TransferType::Isochronous => (1..=1023).contains(&max_packet),
    };
    if !allowed {
        return fail(
            "endpoint",
            format!("{transfer:?} with packets of {max_packet} bytes at full speed"),
        );
    }
    if transfer == TransferType::Interrupt && part[6] == 0 {
        return fail("endpoint", "an interrupt endpoint with bInterval 0");
    }
    if part[2] & 0x70 != 0 || part[2] & 0xf == 0 {
        return fail("endpoint", format!("bEndpointAddress {:#04x}", part[2]));
    }
    Ok(EndpointDescriptor { address: part[2], transfer, max_packet, interval: part[6] })
}

/// Reads a string descriptor.
///
/// # Errors
/// It is no UTF-16 string descriptor.
pub fn parse_string(bytes: &[u8]) -> Result<String, DescriptorError> {
    if bytes.len() < 2
        || usize::from(bytes[0]) != bytes.len()
        || bytes[1] != 3
        || !bytes.len().is_multiple_of(2)
    {
        return fail("string", format!("{bytes:02x?}"));
    }
    let units: Vec<u16> = bytes[2..].chunks_exact(2).map(|c| word(c, 0)).collect();
    String::from_utf16(&units).or_else(|_| fail("string", "not UTF-16"))
}

/// The Microsoft OS 2.0 platform capability in a BOS.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MsOsCapability {
    /// Length of the descriptor set.
    pub set_length: u16,
    /// bRequest that fetches it.
    pub vendor_code: u8,
}

/// UUID of the Microsoft OS 2.0 platform capability, as on the wire.
const MS_OS_UUID: [u8; 16] = [
    0xdf, 0x60, 0xdd, 0xd8, 0x89, 0x45, 0xc7, 0x4c, 0x9c, 0xd2, 0x65, 0x9d, 0x9e, 0x64, 0x8a, 0x9f,
];

/// Reads a BOS and finds the Microsoft OS 2.0 capability.
///
/// # Errors
/// A broken rule.
pub fn parse_bos(bytes: &[u8]) -> Result<Option<MsOsCapability>, DescriptorError> {
    if bytes.len() < 5
        || bytes[0] != 5
        || bytes[1] != 15
        || usize::from(word(bytes, 2)) != bytes.len()
    {
        return fail(
            "BOS",
            format!("header {:02x?} of {} bytes", &bytes[..bytes.len().min(5)], bytes.len()),
        );
    }
    let (mut rest, mut count, mut found) = (&bytes[5..], 0, None);
    while !rest.is_empty() {
        let length = usize::from(rest[0]);
        if length < 3 || length > rest.len() || rest[1] != 16 {
            return fail("BOS", "a capability that does not fit");
        }
        let (part, tail) = rest.split_at(length);
        (rest, count) = (tail, count + 1);
        if part[2] == 5 && length == 28 && part[4..20] == MS_OS_UUID {
            found = Some(MsOsCapability { set_length: word(part, 24), vendor_code: part[26] });
        }
    }
    if count != bytes[4] {
        return fail("BOS", format!("bNumDeviceCaps is {}, found {count}", bytes[4]));
    }
    Ok(found)
}

/// What a Microsoft OS 2.0 descriptor set says.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MsOsSet {
    /// Compatible ID, such as `WINUSB`.
    pub compatible_id: String,
    /// Value of the registry property `DeviceInterfaceGUIDs`.
    pub interface_guids: String,
}

/// Reads a Microsoft OS 2.0 descriptor set.
///
/// # Errors
/// A broken rule.
pub fn parse_ms_os_set(bytes: &[u8]) -> Result<MsOsSet, DescriptorError> {
    const KIND: &str = "MS OS 2.0";
    if bytes.len() < 10
        || word(bytes, 0) != 10
        || word(bytes, 2) != 0
        || usize::from(word(bytes, 8)) != bytes.len()
    {
        return fail(KIND, "header does not match the length");
    }
    let mut set = MsOsSet::default();
    let mut rest = &bytes[10..];
    while !rest.is_empty() {
        let length = if rest.len() >= 4 { usize::from(word(rest, 0)) } else { 0 };
        if length < 4 || length > rest.len() {
            return fail(KIND, "a part that does not fit");
        }
        let (part, tail) = rest.split_at(length);
        rest = tail;
        match word(part, 2) {
            // Subset headers hold what follows them.
            1 | 2 => {}
            3 if length == 20 => {
                set.compatible_id =
                    String::from_utf8_lossy(&part[4..12]).trim_end_matches('\0').to_string();
            }
            4 if length >= 10 => {
                let name_length = usize::from(word(part, 6));
                let name = utf16(&part[8..8 + name_length]);
                if name == "DeviceInterfaceGUIDs" || name == "DeviceInterfaceGUID" {
                    set.interface_guids = utf16(&part[10 + name_length..]);
                }
            }
            _ => {}
        }
    }
    Ok(set)
}

fn utf16(bytes: &[u8]) -> String {
    let units: Vec<u16> = bytes.chunks_exact(2).map(|c| word(c, 0)).collect();
    String::from_utf16_lossy(&units).trim_end_matches('\0').to_string()
}

impl fmt::Display for ConfigurationDescriptor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "  Configuration {}: attributes {:#04x}, MaxPower {}mA",
            self.value, self.attributes, self.max_power_ma
        )?;
        for interface in &self.interfaces {
            let [class, subclass, protocol] = interface.class;
            writeln!(
                f,
                "    Interface {}: class {class} subclass {subclass} protocol {protocol}",
                interface.number
            )?;
            for endpoint in &interface.endpoints {
                let direction = if endpoint.address & 0x80 != 0 { "IN" } else { "OUT" };
                writeln!(
                    f,
                    "      Endpoint {:#04x} EP {} {direction}: {:?}, {} bytes, interval {}",
                    endpoint.address,
                    endpoint.address & 0xf,
                    endpoint.transfer,
                    endpoint.max_packet,
                    endpoint.interval
                )?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIGURATION: [u8; 25] =
        [9, 2, 25, 0, 1, 1, 0, 0x80, 125, 9, 4, 0, 0, 1, 0xff, 0x53, 1, 0, 7, 5, 0x81, 2, 64, 0, 0];

    #[test]
    fn a_sound_configuration_is_read_and_unsound_ones_are_named() {
        let configuration = ConfigurationDescriptor::parse(&CONFIGURATION).unwrap();
        assert_eq!(configuration.max_power_ma, 250);
        assert_eq!(configuration.interfaces[0].endpoints[0].transfer, TransferType::Bulk);
        let broken = |at: usize, value: u8| {
            let mut bytes = CONFIGURATION;
            bytes[at] = value;
            ConfigurationDescriptor::parse(&bytes).unwrap_err().to_string()
        };
        assert!(broken(2, 24).contains("wTotalLength"));
        assert!(broken(4, 2).contains("bNumInterfaces"));
        assert!(broken(13, 2).contains("bNumEndpoints"));
        assert!(broken(22, 63).contains("63 bytes at full speed"));
        assert!(broken(18, 9).contains("9 bytes where 7"));
    }
}
