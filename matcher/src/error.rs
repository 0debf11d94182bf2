//! What can be wrong with a matching request.

/// Errors of the matcher: each names the input at fault and what was expected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The stack has no frame or more than the matcher handles.
    #[error("a stack needs 1 to 16 frames, got {frames}")]
    FrameCount {
        /// Frames given.
        frames: usize,
    },
    /// Left and right stacks, their masks or times differ in number or size.
    #[error("{what}: expected {expected}, got {got}")]
    Shape {
        /// Which input.
        what: &'static str,
        /// What it should be.
        expected: String,
        /// What it was.
        got: String,
    },
    /// A parameter is outside its range.
    #[error("parameter {name} is {got}, allowed is {allowed}")]
    Parameter {
        /// Name of the field in [`crate::Params`].
        name: &'static str,
        /// Its value.
        got: String,
        /// The allowed range.
        allowed: String,
    },
}
