//! Where depth frames come from: `usb:`, `serial:`, `sim:` and `replay:`.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A parsed source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SourceUri {
    /// `usb:` (the only sensor) or `usb:SERIAL`, with `?OPTION=VALUE&...`.
    Usb {
        /// Serial number, where more than one sensor is plugged in.
        serial: Option<String>,
        /// Options in the order given; [`crate::sensor::open`] has their table.
        options: Vec<(String, String)>,
    },
    /// `serial:` (the only sensor at a USB bridge) or `serial:PATH`, such as `serial:/dev/ttyUSB0`, with
    /// `?OPTION=VALUE&...`.
    Serial {
        /// The port; found by probing when `None`.
        path: Option<PathBuf>,
        /// Options in the order given, as with `usb:`.
        options: Vec<(String, String)>,
    },
    /// `sim:`, `sim:SCENE` or `sim:SCENE?OPTION=VALUE&...`.
    Sim {
        /// Name of the scene, or the path of a mesh; the default scene when `None`.
        scene: Option<String>,
        /// Options in the order given.
        options: Vec<(String, String)>,
    },
    /// `replay:FOLDER` or `replay:FOLDER?OPTION=VALUE&...`: a recording.
    Replay {
        /// The recording folder.
        folder: PathBuf,
        /// Options in the order given.
        options: Vec<(String, String)>,
    },
}

/// Why a source is not understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UriError {
    /// It has no scheme, or one that is not known.
    #[error(
        "{uri:?} names no source: expected usb:, usb:SERIAL, serial:, serial:PORT, sim:, sim:SCENE or replay:FOLDER"
    )]
    Scheme {
        /// What was given.
        uri: String,
    },
    /// The part after the scheme is missing.
    #[error("{uri:?} lacks {what} after the colon, as in {example}")]
    Missing {
        /// What was given.
        uri: String,
        /// What should be there.
        what: &'static str,
        /// A complete source.
        example: &'static str,
    },
    /// An option is not `NAME=VALUE`.
    #[error("option {option:?} in {uri:?} should be NAME=VALUE")]
    OptionSyntax {
        /// What was given.
        uri: String,
        /// The option.
        option: String,
    },
    /// The source does not have this option.
    #[error("{scheme}: has no option {name:?}; it has {known}")]
    OptionUnknown {
        /// The scheme.
        scheme: &'static str,
        /// The option's name.
        name: String,
        /// Names it could have.
        known: &'static str,
    },
    /// An option's value is not what it takes.
    #[error("option {name}={value} should be {expected}")]
    OptionValue {
        /// The option's name.
        name: String,
        /// Its value.
        value: String,
        /// What it takes.
        expected: String,
    },
}

impl FromStr for SourceUri {
    type Err = UriError;

    fn from_str(uri: &str) -> Result<Self, UriError> {
        let unknown = || UriError::Scheme { uri: uri.to_owned() };
        let (scheme, rest) = uri.split_once(':').ok_or_else(unknown)?;
        let missing = |what, example| UriError::Missing { uri: uri.to_owned(), what, example };
        match scheme {
            "usb" => {
                let (serial, options) = split_options(uri, rest)?;
                Ok(Self::Usb { serial: (!serial.is_empty()).then(|| serial.to_owned()), options })
            }
            "serial" => {
                let (path, options) = split_options(uri, rest)?;
                Ok(Self::Serial { path: (!path.is_empty()).then(|| path.into()), options })
            }
            "sim" => {
                let (scene, options) = split_options(uri, rest)?;
                Ok(Self::Sim { scene: (!scene.is_empty()).then(|| scene.to_owned()), options })
            }
            "replay" => {
                // A folder's name may hold a question mark; an existing folder wins.
                if !rest.is_empty() && std::path::Path::new(rest).is_dir() {
                    return Ok(Self::Replay { folder: rest.into(), options: Vec::new() });
                }
                let (folder, options) = split_options(uri, rest)?;
                if folder.is_empty() {
                    return Err(missing("a recording folder", "replay:recordings/plane"));
                }
                Ok(Self::Replay { folder: folder.into(), options })
            }
            _ => Err(unknown()),
        }
    }
}

type Options = Vec<(String, String)>;

fn split_options<'a>(uri: &str, rest: &'a str) -> Result<(&'a str, Options), UriError> {
    let Some((path, query)) = rest.split_once('?') else { return Ok((rest, Vec::new())) };
    let options = query
        .split('&')
        .filter(|option| !option.is_empty())
        .map(|option| {
            let (name, value) = option
                .split_once('=')
                .filter(|(name, _)| !name.is_empty())
                .ok_or(UriError::OptionSyntax { uri: uri.to_owned(), option: option.to_owned() })?;
            Ok((name.to_owned(), value.to_owned()))
        })
        .collect::<Result<_, UriError>>()?;
    Ok((path, options))
}

impl fmt::Display for SourceUri {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let with_options = |f: &mut fmt::Formatter<'_>, options: &[(String, String)]| {
            for (k, (name, value)) in options.iter().enumerate() {
                write!(f, "{}{name}={value}", if k == 0 { '?' } else { '&' })?;
            }
            Ok(())
        };
        match self {
            Self::Usb { serial, options } => {
                write!(f, "usb:{}", serial.as_deref().unwrap_or_default())?;
                with_options(f, options)
            }
            Self::Serial { path, options } => {
                write!(f, "serial:{}", path.as_deref().unwrap_or(Path::new("")).display())?;
                with_options(f, options)
            }
            Self::Sim { scene, options } => {
                write!(f, "sim:{}", scene.as_deref().unwrap_or_default())?;
                with_options(f, options)
            }
            Self::Replay { folder, options } => {
                write!(f, "replay:{}", folder.display())?;
                with_options(f, options)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn parse(uri: &str) -> Result<SourceUri, UriError> {
        uri.parse()
    }

    #[test]
    fn every_scheme_is_understood() {
        assert_eq!(parse("usb:"), Ok(SourceUri::Usb { serial: None, options: vec![] }));
        assert_eq!(
            parse("usb:A1?calibration=a.yaml"),
            Ok(SourceUri::Usb {
                serial: Some("A1".into()),
                options: vec![("calibration".into(), "a.yaml".into())],
            })
        );
        assert_eq!(parse("serial:"), Ok(SourceUri::Serial { path: None, options: vec![] }));
        assert_eq!(
            parse("serial:/dev/ttyUSB0"),
            Ok(SourceUri::Serial { path: Some("/dev/ttyUSB0".into()), options: vec![] })
        );
        assert_eq!(parse("sim:"), Ok(SourceUri::Sim { scene: None, options: vec![] }));
        assert_eq!(
            parse("sim:plane?distance_m=1.5&seed=7"),
            Ok(SourceUri::Sim {
                scene: Some("plane".into()),
                options: vec![("distance_m".into(), "1.5".into()), ("seed".into(), "7".into())],
            })
        );
        assert_eq!(
            parse("replay:some/folder"),
            Ok(SourceUri::Replay { folder: "some/folder".into(), options: vec![] })
        );
    }

    #[test]
    fn what_is_wrong_is_named() {
        let message = |uri: &str| parse(uri).unwrap_err().to_string();
        assert!(message("plane").contains("expected usb:"));
        assert!(message("http://x").contains("names no source"));
        assert!(message("replay:").contains("lacks a recording folder"));
        assert!(message("sim:plane?seed").contains("\"seed\""));
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_refused_and_round_trips(text in "\\PC{0,40}") {
            let schemes = ["", "sim:", "replay:", "usb:", "serial:"];
            for uri in schemes.map(|scheme| format!("{scheme}{text}")) {
                if let Ok(parsed) = parse(&uri) {
                    prop_assert_eq!(parse(&parsed.to_string()), Ok(parsed));
                }
            }
        }
    }
}
