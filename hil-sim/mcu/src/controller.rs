//! The emulated chip behind the simulator's [`Controller`]: bytes over the UART (F330) or over a USB
//! host that enumerates it first (F350), pins as edges.

use std::path::{Path, PathBuf};

use stspp_hil_sim::device::{Controller, Line, PinEdge};
use stspp_protocol::usb;

use crate::board::{Board, thermistor_volts};
use crate::chip::Chip;
use crate::image::{Image, ImageError};
use crate::soc::Variant;
use crate::soc::pins::{Level, PinChange};
use crate::usb::enumerate::{Enumerated, UsbError, enumerate};
use crate::usb::host::{BusState, Request, UrbId, UrbStatus};

/// Bytes per bulk IN request.
const BULK_IN_BYTES: usize = 64;
/// How often the USB host side looks for finished requests.
const HOST_LOOK_NS: u64 = 100_000;

/// Where `cargo xtask firmware` puts a board's ELF: in the folder named by the environment variable
/// `STSPP_FIRMWARE_DIR`, or in the workspace's `target/firmware`.
#[must_use]
pub fn firmware_elf(variant: Variant) -> PathBuf {
    let name = match variant {
        Variant::F330 => "f330.elf",
        Variant::F350 => "f350.elf",
    };
    let workspace = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/firmware");
    std::env::var_os("STSPP_FIRMWARE_DIR")
        .map_or_else(|| PathBuf::from(workspace), PathBuf::from)
        .join(name)
}

/// Why there is no emulated controller.
#[derive(Debug, thiserror::Error)]
pub enum ControllerError {
    /// The firmware cannot be loaded.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The firmware's USB device does not enumerate.
    #[error("the emulated USB device: {0}")]
    Usb(#[from] UsbError),
}

/// One direction's frames of a USB pipe, kept whole: frames of two pipes must not mix.
#[derive(Debug, Default)]
struct Reassembly {
    partial: Vec<u8>,
}

impl Reassembly {
    /// Adds bytes of the pipe; whole frames (they end in 0) go to `out`.
    fn push(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.partial.extend_from_slice(bytes);
        if let Some(end) = self.partial.iter().rposition(|byte| *byte == 0) {
            out.extend(self.partial.drain(..=end));
        }
    }
}

/// The host's side of the USB link.
#[derive(Debug, Default)]
struct UsbLink {
    configured: bool,
    resets_seen: u64,
    replies: Option<UrbId>,
    events: Option<UrbId>,
    reply_frames: Reassembly,
    event_frames: Reassembly,
    enumerated: Option<Enumerated>,
}

/// The emulated controller.
pub struct McuController {
    chip: Chip,
    image: Image,
    board: Board,
    usb: Option<UsbLink>,
    to_host: Vec<u8>,
    changes: Vec<PinChange>,
    /// Lines that are high.
    high: Vec<Line>,
    link_connected: bool,
    /// Another host has the USB port; see [`McuController::lend_usb`].
    usb_lent: bool,
}

impl McuController {
    /// Powers a chip with the firmware at `elf`; the link is up when this returns.
    ///
    /// # Errors
    /// The firmware cannot be loaded, or does not enumerate on USB.
    pub fn load(variant: Variant, elf: &Path) -> Result<Self, ControllerError> {
        Self::start(variant, Image::load(elf)?)
    }

    /// Powers a chip with a firmware image; the link is up when this returns.
    ///
    /// # Errors
    /// The firmware does not enumerate on USB.
    pub fn start(variant: Variant, image: Image) -> Result<Self, ControllerError> {
        Self::on_chip(Chip::new(variant, &image), image)
    }

    /// Takes a chip that was just powered with `image`; the link is up when this returns.
    ///
    /// # Errors
    /// The firmware does not enumerate on USB.
    pub fn on_chip(chip: Chip, image: Image) -> Result<Self, ControllerError> {
        let variant = chip.soc().variant();
        let usb = (variant == Variant::F350).then(UsbLink::default);
        let mut controller = Self {
            chip,
            image,
            board: Board::of(variant),
            usb,
            to_host: Vec::new(),
            changes: Vec::new(),
            high: Vec::new(),
            link_connected: true,
            usb_lent: false,
        };
        controller.set_interlock_closed(true);
        controller.set_temperature_c(25.0);
        controller.set_trigger_in(false);
        if controller.usb.is_some() {
            controller.enumerate()?;
        } else {
            controller.chip.soc().usarts[0].set_host_baud(usb::SERIAL_BAUD);
        }
        Ok(controller)
    }

    /// The chip, for measurements and for faults.
    pub fn chip(&mut self) -> &mut Chip {
        &mut self.chip
    }

    /// The firmware that runs.
    #[must_use]
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// The board around the chip.
    #[must_use]
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// What enumeration found (F350).
    #[must_use]
    pub fn enumerated(&self) -> Option<&Enumerated> {
        self.usb.as_ref()?.enumerated.as_ref()
    }

    /// Takes the changes of all pins since the last call, those of the LED and the link included.
    pub fn take_pin_changes(&mut self) -> Vec<PinChange> {
        self.collect_changes();
        std::mem::take(&mut self.changes)
    }

    /// Lines that are high, as far as the edges handed out say.
    #[must_use]
    pub fn high_lines(&self) -> &[Line] {
        &self.high
    }

    /// Whether any light is on.
    #[must_use]
    pub fn light_is_on(&self) -> bool {
        self.board
            .projectors
            .iter()
            .chain([&self.board.floodlight])
            .any(|pin| self.chip.pin_level(*pin) == Level::High)
    }

    /// Enumerates the USB device, as after plugging it in.
    ///
    /// # Errors
    /// It does not answer as it should.
    pub fn enumerate(&mut self) -> Result<(), ControllerError> {
        let enumerated = enumerate(&mut self.chip)?;
        let resets = self.chip.soc().usbfs.host().resets();
        if let Some(link) = &mut self.usb {
            *link = UsbLink {
                configured: true,
                resets_seen: resets,
                enumerated: Some(enumerated),
                ..UsbLink::default()
            };
        }
        self.collect_changes();
        self.keep_reading();
        Ok(())
    }

    /// Lets go of the USB port, so that another host can use it (see [`crate::front`]): from now on
    /// nothing is read, written or enumerated here. What enumeration had found; `None` without USB.
    pub fn lend_usb(&mut self) -> Option<Enumerated> {
        let link = self.usb.as_mut()?;
        self.usb_lent = true;
        let reads = [link.replies.take(), link.events.take()];
        let enumerated = link.enumerated.clone();
        let now_ns = self.chip.now_ns();
        let mut soc = self.chip.soc();
        let host = soc.usbfs.host();
        for id in reads.into_iter().flatten() {
            host.unlink(id, now_ns);
        }
        while host.take_completion().is_some() {}
        enumerated
    }

    /// Suspends the bus (the host goes to sleep), or resumes it.
    pub fn set_bus_suspended(&mut self, suspended: bool) {
        let now_ns = self.chip.now_ns();
        self.chip.act(|soc, cx| {
            let host = soc.usbfs.host();
            if suspended {
                host.suspend(now_ns)
            } else {
                host.resume(now_ns)
            }
            soc.usbfs.settle(cx);
        });
    }

    fn submit(&mut self, request: Request) -> UrbId {
        let now_ns = self.chip.now_ns();
        self.chip.act(|soc, cx| {
            let id = soc.usbfs.host().submit(request, now_ns);
            soc.usbfs.settle(cx);
            id
        })
    }

    /// Keeps one request on each IN endpoint, as a driver does.
    fn keep_reading(&mut self) {
        let Some(link) = &self.usb else { return };
        let active = self.chip.soc().usbfs.host().state() == BusState::Active;
        if !link.configured || !active || self.usb_lent {
            return;
        }
        let (replies, events) = (link.replies.is_none(), link.events.is_none());
        if replies {
            let id = self.submit(Request::In {
                endpoint: usb::ENDPOINT_REPLIES & 0xf,
                length: BULK_IN_BYTES,
            });
            self.usb.get_or_insert_default().replies = Some(id);
        }
        if events {
            let request = Request::InterruptIn {
                endpoint: usb::ENDPOINT_EVENTS & 0xf,
                length: usb::MAX_PACKET_LEN,
                interval_ms: u16::from(usb::EVENT_INTERVAL_MS),
            };
            let id = self.submit(request);
            self.usb.get_or_insert_default().events = Some(id);
        }
    }

    /// Takes finished USB requests, and enumerates again when the device came back.
    fn serve_usb(&mut self) {
        if self.usb_lent {
            return;
        }
        let Some(link) = &mut self.usb else { return };
        let mut soc = self.chip.soc();
        let host = soc.usbfs.host();
        if host.resets() != link.resets_seen {
            link.configured = false;
        }
        let state = host.state();
        let mut finished = Vec::new();
        while let Some(done) = host.take_completion() {
            finished.push(done);
        }
        drop(soc);
        for done in finished {
            let (pipe, frames) = if link.replies == Some(done.id) {
                (&mut link.replies, &mut link.reply_frames)
            } else if link.events == Some(done.id) {
                (&mut link.events, &mut link.event_frames)
            } else {
                continue;
            };
            *pipe = None;
            if done.status == UrbStatus::Ok {
                frames.push(&done.data, &mut self.to_host);
            }
        }
        if link.configured {
            self.keep_reading();
        } else if state == BusState::Active {
            // A device that has come back is enumerated anew; one that refuses stays silent, as it
            // would on a desk.
            let _ = self.enumerate();
        }
    }

    fn collect_changes(&mut self) {
        let changes = self.chip.take_pin_changes();
        self.changes.extend(changes);
    }
}

impl Controller for McuController {
    fn now_ns(&self) -> u64 {
        self.chip.now_ns()
    }

    fn host_write(&mut self, bytes: &[u8]) {
        if self.usb.is_some() {
            if self.link_connected && !self.usb_lent && !bytes.is_empty() {
                self.submit(Request::Out {
                    endpoint: usb::ENDPOINT_REQUESTS & 0xf,
                    data: bytes.to_vec(),
                });
            }
        } else {
            self.chip.act(|soc, cx| soc.usarts[0].host_send(bytes, cx));
        }
    }

    fn host_read(&mut self, out: &mut Vec<u8>) {
        if self.usb.is_some() {
            self.serve_usb();
        } else {
            let sent = self.chip.soc().usarts[0].take_sent();
            self.to_host.extend(sent.into_iter().map(|sent| sent.byte));
        }
        out.append(&mut self.to_host);
    }

    fn run_until(&mut self, time_ns: u64, edges: &mut Vec<PinEdge>) {
        if self.usb.is_some() {
            while self.chip.now_ns() < time_ns {
                self.chip.run_until_ns(time_ns.min(self.chip.now_ns() + HOST_LOOK_NS));
                self.serve_usb();
            }
        } else {
            self.chip.run_until_ns(time_ns);
        }
        self.collect_changes();
        let mut kept = Vec::new();
        for change in self.changes.drain(..) {
            match self.board.line_of(change.pin) {
                Some(line) => {
                    // A floating gate is off: its pull-down holds it.
                    let high = change.level == Level::High;
                    let position = self.high.iter().position(|l| *l == line);
                    match (high, position) {
                        (true, None) => self.high.push(line),
                        (false, Some(position)) => drop(self.high.swap_remove(position)),
                        _ => continue,
                    }
                    edges.push(PinEdge { time_ns: change.time_ns, line, high });
                }
                None => kept.push(change),
            }
        }
        self.changes = kept;
    }

    fn set_interlock_closed(&mut self, closed: bool) {
        let level = closed == self.board.interlock_closed_level;
        let pin = self.board.interlock;
        self.chip.drive_pin(pin, Some(level));
    }

    fn set_temperature_c(&mut self, temperature_c: f32) {
        let channel = self.board.thermistor_channel;
        self.chip.soc().adc.set_volts(channel, thermistor_volts(temperature_c));
    }

    fn set_trigger_in(&mut self, high: bool) {
        let pin = self.board.trigger_in;
        self.chip.drive_pin(pin, Some(high));
    }

    fn set_link_connected(&mut self, connected: bool) {
        self.link_connected = connected;
        if self.usb.is_some() {
            self.chip.act(|soc, cx| soc.usbfs.set_cable(connected, cx));
        } else {
            self.chip.soc().usarts[0].set_connected(connected);
        }
    }
}
