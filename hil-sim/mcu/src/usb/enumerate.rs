//! Enumeration as an operating system does it, and requests that wait for their answer.

use super::descriptors::{
    ConfigurationDescriptor, DescriptorError, DeviceDescriptor, MsOsSet, parse_bos,
    parse_ms_os_set, parse_string,
};
use super::host::{BusState, Completion, Request, UrbStatus};
use crate::chip::Chip;

/// A request waits this long before it is given up, as an operating system's control requests do.
pub const TIMEOUT_NS: u64 = 5_000_000_000;
/// Longest wait for a device to appear.
const ATTACH_NS: u64 = 2_000_000_000;
/// How often the host looks while it waits.
const LOOK_NS: u64 = 20_000;
/// Address that the device gets.
pub(crate) const ADDRESS: u8 = 5;

/// What went wrong on the bus.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UsbError {
    /// No device pulled its line up and came out of reset in time.
    #[error("no USB device appeared; the bus is {0:?}")]
    NotAttached(BusState),
    /// A request did not end in time: the device answered NAK throughout.
    #[error("{0} was not answered in time")]
    Timeout(String),
    /// A request ended badly.
    #[error("{what} ended with {status:?}")]
    Failed {
        /// Which request.
        what: String,
        /// How.
        status: UrbStatus,
    },
    /// A descriptor breaks a rule.
    #[error(transparent)]
    Descriptor(#[from] DescriptorError),
}

/// What enumeration found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Enumerated {
    /// Device descriptor.
    pub device: DeviceDescriptor,
    /// Its bytes.
    pub device_bytes: Vec<u8>,
    /// The configuration, which is now set.
    pub configuration: ConfigurationDescriptor,
    /// Its bytes.
    pub configuration_bytes: Vec<u8>,
    /// Manufacturer, product and serial number.
    pub strings: [String; 3],
    /// What tells Windows to use WinUSB, if the device has it.
    pub ms_os: Option<MsOsSet>,
}

impl std::fmt::Display for Enumerated {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let d = &self.device;
        writeln!(
            f,
            "ID {:04x}:{:04x} {} {}",
            d.vendor_id, d.product_id, self.strings[0], self.strings[1]
        )?;
        writeln!(
            f,
            "  bcdUSB {:x}.{:02x}  bMaxPacketSize0 {}  bcdDevice {:x}.{:02x}  iSerial {}",
            d.usb_version >> 8,
            d.usb_version & 0xff,
            d.max_packet_0,
            d.device_version >> 8,
            d.device_version & 0xff,
            self.strings[2]
        )?;
        write!(f, "{}", self.configuration)?;
        if let Some(ms) = &self.ms_os {
            writeln!(f, "  MS OS 2.0: {} {}", ms.compatible_id, ms.interface_guids)?;
        }
        Ok(())
    }
}

/// Sends a request and lets time pass until it ends.
///
/// # Errors
/// It timed out (and was taken back), or it ended otherwise than well.
pub fn transfer(
    chip: &mut Chip,
    what: &str,
    request: Request,
    timeout_ns: u64,
) -> Result<Completion, UsbError> {
    let now_ns = chip.now_ns();
    let id = chip.act(|soc, cx| {
        let id = soc.usbfs.host().submit(request, now_ns);
        soc.usbfs.settle(cx);
        id
    });
    let mut completion = None;
    chip.run_until(timeout_ns, LOOK_NS, |chip| {
        completion = chip.soc().usbfs.host().take_completion_of(id);
        completion.is_some()
    });
    match completion {
        Some(done) if done.status == UrbStatus::Ok => Ok(done),
        Some(done) => Err(UsbError::Failed { what: what.to_string(), status: done.status }),
        None => {
            let now_ns = chip.now_ns();
            chip.act(|soc, _| {
                soc.usbfs.host().unlink(id, now_ns);
                soc.usbfs.host().take_completion_of(id)
            });
            Err(UsbError::Timeout(what.to_string()))
        }
    }
}

/// A control transfer.
///
/// # Errors
/// As [`transfer`].
pub fn control(
    chip: &mut Chip,
    what: &str,
    setup: [u8; 8],
    data: &[u8],
) -> Result<Vec<u8>, UsbError> {
    transfer(chip, what, Request::Control { setup, data: data.to_vec() }, TIMEOUT_NS)
        .map(|done| done.data)
}

fn get_descriptor(
    chip: &mut Chip,
    what: &str,
    value: u16,
    index: u16,
    length: u16,
) -> Result<Vec<u8>, UsbError> {
    let [v0, v1] = value.to_le_bytes();
    let [i0, i1] = index.to_le_bytes();
    let [l0, l1] = length.to_le_bytes();
    control(chip, what, [0x80, 6, v0, v1, i0, i1, l0, l1], &[])
}

fn total_length(header: &[u8]) -> u16 {
    if header.len() >= 4 { u16::from_le_bytes([header[2], header[3]]) } else { 0 }
}

/// Waits until the device is attached and out of reset.
///
/// # Errors
/// It does not appear.
pub fn wait_attached(chip: &mut Chip) -> Result<(), UsbError> {
    let there = chip.run_until(ATTACH_NS, 1_000_000, |chip| {
        chip.soc().usbfs.host().state() == BusState::Active
    });
    let state = chip.soc().usbfs.host().state();
    if there { Ok(()) } else { Err(UsbError::NotAttached(state)) }
}

/// Enumerates the device: descriptors are read as an operating system reads them and checked, the
/// configuration is set.
///
/// # Errors
/// The device does not answer as the specification wants.
pub fn enumerate(chip: &mut Chip) -> Result<Enumerated, UsbError> {
    wait_attached(chip)?;
    // The first eight bytes tell the packet size; then the address is given.
    let head = get_descriptor(chip, "GET_DESCRIPTOR(device, 8)", 0x0100, 0, 8)?;
    let max_packet_0 = head.get(7).copied().unwrap_or(8);
    chip.act(|soc, _| {
        soc.usbfs.host().set_max_packet(0, true, u16::from(max_packet_0));
        soc.usbfs.host().set_max_packet(0, false, u16::from(max_packet_0));
    });
    control(chip, "SET_ADDRESS", [0, 5, ADDRESS, 0, 0, 0, 0, 0], &[])?;
    chip.run_for_ns(2_000_000);

    let device_bytes = get_descriptor(chip, "GET_DESCRIPTOR(device)", 0x0100, 0, 18)?;
    let device = DeviceDescriptor::parse(&device_bytes)?;
    let header = get_descriptor(chip, "GET_DESCRIPTOR(configuration, 9)", 0x0200, 0, 9)?;
    let configuration_bytes =
        get_descriptor(chip, "GET_DESCRIPTOR(configuration)", 0x0200, 0, total_length(&header))?;
    let configuration = ConfigurationDescriptor::parse(&configuration_bytes)?;

    let languages = get_descriptor(chip, "GET_DESCRIPTOR(languages)", 0x0300, 0, 255)?;
    let language = if languages.len() >= 4 {
        u16::from_le_bytes([languages[2], languages[3]])
    } else {
        0x0409
    };
    let mut strings: [String; 3] = Default::default();
    for (string, index) in strings.iter_mut().zip(device.strings) {
        if index != 0 {
            let bytes = get_descriptor(
                chip,
                "GET_DESCRIPTOR(string)",
                0x0300 | u16::from(index),
                language,
                255,
            )?;
            *string = parse_string(&bytes)?;
        }
    }
    let ms_os = if device.usb_version > 0x0200 { read_ms_os(chip)? } else { None };

    control(chip, "SET_CONFIGURATION", [0, 9, configuration.value, 0, 0, 0, 0, 0], &[])?;
    chip.act(|soc, _| {
        for endpoint in configuration.interfaces.iter().flat_map(|i| &i.endpoints) {
            soc.usbfs.host().set_max_packet(
                endpoint.address,
                endpoint.address & 0x80 != 0,
                endpoint.max_packet,
            );
        }
    });
    Ok(Enumerated { device, device_bytes, configuration, configuration_bytes, strings, ms_os })
}

fn read_ms_os(chip: &mut Chip) -> Result<Option<MsOsSet>, UsbError> {
    let header = get_descriptor(chip, "GET_DESCRIPTOR(BOS, 5)", 0x0f00, 0, 5)?;
    let bos = get_descriptor(chip, "GET_DESCRIPTOR(BOS)", 0x0f00, 0, total_length(&header))?;
    let Some(capability) = parse_bos(&bos)? else { return Ok(None) };
    let [l0, l1] = capability.set_length.to_le_bytes();
    // bmRequestType device-to-host, vendor, device; wIndex 7: MS_OS_20_DESCRIPTOR_INDEX.
    let set = control(
        chip,
        "MS OS 2.0 descriptor set",
        [0xc0, capability.vendor_code, 0, 0, 7, 0, l0, l1],
        &[],
    )?;
    Ok(Some(parse_ms_os_set(&set)?))
}
