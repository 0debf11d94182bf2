//! Strategies for every message of the protocol.
#![allow(dead_code, reason = "each test crate uses its part")]

use proptest::prelude::*;
use stspp_protocol::event::{BootEvent, FaultEvent, StateEvent, TimingEvent, TriggerEvent};
use stspp_protocol::fault::{FaultReason, FaultRecord, FaultReport, FaultSet};
use stspp_protocol::message::{Event, Reply, Request};
use stspp_protocol::reply::*;
use stspp_protocol::request::*;
use stspp_protocol::timing::{Limits, MAX_SLOTS, ProjectionTiming, Slot, TimingError, TimingField};
use stspp_protocol::trigger::{ExternalTrigger, TriggerEdge, TriggerInput, TriggerSource};
use stspp_protocol::version::*;

/// Any timing, possible or not.
pub fn timing() -> impl Strategy<Value = ProjectionTiming> {
    let slot = (any::<u16>(), any::<bool>())
        .prop_map(|(projector_mask, floodlight)| Slot { projector_mask, floodlight });
    let slots = prop::collection::vec(slot, 0..=MAX_SLOTS);
    (slots, any::<[u32; 5]>()).prop_map(|(slots, [period, exposure, delay, lead, lag])| {
        ProjectionTiming {
            slots: slots.into_iter().collect(),
            frame_period_us: period,
            exposure_us: exposure,
            trigger_delay_us: delay,
            gate_lead_us: lead,
            gate_lag_us: lag,
        }
    })
}

fn version() -> impl Strategy<Value = ProtocolVersion> {
    any::<(u16, u16)>().prop_map(|(major, minor)| ProtocolVersion { major, minor })
}

fn source() -> impl Strategy<Value = TriggerSource> {
    let edge = prop::sample::select(vec![TriggerEdge::Rising, TriggerEdge::Falling]);
    prop::option::of((edge, any::<u32>())).prop_map(|external| match external {
        None => TriggerSource::FreeRunning,
        Some((edge, delay_us)) => TriggerSource::External(ExternalTrigger { edge, delay_us }),
    })
}

pub fn request() -> impl Strategy<Value = Request> {
    prop_oneof![
        version().prop_map(|host| Request::Hello(Hello { host })),
        Just(Request::GetInfo(GetInfo)),
        Just(Request::Heartbeat(Heartbeat)),
        Just(Request::GetStatus(GetStatus)),
        Just(Request::GetTiming(GetTiming)),
        timing().prop_map(|timing| Request::SetTiming(SetTiming { timing })),
        Just(Request::Arm(Arm)),
        Just(Request::Disarm(Disarm)),
        Just(Request::StartStream(StartStream)),
        Just(Request::StopStream(StopStream)),
        any::<u16>().prop_map(|frames| Request::StartBurst(StartBurst { frames })),
        any::<u32>().prop_map(|duration_us| Request::FloodlightOn(FloodlightOn { duration_us })),
        Just(Request::FloodlightOff(FloodlightOff)),
        Just(Request::GetFaults(GetFaults)),
        Just(Request::ClearFaults(ClearFaults)),
        Just(Request::SaveSettings(SaveSettings)),
        Just(Request::LoadSettings(LoadSettings)),
        Just(Request::LoadDefaults(LoadDefaults)),
        Just(Request::Reset(Reset)),
        any::<u32>().prop_map(|key| Request::RebootToBootloader(RebootToBootloader { key })),
        source().prop_map(|source| Request::SetTriggerSource(SetTriggerSource { source })),
        Just(Request::GetTriggerSource(GetTriggerSource)),
    ]
}

fn fault_set() -> impl Strategy<Value = FaultSet> {
    any::<u32>().prop_map(FaultSet)
}

fn record() -> impl Strategy<Value = FaultRecord> {
    (prop::sample::select(&FaultReason::ALL[..]), any::<(u64, i32, i32)>())
        .prop_map(|(reason, (time_us, value, limit))| FaultRecord { reason, time_us, value, limit })
}

fn state() -> impl Strategy<Value = DeviceState> {
    prop::sample::select(vec![
        DeviceState::Idle,
        DeviceState::Armed,
        DeviceState::Running,
        DeviceState::Faulted,
    ])
}

fn reset_cause() -> impl Strategy<Value = ResetCause> {
    prop::sample::select(vec![
        ResetCause::PowerOn,
        ResetCause::Pin,
        ResetCause::Software,
        ResetCause::Watchdog,
        ResetCause::Unknown,
    ])
}

fn limits() -> impl Strategy<Value = Limits> {
    (any::<([u8; 3], bool, [u32; 7])>(), any::<([u16; 2], [u32; 3], i16)>()).prop_map(
        |((bytes, has_floodlight, a), (duty, b, max_temperature_dc))| Limits {
            max_slots: bytes[0],
            projector_count: bytes[1],
            max_simultaneous_projectors: bytes[2],
            has_floodlight,
            tick_ns: a[0],
            min_frame_period_us: a[1],
            max_frame_period_us: a[2],
            min_exposure_us: a[3],
            max_gate_margin_us: a[4],
            max_on_time_us: a[5],
            min_dead_time_us: a[6],
            max_projector_duty_permille: duty[0],
            max_floodlight_duty_permille: duty[1],
            max_floodlight_on_us: b[0],
            duty_window_us: b[1],
            heartbeat_timeout_us: b[2],
            max_temperature_dc,
        },
    )
}

fn info() -> impl Strategy<Value = DeviceInfo> {
    (version(), any::<([u8; 3], bool, [u8; 12], u32)>(), limits(), reset_cause(), fault_set())
        .prop_map(|(protocol, (fw, is_f350, serial, caps), limits, reset_cause, latched)| {
            DeviceInfo {
                protocol,
                firmware: FirmwareVersion { major: fw[0], minor: fw[1], patch: fw[2] },
                board: if is_f350 { BoardKind::F350 } else { BoardKind::F330 },
                serial: SerialNumber(serial),
                capabilities: Capabilities(caps),
                limits,
                reset_cause,
                latched,
            }
        })
}

fn status() -> impl Strategy<Value = Status> {
    (state(), fault_set(), any::<(u64, [bool; 3], i16, u16, u32)>(), any::<[u32; 4]>()).prop_map(
        |(state, latched, (time, flags, temperature_dc, generation, frame), counts)| Status {
            state,
            device_time_us: time,
            session: flags[0],
            latched,
            interlock_closed: flags[1],
            temperature_dc,
            timing_generation: generation,
            next_frame_sequence: frame,
            floodlight_on: flags[2],
            events_dropped: counts[0],
            link: LinkCounters {
                frames_received: counts[1],
                frames_rejected: counts[2],
                bytes_overrun: counts[3],
            },
        },
    )
}

fn active_timing() -> impl Strategy<Value = ActiveTiming> {
    (timing(), any::<u16>(), any::<bool>()).prop_map(|(timing, timing_generation, pending)| {
        ActiveTiming { timing, timing_generation, pending }
    })
}

fn started() -> impl Strategy<Value = Started> {
    any::<(u32, u16, u64)>().prop_map(|(first_frame_sequence, timing_generation, start_time_us)| {
        Started { first_frame_sequence, timing_generation, start_time_us }
    })
}

fn report() -> impl Strategy<Value = FaultReport> {
    (fault_set(), fault_set(), prop::option::of(record()), prop::option::of(record()))
        .prop_map(|(latched, active, first, last)| FaultReport { latched, active, first, last })
}

pub fn reply() -> impl Strategy<Value = Reply> {
    let simple = prop_oneof![
        Just(Reply::Arm(Done)),
        Just(Reply::Disarm(Done)),
        Just(Reply::FloodlightOn(Done)),
        Just(Reply::FloodlightOff(Done)),
        Just(Reply::SaveSettings(Done)),
        Just(Reply::Reset(Done)),
        Just(Reply::RebootToBootloader(Done)),
        Just(Reply::SetTriggerSource(Done)),
    ];
    prop_oneof![
        simple,
        info().prop_map(Reply::Hello),
        info().prop_map(Reply::GetInfo),
        (any::<u64>(), state()).prop_map(|(device_time_us, state)| {
            Reply::Heartbeat(Alive { device_time_us, state })
        }),
        status().prop_map(Reply::GetStatus),
        active_timing().prop_map(Reply::GetTiming),
        any::<(u16, bool)>().prop_map(|(timing_generation, pending)| {
            Reply::SetTiming(TimingAccepted { timing_generation, pending })
        }),
        started().prop_map(Reply::StartStream),
        any::<u32>()
            .prop_map(|end_frame_sequence| { Reply::StopStream(Stopping { end_frame_sequence }) }),
        started().prop_map(Reply::StartBurst),
        report().prop_map(Reply::GetFaults),
        report().prop_map(Reply::ClearFaults),
        active_timing().prop_map(Reply::LoadSettings),
        active_timing().prop_map(Reply::LoadDefaults),
        (source(), any::<[u32; 2]>()).prop_map(|(source, [edges_taken, edges_ignored])| {
            Reply::GetTriggerSource(TriggerInput { source, edges_taken, edges_ignored })
        }),
    ]
}

fn timing_error() -> impl Strategy<Value = TimingError> {
    let field = prop::sample::select(vec![
        TimingField::SlotCount,
        TimingField::ProjectorMask,
        TimingField::SimultaneousProjectors,
        TimingField::Floodlight,
        TimingField::FramePeriodUs,
        TimingField::GateLeadUs,
        TimingField::GateLagUs,
        TimingField::ExposureUs,
        TimingField::TriggerDelayUs,
        TimingField::ProjectorDutyPermille,
        TimingField::FloodlightDutyPermille,
    ]);
    (field, any::<(Option<u8>, u32, u32, u32)>())
        .prop_map(|(field, (index, value, min, max))| TimingError { field, index, value, min, max })
}

pub fn error() -> impl Strategy<Value = RequestError> {
    let field = prop::sample::select(vec![
        RequestField::BurstFrames,
        RequestField::FloodlightDurationUs,
        RequestField::BootloaderKey,
        RequestField::TriggerDelayUs,
    ]);
    let storage =
        prop::sample::select(vec![StorageError::Empty, StorageError::Write, StorageError::Read]);
    prop_oneof![
        version().prop_map(|device| RequestError::VersionMismatch { device }),
        any::<u8>().prop_map(|id| RequestError::UnknownMessage { id }),
        any::<u8>().prop_map(|id| RequestError::Malformed { id }),
        Just(RequestError::NoSession),
        (state(), state()).prop_map(|(state, needed)| RequestError::WrongState { state, needed }),
        timing_error().prop_map(RequestError::Timing),
        fault_set().prop_map(|latched| RequestError::Faulted { latched }),
        Just(RequestError::InterlockOpen),
        (field, any::<(u32, u32, u32)>()).prop_map(|(field, (value, min, max))| {
            RequestError::OutOfRange { field, value, min, max }
        }),
        any::<(u8, u32)>().prop_map(|(emitter, retry_after_us)| RequestError::DutyBudget {
            emitter,
            retry_after_us
        }),
        storage.prop_map(RequestError::Storage),
        Just(RequestError::Unsupported),
    ]
}

pub fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        (any::<(u32, u8, u16, bool)>(), any::<(u64, Option<u16>, u16)>()).prop_map(
            |((frame_sequence, slot_index, projector_mask, floodlight), (time, usb_sof, gen_))| {
                Event::TriggerEvent(TriggerEvent {
                    frame_sequence,
                    slot_index,
                    projector_mask,
                    floodlight,
                    trigger_time_us: time,
                    usb_sof,
                    timing_generation: gen_,
                })
            }
        ),
        (record(), fault_set())
            .prop_map(|(record, latched)| Event::FaultEvent(FaultEvent { record, latched })),
        (state(), state(), any::<(u64, u32)>()).prop_map(
            |(from, to, (time_us, next_frame_sequence))| {
                Event::StateEvent(StateEvent { from, to, time_us, next_frame_sequence })
            }
        ),
        any::<(u16, u32)>().prop_map(|(timing_generation, first_frame_sequence)| {
            Event::TimingEvent(TimingEvent { timing_generation, first_frame_sequence })
        }),
        (version(), reset_cause(), fault_set()).prop_map(|(protocol, reset_cause, latched)| {
            Event::BootEvent(BootEvent { protocol, reset_cause, latched })
        }),
    ]
}
