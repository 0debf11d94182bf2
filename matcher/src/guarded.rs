//! Test buffers with a page on either side that stops the program: what a kernel reads or writes beyond
//! its slices is seen at every level, also by instructions that a memory checker does not know. Without
//! Unix they are plain ones.

#[cfg(not(unix))]
pub(crate) use plain::Guarded;
#[cfg(unix)]
pub(crate) use unix::Guarded;

/// Which end of a buffer lies at a page that must not be touched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Edge {
    Begin,
    End,
}

impl Edge {
    pub(crate) const BOTH: [Edge; 2] = [Edge::Begin, Edge::End];
}

#[cfg(unix)]
mod unix {
    use std::ops::{Deref, DerefMut};

    use libc::{MAP_ANONYMOUS, MAP_FAILED, MAP_PRIVATE, PROT_NONE, PROT_READ, PROT_WRITE};

    use super::Edge;

    /// A slice at such a page.
    #[derive(Debug)]
    pub(crate) struct Guarded<T: Copy> {
        pages: *mut libc::c_void,
        /// Length of all pages.
        bytes: usize,
        values: *mut T,
        len: usize,
    }

    impl<T: Copy> Guarded<T> {
        /// A copy of `values`.
        pub(crate) fn new(values: &[T], edge: Edge) -> Self {
            // SAFETY: asks for a number.
            let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) } as usize;
            let inner = size_of_val(values).next_multiple_of(page).max(page);
            let bytes = inner + 2 * page;
            let offset = match edge {
                Edge::Begin => page,
                Edge::End => page + inner - size_of_val(values),
            };
            // SAFETY: new pages, of which those between the outermost are made writable; the values lie within
            // them, at a multiple of their size from a page's begin or end.
            unsafe {
                let flags = MAP_PRIVATE | MAP_ANONYMOUS;
                let pages = libc::mmap(std::ptr::null_mut(), bytes, PROT_NONE, flags, -1, 0);
                assert!(pages != MAP_FAILED, "no pages");
                let writable = libc::mprotect(pages.byte_add(page), inner, PROT_READ | PROT_WRITE);
                assert!(writable == 0, "no writable pages");
                let to = pages.byte_add(offset).cast::<T>();
                to.copy_from_nonoverlapping(values.as_ptr(), values.len());
                Self { pages, bytes, values: to, len: values.len() }
            }
        }
    }

    impl<T: Copy> Deref for Guarded<T> {
        type Target = [T];

        fn deref(&self) -> &[T] {
            // SAFETY: as many values were written there.
            unsafe { std::slice::from_raw_parts(self.values, self.len) }
        }
    }

    impl<T: Copy> DerefMut for Guarded<T> {
        fn deref_mut(&mut self) -> &mut [T] {
            // SAFETY: as above, and they are this buffer's alone.
            unsafe { std::slice::from_raw_parts_mut(self.values, self.len) }
        }
    }

    impl<T: Copy> Drop for Guarded<T> {
        fn drop(&mut self) {
            // SAFETY: the pages are this buffer's, and nothing points to them any more.
            let freed = unsafe { libc::munmap(self.pages, self.bytes) };
            debug_assert_eq!(freed, 0);
        }
    }
}

#[cfg(not(unix))]
mod plain {
    use std::ops::{Deref, DerefMut};

    /// A slice.
    #[derive(Debug)]
    pub(crate) struct Guarded<T>(Vec<T>);

    impl<T: Copy> Guarded<T> {
        /// A copy of `values`.
        pub(crate) fn new(values: &[T], _edge: super::Edge) -> Self {
            Self(values.to_vec())
        }
    }

    impl<T> Deref for Guarded<T> {
        type Target = [T];

        fn deref(&self) -> &[T] {
            &self.0
        }
    }

    impl<T> DerefMut for Guarded<T> {
        fn deref_mut(&mut self) -> &mut [T] {
            &mut self.0
        }
    }
}
