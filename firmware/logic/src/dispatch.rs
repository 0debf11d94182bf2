//! What each request does: a method each, checked first, done then.
//!
//! A refused request has changed nothing. Requests that only look, and those that only switch light
//! off, need no session.

use stspp_protocol::fault::FaultReport;
use stspp_protocol::message::Serve;
use stspp_protocol::reply::{
    ActiveTiming, Alive, DeviceState, Done, RequestError, RequestField, Started, Status, Stopping,
    TimingAccepted,
};
use stspp_protocol::request::{
    Arm, BOOTLOADER_KEY, ClearFaults, Disarm, FloodlightOff, FloodlightOn, GetFaults, GetInfo,
    GetStatus, GetTiming, GetTriggerSource, Heartbeat, Hello, LoadDefaults, LoadSettings,
    RebootToBootloader, Reset, SaveSettings, SetTiming, SetTriggerSource, StartBurst, StartStream,
    StopStream,
};
use stspp_protocol::timing::ProjectionTiming;
use stspp_protocol::trigger::{TriggerInput, TriggerSource};
use stspp_protocol::version::{Capabilities, DeviceInfo, PROTOCOL_VERSION};

use crate::controller::{Controller, Floodlight, Session};
use crate::duty::Exhausted;
use crate::hardware::{GateEngine, SettingsStore, SystemAction};
use crate::settings;
use crate::timing::{GateWord, SlotPlan};

impl<E: GateEngine, S: SettingsStore> Serve for Controller<E, S> {
    fn hello(&mut self, request: Hello) -> Result<DeviceInfo, RequestError> {
        self.go_dark();
        // A host that knows nothing of trigger-in must not wait for its edges.
        self.choose_trigger(TriggerSource::FreeRunning);
        self.host_minor = request.host.minor;
        if request.host.is_compatible_with(PROTOCOL_VERSION) {
            self.session = Session::Open;
            Ok(self.info())
        } else {
            self.session = Session::Refused;
            Err(RequestError::VersionMismatch { device: PROTOCOL_VERSION })
        }
    }

    fn get_info(&mut self, _: GetInfo) -> Result<DeviceInfo, RequestError> {
        Ok(self.info())
    }

    fn heartbeat(&mut self, _: Heartbeat) -> Result<Alive, RequestError> {
        Ok(Alive { device_time_us: self.now_us, state: self.state })
    }

    fn get_status(&mut self, _: GetStatus) -> Result<Status, RequestError> {
        Ok(Status {
            state: self.state,
            device_time_us: self.now_us,
            session: self.session == Session::Open,
            latched: self.interlock.latched(),
            interlock_closed: self.interlock.is_closed(),
            temperature_dc: self.interlock.temperature_dc(),
            timing_generation: self.sequencer.generation(),
            next_frame_sequence: self.sequencer.next_frame_sequence(),
            floodlight_on: self.floodlight.is_some(),
            events_dropped: self.outbox.dropped(),
            link: self.link_counters(),
        })
    }

    fn get_timing(&mut self, _: GetTiming) -> Result<ActiveTiming, RequestError> {
        Ok(self.active_timing())
    }

    fn set_timing(&mut self, request: SetTiming) -> Result<TimingAccepted, RequestError> {
        self.check_session()?;
        self.accept_timing(request.timing)?;
        Ok(TimingAccepted {
            timing_generation: self.sequencer.generation(),
            pending: self.sequencer.is_pending(),
        })
    }

    fn arm(&mut self, _: Arm) -> Result<Done, RequestError> {
        self.check_session()?;
        self.check_faults()?;
        if !self.interlock.is_closed() {
            return Err(RequestError::InterlockOpen);
        }
        if self.state == DeviceState::Idle {
            self.enter(DeviceState::Armed);
        }
        Ok(Done)
    }

    fn disarm(&mut self, _: Disarm) -> Result<Done, RequestError> {
        self.go_dark();
        Ok(Done)
    }

    fn start_stream(&mut self, _: StartStream) -> Result<Started, RequestError> {
        self.start(None)
    }

    fn stop_stream(&mut self, _: StopStream) -> Result<Stopping, RequestError> {
        if self.state != DeviceState::Running {
            return Ok(Stopping { end_frame_sequence: self.sequencer.next_frame_sequence() });
        }
        let slots = self.engine.stop();
        let end_frame_sequence = self.sequencer.end_frame_sequence(slots);
        if self.sequencer.stopping(slots) {
            self.enter(DeviceState::Armed);
        }
        Ok(Stopping { end_frame_sequence })
    }

    fn start_burst(&mut self, request: StartBurst) -> Result<Started, RequestError> {
        if request.frames == 0 {
            return Err(RequestError::OutOfRange {
                field: RequestField::BurstFrames,
                value: 0,
                min: 1,
                max: u32::from(u16::MAX),
            });
        }
        self.start(Some(u32::from(request.frames)))
    }

    fn floodlight_on(&mut self, request: FloodlightOn) -> Result<Done, RequestError> {
        if !self.limits.has_floodlight {
            return Err(RequestError::Unsupported);
        }
        self.check_state(DeviceState::Armed)?;
        self.charge_floodlight();
        let now_us = self.now_us;
        let lit = self.floodlight.filter(|lit| now_us < lit.until_us);
        let since_us = lit.map_or(now_us, |lit| lit.since_us);
        // Asking again does not stretch one on-time beyond the limit.
        let used_us = u32::try_from(now_us.saturating_sub(since_us)).unwrap_or(u32::MAX);
        let max = self.limits.max_floodlight_on_us.saturating_sub(used_us);
        let value = request.duration_us;
        if value == 0 || value > max {
            let field = RequestField::FloodlightDurationUs;
            return Err(RequestError::OutOfRange { field, value, min: 1, max });
        }
        self.duty.advance(now_us);
        self.duty.admit(GateWord::FLOODLIGHT_ONLY).map_err(refuse)?;
        self.engine.set_floodlight(value);
        let until_us = now_us.saturating_add(u64::from(value));
        self.floodlight = Some(Floodlight { since_us, charged_until_us: now_us, until_us });
        Ok(Done)
    }

    fn floodlight_off(&mut self, _: FloodlightOff) -> Result<Done, RequestError> {
        self.end_floodlight();
        Ok(Done)
    }

    fn get_faults(&mut self, _: GetFaults) -> Result<FaultReport, RequestError> {
        Ok(self.interlock.report(self.host_minor))
    }

    fn clear_faults(&mut self, _: ClearFaults) -> Result<FaultReport, RequestError> {
        self.check_session()?;
        if self.interlock.clear() && self.state == DeviceState::Faulted {
            self.enter(DeviceState::Idle);
        }
        Ok(self.interlock.report(self.host_minor))
    }

    fn save_settings(&mut self, _: SaveSettings) -> Result<Done, RequestError> {
        self.check_session()?;
        self.check_dark()?;
        let settings = self.settings();
        settings::save(&mut self.store, &settings).map_err(RequestError::Storage)?;
        Ok(Done)
    }

    fn load_settings(&mut self, _: LoadSettings) -> Result<ActiveTiming, RequestError> {
        self.check_session()?;
        self.check_dark()?;
        let stored = settings::load(&self.store).map_err(RequestError::Storage)?;
        self.accept_timing(stored.timing)?;
        Ok(self.active_timing())
    }

    fn load_defaults(&mut self, _: LoadDefaults) -> Result<ActiveTiming, RequestError> {
        self.check_session()?;
        self.check_dark()?;
        self.accept_timing(ProjectionTiming::default())?;
        Ok(self.active_timing())
    }

    fn reset(&mut self, _: Reset) -> Result<Done, RequestError> {
        self.check_session()?;
        self.go_dark();
        self.action = Some(SystemAction::Reset);
        Ok(Done)
    }

    fn reboot_to_bootloader(&mut self, request: RebootToBootloader) -> Result<Done, RequestError> {
        self.check_session()?;
        if !self.identity.capabilities.contains(Capabilities::BOOTLOADER) {
            return Err(RequestError::Unsupported);
        }
        if request.key != BOOTLOADER_KEY {
            return Err(RequestError::OutOfRange {
                field: RequestField::BootloaderKey,
                value: request.key,
                min: BOOTLOADER_KEY,
                max: BOOTLOADER_KEY,
            });
        }
        self.go_dark();
        self.action = Some(SystemAction::Bootloader);
        Ok(Done)
    }

    fn set_trigger_source(&mut self, request: SetTriggerSource) -> Result<Done, RequestError> {
        self.check_session()?;
        if !self.identity.capabilities.contains(Capabilities::TRIGGER_IN) {
            return Err(RequestError::Unsupported);
        }
        if self.state == DeviceState::Running {
            let (state, needed) = (self.state, DeviceState::Armed);
            return Err(RequestError::WrongState { state, needed });
        }
        request.source.validate()?;
        self.choose_trigger(request.source);
        Ok(Done)
    }

    fn get_trigger_source(&mut self, _: GetTriggerSource) -> Result<TriggerInput, RequestError> {
        let edges = self.engine.trigger_edges();
        Ok(TriggerInput {
            source: self.trigger_source,
            edges_taken: edges.taken,
            edges_ignored: edges.ignored,
        })
    }
}

impl<E: GateEngine, S: SettingsStore> Controller<E, S> {
    fn check_session(&self) -> Result<(), RequestError> {
        if self.session == Session::Open { Ok(()) } else { Err(RequestError::NoSession) }
    }

    fn check_faults(&self) -> Result<(), RequestError> {
        let latched = self.interlock.latched();
        if latched.is_empty() { Ok(()) } else { Err(RequestError::Faulted { latched }) }
    }

    fn check_state(&self, needed: DeviceState) -> Result<(), RequestError> {
        self.check_session()?;
        self.check_faults()?;
        if self.state == needed {
            Ok(())
        } else {
            Err(RequestError::WrongState { state: self.state, needed })
        }
    }

    /// Called only when no run is under way.
    fn choose_trigger(&mut self, source: TriggerSource) {
        self.trigger_source = source;
        self.engine.set_trigger_source(source);
    }

    /// Flash work stalls the processor, and settings change under a run only by `SetTiming`.
    fn check_dark(&self) -> Result<(), RequestError> {
        match self.state {
            DeviceState::Idle | DeviceState::Faulted => Ok(()),
            state => Err(RequestError::WrongState { state, needed: DeviceState::Idle }),
        }
    }

    fn active_timing(&self) -> ActiveTiming {
        ActiveTiming {
            timing: self.sequencer.timing().clone(),
            timing_generation: self.sequencer.generation(),
            pending: self.sequencer.is_pending(),
        }
    }

    fn accept_timing(&mut self, timing: ProjectionTiming) -> Result<(), RequestError> {
        let plan = SlotPlan::compile(
            &timing,
            &self.limits,
            self.engine.ticks_per_us(),
            self.sequencer.next_generation(),
        )?;
        self.engine.load(&plan);
        self.sequencer.accept(timing);
        Ok(())
    }

    fn start(&mut self, slots: Option<u32>) -> Result<Started, RequestError> {
        self.check_state(DeviceState::Armed)?;
        self.charge_floodlight();
        self.duty.advance(self.now_us);
        for gates in self.sequencer.gates_used() {
            self.duty.admit(gates).map_err(refuse)?;
        }
        self.end_floodlight();
        let first_frame_sequence = self.sequencer.next_frame_sequence();
        let start_time_us = self.engine.start(slots);
        let external = self.trigger_source != TriggerSource::FreeRunning;
        self.sequencer.started(start_time_us, slots, external);
        self.enter(DeviceState::Running);
        let timing_generation = self.sequencer.generation();
        Ok(Started { first_frame_sequence, timing_generation, start_time_us })
    }

    fn end_floodlight(&mut self) {
        self.charge_floodlight();
        if self.floodlight.take().is_some() {
            self.engine.set_floodlight(0);
        }
    }
}

fn refuse(exhausted: Exhausted) -> RequestError {
    RequestError::DutyBudget {
        emitter: exhausted.emitter,
        retry_after_us: exhausted.retry_after_us,
    }
}
