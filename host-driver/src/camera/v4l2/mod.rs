//! Cameras behind the kernel's Video4Linux2 interface: two video nodes, or one with both pictures
//! side by side.
//!
//! `ioctl` are the system calls, [`node`] an open node, [`pixels`] what a picture's bytes mean,
//! [`metadata`] the camera's own clock, [`topology`] which nodes belong together.
//!
//! A frame's sequence number is the driver's count since the stream's start. Its camera time is the
//! camera's presentation time (the start of exposure) where the metadata node gives it, else the
//! driver's timestamp of the picture's first packet.

mod ioctl;
pub mod metadata;
pub mod node;
pub mod pixels;
pub mod topology;

use super::{CameraError, CameraFrame, CameraSource, fingerprint};
use crate::RawImage;
use crate::clock::Clock;
use crate::sync::{FrameStamp, Side};
use ioctl::PixelLayout;
use metadata::{HeaderTimes, TickClock};
use node::{Dequeued, Node, NodeKind};
use pixels::PixelFormat;
use std::collections::VecDeque;
use std::io;
use std::os::fd::BorrowedFd;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use topology::{SensorCameras, UsbCamera};

const EXPOSURE_AUTO: u32 = 0x009a_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const GAIN: u32 = 0x0098_0913;
const EXPOSURE_MANUAL: i32 = 1;

/// Buffers of a stream: a third of a second at 30 Hz, so that a busy host loses nothing.
const BUFFERS: u32 = 10;

/// Pictures that wait for their metadata, which the driver delivers on its own node.
const AWAITING_METADATA: usize = 3;

/// What to set on the cameras before they stream.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraSettings {
    /// Size of one camera's pictures, [width, height] in pixels.
    pub resolution_px: [usize; 2],
    /// Longest time between two pictures, seconds as a fraction.
    pub interval: [u32; 2],
    /// Exposure in microseconds, where the camera has that control.
    pub exposure_us: Option<u32>,
    /// Gain in the camera's own units.
    pub gain: Option<i32>,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self { resolution_px: [1280, 1024], interval: [1, 30], exposure_us: None, gain: None }
    }
}

/// A stream of one camera: pictures, and metadata where there is any.
struct Stream {
    /// The sides that a picture holds, left to right.
    sides: Vec<Side>,
    video: Node,
    metadata: Option<Node>,
    format: PixelFormat,
    layout: PixelLayout,
    ticks: TickClock,
    clock_hz: u32,
    /// Times of pictures by sequence number.
    times: VecDeque<(u32, HeaderTimes)>,
    pictures: VecDeque<Dequeued<Images>>,
}

/// One image for each side that a picture holds; `None` where the picture is too short.
type Images = Vec<Option<RawImage>>;

/// Cameras as a source of frames.
pub struct V4l2Cameras {
    streams: Vec<Stream>,
    clock: Arc<dyn Clock>,
    ready: VecDeque<CameraFrame>,
    damaged: [u64; 2],
    shares_bus: bool,
}

impl V4l2Cameras {
    /// Opens and configures the cameras of a sensor. `shares_bus`: they are on the control interface's
    /// USB bus, so that frame numbers of that bus tie their pictures to its triggers.
    ///
    /// # Errors
    /// Names the camera: no permission, in use by another program, no grey format, another size.
    pub fn open(
        cameras: &SensorCameras,
        settings: &CameraSettings,
        shares_bus: bool,
        clock: Arc<dyn Clock>,
    ) -> Result<Self, CameraError> {
        let streams = match cameras {
            SensorCameras::Two { left, right } => vec![
                Stream::open(left, vec![Side::Left], settings)?,
                Stream::open(right, vec![Side::Right], settings)?,
            ],
            SensorCameras::SideBySide(both) => {
                vec![Stream::open(both, vec![Side::Left, Side::Right], settings)?]
            }
        };
        Ok(Self { streams, clock, ready: VecDeque::new(), damaged: [0; 2], shares_bus })
    }

    fn collect(&mut self) -> Result<(), CameraError> {
        let arrival_host_ns = self.clock.now_ns();
        for stream in &mut self.streams {
            let side = stream.sides[0];
            stream.fetch().map_err(|e| gone_or_io(side, e))?;
            while let Some((picture, timestamp_camera_ns, usb_sof)) = stream.complete() {
                if picture.is_damaged || picture.content.iter().any(Option::is_none) {
                    for side in &stream.sides {
                        self.damaged[side.index()] += 1;
                    }
                    continue;
                }
                let images = picture.content.into_iter().flatten();
                for (side, image) in stream.sides.iter().zip(images) {
                    let stamp = FrameStamp {
                        side: *side,
                        sequence: picture.sequence,
                        timestamp_camera_ns,
                        arrival_host_ns,
                        fingerprint: fingerprint(&image),
                        usb_sof: usb_sof.filter(|_| self.shares_bus),
                    };
                    self.ready.push_back(CameraFrame { stamp, image });
                }
            }
        }
        Ok(())
    }
}

impl CameraSource for V4l2Cameras {
    fn damaged(&self) -> [u64; 2] {
        self.damaged
    }

    fn start(&mut self) -> Result<(), CameraError> {
        self.ready.clear();
        for stream in &mut self.streams {
            let side = stream.sides[0];
            stream.start().map_err(|e| start_error(side, stream.video.path().into(), e))?;
        }
        Ok(())
    }

    fn stop(&mut self) {
        for stream in &mut self.streams {
            stream.stop();
        }
        self.ready.clear();
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Option<CameraFrame>, CameraError> {
        let deadline = Instant::now() + timeout;
        loop {
            self.collect()?;
            if let Some(frame) = self.ready.pop_front() {
                return Ok(Some(frame));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            let fds: Vec<BorrowedFd<'_>> = self.streams.iter().flat_map(Stream::fds).collect();
            // A camera that stops delivering must not keep a picture waiting for its metadata.
            let milliseconds = left.as_millis().clamp(1, 50) as i32;
            let side = self.streams[0].sides[0];
            ioctl::wait(&fds, milliseconds).map_err(|source| CameraError::Io { side, source })?;
        }
    }
}

impl Stream {
    fn open(
        camera: &UsbCamera,
        sides: Vec<Side>,
        settings: &CameraSettings,
    ) -> Result<Self, CameraError> {
        let side = sides[0];
        let mut video = None;
        let mut metadata = None;
        for path in &camera.nodes {
            let node = Node::open(path).map_err(|e| start_error(side, path.clone(), e))?;
            match node.kind() {
                NodeKind::Video => video = video.or(Some(node)),
                NodeKind::Metadata => {
                    let is_uvc = node.meta_format().is_ok_and(|f| f.0 == metadata::UVC_HEADERS);
                    metadata = metadata.or(is_uvc.then_some(node));
                }
            }
        }
        let video = video.ok_or(CameraError::Gone { side })?;
        // Without the clock's rate the metadata's ticks mean nothing.
        let metadata = metadata.filter(|_| camera.clock_hz.is_some());
        let offered = video.pixel_formats();
        let format = PixelFormat::ALL
            .into_iter()
            .find(|format| offered.contains(&format.fourcc()))
            .ok_or_else(|| CameraError::NoGreyFormat { side, path: video.path().into() })?;
        let [width, height] = settings.resolution_px;
        let wide = width * sides.len();
        let layout = video
            .negotiate(format.fourcc(), wide as u32, height as u32, settings.interval)
            .map_err(|e| start_error(side, video.path().into(), e))?;
        let got = [layout.width as usize / sides.len(), layout.height as usize];
        if got != settings.resolution_px {
            return Err(CameraError::Size { side, expected: settings.resolution_px, got });
        }
        if layout.pixel_format != format.fourcc() {
            return Err(CameraError::NoGreyFormat { side, path: video.path().into() });
        }
        let clock_hz = camera.clock_hz.unwrap_or(1);
        let ticks = TickClock::new(clock_hz);
        let mut stream = Self {
            sides,
            video,
            metadata,
            format,
            layout,
            ticks,
            clock_hz,
            times: VecDeque::new(),
            pictures: VecDeque::new(),
        };
        stream.configure(settings)?;
        Ok(stream)
    }

    fn configure(&mut self, settings: &CameraSettings) -> Result<(), CameraError> {
        let side = self.sides[0];
        let controls = self.video.controls();
        let has = |id: u32| controls.iter().find(|c| c.id == id);
        if has(EXPOSURE_AUTO).is_some() {
            // Automatic exposure would change the pictures within a window.
            let _ = self.video.set_control(EXPOSURE_AUTO, EXPOSURE_MANUAL);
        }
        if let Some(trigger) = controls.iter().find(|c| is_named(&c.name, "trigger mode")) {
            let _ = self.video.set_control(trigger.id, trigger.maximum);
        }
        let wanted = [
            (EXPOSURE_ABSOLUTE, "exposure", settings.exposure_us.map(|us| us.div_ceil(100) as i32)),
            (GAIN, "gain", settings.gain),
        ];
        for (id, name, value) in wanted {
            let Some(value) = value else { continue };
            let control = has(id).ok_or(CameraError::NoControl { side, name })?;
            if !(control.minimum..=control.maximum).contains(&value) {
                let allowed = [control.minimum, control.maximum];
                return Err(CameraError::ControlRange { side, name, value, allowed });
            }
            self.video.set_control(id, value).map_err(|source| CameraError::Io { side, source })?;
        }
        Ok(())
    }

    fn start(&mut self) -> io::Result<()> {
        self.times.clear();
        self.pictures.clear();
        // Metadata first: none of its buffers may be missed.
        if let Some(metadata) = &mut self.metadata {
            metadata.start(BUFFERS)?;
        }
        self.video.start(BUFFERS)
    }

    fn stop(&mut self) {
        self.video.stop();
        if let Some(metadata) = &mut self.metadata {
            metadata.stop();
        }
    }

    fn fds(&self) -> Vec<BorrowedFd<'_>> {
        self.metadata.iter().chain([&self.video]).map(Node::fd).collect()
    }

    fn fetch(&mut self) -> io::Result<()> {
        if let Some(metadata) = &mut self.metadata {
            while let Some(buffer) = metadata.take(metadata::parse)? {
                if let Some(times) = buffer.content {
                    self.times.push_back((buffer.sequence, times));
                }
            }
            while self.times.len() > 2 * BUFFERS as usize {
                self.times.pop_front();
            }
        }
        let (format, layout, count) = (self.format, &self.layout, self.sides.len());
        let width = layout.width as usize / count;
        let images = |bytes: &[u8]| -> Images {
            (0..count).map(|i| pixels::image(format, layout, bytes, i * width, width)).collect()
        };
        while let Some(picture) = self.video.take(images)? {
            self.pictures.push_back(picture);
        }
        Ok(())
    }

    /// The oldest picture with its camera time and the USB frame number of its exposure's start, once
    /// its metadata is there or will not come.
    fn complete(&mut self) -> Option<(Dequeued<Images>, u64, Option<u16>)> {
        let first = self.pictures.front()?;
        if self.metadata.is_none() {
            let picture = self.pictures.pop_front()?;
            let timestamp_ns = picture.timestamp_ns;
            return Some((picture, timestamp_ns, None));
        }
        let sequence = first.sequence;
        match self.times.iter().position(|(of, _)| *of == sequence) {
            Some(at) => {
                let (_, times) = self.times.remove(at)?;
                let timestamp_ns = self.ticks.nanoseconds(times.presentation_ticks);
                let usb_sof = times.presentation_sof(self.clock_hz);
                Some((self.pictures.pop_front()?, timestamp_ns, usb_sof))
            }
            // A time of another clock would mislead the pairing: without its own time a picture is
            // damaged.
            None if self.pictures.len() > AWAITING_METADATA => {
                let mut picture = self.pictures.pop_front()?;
                picture.is_damaged = true;
                Some((picture, 0, None))
            }
            None => None,
        }
    }
}

fn is_named(name: &[u8; 32], wanted: &str) -> bool {
    let end = name.iter().position(|b| *b == 0).unwrap_or(name.len());
    String::from_utf8_lossy(&name[..end]).to_ascii_lowercase().contains(wanted)
}

fn gone_or_io(side: Side, source: io::Error) -> CameraError {
    match source.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO) => CameraError::Gone { side },
        _ => CameraError::Io { side, source },
    }
}

fn start_error(side: Side, path: PathBuf, source: io::Error) -> CameraError {
    match source.kind() {
        io::ErrorKind::PermissionDenied => CameraError::Permission { side, path },
        io::ErrorKind::ResourceBusy => CameraError::Busy { side, path },
        io::ErrorKind::NotFound => CameraError::Gone { side },
        _ => gone_or_io(side, source),
    }
}
