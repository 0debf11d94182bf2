//! Memory of large buffers: in pages of 2 MiB where the system has them.
//!
//! A frame reads twenty images row by row, and a page of 4 KiB ends after one and a half rows: the
//! processor then looks for the next one's address, 50 000 times a frame.

use std::alloc::{Layout, alloc, dealloc, handle_alloc_error};
use std::mem::{ManuallyDrop, MaybeUninit};
use std::ops::{Deref, DerefMut};
use std::ptr::NonNull;

/// Bytes of a cache line, and of the widest vector: a vector that lies across two lines takes twice as
/// long to load.
const LINE: usize = 64;
/// Bytes of a large page.
const PAGE: usize = 2 << 20;
/// Buffers of so many bytes begin at a large page, and have whole ones.
const LARGE: usize = PAGE / 2;

/// A slice of its own that begins at a cache line, unless it was a vector.
pub(crate) struct Buffer<T> {
    data: NonNull<T>,
    len: usize,
    /// What the memory was asked for with; nothing was for a size of 0.
    layout: Layout,
}

// SAFETY: it owns its values, as a vector does.
unsafe impl<T: Send> Send for Buffer<T> {}
// SAFETY: as above.
unsafe impl<T: Sync> Sync for Buffer<T> {}

impl<T> Default for Buffer<T> {
    fn default() -> Self {
        Self::from(Vec::new())
    }
}

impl<T: Copy> Buffer<T> {
    /// `len` times `fill`.
    pub fn new(len: usize, fill: T) -> Self {
        let layout = Layout::array::<T>(len).expect("no buffer is larger than the memory");
        let large = layout.size() >= LARGE;
        let layout = layout.align_to(if large { PAGE } else { LINE });
        let layout = layout.expect("no buffer is larger than the memory");
        let layout = if large { layout.pad_to_align() } else { layout };
        if layout.size() == 0 {
            return Self::default();
        }
        // SAFETY: the size is not zero.
        let data = unsafe { alloc(layout) };
        let Some(data) = NonNull::new(data.cast::<T>()) else { handle_alloc_error(layout) };
        if large {
            ask_for_large_pages(data.cast(), layout.size());
        }
        // SAFETY: there is room for `len` values, which are not initialised.
        let values =
            unsafe { std::slice::from_raw_parts_mut(data.as_ptr().cast::<MaybeUninit<T>>(), len) };
        values.fill(MaybeUninit::new(fill));
        Self { data, len, layout }
    }

    /// The values as a vector; copied unless they were one.
    pub fn into_vec(self) -> Vec<T> {
        if self.layout.align() != align_of::<T>() {
            return self.to_vec();
        }
        let this = ManuallyDrop::new(self);
        // SAFETY: with a type's own alignment the memory is a vector's, whose capacity the layout says.
        unsafe {
            Vec::from_raw_parts(this.data.as_ptr(), this.len, this.layout.size() / size_of::<T>())
        }
    }
}

impl<T> From<Vec<T>> for Buffer<T> {
    fn from(values: Vec<T>) -> Self {
        let mut values = ManuallyDrop::new(values);
        let layout = Layout::array::<T>(values.capacity()).expect("as a vector has it");
        let data = NonNull::new(values.as_mut_ptr()).expect("a vector's address is not zero");
        Self { data, len: values.len(), layout }
    }
}

impl<T> Drop for Buffer<T> {
    fn drop(&mut self) {
        if self.layout.size() != 0 {
            // SAFETY: it was asked for with this layout.
            unsafe { dealloc(self.data.as_ptr().cast(), self.layout) };
        }
    }
}

impl<T> Deref for Buffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        // SAFETY: so many values are there, and borrowed with `self`.
        unsafe { std::slice::from_raw_parts(self.data.as_ptr(), self.len) }
    }
}

impl<T> DerefMut for Buffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: so many values are there, and borrowed with `self`.
        unsafe { std::slice::from_raw_parts_mut(self.data.as_ptr(), self.len) }
    }
}

impl<T: std::fmt::Debug> std::fmt::Debug for Buffer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        (**self).fmt(f)
    }
}

/// Asks for large pages, which systems give to who asks; where they do not, pages are small as ever.
fn ask_for_large_pages(at: NonNull<u8>, size: usize) {
    #[cfg(target_os = "linux")]
    // SAFETY: the memory is ours; the advice changes nothing of what it holds.
    unsafe {
        libc::madvise(at.as_ptr().cast(), size, libc::MADV_HUGEPAGE);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = (at, size);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holds_what_a_vector_does() {
        for len in [0usize, 1, 1000, LARGE / 4 - 1, LARGE / 4, PAGE] {
            let mut buffer = Buffer::new(len, 2.5f32);
            assert!(buffer.len() == len && buffer.iter().all(|v| *v == 2.5));
            let begins = if 4 * len >= LARGE { PAGE } else { LINE };
            assert!(len == 0 || buffer.as_ptr().addr().is_multiple_of(begins), "{len}");
            if let Some(last) = buffer.last_mut() {
                *last = 1.0;
            }
            let mut values = buffer.into_vec();
            assert_eq!(values.last().copied(), (len > 0).then_some(1.0));
            values.reserve(7);
            let at = values.as_ptr();
            let buffer = Buffer::from(values);
            assert_eq!((buffer.len(), buffer.as_ptr()), (len, at));
            let values = buffer.into_vec();
            assert_eq!(values.as_ptr(), at);
        }
    }
}
