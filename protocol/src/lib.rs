//! Messages between the stspp sensor and its host.
#![no_std]
