//! Register arithmetic as pure functions: no register is touched here, so all of it runs in the
//! tests on the host (`cargo xtask firmware --test`).

pub mod analog;
pub mod baud;
pub mod chain;
pub mod clock;
pub mod period;
pub mod ring;
pub mod timing;
