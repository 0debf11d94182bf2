//! A full-speed USB host: frames of 1 ms, transactions with their bus time, requests (URBs) that
//! wait while the device answers NAK. It knows nothing of descriptors; [`super::enumerate`] does.

use std::collections::VecDeque;

use super::core::{Answer, DeviceCore};

/// Time from the connection to the reset (USB 2.0, 7.1.7.3).
const DEBOUNCE_NS: u64 = 100_000_000;
/// Length of the reset.
const RESET_NS: u64 = 10_000_000;
/// Rest after the reset.
const RECOVERY_NS: u64 = 10_000_000;
const FRAME_NS: u64 = 1_000_000;
/// Bus idle that means suspend.
const SUSPEND_NS: u64 = 3_000_000;
/// Resume signalling.
const RESUME_NS: u64 = 20_000_000;
/// Pause before NAKed requests are tried again.
const RETRY_NS: u64 = 50_000;
/// Token, header and handshake of a transaction, in byte times (USB 2.0, 5.8.4: 13 for bulk).
const OVERHEAD_BYTES: u64 = 13;
/// Attempts at a transaction without an answer (USB 2.0, 8.6.5).
const ATTEMPTS: u8 = 3;

/// Number of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct UrbId(pub u64);

/// What a request asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// A control transfer on endpoint 0: the setup packet, and the data for an OUT transfer.
    Control {
        /// The eight bytes of the SETUP.
        setup: [u8; 8],
        /// Data stage towards the device (empty for IN).
        data: Vec<u8>,
    },
    /// Data to a bulk or interrupt endpoint; an empty one is a zero-length packet.
    Out {
        /// Endpoint number.
        endpoint: u8,
        /// The bytes.
        data: Vec<u8>,
    },
    /// Data from a bulk endpoint, up to `length` bytes or a short packet.
    In {
        /// Endpoint number.
        endpoint: u8,
        /// Most bytes to take.
        length: usize,
    },
    /// Data from an interrupt endpoint, polled every `interval_ms` frames.
    InterruptIn {
        /// Endpoint number.
        endpoint: u8,
        /// Most bytes to take.
        length: usize,
        /// Frames between polls.
        interval_ms: u16,
    },
}

/// How a request ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UrbStatus {
    /// As asked, or with a short packet.
    Ok,
    /// The endpoint is halted, or the control request was refused.
    Stall,
    /// No answer in three attempts.
    NoAnswer,
    /// More data than asked for.
    Babble,
    /// Taken back by [`Host::unlink`].
    Unlinked,
    /// The device is gone, or was reset.
    Disconnected,
}

/// A finished request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Completion {
    /// Which.
    pub id: UrbId,
    /// How it ended.
    pub status: UrbStatus,
    /// Data from the device.
    pub data: Vec<u8>,
    /// Bytes moved in the data stage.
    pub actual: usize,
    /// Virtual time of the submission.
    pub submitted_ns: u64,
    /// Virtual time of the end.
    pub completed_ns: u64,
}

/// State of the bus as the host sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusState {
    /// Nothing pulls the line up.
    Detached,
    /// A device is there; the reset follows.
    Debouncing,
    /// In reset.
    Resetting,
    /// Frames run.
    Active,
    /// No frames.
    Suspended,
    /// Resume signalling.
    Resuming,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Setup,
    Data,
    Status,
}

#[derive(Debug)]
struct Pending {
    id: UrbId,
    request: Request,
    stage: Stage,
    data: Vec<u8>,
    sent: usize,
    attempts: u8,
    not_before_ns: u64,
    submitted_ns: u64,
}

impl Pending {
    /// Endpoint number and whether data flows to the host now.
    fn pipe(&self) -> (u8, bool) {
        match &self.request {
            Request::Control { .. } => (0, false),
            Request::Out { endpoint, .. } => (*endpoint, false),
            Request::In { endpoint, .. } | Request::InterruptIn { endpoint, .. } => {
                (*endpoint, true)
            }
        }
    }
}

/// The host.
#[derive(Debug)]
pub struct Host {
    cable: bool,
    device_seen: bool,
    state: BusState,
    at_ns: Option<u64>,
    next_frame_ns: u64,
    frame: u16,
    address: u8,
    /// Next data toggle per endpoint: IN and OUT.
    toggles: [[bool; 16]; 2],
    max_packet: [[u16; 16]; 2],
    /// When each pipe had its last transaction.
    served_ns: [[u64; 16]; 2],
    pending: VecDeque<Pending>,
    completed: VecDeque<Completion>,
    last_id: u64,
    suspend_at_ns: Option<u64>,
    resets: u64,
}

impl Host {
    /// A host with the cable plugged in.
    #[must_use]
    pub fn new() -> Self {
        Self {
            cable: true,
            device_seen: false,
            state: BusState::Detached,
            at_ns: None,
            next_frame_ns: 0,
            frame: 0,
            address: 0,
            toggles: [[false; 16]; 2],
            max_packet: [[64; 16]; 2],
            served_ns: [[0; 16]; 2],
            pending: VecDeque::new(),
            completed: VecDeque::new(),
            last_id: 0,
            suspend_at_ns: None,
            resets: 0,
        }
    }

    /// Whether the cable is plugged in.
    #[must_use]
    pub fn cable_connected(&self) -> bool {
        self.cable
    }

    /// State of the bus.
    #[must_use]
    pub fn state(&self) -> BusState {
        self.state
    }

    /// Bus resets driven so far: each one makes the device start over.
    #[must_use]
    pub fn resets(&self) -> u64 {
        self.resets
    }

    /// Number of the frame in progress, 0..=2047.
    #[must_use]
    pub fn frame(&self) -> u16 {
        self.frame
    }

    /// Submits a request.
    pub fn submit(&mut self, request: Request, now_ns: u64) -> UrbId {
        self.last_id += 1;
        let id = UrbId(self.last_id);
        let pending = Pending {
            id,
            request,
            stage: Stage::Setup,
            data: Vec::new(),
            sent: 0,
            attempts: 0,
            not_before_ns: now_ns,
            submitted_ns: now_ns,
        };
        if self.state == BusState::Detached {
            self.finish(pending, UrbStatus::Disconnected, now_ns);
        } else {
            self.pending.push_back(pending);
            self.wake(now_ns);
        }
        id
    }

    /// Takes a request back. Its completion says [`UrbStatus::Unlinked`], with what came so far.
    pub fn unlink(&mut self, id: UrbId, now_ns: u64) -> bool {
        let Some(position) = self.pending.iter().position(|p| p.id == id) else { return false };
        if let Some(pending) = self.pending.remove(position) {
            self.finish(pending, UrbStatus::Unlinked, now_ns);
        }
        true
    }

    /// The oldest finished request.
    pub fn take_completion(&mut self) -> Option<Completion> {
        self.completed.pop_front()
    }

    /// A particular finished request.
    pub fn take_completion_of(&mut self, id: UrbId) -> Option<Completion> {
        let position = self.completed.iter().position(|c| c.id == id)?;
        self.completed.remove(position)
    }

    /// Sets the largest packet of an endpoint (from its descriptor).
    pub fn set_max_packet(&mut self, endpoint: u8, is_in: bool, bytes: u16) {
        self.max_packet[usize::from(is_in)][usize::from(endpoint & 0xf)] = bytes;
    }

    /// Starts the toggles of an endpoint at DATA0 (after a cleared halt or a new configuration).
    pub fn reset_toggle(&mut self, endpoint: u8, is_in: bool) {
        self.toggles[usize::from(is_in)][usize::from(endpoint & 0xf)] = false;
    }

    /// Resets the bus.
    pub fn reset_bus(&mut self, now_ns: u64) {
        if self.state != BusState::Detached {
            self.state = BusState::Debouncing;
            self.at_ns = Some(now_ns);
        }
    }

    /// Stops the frames: the device sees a suspended bus 3 ms later.
    pub fn suspend(&mut self, now_ns: u64) {
        if self.state == BusState::Active {
            self.state = BusState::Suspended;
            self.suspend_at_ns = Some(now_ns + SUSPEND_NS);
            self.at_ns = self.suspend_at_ns;
        }
    }

    /// Resumes the bus.
    pub fn resume(&mut self, now_ns: u64) {
        if self.state == BusState::Suspended {
            self.state = BusState::Resuming;
            self.suspend_at_ns = None;
            self.at_ns = Some(now_ns + RESUME_NS);
        }
    }

    pub(super) fn set_cable(&mut self, connected: bool, now_ns: u64) {
        self.cable = connected;
        self.sense(self.device_seen, now_ns);
    }

    /// Whether a device pulls the line up now.
    pub(super) fn sense(&mut self, pulled_up: bool, now_ns: u64) {
        self.device_seen = pulled_up;
        let there = self.cable && pulled_up;
        if there && self.state == BusState::Detached {
            self.state = BusState::Debouncing;
            self.at_ns = Some(now_ns + DEBOUNCE_NS);
        } else if !there && self.state != BusState::Detached {
            self.state = BusState::Detached;
            // A device that stays powered sees an idle bus.
            self.suspend_at_ns = Some(now_ns + SUSPEND_NS);
            self.at_ns = self.suspend_at_ns;
            self.drop_pending(now_ns);
        }
    }

    pub(super) fn next_ns(&self) -> Option<u64> {
        self.at_ns
    }

    fn wake(&mut self, now_ns: u64) {
        if self.state == BusState::Active {
            self.at_ns = Some(self.at_ns.map_or(now_ns, |at| at.min(now_ns)));
        }
    }

    fn drop_pending(&mut self, now_ns: u64) {
        while let Some(pending) = self.pending.pop_front() {
            self.finish(pending, UrbStatus::Disconnected, now_ns);
        }
    }

    fn finish(&mut self, pending: Pending, status: UrbStatus, now_ns: u64) {
        let actual = pending.sent.max(pending.data.len());
        self.completed.push_back(Completion {
            id: pending.id,
            status,
            data: pending.data,
            actual,
            submitted_ns: pending.submitted_ns,
            completed_ns: now_ns,
        });
    }

    /// Does what is due at `now_ns`.
    pub(super) fn step(&mut self, now_ns: u64, core: &mut DeviceCore) {
        if self.at_ns.is_none_or(|at| at > now_ns) {
            return;
        }
        self.at_ns = None;
        match self.state {
            BusState::Detached | BusState::Suspended => {
                if self.suspend_at_ns.take().is_some() {
                    core.suspend();
                }
            }
            BusState::Debouncing => {
                self.resets += 1;
                self.drop_pending(now_ns);
                self.address = 0;
                self.toggles = [[false; 16]; 2];
                core.bus_reset();
                self.state = BusState::Resetting;
                self.at_ns = Some(now_ns + RESET_NS);
            }
            BusState::Resetting => {
                core.reset_done();
                self.state = BusState::Active;
                self.next_frame_ns = now_ns + FRAME_NS;
                self.at_ns = Some(self.next_frame_ns);
                for pending in &mut self.pending {
                    pending.not_before_ns = now_ns + RECOVERY_NS;
                }
            }
            BusState::Resuming => {
                core.resume();
                self.state = BusState::Active;
                self.next_frame_ns = now_ns;
                self.at_ns = Some(now_ns);
            }
            BusState::Active => self.run_frame(now_ns, core),
        }
    }

    fn run_frame(&mut self, now_ns: u64, core: &mut DeviceCore) {
        if now_ns >= self.next_frame_ns {
            self.frame = (self.frame + 1) & 0x7ff;
            core.start_of_frame(self.frame);
            self.next_frame_ns += FRAME_NS;
        }
        // One transaction of the pipe that was served longest ago, in the order of its requests.
        let chosen = (0..self.pending.len())
            .filter(|&position| {
                let pending = &self.pending[position];
                let first_of_pipe =
                    self.pending.iter().take(position).all(|p| p.pipe() != pending.pipe());
                first_of_pipe && pending.not_before_ns <= now_ns
            })
            .min_by_key(|&position| self.served(self.pending[position].pipe()));
        let Some(position) = chosen else {
            let soonest = self.pending.iter().map(|p| p.not_before_ns.max(now_ns + 1)).min();
            self.at_ns = Some(soonest.map_or(self.next_frame_ns, |at| at.min(self.next_frame_ns)));
            return;
        };
        let Some(mut pending) = self.pending.remove(position) else { return };
        let (endpoint, is_in) = pending.pipe();
        self.served_ns[usize::from(is_in)][usize::from(endpoint & 0xf)] = now_ns;
        let (moved_bytes, outcome) = self.transact(&mut pending, core, now_ns);
        let end_ns = now_ns + (OVERHEAD_BYTES + moved_bytes as u64) * 2_000 / 3;
        match outcome {
            Outcome::Done(status) => self.finish(pending, status, end_ns),
            Outcome::Again => self.pending.insert(position, pending),
        }
        self.at_ns =
            Some(if end_ns + 60_000 > self.next_frame_ns { self.next_frame_ns } else { end_ns });
    }

    fn served(&self, (endpoint, is_in): (u8, bool)) -> u64 {
        self.served_ns[usize::from(is_in)][usize::from(endpoint & 0xf)]
    }

    fn transact(
        &mut self,
        pending: &mut Pending,
        core: &mut DeviceCore,
        now_ns: u64,
    ) -> (usize, Outcome) {
        if !core.answers(self.address) {
            return (0, Self::no_answer(pending, now_ns));
        }
        match pending.request.clone() {
            Request::Control { setup, data } => self.control(pending, setup, &data, core, now_ns),
            Request::Out { endpoint, data } => {
                let (moved, outcome) = self.send(pending, endpoint, &data, core, now_ns);
                (moved, outcome.unwrap_or(Outcome::Again))
            }
            Request::In { endpoint, length } => {
                let (moved, outcome) =
                    self.receive(pending, endpoint, length, core, now_ns, RETRY_NS);
                (moved, outcome.unwrap_or(Outcome::Again))
            }
            Request::InterruptIn { endpoint, length, interval_ms } => {
                let (moved, outcome) = self.receive(
                    pending,
                    endpoint,
                    length,
                    core,
                    now_ns,
                    u64::from(interval_ms) * FRAME_NS,
                );
                (moved, outcome.unwrap_or(Outcome::Again))
            }
        }
    }

    fn no_answer(pending: &mut Pending, now_ns: u64) -> Outcome {
        pending.attempts += 1;
        if pending.attempts >= ATTEMPTS {
            Outcome::Done(UrbStatus::NoAnswer)
        } else {
            pending.not_before_ns = now_ns + RETRY_NS;
            Outcome::Again
        }
    }

    fn control(
        &mut self,
        pending: &mut Pending,
        setup: [u8; 8],
        data: &[u8],
        core: &mut DeviceCore,
        now_ns: u64,
    ) -> (usize, Outcome) {
        let is_in = setup[0] & 0x80 != 0;
        let length = usize::from(u16::from_le_bytes([setup[6], setup[7]]));
        match pending.stage {
            Stage::Setup => {
                core.setup(setup);
                self.toggles[0][0] = true;
                self.toggles[1][0] = true;
                pending.stage = if length == 0 { Stage::Status } else { Stage::Data };
                (8, Outcome::Again)
            }
            Stage::Data => {
                let (moved, outcome) = if is_in {
                    self.receive(pending, 0, length, core, now_ns, RETRY_NS)
                } else {
                    self.send(pending, 0, data, core, now_ns)
                };
                match outcome {
                    Some(Outcome::Done(UrbStatus::Ok)) => {
                        pending.stage = Stage::Status;
                        (moved, Outcome::Again)
                    }
                    other => (moved, other.unwrap_or(Outcome::Again)),
                }
            }
            Stage::Status => {
                // The status packet flows against the data, always DATA1.
                let towards_host = !is_in || length == 0;
                let answer = if towards_host { core.input(0) } else { core.out(0, &[], true) };
                match answer {
                    Answer::Ack | Answer::Data(..) => {
                        self.note_request(setup);
                        (0, Outcome::Done(UrbStatus::Ok))
                    }
                    Answer::Nak => {
                        pending.not_before_ns = now_ns + RETRY_NS;
                        (0, Outcome::Again)
                    }
                    Answer::Stall => (0, Outcome::Done(UrbStatus::Stall)),
                    Answer::Silence => (0, Self::no_answer(pending, now_ns)),
                }
            }
        }
    }

    /// Follows the standard requests that change the host's own books.
    fn note_request(&mut self, setup: [u8; 8]) {
        match (setup[0], setup[1]) {
            (0x00, 5) => self.address = setup[2],
            (0x00, 9) | (0x01, 11) => {
                for endpoint in 1..16 {
                    self.reset_toggle(endpoint, false);
                    self.reset_toggle(endpoint, true);
                }
            }
            (0x02, 1) => self.reset_toggle(setup[4], setup[4] & 0x80 != 0),
            _ => {}
        }
    }

    fn send(
        &mut self,
        pending: &mut Pending,
        endpoint: u8,
        data: &[u8],
        core: &mut DeviceCore,
        now_ns: u64,
    ) -> (usize, Option<Outcome>) {
        let n = usize::from(endpoint & 0xf);
        let max = usize::from(self.max_packet[0][n]);
        let packet = &data[pending.sent..data.len().min(pending.sent + max)];
        match core.out(n, packet, self.toggles[0][n]) {
            Answer::Ack => {
                self.toggles[0][n] ^= true;
                pending.sent += packet.len();
                pending.attempts = 0;
                let done = pending.sent == data.len();
                (packet.len(), done.then_some(Outcome::Done(UrbStatus::Ok)))
            }
            Answer::Stall => (packet.len(), Some(Outcome::Done(UrbStatus::Stall))),
            Answer::Silence => (packet.len(), Some(Self::no_answer(pending, now_ns))),
            Answer::Nak | Answer::Data(..) => {
                pending.not_before_ns = now_ns + RETRY_NS;
                (packet.len(), None)
            }
        }
    }

    fn receive(
        &mut self,
        pending: &mut Pending,
        endpoint: u8,
        length: usize,
        core: &mut DeviceCore,
        now_ns: u64,
        retry_ns: u64,
    ) -> (usize, Option<Outcome>) {
        let n = usize::from(endpoint & 0xf);
        let max = usize::from(self.max_packet[1][n]);
        match core.input(n) {
            Answer::Data(bytes, toggle) => {
                pending.attempts = 0;
                let count = bytes.len();
                if toggle != self.toggles[1][n] {
                    // The host takes it for a repetition: acknowledged, and dropped.
                    return (count, None);
                }
                self.toggles[1][n] ^= true;
                pending.data.extend(bytes);
                let outcome = if pending.data.len() > length {
                    Some(Outcome::Done(UrbStatus::Babble))
                } else if count < max || pending.data.len() == length {
                    Some(Outcome::Done(UrbStatus::Ok))
                } else {
                    None
                };
                (count, outcome)
            }
            Answer::Stall => (0, Some(Outcome::Done(UrbStatus::Stall))),
            Answer::Silence => (0, Some(Self::no_answer(pending, now_ns))),
            Answer::Nak | Answer::Ack => {
                pending.not_before_ns = now_ns + retry_ns;
                (0, None)
            }
        }
    }
}

impl Default for Host {
    fn default() -> Self {
        Self::new()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Done(UrbStatus),
    Again,
}
