//! Light: scene, projectors, cameras, noise, ground truth.
