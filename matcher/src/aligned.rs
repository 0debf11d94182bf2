//! Buffers that begin at a cache line and keep their memory.

use std::ops::{Deref, DerefMut};

use crate::memory::Buffer;

/// A slice that can be given another length; its first value lies at the start of a cache line.
#[derive(Debug)]
pub(crate) struct Aligned<T> {
    data: Buffer<T>,
    len: usize,
}

impl<T> Default for Aligned<T> {
    fn default() -> Self {
        Self { data: Buffer::default(), len: 0 }
    }
}

impl<T: Copy> Aligned<T> {
    /// Makes it `len` long, with `fill` everywhere if that is another length than before.
    pub(crate) fn resize(&mut self, len: usize, fill: T) {
        if self.len == len {
            return;
        }
        self.len = len;
        match self.data.get_mut(..len) {
            Some(data) => data.fill(fill),
            None => self.data = Buffer::new(len, fill),
        }
    }
}

impl<T> Deref for Aligned<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.data[..self.len]
    }
}

impl<T> DerefMut for Aligned<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.data[..self.len]
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
            assert!(buffer.as_ptr().addr().is_multiple_of(64) && buffer.len() == len);
            assert!(buffer.iter().all(|v| *v == 2.5));
            buffer[0] = 1.0;
            buffer.resize(len, 0.0);
            assert_eq!(buffer[0], 1.0);
        }
    }
}
