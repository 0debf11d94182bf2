//! Hardware-free firmware logic of the stspp sensor.
#![no_std]
