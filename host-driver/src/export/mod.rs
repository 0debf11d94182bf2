//! Files that others read: point clouds, images, reports. All appear whole or not at all.

pub mod atomic;
pub mod colour;
pub mod folder;
pub mod images;
pub mod model;
pub mod outputs;
pub mod ply;
