//! A gate engine and a flash that do what a test tells them, and a host that talks in frames.
#![allow(dead_code, reason = "each test crate uses its part")]

use stspp_firmware_logic::controller::{Boot, Controller, Identity};
use stspp_firmware_logic::hardware::{
    Aborted, GateEngine, Page, SettingsStore, SlotDone, StoreError, TriggerEdges,
};
use stspp_firmware_logic::timing::{GateWord, SlotPlan};
use stspp_protocol::fault::FaultSet;
use stspp_protocol::message::{Call, Event, FromDevice, decode_reply, encode_request};
use stspp_protocol::reply::RequestError;
use stspp_protocol::request::{Arm, Hello};
use stspp_protocol::timing::Slot;
use stspp_protocol::trigger::TriggerSource;
use stspp_protocol::version::{BoardKind, PROTOCOL_VERSION, ResetCause, SerialNumber};
use stspp_protocol::wire::{FrameDecoder, MAX_FRAME_LEN};

/// What the logic asked of the engine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Asked {
    Load(u16),
    Start(Option<u32>),
    Stop,
    ForceOff,
    Floodlight(u32),
    TriggerSource(TriggerSource),
}

#[derive(Debug, Default)]
pub struct MockEngine {
    pub asked: Vec<Asked>,
    /// Start of the next run.
    pub start_us: u64,
    /// Answer to `stop`.
    pub stops_after: u32,
    /// Answer to `force_off`.
    pub aborted: Aborted,
    /// Answer to `trigger_edges`.
    pub edges: TriggerEdges,
    /// Whether the floodlight's timer fails to end it.
    pub floodlight_stuck: bool,
}

impl GateEngine for MockEngine {
    fn ticks_per_us(&self) -> u32 {
        4
    }

    fn load(&mut self, plan: &SlotPlan) {
        self.asked.push(Asked::Load(plan.timing_generation()));
    }

    fn start(&mut self, slots: Option<u32>) -> u64 {
        self.asked.push(Asked::Start(slots));
        self.start_us
    }

    fn stop(&mut self) -> u32 {
        self.asked.push(Asked::Stop);
        self.stops_after
    }

    fn force_off(&mut self) -> Aborted {
        self.asked.push(Asked::ForceOff);
        std::mem::take(&mut self.aborted)
    }

    fn set_floodlight(&mut self, duration_us: u32) {
        self.asked.push(Asked::Floodlight(duration_us));
    }

    fn floodlight_is_on(&self) -> bool {
        self.floodlight_stuck
    }

    fn set_trigger_source(&mut self, source: TriggerSource) {
        self.asked.push(Asked::TriggerSource(source));
    }

    fn trigger_edges(&self) -> TriggerEdges {
        self.edges
    }
}

/// Flash of two pages that may refuse.
#[derive(Debug, Clone)]
pub struct MockFlash {
    pub pages: [[u8; 256]; 2],
    pub refuse_reads: bool,
    pub refuse_writes: bool,
}

impl Default for MockFlash {
    fn default() -> Self {
        Self { pages: [[0xFF; 256]; 2], refuse_reads: false, refuse_writes: false }
    }
}

impl SettingsStore for MockFlash {
    fn read(&self, page: Page, out: &mut [u8]) -> Result<(), StoreError> {
        if self.refuse_reads {
            return Err(StoreError);
        }
        out.copy_from_slice(&self.pages[page as usize][..out.len()]);
        Ok(())
    }

    fn erase(&mut self, page: Page) -> Result<(), StoreError> {
        if self.refuse_writes {
            return Err(StoreError);
        }
        self.pages[page as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, page: Page, bytes: &[u8]) -> Result<(), StoreError> {
        assert_eq!(bytes.len() % 4, 0);
        if self.refuse_writes {
            return Err(StoreError);
        }
        for (place, byte) in self.pages[page as usize].iter_mut().zip(bytes) {
            *place &= byte;
        }
        Ok(())
    }
}

pub struct Bench {
    pub logic: Controller<MockEngine, MockFlash>,
    pub now_us: u64,
}

impl Bench {
    pub fn booted(boot: Boot, store: MockFlash) -> Self {
        let identity = Identity::new(BoardKind::F350, SerialNumber([7; 12]));
        Self { logic: Controller::new(identity, MockEngine::default(), store, boot), now_us: 0 }
    }

    pub fn new() -> Self {
        let boot = Boot { cause: ResetCause::PowerOn, carried: FaultSet::EMPTY };
        Self::booted(boot, MockFlash::default())
    }

    /// In a session and armed, events so far dropped.
    pub fn armed() -> Self {
        let mut bench = Self::new();
        bench.call(&Hello { host: PROTOCOL_VERSION }).unwrap();
        bench.call(&Arm).unwrap();
        bench.events();
        bench
    }

    pub fn call<C: Call>(&mut self, request: &C) -> Result<C::Reply, RequestError> {
        let mut frame = [0; MAX_FRAME_LEN];
        let mut bytes = encode_request(1, request, &mut frame).unwrap();
        let mut out = [0; MAX_FRAME_LEN];
        let len = self.logic.receive(self.now_us, &mut bytes, &mut out).expect("a reply");
        assert!(bytes.is_empty());
        let mut decoder = FrameDecoder::new();
        let frame = decoder.next_frame(&mut &out[..len]).unwrap().unwrap();
        decode_reply::<C>(&frame).unwrap()
    }

    pub fn numbered_events(&mut self) -> Vec<(u16, Event)> {
        let mut events = Vec::new();
        let mut out = [0; MAX_FRAME_LEN];
        while let Some(len) = self.logic.next_event(&mut out) {
            let mut decoder = FrameDecoder::new();
            let frame = decoder.next_frame(&mut &out[..len]).unwrap().unwrap();
            match FromDevice::decode(&frame).unwrap() {
                FromDevice::Event { seq, event } => events.push((seq, event)),
                other @ FromDevice::Reply { .. } => panic!("{other:?}"),
            }
        }
        assert!(!self.logic.has_event());
        events
    }

    pub fn events(&mut self) -> Vec<Event> {
        self.numbered_events().into_iter().map(|(_, event)| event).collect()
    }

    pub fn poll_at(&mut self, now_us: u64) {
        self.now_us = now_us;
        self.logic.poll(now_us);
    }

    pub fn done(&mut self, done: SlotDone) {
        self.now_us = self.now_us.max(done.trigger_time_us + u64::from(done.on_time_us));
        self.logic.on_slot_done(self.now_us, &done);
    }
}

/// The report of slot `number` of a run of the default timing, started at 0.
pub fn slot(number: u32) -> SlotDone {
    let index = (number % 10) as u8;
    SlotDone {
        slot_number: number,
        slot_index: index,
        gates: GateWord::from_slot(Slot::projector(index)),
        timing_generation: 1,
        trigger_time_us: u64::from(number) * 33_333 + 100,
        on_time_us: 32_100,
        usb_sof: None,
    }
}
