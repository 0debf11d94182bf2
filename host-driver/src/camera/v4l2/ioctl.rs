//! Video4Linux2 system calls: the structures and requests of `linux/videodev2.h`, and nothing else.
//!
//! Every function borrows an open descriptor, so that none can outlive its device, and returns the
//! kernel's answer as a value. All `unsafe` of the camera code is in this file.

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd, RawFd};

/// Pictures from a camera.
pub const BUFFER_VIDEO_CAPTURE: u32 = 1;
/// Metadata of pictures.
pub const BUFFER_META_CAPTURE: u32 = 13;
/// The node delivers pictures.
pub const CAPABILITY_VIDEO_CAPTURE: u32 = 0x1;
/// The node delivers metadata.
pub const CAPABILITY_META_CAPTURE: u32 = 0x0080_0000;
/// The node streams through mapped buffers.
pub const CAPABILITY_STREAMING: u32 = 0x0400_0000;
/// The buffer holds a picture that was damaged on its way.
pub const BUFFER_FLAG_ERROR: u32 = 0x40;
/// The control is there but cannot be used.
pub const CONTROL_FLAG_DISABLED: u32 = 1;
/// Asks [`query_control`] for the next control after an id.
pub const CONTROL_NEXT: u32 = 0x8000_0000;

const MEMORY_MMAP: u32 = 1;

/// `struct v4l2_capability`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Capability {
    pub driver: [u8; 16],
    pub card: [u8; 32],
    pub bus_info: [u8; 32],
    pub version: u32,
    pub capabilities: u32,
    pub device_caps: u32,
    reserved: [u32; 3],
}

/// `struct v4l2_pix_format`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelLayout {
    pub width: u32,
    pub height: u32,
    pub pixel_format: u32,
    pub field: u32,
    pub bytes_per_line: u32,
    pub size_image: u32,
    pub colorspace: u32,
    pub private: u32,
    pub flags: u32,
    pub encoding: u32,
    pub quantization: u32,
    pub transfer: u32,
}

/// `struct v4l2_format`; the union begins at the alignment of a pointer.
#[repr(C, align(8))]
#[derive(Clone, Copy)]
struct Format {
    kind: u32,
    padding: u32,
    layout: [u8; 200],
}

/// `struct v4l2_fmtdesc`.
#[repr(C)]
#[derive(Clone, Copy)]
struct FormatDescription {
    index: u32,
    kind: u32,
    flags: u32,
    description: [u8; 32],
    pixel_format: u32,
    media_bus_code: u32,
    reserved: [u32; 3],
}

/// `struct v4l2_requestbuffers`.
#[repr(C)]
#[derive(Clone, Copy)]
struct RequestBuffers {
    count: u32,
    kind: u32,
    memory: u32,
    capabilities: u32,
    flags: u8,
    reserved: [u8; 3],
}

/// `struct v4l2_buffer` where `long` has 64 bits.
#[repr(C, align(8))]
#[derive(Clone, Copy, Default)]
pub struct Buffer {
    pub index: u32,
    kind: u32,
    pub bytes_used: u32,
    pub flags: u32,
    field: u32,
    padding: u32,
    pub timestamp_s: i64,
    pub timestamp_us: i64,
    timecode: [u32; 4],
    pub sequence: u32,
    memory: u32,
    pub offset: u64,
    pub length: u32,
    reserved: [u32; 2],
    tail: u32,
}

/// `struct v4l2_streamparm` for capture.
#[repr(C)]
#[derive(Clone, Copy)]
struct StreamParameters {
    kind: u32,
    capability: u32,
    capture_mode: u32,
    interval: [u32; 2],
    rest: [u32; 46],
}

/// `struct v4l2_control`.
#[repr(C)]
#[derive(Clone, Copy)]
struct Control {
    id: u32,
    value: i32,
}

/// `struct v4l2_queryctrl`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct ControlDescription {
    pub id: u32,
    pub kind: u32,
    pub name: [u8; 32],
    pub minimum: i32,
    pub maximum: i32,
    pub step: i32,
    pub default: i32,
    pub flags: u32,
    reserved: [u32; 2],
}

const fn request<T>(direction: u32, number: u32) -> libc::c_ulong {
    ((direction << 30) | ((size_of::<T>() as u32) << 16) | ((b'V' as u32) << 8) | number)
        as libc::c_ulong
}

const fn read<T>(number: u32) -> libc::c_ulong {
    request::<T>(2, number)
}

const fn write<T>(number: u32) -> libc::c_ulong {
    request::<T>(1, number)
}

const fn both<T>(number: u32) -> libc::c_ulong {
    request::<T>(3, number)
}

const _: () = {
    assert!(size_of::<Capability>() == 104);
    assert!(size_of::<Format>() == 208);
    assert!(size_of::<FormatDescription>() == 64);
    assert!(size_of::<RequestBuffers>() == 20);
    assert!(size_of::<Buffer>() == 88);
    assert!(size_of::<StreamParameters>() == 204);
    assert!(size_of::<ControlDescription>() == 68);
};

/// Calls `ioctl` and repeats it when a signal interrupts it.
///
/// # Safety
/// `request` must be one that takes a pointer to a `T`.
unsafe fn ioctl<T>(fd: RawFd, request: libc::c_ulong, argument: &mut T) -> io::Result<()> {
    loop {
        // SAFETY: the caller matches request and type; the kernel writes within the `T` only.
        let result = unsafe { libc::ioctl(fd, request as _, std::ptr::from_mut(argument)) };
        if result >= 0 {
            return Ok(());
        }
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
    }
}

/// What the node is (VIDIOC_QUERYCAP).
pub fn query_capability(fd: BorrowedFd<'_>) -> io::Result<Capability> {
    let mut capability = Capability {
        driver: [0; 16],
        card: [0; 32],
        bus_info: [0; 32],
        version: 0,
        capabilities: 0,
        device_caps: 0,
        reserved: [0; 3],
    };
    // SAFETY: QUERYCAP fills a v4l2_capability.
    unsafe { ioctl(fd.as_raw_fd(), read::<Capability>(0), &mut capability) }?;
    Ok(capability)
}

/// The pixel formats that the node offers (VIDIOC_ENUM_FMT).
pub fn pixel_formats(fd: BorrowedFd<'_>) -> Vec<u32> {
    let mut formats = Vec::new();
    for index in 0..64 {
        let mut description = FormatDescription {
            index,
            kind: BUFFER_VIDEO_CAPTURE,
            flags: 0,
            description: [0; 32],
            pixel_format: 0,
            media_bus_code: 0,
            reserved: [0; 3],
        };
        // SAFETY: ENUM_FMT fills a v4l2_fmtdesc.
        let result =
            unsafe { ioctl(fd.as_raw_fd(), both::<FormatDescription>(2), &mut description) };
        if result.is_err() {
            break;
        }
        formats.push(description.pixel_format);
    }
    formats
}

fn to_bytes(layout: PixelLayout) -> [u8; 200] {
    let fields = [
        layout.width,
        layout.height,
        layout.pixel_format,
        layout.field,
        layout.bytes_per_line,
        layout.size_image,
        layout.colorspace,
        layout.private,
        layout.flags,
        layout.encoding,
        layout.quantization,
        layout.transfer,
    ];
    let mut bytes = [0; 200];
    for (to, field) in bytes.chunks_exact_mut(4).zip(fields) {
        to.copy_from_slice(&field.to_ne_bytes());
    }
    bytes
}

fn from_bytes(bytes: &[u8; 200]) -> PixelLayout {
    let field = |i: usize| u32::from_ne_bytes([0, 1, 2, 3].map(|j| bytes[4 * i + j]));
    PixelLayout {
        width: field(0),
        height: field(1),
        pixel_format: field(2),
        field: field(3),
        bytes_per_line: field(4),
        size_image: field(5),
        colorspace: field(6),
        private: field(7),
        flags: field(8),
        encoding: field(9),
        quantization: field(10),
        transfer: field(11),
    }
}

/// Asks for a picture layout and says what the driver made of it (VIDIOC_S_FMT).
pub fn set_format(fd: BorrowedFd<'_>, layout: PixelLayout) -> io::Result<PixelLayout> {
    let mut format = Format { kind: BUFFER_VIDEO_CAPTURE, padding: 0, layout: to_bytes(layout) };
    // SAFETY: S_FMT reads and fills a v4l2_format.
    unsafe { ioctl(fd.as_raw_fd(), both::<Format>(5), &mut format) }?;
    Ok(from_bytes(&format.layout))
}

/// The picture layout now (VIDIOC_G_FMT).
pub fn format(fd: BorrowedFd<'_>) -> io::Result<PixelLayout> {
    let mut format = Format { kind: BUFFER_VIDEO_CAPTURE, padding: 0, layout: [0; 200] };
    // SAFETY: G_FMT fills a v4l2_format.
    unsafe { ioctl(fd.as_raw_fd(), both::<Format>(4), &mut format) }?;
    Ok(from_bytes(&format.layout))
}

/// Format and buffer size of a metadata node (VIDIOC_G_FMT).
pub fn meta_format(fd: BorrowedFd<'_>) -> io::Result<(u32, u32)> {
    let mut format = Format { kind: BUFFER_META_CAPTURE, padding: 0, layout: [0; 200] };
    // SAFETY: G_FMT fills a v4l2_format.
    unsafe { ioctl(fd.as_raw_fd(), both::<Format>(4), &mut format) }?;
    let layout = from_bytes(&format.layout);
    Ok((layout.width, layout.height))
}

/// Asks for a frame interval, seconds as a fraction, and says what it became (VIDIOC_S_PARM).
pub fn set_interval(fd: BorrowedFd<'_>, interval: [u32; 2]) -> io::Result<[u32; 2]> {
    let mut parameters = StreamParameters {
        kind: BUFFER_VIDEO_CAPTURE,
        capability: 0,
        capture_mode: 0,
        interval,
        rest: [0; 46],
    };
    // SAFETY: S_PARM reads and fills a v4l2_streamparm.
    unsafe { ioctl(fd.as_raw_fd(), both::<StreamParameters>(22), &mut parameters) }?;
    Ok(parameters.interval)
}

/// Makes `count` buffers that can be mapped; 0 gives them back (VIDIOC_REQBUFS).
pub fn request_buffers(fd: BorrowedFd<'_>, kind: u32, count: u32) -> io::Result<u32> {
    let mut request = RequestBuffers {
        count,
        kind,
        memory: MEMORY_MMAP,
        capabilities: 0,
        flags: 0,
        reserved: [0; 3],
    };
    // SAFETY: REQBUFS reads and fills a v4l2_requestbuffers.
    unsafe { ioctl(fd.as_raw_fd(), both::<RequestBuffers>(8), &mut request) }?;
    Ok(request.count)
}

/// Where a buffer is (VIDIOC_QUERYBUF).
pub fn query_buffer(fd: BorrowedFd<'_>, kind: u32, index: u32) -> io::Result<Buffer> {
    let mut buffer = Buffer { index, kind, memory: MEMORY_MMAP, ..Buffer::default() };
    // SAFETY: QUERYBUF reads and fills a v4l2_buffer.
    unsafe { ioctl(fd.as_raw_fd(), both::<Buffer>(9), &mut buffer) }?;
    // The kernel's union is an offset of 32 bits here.
    buffer.offset &= u64::from(u32::MAX);
    Ok(buffer)
}

/// Gives a buffer to the driver (VIDIOC_QBUF).
pub fn enqueue(fd: BorrowedFd<'_>, kind: u32, index: u32) -> io::Result<()> {
    let mut buffer = Buffer { index, kind, memory: MEMORY_MMAP, ..Buffer::default() };
    // SAFETY: QBUF reads and fills a v4l2_buffer.
    unsafe { ioctl(fd.as_raw_fd(), both::<Buffer>(15), &mut buffer) }
}

/// Takes a filled buffer from the driver; `WouldBlock` when there is none (VIDIOC_DQBUF).
pub fn dequeue(fd: BorrowedFd<'_>, kind: u32) -> io::Result<Buffer> {
    let mut buffer = Buffer { kind, memory: MEMORY_MMAP, ..Buffer::default() };
    // SAFETY: DQBUF fills a v4l2_buffer.
    unsafe { ioctl(fd.as_raw_fd(), both::<Buffer>(17), &mut buffer) }?;
    Ok(buffer)
}

/// Starts or stops the stream (VIDIOC_STREAMON, VIDIOC_STREAMOFF).
pub fn stream(fd: BorrowedFd<'_>, kind: u32, on: bool) -> io::Result<()> {
    let mut kind = kind as i32;
    let number = if on { 18 } else { 19 };
    // SAFETY: STREAMON and STREAMOFF read an int.
    unsafe { ioctl(fd.as_raw_fd(), write::<i32>(number), &mut kind) }
}

/// What a control is (VIDIOC_QUERYCTRL).
pub fn query_control(fd: BorrowedFd<'_>, id: u32) -> io::Result<ControlDescription> {
    let mut description = ControlDescription { id, ..ControlDescription::default() };
    // SAFETY: QUERYCTRL reads and fills a v4l2_queryctrl.
    unsafe { ioctl(fd.as_raw_fd(), both::<ControlDescription>(36), &mut description) }?;
    Ok(description)
}

/// Value of a control (VIDIOC_G_CTRL).
pub fn control(fd: BorrowedFd<'_>, id: u32) -> io::Result<i32> {
    let mut control = Control { id, value: 0 };
    // SAFETY: G_CTRL reads and fills a v4l2_control.
    unsafe { ioctl(fd.as_raw_fd(), both::<Control>(27), &mut control) }?;
    Ok(control.value)
}

/// Sets a control and says what it became (VIDIOC_S_CTRL).
pub fn set_control(fd: BorrowedFd<'_>, id: u32, value: i32) -> io::Result<i32> {
    let mut control = Control { id, value };
    // SAFETY: S_CTRL reads and fills a v4l2_control.
    unsafe { ioctl(fd.as_raw_fd(), both::<Control>(28), &mut control) }?;
    Ok(control.value)
}

/// Waits until one of `fds` has a buffer or has gone, at most `timeout_ms`; says which.
pub fn wait(fds: &[BorrowedFd<'_>], timeout_ms: i32) -> io::Result<Vec<bool>> {
    let mut polled: Vec<libc::pollfd> = fds
        .iter()
        .map(|fd| libc::pollfd { fd: fd.as_raw_fd(), events: libc::POLLIN, revents: 0 })
        .collect();
    // SAFETY: `polled` is a valid array of its own length.
    let result =
        unsafe { libc::poll(polled.as_mut_ptr(), polled.len() as libc::nfds_t, timeout_ms) };
    if result < 0 {
        let error = io::Error::last_os_error();
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
        return Ok(vec![false; fds.len()]);
    }
    Ok(polled.iter().map(|p| p.revents != 0).collect())
}

/// A driver's buffer in our memory.
pub struct Mapping {
    address: *mut libc::c_void,
    length: usize,
}

// SAFETY: the memory is shared with the kernel, not with a thread; `&Mapping` only reads.
unsafe impl Send for Mapping {}

impl Mapping {
    /// Maps a buffer that [`query_buffer`] described.
    pub fn new(fd: BorrowedFd<'_>, buffer: &Buffer) -> io::Result<Self> {
        let length = buffer.length as usize;
        // SAFETY: a new mapping at an address of the kernel's choice harms no other.
        let address = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                length,
                libc::PROT_READ,
                libc::MAP_SHARED,
                fd.as_raw_fd(),
                buffer.offset as libc::off_t,
            )
        };
        if address == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(Self { address, length })
    }

    /// The first `length` bytes, at most all. To be called between dequeue and enqueue of this
    /// buffer only: else the driver may be writing it.
    pub fn bytes(&self, length: usize) -> &[u8] {
        // SAFETY: mapped and readable for `self.length` bytes until `drop`.
        unsafe { std::slice::from_raw_parts(self.address.cast(), length.min(self.length)) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length, and nobody holds a slice of it any more.
        unsafe { libc::munmap(self.address, self.length) };
    }
}
