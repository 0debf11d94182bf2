//! What can be wrong with a scene or a sensor model.

use std::path::PathBuf;

/// Why a [`World`](super::World) cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorldError {
    /// No scene has this name.
    #[error("there is no scene \"{name}\"; the scenes are {known}")]
    UnknownScene {
        /// What was asked for.
        name: String,
        /// All names, comma separated.
        known: String,
    },
    /// The scene exists but has no such option.
    #[error("scene \"{scene}\" has no option \"{option}\"; its options are {known}")]
    UnknownOption {
        /// The scene.
        scene: &'static str,
        /// What was asked for.
        option: String,
        /// All options, comma separated.
        known: String,
    },
    /// An option's value is malformed or out of range.
    #[error("scene \"{scene}\": option {option}={value} is not {expected}")]
    BadOption {
        /// The scene.
        scene: &'static str,
        /// The option.
        option: &'static str,
        /// Its value as given.
        value: String,
        /// What would be right.
        expected: String,
    },
    /// An option that the scene cannot do without is missing.
    #[error("scene \"{scene}\" needs the option {option} ({expected})")]
    MissingOption {
        /// The scene.
        scene: &'static str,
        /// The option.
        option: &'static str,
        /// What it holds.
        expected: &'static str,
    },
    /// The mesh file cannot be used.
    #[error("mesh {}: {problem}", path.display())]
    Mesh {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what to do.
        problem: String,
    },
    /// The sensor model contradicts physics or itself.
    #[error("sensor model: {0}")]
    Model(String),
}
