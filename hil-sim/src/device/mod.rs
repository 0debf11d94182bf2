//! The sensor's controller as seen from outside: bytes of the control link in and out, edges of its
//! pins, all in virtual time.
//!
//! [`in_process`] runs the firmware's logic on the host.

pub mod in_process;

/// An output of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Line {
    /// Gate of projector 0..=9.
    Projector(u8),
    /// Gate of the floodlight.
    Floodlight,
    /// Trigger of camera 0 (left) or 1 (right): the camera integrates while it is high.
    CameraTrigger(u8),
}

/// A level change of one output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PinEdge {
    /// Virtual time in nanoseconds since the controller's power-on.
    pub time_ns: u64,
    /// Which output.
    pub line: Line,
    /// The level from this time on.
    pub high: bool,
}

/// A controller in virtual time: the firmware's logic run on the host, or the real binary on an
/// emulated chip. Time passes only in [`Controller::run_until`].
pub trait Controller: Send {
    /// Virtual time since power-on.
    fn now_ns(&self) -> u64;

    /// Gives bytes of the control link to the controller, arriving now.
    fn host_write(&mut self, bytes: &[u8]);

    /// Takes the bytes that the controller has sent so far.
    fn host_read(&mut self, out: &mut Vec<u8>);

    /// Lets virtual time pass up to `time_ns` and appends the edges of the outputs, in time order.
    fn run_until(&mut self, time_ns: u64, edges: &mut Vec<PinEdge>);

    /// Sets the interlock input: `true` is closed (light allowed). Starts closed.
    fn set_interlock_closed(&mut self, closed: bool);

    /// Sets the temperature at the projector board's NTC. Starts at 25.
    fn set_temperature_c(&mut self, temperature_c: f32);

    /// Sets the level at the trigger input. Starts low.
    fn set_trigger_in(&mut self, high: bool);

    /// Cuts or restores the control link (cable pulled). Starts connected.
    fn set_link_connected(&mut self, connected: bool);
}
