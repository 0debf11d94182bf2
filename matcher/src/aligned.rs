//! Buffers that begin at a cache line: a vector of 64 bytes that lies across two lines takes twice as
//! long to load.

use std::ops::{Deref, DerefMut};

/// Bytes of a cache line, and of the widest vector.
const LINE: usize = 64;

/// A growable slice whose first value lies at the start of a cache line.
#[derive(Debug)]
pub(crate) struct Aligned<T> {
    data: Vec<T>,
    from: usize,
    len: usize,
}

impl<T> Default for Aligned<T> {
    fn default() -> Self {
        Self { data: Vec::new(), from: 0, len: 0 }
    }
}

impl<T: Copy> Aligned<T> {
    /// Makes it `len` long, with `fill` everywhere if that is another length than before.
    pub(crate) fn resize(&mut self, len: usize, fill: T) {
        if self.len == len {
            return;
        }
        self.data.clear();
        self.data.resize(len + LINE / size_of::<T>(), fill);
        self.from = self.data.as_ptr().align_offset(LINE).min(LINE / size_of::<T>());
        self.len = len;
    }
}

impl<T> Deref for Aligned<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.data[self.from..][..self.len]
    }
}

impl<T> DerefMut for Aligned<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.data[self.from..][..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn begins_at_a_line_and_keeps_what_it_holds() {
        let mut buffer = Aligned::default();
        for len in [1usize, 100, 5000] {
            buffer.resize(len, 2.5f32);
            assert!(buffer.as_ptr().addr().is_multiple_of(LINE) && buffer.len() == len);
            assert!(buffer.iter().all(|v| *v == 2.5));
            buffer[0] = 1.0;
            buffer.resize(len, 0.0);
            assert_eq!(buffer[0], 1.0);
        }
    }
}
