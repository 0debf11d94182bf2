//! Reads and checks descriptors.
