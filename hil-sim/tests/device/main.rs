//! The in-process device from outside: bytes in, bytes and edges out.

mod dialogue;
mod edges;
mod faults;
mod host;
mod model;
mod safety;
mod settings;
mod twin;
