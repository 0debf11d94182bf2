//! The state machine of `docs/protocol.md`, written down a second time as a table of who is refused
//! when, against the device under random requests.

use std::mem::discriminant;

use proptest::prelude::*;
use stspp_hil_sim::device::Controller;
use stspp_protocol::fault::{FaultReason, FaultSet};
use stspp_protocol::message::Request;
use stspp_protocol::reply::{DeviceState, RequestError, StorageError};
use stspp_protocol::request::*;
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerSource};
use stspp_protocol::version::{PROTOCOL_VERSION, ProtocolVersion};

use crate::host::{Host, MS};

#[derive(Debug, Clone)]
enum Step {
    Ask(Request),
    Interlock(bool),
    Hot(bool),
    Wait,
}

fn timing(exposure_us: u32) -> ProjectionTiming {
    ProjectionTiming { frame_period_us: 2_000, exposure_us, ..ProjectionTiming::default() }
}

/// A slot cannot start as long after its edge as this.
const TOO_LATE: TriggerSource =
    TriggerSource::External(ExternalTrigger { edge: TriggerEdge::Rising, delay_us: 5_000 });

fn set_trigger(source: TriggerSource) -> Request {
    Request::SetTriggerSource(SetTriggerSource { source })
}

fn step() -> impl Strategy<Value = Step> {
    let hello = |host| Request::Hello(Hello { host });
    let other_major = ProtocolVersion { major: 2, minor: 0 };
    let request = prop_oneof![
        4 => Just(hello(PROTOCOL_VERSION)),
        1 => Just(hello(other_major)),
        1 => Just(Request::GetInfo(GetInfo)),
        1 => Just(Request::Heartbeat(Heartbeat)),
        1 => Just(Request::GetStatus(GetStatus)),
        1 => Just(Request::GetTiming(GetTiming)),
        2 => Just(Request::SetTiming(SetTiming { timing: timing(300) })),
        1 => Just(Request::SetTiming(SetTiming { timing: timing(5_000) })),
        8 => Just(Request::Arm(Arm)),
        2 => Just(Request::Disarm(Disarm)),
        5 => Just(Request::StartStream(StartStream)),
        3 => Just(Request::StopStream(StopStream)),
        3 => Just(Request::StartBurst(StartBurst { frames: 3 })),
        1 => Just(Request::StartBurst(StartBurst { frames: 0 })),
        2 => Just(Request::FloodlightOn(FloodlightOn { duration_us: 500 })),
        1 => Just(Request::FloodlightOff(FloodlightOff)),
        1 => Just(Request::GetFaults(GetFaults)),
        4 => Just(Request::ClearFaults(ClearFaults)),
        1 => Just(Request::SaveSettings(SaveSettings)),
        2 => Just(Request::LoadSettings(LoadSettings)),
        1 => Just(Request::LoadDefaults(LoadDefaults)),
        1 => Just(Request::RebootToBootloader(RebootToBootloader { key: 1 })),
        1 => Just(Request::GetTriggerSource(GetTriggerSource)),
        1 => Just(set_trigger(TriggerSource::FreeRunning)),
        1 => Just(set_trigger(TOO_LATE)),
    ];
    prop_oneof![
        20 => request.prop_map(Step::Ask),
        1 => any::<bool>().prop_map(Step::Interlock),
        1 => any::<bool>().prop_map(Step::Hot),
        3 => Just(Step::Wait),
    ]
}

#[derive(Debug, PartialEq, Clone, Copy)]
enum Session {
    None,
    Open,
    Refused,
}

#[derive(Debug)]
struct Model {
    session: Session,
    state: DeviceState,
    latched: FaultSet,
    active: FaultSet,
    /// Whether the run ends on its own while time passes.
    ends: bool,
    saved: bool,
}

impl Model {
    fn dark(&mut self) {
        if self.state != DeviceState::Faulted {
            self.state = DeviceState::Idle;
        }
    }

    fn fault(&mut self, reason: FaultReason) {
        self.latched.insert(reason);
        self.state = DeviceState::Faulted;
    }

    fn light_allowed(&self) -> bool {
        matches!(self.state, DeviceState::Armed | DeviceState::Running)
    }

    /// What the request comes to, and the state after it.
    fn ask(&mut self, request: &Request) -> Result<(), RequestError> {
        use DeviceState::{Armed, Faulted, Idle, Running};
        let mismatch = RequestError::VersionMismatch { device: PROTOCOL_VERSION };
        let faulted = RequestError::Faulted { latched: self.latched };
        if let Request::Hello(Hello { host }) = request {
            self.dark();
            let same = host.major == PROTOCOL_VERSION.major;
            self.session = if same { Session::Open } else { Session::Refused };
            return if same { Ok(()) } else { Err(mismatch) };
        }
        if self.session == Session::Refused {
            return Err(mismatch);
        }
        let open =
            if self.session == Session::Open { Ok(()) } else { Err(RequestError::NoSession) };
        let healthy = if self.latched == FaultSet::EMPTY { Ok(()) } else { Err(faulted) };
        let in_state = |needed, state| {
            if state == needed { Ok(()) } else { Err(RequestError::WrongState { state, needed }) }
        };
        let light_off = match self.state {
            Idle | Faulted => Ok(()),
            state => Err(RequestError::WrongState { state, needed: Idle }),
        };
        match request {
            Request::Hello(_) => unreachable!("answered above"),
            Request::GetInfo(_)
            | Request::Heartbeat(_)
            | Request::GetStatus(_)
            | Request::GetTiming(_)
            | Request::GetFaults(_)
            | Request::GetTriggerSource(_)
            | Request::FloodlightOff(_) => Ok(()),
            Request::Disarm(_) => {
                self.dark();
                Ok(())
            }
            Request::StopStream(_) => {
                self.ends |= self.state == Running;
                Ok(())
            }
            Request::SetTriggerSource(set) => {
                open?;
                if self.state == Running {
                    return Err(RequestError::WrongState { state: Running, needed: Armed });
                }
                set.source.validate()
            }
            Request::SetTiming(set) => {
                open?;
                set.timing
                    .validate(&stspp_protocol::timing::Limits::F350)
                    .map_err(RequestError::Timing)
            }
            Request::Arm(_) => {
                open.and(healthy)?;
                if self.active.contains(FaultReason::Interlock) {
                    return Err(RequestError::InterlockOpen);
                }
                if self.state == Idle {
                    self.state = Armed;
                }
                Ok(())
            }
            Request::StartBurst(StartBurst { frames: 0 }) => Err(RequestError::OutOfRange {
                field: stspp_protocol::reply::RequestField::BurstFrames,
                value: 0,
                min: 1,
                max: 65_535,
            }),
            Request::StartStream(_) | Request::StartBurst(_) => {
                open.and(healthy).and(in_state(Armed, self.state))?;
                self.state = Running;
                self.ends = matches!(request, Request::StartBurst(_));
                Ok(())
            }
            Request::FloodlightOn(_) => open.and(healthy).and(in_state(Armed, self.state)),
            Request::ClearFaults(_) => {
                open?;
                self.latched = FaultSet(self.latched.0 & self.active.0);
                if self.latched == FaultSet::EMPTY && self.state == Faulted {
                    self.state = Idle;
                }
                Ok(())
            }
            Request::SaveSettings(_) => {
                open.and(light_off)?;
                self.saved = true;
                Ok(())
            }
            Request::LoadSettings(_) => {
                open.and(light_off)?;
                if self.saved { Ok(()) } else { Err(RequestError::Storage(StorageError::Empty)) }
            }
            Request::LoadDefaults(_) => open.and(light_off),
            Request::RebootToBootloader(request) => {
                open?;
                Err(RequestError::OutOfRange {
                    field: stspp_protocol::reply::RequestField::BootloaderKey,
                    value: request.key,
                    min: BOOTLOADER_KEY,
                    max: BOOTLOADER_KEY,
                })
            }
            Request::Reset(_) => unreachable!("not among the steps"),
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn requests_are_granted_and_refused_as_drawn(steps in prop::collection::vec(step(), 1..100)) {
        let mut host = Host::new(Default::default());
        let mut model = Model {
            session: Session::None,
            state: DeviceState::Idle,
            latched: FaultSet::EMPTY,
            active: FaultSet::EMPTY,
            ends: false,
            saved: false,
        };
        for step in &steps {
            match step {
                Step::Ask(request) => {
                    let expected = model.ask(request);
                    let reply = host.ask(request).expect("a reply");
                    let answered = reply.as_ref().map(|_| ()).map_err(|error| *error);
                    prop_assert_eq!(answered, expected, "{:?}", request);
                    if let Ok(reply) = reply {
                        // The reply is the request's own.
                        let name = |debug: String| debug.split('(').next().map(str::to_owned);
                        prop_assert_eq!(name(format!("{reply:?}")), name(format!("{request:?}")));
                    }
                }
                Step::Interlock(closed) => {
                    host.device.set_interlock_closed(*closed);
                    if *closed {
                        model.active.remove(FaultReason::Interlock);
                    } else {
                        model.active.insert(FaultReason::Interlock);
                        if model.light_allowed() {
                            model.fault(FaultReason::Interlock);
                        }
                    }
                }
                Step::Hot(hot) => {
                    host.device.set_temperature_c(if *hot { 99.0 } else { 20.0 });
                    if *hot {
                        model.active.insert(FaultReason::OverTemperature);
                        model.fault(FaultReason::OverTemperature);
                    } else {
                        model.active.remove(FaultReason::OverTemperature);
                    }
                }
                Step::Wait => {}
            }
            // Long enough for a burst or a stop to end, in either timing.
            host.run(120 * MS);
            host.call(&Heartbeat).ok();
            if model.state == DeviceState::Running && model.ends {
                model.state = DeviceState::Armed;
            }
            model.ends &= model.state == DeviceState::Running;
            prop_assert_eq!(host.device.state(), Some(model.state), "after {:?}", step);
        }
        // Every change was told, and the changes told lead to the state.
        let told = host.events.iter().filter_map(|event| match event {
            stspp_protocol::message::Event::StateEvent(state) => Some(*state),
            _ => None,
        });
        let mut state = DeviceState::Idle;
        for change in told {
            prop_assert_eq!(change.from, state);
            prop_assert!(discriminant(&change.to) != discriminant(&state));
            state = change.to;
        }
        prop_assert_eq!(state, model.state);
    }
}
