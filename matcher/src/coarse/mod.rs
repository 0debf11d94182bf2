//! Coarse.
