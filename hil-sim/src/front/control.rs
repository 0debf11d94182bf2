//! The control interface of a simulated controller as a USB device, with the descriptors of the
//! firmware's own.
//!
//! The controller's one byte stream becomes two endpoints: replies and events are told apart by their
//! ids. What is not here is the firmware's USB stack itself: that runs on the emulated chip.

use std::collections::VecDeque;
use std::sync::Arc;

use stspp_protocol::message::REPLY_BIT;
use stspp_protocol::usb as ids;
use stspp_protocol::wire::FrameDecoder;

use super::bench::Bench;
use super::usb::{Answer, Identity, Kind, Setup, Speed, UsbFunction};

/// Frames that wait for a host that does not read; older ones are lost, as on the device.
const WAITING: usize = 64;

/// Endpoints, in the order of their halt flags.
const ENDPOINTS: [u8; 3] = [ids::ENDPOINT_REQUESTS, ids::ENDPOINT_REPLIES, ids::ENDPOINT_EVENTS];

/// The device.
pub struct ControlFunction {
    bench: Arc<Bench>,
    serial: String,
    configured: bool,
    halted: [bool; 3],
    /// Bytes of a frame that has not ended yet.
    partial: Vec<u8>,
    replies: VecDeque<Vec<u8>>,
    events: VecDeque<Vec<u8>>,
    lost: u64,
}

impl ControlFunction {
    /// The control interface of the sensor on `bench`; `serial` is what its string descriptor says.
    #[must_use]
    pub fn new(bench: Arc<Bench>, serial: &str) -> Self {
        bench.rig().controller().set_link_connected(false);
        Self {
            bench,
            serial: serial.to_owned(),
            configured: false,
            halted: [false; 3],
            partial: Vec::new(),
            replies: VecDeque::new(),
            events: VecDeque::new(),
            lost: 0,
        }
    }

    /// Frames that the host did not fetch in time.
    #[must_use]
    pub fn frames_lost(&self) -> u64 {
        self.lost
    }

    /// Halts an endpoint, as a device does that cannot go on.
    pub fn halt(&mut self, endpoint: u8) {
        if let Some(at) = ENDPOINTS.iter().position(|known| *known == endpoint) {
            self.halted[at] = true;
        }
    }

    /// The device descriptor.
    #[must_use]
    pub fn device_descriptor() -> [u8; 18] {
        let [v0, v1] = ids::VENDOR_ID.to_le_bytes();
        let [p0, p1] = ids::PRODUCT_ID.to_le_bytes();
        [18, 1, 0x10, 2, 0, 0, 0, 64, v0, v1, p0, p1, 0x10, 0, 1, 2, 3, 1]
    }

    /// The configuration with its interface and endpoints.
    #[must_use]
    pub fn configuration_descriptor() -> Vec<u8> {
        let mut bytes = vec![9, 2, 0, 0, 1, 1, 0, 0x80, (ids::MAX_POWER_MA / 2) as u8];
        bytes.extend([9, 4, ids::INTERFACE_NUMBER, 0, 3]);
        bytes.extend([ids::INTERFACE_CLASS, ids::INTERFACE_SUBCLASS, ids::INTERFACE_PROTOCOL, 0]);
        let packet = ids::MAX_PACKET_LEN as u8;
        bytes.extend([7, 5, ids::ENDPOINT_REQUESTS, 2, packet, 0, 0]);
        bytes.extend([7, 5, ids::ENDPOINT_REPLIES, 2, packet, 0, 0]);
        bytes.extend([7, 5, ids::ENDPOINT_EVENTS, 3, packet, 0, ids::EVENT_INTERVAL_MS]);
        bytes[2] = bytes.len() as u8;
        bytes
    }

    fn descriptor(&self, value: u16) -> Option<Vec<u8>> {
        let [index, kind] = value.to_le_bytes();
        match (kind, index) {
            (1, 0) => Some(Self::device_descriptor().to_vec()),
            (2, 0) => Some(Self::configuration_descriptor()),
            (3, 0) => Some(vec![4, 3, 0x09, 0x04]),
            (3, 1) => Some(string(ids::MANUFACTURER)),
            (3, 2) => Some(string(ids::PRODUCT)),
            (3, 3) => Some(string(&self.serial)),
            // BOS without capabilities: what Windows finds there is the firmware's own affair.
            (15, 0) => Some(vec![5, 15, 5, 0, 0]),
            _ => None,
        }
    }

    fn connect(&mut self, connected: bool) {
        self.bench.rig().controller().set_link_connected(connected);
        self.partial.clear();
        self.replies.clear();
        self.events.clear();
        self.halted = [false; 3];
    }

    /// Sorts what the controller has said since.
    fn collect(&mut self) {
        self.bench.rig().take_replies(&mut self.partial);
        while let Some(end) = self.partial.iter().position(|byte| *byte == 0) {
            let frame: Vec<u8> = self.partial.drain(..=end).collect();
            let queue = if is_event(&frame) { &mut self.events } else { &mut self.replies };
            if queue.len() == WAITING {
                queue.pop_front();
                self.lost += 1;
            }
            queue.push_back(frame);
        }
    }

    fn halt_index(&self, endpoint: u8, is_in: bool) -> Option<usize> {
        let address = if is_in { endpoint | 0x80 } else { endpoint };
        ENDPOINTS.iter().position(|known| *known == address)
    }

    fn standard(&mut self, setup: Setup) -> Answer<Vec<u8>> {
        use super::usb::request::{
            CLEAR_FEATURE, GET_CONFIGURATION, GET_DESCRIPTOR, GET_INTERFACE, GET_STATUS,
            SET_CONFIGURATION, SET_FEATURE, SET_INTERFACE,
        };
        let of_endpoint = (setup.recipient() == 2)
            .then(|| ENDPOINTS.iter().position(|known| u16::from(*known) == setup.index))
            .flatten();
        match (setup.request, of_endpoint) {
            (GET_STATUS, Some(at)) => Answer::Done(vec![u8::from(self.halted[at]), 0]),
            (GET_STATUS, None) => Answer::Done(vec![0, 0]),
            (CLEAR_FEATURE | SET_FEATURE, Some(at)) => {
                self.halted[at] = setup.request == SET_FEATURE;
                Answer::Done(vec![])
            }
            (CLEAR_FEATURE | SET_FEATURE, None) => Answer::Done(vec![]),
            (GET_DESCRIPTOR, _) => match self.descriptor(setup.value) {
                Some(bytes) => Answer::Done(bytes),
                None => Answer::Stall,
            },
            (GET_CONFIGURATION, _) => Answer::Done(vec![u8::from(self.configured)]),
            (SET_CONFIGURATION, _) if setup.value <= 1 => {
                let configured = setup.value == 1;
                if configured != self.configured {
                    self.configured = configured;
                    self.connect(configured);
                }
                Answer::Done(vec![])
            }
            (GET_INTERFACE, _) => Answer::Done(vec![0]),
            (SET_INTERFACE, _) if setup.value == 0 => Answer::Done(vec![]),
            _ => Answer::Stall,
        }
    }
}

fn string(text: &str) -> Vec<u8> {
    let units: Vec<u8> = text.encode_utf16().take(126).flat_map(u16::to_le_bytes).collect();
    let mut bytes = vec![2 + units.len() as u8, 3];
    bytes.extend(units);
    bytes
}

/// Whether a whole frame is an event. One that cannot be read goes the way of the replies.
fn is_event(frame: &[u8]) -> bool {
    let mut decoder = FrameDecoder::new();
    let mut rest = frame;
    match decoder.next_frame(&mut rest) {
        Some(Ok(frame)) => frame.id & REPLY_BIT == 0,
        _ => false,
    }
}

impl UsbFunction for ControlFunction {
    fn identity(&self) -> Identity {
        let configuration = Self::configuration_descriptor();
        Identity::new(Speed::Full, Self::device_descriptor(), &configuration)
    }

    fn reset(&mut self) {
        if std::mem::take(&mut self.configured) {
            self.connect(false);
        }
    }

    fn control(&mut self, setup: Setup, _data: &[u8]) -> Answer<Vec<u8>> {
        match setup.kind() {
            Kind::Standard => self.standard(setup),
            _ => Answer::Stall,
        }
    }

    fn transfer_in(&mut self, endpoint: u8, length: usize) -> Answer<Vec<u8>> {
        let Some(at) = self.halt_index(endpoint, true) else { return Answer::Stall };
        if self.halted[at] || !self.configured {
            return Answer::Stall;
        }
        self.collect();
        let is_events = endpoint | 0x80 == ids::ENDPOINT_EVENTS;
        let queue = if is_events { &mut self.events } else { &mut self.replies };
        let Some(mut frame) = queue.pop_front() else { return Answer::Nak };
        if frame.len() > length {
            queue.push_front(frame.split_off(length));
        }
        Answer::Done(frame)
    }

    fn transfer_out(&mut self, endpoint: u8, data: &[u8]) -> Answer<usize> {
        let Some(at) = self.halt_index(endpoint, false) else { return Answer::Stall };
        if self.halted[at] || !self.configured {
            return Answer::Stall;
        }
        self.bench.rig().write(data);
        Answer::Done(data.len())
    }

    fn poll(&mut self) {
        drop(self.bench.rig());
    }

    fn detach(&mut self) {
        self.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::in_process::InProcess;
    use crate::rig::Rig;
    use stspp_protocol::message::encode_request;
    use stspp_protocol::request::{GetInfo, Hello};
    use stspp_protocol::version::PROTOCOL_VERSION;
    use stspp_protocol::wire::MAX_FRAME_LEN;

    fn setup(request_type: u8, request: u8, value: u16, index: u16) -> Setup {
        Setup { request_type, request, value, index, length: 255 }
    }

    fn function() -> (ControlFunction, Arc<Bench>) {
        let bench = Bench::virtual_time(Rig::new(Box::<InProcess>::default(), 9_000_000, 8));
        let bench = Arc::new(bench);
        let mut function = ControlFunction::new(Arc::clone(&bench), "ABC");
        assert_eq!(function.transfer_in(1, 64), Answer::Stall, "not configured");
        assert_eq!(function.control(setup(0, 9, 1, 0), &[]), Answer::Done(vec![]));
        (function, bench)
    }

    fn pass(bench: &Bench, ns: u64) {
        let mut rig = bench.rig();
        let to_ns = rig.now_ns() + ns;
        rig.advance(to_ns);
    }

    #[test]
    fn requests_go_in_and_replies_come_out() {
        let (mut function, bench) = function();
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = encode_request(7, &Hello { host: PROTOCOL_VERSION }, &mut out).unwrap();
        assert_eq!(function.transfer_out(1, bytes), Answer::Done(bytes.len()));
        pass(&bench, 1_000_000);
        let Answer::Done(reply) = function.transfer_in(1, 512) else { panic!("no reply") };
        assert_eq!(reply.last(), Some(&0));
        assert_eq!(function.transfer_in(1, 512), Answer::Nak);
    }

    #[test]
    fn a_reply_longer_than_asked_for_comes_in_parts() {
        let (mut function, bench) = function();
        let mut out = [0; MAX_FRAME_LEN];
        let bytes = encode_request(7, &GetInfo, &mut out).unwrap();
        function.transfer_out(1, bytes);
        pass(&bench, 1_000_000);
        let mut reply = Vec::new();
        while let Answer::Done(part) = function.transfer_in(1, 16) {
            assert!(part.len() <= 16);
            reply.extend(part);
        }
        assert!(reply.len() > 32 && reply.last() == Some(&0));
    }

    #[test]
    fn a_halted_endpoint_stalls_until_it_is_cleared() {
        let (mut function, _) = function();
        function.halt(ids::ENDPOINT_EVENTS);
        assert_eq!(function.transfer_in(2, 64), Answer::Stall);
        let status = setup(0x82, 0, 0, u16::from(ids::ENDPOINT_EVENTS));
        assert_eq!(function.control(status, &[]), Answer::Done(vec![1, 0]));
        function.control(setup(0x02, 1, 0, u16::from(ids::ENDPOINT_EVENTS)), &[]);
        assert_ne!(function.transfer_in(2, 64), Answer::Stall);
    }

    #[test]
    fn lengths_in_the_configuration_add_up() {
        let bytes = ControlFunction::configuration_descriptor();
        assert_eq!(usize::from(bytes[2]), bytes.len());
        let walked: usize = super::super::usb::descriptors(&bytes).map(<[u8]>::len).sum();
        assert_eq!(walked, bytes.len());
    }
}
