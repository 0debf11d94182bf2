//! One video or metadata node: opened, configured, streaming through mapped buffers.

use super::ioctl::{self, ControlDescription, Mapping, PixelLayout};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// What a node delivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NodeKind {
    /// Pictures.
    Video,
    /// Headers of the pictures' payloads.
    Metadata,
}

impl NodeKind {
    fn buffer_type(self) -> u32 {
        match self {
            Self::Video => ioctl::BUFFER_VIDEO_CAPTURE,
            Self::Metadata => ioctl::BUFFER_META_CAPTURE,
        }
    }
}

/// What a buffer held.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dequeued<T> {
    /// The driver's count of pictures since the stream's start.
    pub sequence: u32,
    /// When the driver saw the picture begin: the machine's monotonic clock, nanoseconds.
    pub timestamp_ns: u64,
    /// The driver saw that the picture is damaged.
    pub is_damaged: bool,
    /// What was made of the bytes.
    pub content: T,
}

/// An open node; stops streaming when dropped.
pub struct Node {
    file: File,
    path: PathBuf,
    kind: NodeKind,
    buffers: Vec<Mapping>,
    streaming: bool,
}

impl Node {
    /// Opens a node for pictures or metadata, whichever it delivers.
    ///
    /// # Errors
    /// The system's; `Unsupported` for a node that is neither.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(libc::O_NONBLOCK | libc::O_CLOEXEC)
            .open(path)?;
        let capability = ioctl::query_capability(file.as_fd())?.device_caps;
        let kind = if capability & ioctl::CAPABILITY_VIDEO_CAPTURE != 0 {
            NodeKind::Video
        } else if capability & ioctl::CAPABILITY_META_CAPTURE != 0 {
            NodeKind::Metadata
        } else {
            return Err(io::ErrorKind::Unsupported.into());
        };
        if capability & ioctl::CAPABILITY_STREAMING == 0 {
            return Err(io::ErrorKind::Unsupported.into());
        }
        Ok(Self { file, path: path.into(), kind, buffers: Vec::new(), streaming: false })
    }

    /// Where the node is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the node delivers.
    pub fn kind(&self) -> NodeKind {
        self.kind
    }

    /// The open descriptor, to wait on.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }

    /// The pixel formats on offer.
    pub fn pixel_formats(&self) -> Vec<u32> {
        ioctl::pixel_formats(self.fd())
    }

    /// Asks for pictures of this format and size; says what the driver will deliver, which may be
    /// something else.
    ///
    /// # Errors
    /// The system's; `ResourceBusy` when another program streams from the node.
    pub fn negotiate(
        &self,
        pixel_format: u32,
        width: u32,
        height: u32,
        interval: [u32; 2],
    ) -> io::Result<PixelLayout> {
        let wanted = PixelLayout { width, height, pixel_format, field: 1, ..Default::default() };
        let layout = ioctl::set_format(self.fd(), wanted)?;
        // Some drivers have no rate to set: the trigger decides it anyway.
        let _ = ioctl::set_interval(self.fd(), interval);
        Ok(layout)
    }

    /// The pictures' layout now.
    ///
    /// # Errors
    /// The system's.
    pub fn layout(&self) -> io::Result<PixelLayout> {
        ioctl::format(self.fd())
    }

    /// Format and buffer size of a metadata node.
    ///
    /// # Errors
    /// The system's.
    pub fn meta_format(&self) -> io::Result<(u32, u32)> {
        ioctl::meta_format(self.fd())
    }

    /// Maps `count` buffers and starts the stream.
    ///
    /// # Errors
    /// The system's.
    pub fn start(&mut self, count: u32) -> io::Result<()> {
        let kind = self.kind.buffer_type();
        let count = ioctl::request_buffers(self.fd(), kind, count)?;
        for index in 0..count {
            let buffer = ioctl::query_buffer(self.fd(), kind, index)?;
            let mapping = Mapping::new(self.fd(), &buffer)?;
            self.buffers.push(mapping);
            ioctl::enqueue(self.fd(), kind, index)?;
        }
        ioctl::stream(self.fd(), kind, true)?;
        self.streaming = true;
        Ok(())
    }

    /// Stops the stream and gives the buffers back.
    pub fn stop(&mut self) {
        let kind = self.kind.buffer_type();
        if std::mem::take(&mut self.streaming) {
            // The device may be gone; then there is nothing to stop.
            let _ = ioctl::stream(self.fd(), kind, false);
        }
        self.buffers.clear();
        let _ = ioctl::request_buffers(self.fd(), kind, 0);
    }

    /// Takes the next filled buffer, if there is one, has `read` make something of its bytes, and gives
    /// it back.
    ///
    /// # Errors
    /// The system's: `ENODEV` when the camera is gone.
    pub fn take<T>(&mut self, read: impl FnOnce(&[u8]) -> T) -> io::Result<Option<Dequeued<T>>> {
        let kind = self.kind.buffer_type();
        let buffer = match ioctl::dequeue(self.fd(), kind) {
            Ok(buffer) => buffer,
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(e) => return Err(e),
        };
        let bytes = self
            .buffers
            .get(buffer.index as usize)
            .map_or(&[][..], |mapping| mapping.bytes(buffer.bytes_used as usize));
        let (seconds, micros) = (buffer.timestamp_s.max(0), buffer.timestamp_us.max(0));
        let dequeued = Dequeued {
            sequence: buffer.sequence,
            timestamp_ns: seconds as u64 * 1_000_000_000 + micros as u64 * 1000,
            is_damaged: buffer.flags & ioctl::BUFFER_FLAG_ERROR != 0,
            content: read(bytes),
        };
        ioctl::enqueue(self.fd(), kind, buffer.index)?;
        Ok(Some(dequeued))
    }

    /// All controls that can be used.
    pub fn controls(&self) -> Vec<ControlDescription> {
        let mut controls = Vec::new();
        let mut id = 0;
        while let Ok(control) = ioctl::query_control(self.fd(), id | ioctl::CONTROL_NEXT) {
            if control.id <= id {
                break;
            }
            id = control.id;
            if control.flags & ioctl::CONTROL_FLAG_DISABLED == 0 {
                controls.push(control);
            }
        }
        controls
    }

    /// Value of a control.
    ///
    /// # Errors
    /// The system's.
    pub fn control(&self, id: u32) -> io::Result<i32> {
        ioctl::control(self.fd(), id)
    }

    /// Sets a control; says what it became.
    ///
    /// # Errors
    /// The system's: `ERANGE` outside the control's range.
    pub fn set_control(&self, id: u32, value: i32) -> io::Result<i32> {
        ioctl::set_control(self.fd(), id, value)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.stop();
    }
}
