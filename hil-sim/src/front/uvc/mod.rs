//! A camera of the sensor as a USB Video Class 1.1 device with a bulk endpoint, as the stock Linux
//! driver takes it.
//!
//! [`descriptors`] is what it says of itself, [`controls`] are its settings, [`payload`] the bytes
//! that a frame becomes. Frames come from a [`FrameSource`], which keeps a few for a host that is slow
//! and loses others, as on hardware.

pub mod controls;
pub mod descriptors;
pub mod payload;

use super::usb::{Answer, Identity, Kind, Setup, Speed, UsbFunction};
use controls::Controls;
use descriptors::{Description, STREAM_ENDPOINT};
use payload::Payload;

/// A raw frame of the camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Rows of pixels, one byte each for GREY, two (little-endian) for Y16.
    pub pixels: Vec<u8>,
    /// Start of exposure in the camera's clock, ticks of [`payload::CLOCK_HZ`].
    pub exposure_ticks: u32,
    /// USB frame number (11 bits) at the start of exposure.
    pub sof: u16,
    /// The camera says that its data are damaged.
    pub is_damaged: bool,
}

/// Settings that the host has made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Longest exposure, microseconds: the camera integrates while its trigger is high, but no longer.
    pub exposure_us: u32,
    /// Analog gain in hundredths.
    pub gain_percent: u32,
}

/// Where frames come from.
pub trait FrameSource: Send {
    /// The host has started the stream: frames are wanted from now on.
    fn start(&mut self) {}

    /// Nobody wants frames any more.
    fn stop(&mut self) {}

    /// Lets time pass and gives the next frame if one is ready.
    fn poll(&mut self, settings: Settings) -> Option<Frame>;

    /// Camera time now, ticks of [`payload::CLOCK_HZ`], and the USB frame number.
    fn clock(&self) -> (u32, u16);
}

/// The device.
pub struct UvcCamera<S> {
    description: Description,
    controls: Controls,
    source: S,
    configured: bool,
    streaming: bool,
    sending: Option<Payload>,
    waiting: Option<Frame>,
    toggle: bool,
}

impl<S: FrameSource> UvcCamera<S> {
    /// A camera with this description, fed by `source`.
    pub fn new(description: Description, source: S) -> Self {
        let controls = Controls::new(&description);
        Self {
            description,
            controls,
            source,
            configured: false,
            streaming: false,
            sending: None,
            waiting: None,
            toggle: false,
        }
    }

    /// Where the frames come from.
    pub fn source_mut(&mut self) -> &mut S {
        &mut self.source
    }

    fn stop(&mut self) {
        if std::mem::take(&mut self.streaming) {
            self.source.stop();
        }
        self.sending = None;
        self.waiting = None;
    }

    fn standard(&mut self, setup: Setup) -> Answer<Vec<u8>> {
        use super::usb::request::{
            CLEAR_FEATURE, GET_CONFIGURATION, GET_DESCRIPTOR, GET_INTERFACE, GET_STATUS,
            SET_CONFIGURATION, SET_FEATURE, SET_INTERFACE,
        };
        match setup.request {
            GET_STATUS => Answer::Done(vec![0, 0]),
            // The host clears the endpoint's halt to end a bulk stream.
            CLEAR_FEATURE if setup.recipient() == 2 => {
                self.stop();
                Answer::Done(vec![])
            }
            SET_FEATURE | CLEAR_FEATURE => Answer::Done(vec![]),
            GET_DESCRIPTOR => match self.description.descriptor(setup.value) {
                Some(bytes) => Answer::Done(bytes),
                None => Answer::Stall,
            },
            GET_CONFIGURATION => Answer::Done(vec![u8::from(self.configured)]),
            SET_CONFIGURATION if setup.value <= 1 => {
                self.configured = setup.value == 1;
                self.stop();
                Answer::Done(vec![])
            }
            GET_INTERFACE => Answer::Done(vec![0]),
            SET_INTERFACE if setup.value == 0 => {
                self.stop();
                Answer::Done(vec![])
            }
            _ => Answer::Stall,
        }
    }
}

impl<S: FrameSource> UsbFunction for UvcCamera<S> {
    fn identity(&self) -> Identity {
        let configuration = self.description.configuration();
        Identity::new(Speed::High, self.description.device(), &configuration)
    }

    fn reset(&mut self) {
        self.stop();
        self.configured = false;
        self.controls = Controls::new(&self.description);
    }

    fn control(&mut self, setup: Setup, data: &[u8]) -> Answer<Vec<u8>> {
        match setup.kind() {
            Kind::Standard => self.standard(setup),
            Kind::Class => match self.controls.request(setup, data) {
                Some(controls::Outcome::Answer(bytes)) => Answer::Done(bytes),
                Some(controls::Outcome::Committed) => {
                    self.stop();
                    self.source.start();
                    self.streaming = true;
                    Answer::Done(vec![])
                }
                None => Answer::Stall,
            },
            Kind::Vendor | Kind::Reserved => Answer::Stall,
        }
    }

    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>> {
        if endpoint != STREAM_ENDPOINT & 0x0f || !self.configured {
            return Answer::Stall;
        }
        if self.sending.is_none() {
            let Some(frame) = self.waiting.take().filter(|_| self.streaming) else {
                return Answer::Nak;
            };
            self.toggle = !self.toggle;
            self.sending = Some(Payload::new(frame, self.toggle, self.source.clock()));
        }
        let Some(payload) = &mut self.sending else { return Answer::Nak };
        let part = payload.take(length);
        // The host knows the payload's end by a transfer that is shorter than its buffer.
        if part.len() < length {
            self.sending = None;
        }
        Answer::Done(part)
    }

    fn transfer_out(&mut self, _endpoint: u8, _data: &[u8]) -> Answer<usize> {
        Answer::Stall
    }

    fn detach(&mut self) {
        self.stop();
    }

    fn poll(&mut self) {
        // One frame is on its way and one waits: further ones stay with the source, which loses those
        // that it has no room for.
        if self.streaming && self.waiting.is_none() {
            self.waiting = self.source.poll(self.controls.settings());
        }
    }
}
