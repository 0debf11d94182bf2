//! What the camera says of itself (UVC 1.1 section 3, USB 2.0 section 9.6).

use super::payload::{CLOCK_HZ, HEADER_LENGTH};

/// Interface with the settings.
pub const CONTROL_INTERFACE: u8 = 0;
/// Interface with the pictures.
pub const STREAM_INTERFACE: u8 = 1;
/// Bulk IN endpoint of the pictures.
pub const STREAM_ENDPOINT: u8 = 0x81;
/// Unit that the exposure belongs to.
pub const CAMERA_TERMINAL: u8 = 1;
/// Unit that the gain belongs to.
pub const PROCESSING_UNIT: u8 = 2;
const OUTPUT_TERMINAL: u8 = 3;
const BULK_PACKET: u16 = 512;

/// How a pixel is stored: as the kernel's formats of these names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    /// 8-bit grey.
    Grey,
    /// 10 bits in 16, little-endian.
    Y10,
    /// 12 bits in 16, little-endian.
    Y12,
    /// 16 bits little-endian, of which the camera's depth is used.
    Y16,
    /// 8-bit luma, each followed by a byte of colour, which is none.
    Yuyv,
}

impl PixelFormat {
    /// Bytes of a pixel.
    pub fn bytes(self) -> u32 {
        match self {
            Self::Grey => 1,
            Self::Y10 | Self::Y12 | Self::Y16 | Self::Yuyv => 2,
        }
    }

    /// Grey values of at most 16 bits as they are sent.
    pub fn pack(self, values: &[u16]) -> Vec<u8> {
        const NO_COLOUR: u8 = 128;
        match self {
            Self::Grey => values.iter().map(|&v| v as u8).collect(),
            Self::Yuyv => values.iter().flat_map(|&v| [v as u8, NO_COLOUR]).collect(),
            Self::Y10 | Self::Y12 | Self::Y16 => {
                values.iter().flat_map(|v| v.to_le_bytes()).collect()
            }
        }
    }

    fn guid(self) -> [u8; 16] {
        let code = match self {
            Self::Grey => *b"Y800",
            Self::Y10 => *b"Y10 ",
            Self::Y12 => *b"Y12 ",
            Self::Y16 => *b"Y16 ",
            Self::Yuyv => *b"YUY2",
        };
        let mut guid = [0, 0, 0, 0, 0, 0, 0x10, 0, 0x80, 0, 0, 0xaa, 0, 0x38, 0x9b, 0x71];
        guid[..4].copy_from_slice(&code);
        guid
    }
}

/// A camera's identity and its one picture format.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Description {
    /// USB vendor.
    pub vendor_id: u16,
    /// USB product.
    pub product_id: u16,
    /// Product string.
    pub product: String,
    /// Serial number string.
    pub serial: String,
    /// Pixels of a row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// How a pixel is stored.
    pub format: PixelFormat,
    /// Shortest frame interval in units of 100 ns.
    pub interval_100ns: u32,
}

impl Description {
    /// Bytes of a frame.
    pub fn frame_bytes(&self) -> u32 {
        u32::from(self.width) * u32::from(self.height) * self.format.bytes()
    }

    /// Bytes of a payload, which holds one frame.
    pub fn payload_bytes(&self) -> u32 {
        self.frame_bytes() + HEADER_LENGTH as u32
    }

    /// The descriptor that a GET_DESCRIPTOR's wValue names.
    pub(super) fn descriptor(&self, value: u16) -> Option<Vec<u8>> {
        let [index, kind] = value.to_le_bytes();
        match (kind, index) {
            (1, 0) => Some(self.device().to_vec()),
            (2, 0) => Some(self.configuration()),
            (3, 0) => Some(vec![4, 3, 0x09, 0x04]),
            (3, 1) => Some(string("stspp")),
            (3, 2) => Some(string(&self.product)),
            (3, 3) => Some(string(&self.serial)),
            // Device qualifier: the same at the other speed.
            (6, 0) => Some(vec![10, 6, 0, 2, 0xef, 2, 1, 64, 1, 0]),
            _ => None,
        }
    }

    /// The device descriptor.
    pub fn device(&self) -> [u8; 18] {
        let [v0, v1] = self.vendor_id.to_le_bytes();
        let [p0, p1] = self.product_id.to_le_bytes();
        [18, 1, 0, 2, 0xef, 2, 1, 64, v0, v1, p0, p1, 0, 1, 1, 2, 3, 1]
    }

    /// The configuration with all its interfaces.
    pub fn configuration(&self) -> Vec<u8> {
        let control = control_interface();
        let stream = self.stream_interface();
        let total = (9 + 8 + control.len() + stream.len()) as u16;
        let mut bytes = vec![9, 2];
        bytes.extend(total.to_le_bytes());
        bytes.extend([2, 1, 0, 0x80, 250]);
        // Both interfaces are one video function.
        bytes.extend([8, 11, CONTROL_INTERFACE, 2, 0x0e, 3, 0, 2]);
        bytes.extend(control);
        bytes.extend(stream);
        bytes
    }

    fn stream_interface(&self) -> Vec<u8> {
        let mut format = vec![27, 0x24, 4, 1, 1];
        format.extend(self.format.guid());
        format.extend([8 * self.format.bytes() as u8, 1, 0, 0, 0, 0]);
        let bits_per_second = (u64::from(self.frame_bytes()) * 8 * 10_000_000
            / u64::from(self.interval_100ns))
        .min(u64::from(u32::MAX)) as u32;
        let mut frame = vec![30, 0x24, 5, 1, 0];
        frame.extend(self.width.to_le_bytes());
        frame.extend(self.height.to_le_bytes());
        frame.extend((bits_per_second / 1000).to_le_bytes());
        frame.extend(bits_per_second.to_le_bytes());
        frame.extend(self.frame_bytes().to_le_bytes());
        frame.extend(self.interval_100ns.to_le_bytes());
        frame.push(1);
        frame.extend(self.interval_100ns.to_le_bytes());

        let header_length = 14u16 + format.len() as u16 + frame.len() as u16;
        let mut bytes = vec![9, 4, STREAM_INTERFACE, 0, 1, 0x0e, 2, 0, 0];
        bytes.extend([14, 0x24, 1, 1]);
        bytes.extend(header_length.to_le_bytes());
        bytes.extend([STREAM_ENDPOINT, 0, OUTPUT_TERMINAL, 0, 0, 0, 1, 0]);
        bytes.extend(format);
        bytes.extend(frame);
        let [low, high] = BULK_PACKET.to_le_bytes();
        bytes.extend([7, 5, STREAM_ENDPOINT, 2, low, high, 0]);
        bytes
    }
}

fn control_interface() -> Vec<u8> {
    const AUTO_EXPOSURE_MODE_AND_EXPOSURE_TIME: [u8; 3] = [0b1010, 0, 0];
    const GAIN: [u8; 2] = [0, 0b10];
    let mut units = vec![18, 0x24, 2, CAMERA_TERMINAL, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 3];
    units.extend(AUTO_EXPOSURE_MODE_AND_EXPOSURE_TIME);
    units.extend([12, 0x24, 5, PROCESSING_UNIT, CAMERA_TERMINAL, 0, 0, 2]);
    units.extend(GAIN);
    units.extend([0, 0]);
    units.extend([9, 0x24, 3, OUTPUT_TERMINAL, 1, 1, 0, PROCESSING_UNIT, 0]);
    let mut bytes = vec![9, 4, CONTROL_INTERFACE, 0, 0, 0x0e, 1, 0, 0];
    bytes.extend([13, 0x24, 1, 0x10, 0x01]);
    bytes.extend((13 + units.len() as u16).to_le_bytes());
    bytes.extend(CLOCK_HZ.to_le_bytes());
    bytes.extend([1, STREAM_INTERFACE]);
    bytes.extend(units);
    bytes
}

fn string(text: &str) -> Vec<u8> {
    let units: Vec<u8> = text.encode_utf16().take(126).flat_map(u16::to_le_bytes).collect();
    let mut bytes = vec![2 + units.len() as u8, 3];
    bytes.extend(units);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::front::usb::descriptors;

    fn camera() -> Description {
        Description {
            vendor_id: 0x1209,
            product_id: 0x5753,
            product: "left".into(),
            serial: "1".into(),
            width: 1280,
            height: 1024,
            format: PixelFormat::Grey,
            interval_100ns: 333_333,
        }
    }

    #[test]
    fn lengths_in_the_configuration_add_up() {
        let bytes = camera().configuration();
        assert_eq!(usize::from(u16::from_le_bytes([bytes[2], bytes[3]])), bytes.len());
        let walked: usize = descriptors(&bytes).map(<[u8]>::len).sum();
        assert_eq!(walked, bytes.len());
        // Class-specific headers state the length of what follows in their interface.
        for (interface, subtype_header) in [(1u8, 13usize), (2, 14)] {
            let all: Vec<&[u8]> = descriptors(&bytes).collect();
            let start = all.iter().position(|d| d[1] == 4 && d[6] == interface).unwrap();
            let class: Vec<&&[u8]> = all[start + 1..].iter().take_while(|d| d[1] == 0x24).collect();
            assert_eq!(class[0].len(), subtype_header);
            let at = if interface == 1 { 5 } else { 4 };
            let stated = usize::from(u16::from_le_bytes([class[0][at], class[0][at + 1]]));
            assert_eq!(stated, class.iter().map(|d| d.len()).sum::<usize>());
        }
    }
}
