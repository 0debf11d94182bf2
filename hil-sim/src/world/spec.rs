//! Scenes by name, as the command line and `sim:` addresses give them.

use std::path::PathBuf;

use nalgebra::Isometry3;

use super::board::BoardTexture;
use super::error::WorldError;

/// A scene that [`SceneSpec::parse`] knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneInfo {
    /// Its name.
    pub name: &'static str,
    /// What it shows.
    pub summary: &'static str,
    /// Its options.
    pub options: &'static [OptionInfo],
}

/// An option of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OptionInfo {
    /// Its name, with the unit.
    pub name: &'static str,
    /// Its value when not given.
    pub default: &'static str,
    /// What it does and which values it takes.
    pub summary: &'static str,
}

const MATERIAL: OptionInfo = OptionInfo {
    name: "material",
    default: "lambertian",
    summary: "lambertian, glossy (paint with a clear coat) or metal (satin)",
};
const ALBEDO: OptionInfo = OptionInfo {
    name: "albedo",
    default: "0.8",
    summary: "share of the light that is scattered back, 0.01 to 1",
};
const TILT: OptionInfo = OptionInfo {
    name: "tilt_deg",
    default: "0",
    summary: "turned about the horizontal axis, -75 to 75; positive tilts the upper edge away",
};
const TURN: OptionInfo = OptionInfo {
    name: "turn_deg",
    default: "0",
    summary: "turned about the vertical axis, -180 to 180",
};

const SHIFT_X: OptionInfo =
    OptionInfo { name: "x_mm", default: "0", summary: "shifted to the right, -2000 to 2000" };
const SHIFT_Y: OptionInfo =
    OptionInfo { name: "y_mm", default: "0", summary: "shifted down, -2000 to 2000" };

const fn distance(default: &'static str) -> OptionInfo {
    OptionInfo {
        name: "distance_m",
        default,
        summary: "distance of the object's middle from the sensor, 0.3 to 5",
    }
}

/// All scenes, each in the order of its options' importance.
static SCENES: &[SceneInfo] = &[
    SceneInfo {
        name: "plane",
        summary: "a matt plane that fills the field",
        options: &[distance("1.0"), TILT, TURN, MATERIAL, ALBEDO],
    },
    SceneInfo {
        name: "sphere",
        summary: "a sphere of 75 mm radius before a plane (paper, Figure 2)",
        options: &[
            distance("0.95"),
            OptionInfo {
                name: "plane_m",
                default: "1.1",
                summary: "distance of the plane, 0.3 to 5",
            },
            OptionInfo {
                name: "radius_mm",
                default: "75",
                summary: "radius of the sphere, 1 to 500",
            },
            MATERIAL,
            ALBEDO,
        ],
    },
    SceneInfo {
        name: "statue",
        summary: "a plaster bust of 0.7 m with curls, eyes and drapery (paper, Figures 3 and 4)",
        options: &[distance("1.2"), TILT, TURN, MATERIAL, ALBEDO],
    },
    SceneInfo {
        name: "turntable",
        summary: "the statue turning about its axis (paper, Figure 6)",
        options: &[
            distance("1.2"),
            OptionInfo {
                name: "rpm",
                default: "1.2",
                summary: "turns a minute, -60 to 60; positive turns its front to the sensor's right",
            },
            TURN,
            MATERIAL,
            ALBEDO,
        ],
    },
    SceneInfo {
        name: "part",
        summary: "an industrial part with circles of radius 3, 10, 15 and 50 mm (paper, Figure 7)",
        options: &[
            distance("0.9"),
            OptionInfo { default: "8", ..TILT },
            OptionInfo { default: "-6", ..TURN },
            MATERIAL,
            ALBEDO,
        ],
    },
    SceneInfo {
        name: "panel",
        summary: "a curved panel of 0.87 x 0.63 m like a car door's (paper, Figure 8)",
        options: &[distance("1.6"), TILT, TURN, SHIFT_X, SHIFT_Y, MATERIAL, ALBEDO],
    },
    SceneInfo {
        name: "wires",
        summary: "rods of 3 mm and strips at many depths before a plane",
        options: &[distance("1.0"), MATERIAL, ALBEDO],
    },
    SceneInfo {
        name: "board",
        summary: "a chessboard, for calibration under the floodlight",
        options: &[
            distance("1.0"),
            TILT,
            TURN,
            OptionInfo {
                name: "roll_deg",
                default: "0",
                summary: "turned about its normal, -180 to 180",
            },
            SHIFT_X,
            SHIFT_Y,
            OptionInfo { name: "columns", default: "11", summary: "squares across, 2 to 100" },
            OptionInfo { name: "rows", default: "8", summary: "squares down, 2 to 100" },
            OptionInfo { name: "square_mm", default: "40", summary: "side of a square, 1 to 500" },
        ],
    },
    SceneInfo {
        name: "mesh",
        summary: "a mesh from an OBJ, STL or PLY file",
        options: &[
            OptionInfo { name: "path", default: "", summary: "the file" },
            OptionInfo {
                name: "scale",
                default: "1",
                summary: "metres per unit of the file: 0.001 for millimetres",
            },
            OptionInfo {
                name: "up",
                default: "y",
                summary: "the file's upward axis: y (front along z) or z (front along -y)",
            },
            distance("1.0"),
            TILT,
            TURN,
            SHIFT_X,
            SHIFT_Y,
            MATERIAL,
            ALBEDO,
        ],
    },
    SceneInfo {
        name: "moving-plane",
        summary: "a plane moving along the sensor's z axis (paper, Figure 6)",
        options: &[
            distance("0.9"),
            OptionInfo {
                name: "speed_mm_s",
                default: "9",
                summary: "speed, -1000 to 1000; positive moves away from the sensor",
            },
            TILT,
            TURN,
            MATERIAL,
            ALBEDO,
        ],
    },
];

/// All scenes.
#[must_use]
pub fn list_scenes() -> &'static [SceneInfo] {
    SCENES
}

/// What to put before the sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneSpec {
    pub(crate) kind: SceneKind,
    /// Distance of the object's middle from the sensor's origin along its z axis.
    pub distance_m: f64,
    /// Turned about the horizontal axis; positive tilts the upper edge away.
    pub tilt_deg: f64,
    /// Turned about the vertical axis.
    pub turn_deg: f64,
    /// Turned about its own normal.
    pub roll_deg: f64,
    /// Shifted to the right and down.
    pub shift_m: [f64; 2],
    /// How its surface reflects.
    pub material: MaterialKind,
    /// Share of the light that is scattered back.
    pub albedo: f64,
}

/// The scene and what only it has.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SceneKind {
    Plane,
    Sphere { plane_m: f64, radius_m: f64 },
    MovingPlane { speed_m_per_s: f64 },
    Statue { rpm: f64 },
    Part,
    Panel,
    Wires,
    Board { texture: BoardTexture, rig_from_board: Option<Isometry3<f64>> },
    BoardTour { texture: BoardTexture, rig_from_board: Vec<Isometry3<f64>>, dwell_s: f64 },
    Mesh { path: PathBuf, scale: f64, is_z_up: bool },
}

/// How surfaces reflect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum MaterialKind {
    /// Matt: the same radiance in all directions.
    #[default]
    Lambertian,
    /// Paint under a clear coat: matt with a highlight.
    Glossy,
    /// Satin metal: mostly a broad highlight.
    Metal,
}

impl SceneSpec {
    /// A scene by name with options as (name, value) pairs; [`list_scenes`] lists both.
    ///
    /// # Errors
    /// An unknown name or option, or a value that is malformed or out of range.
    pub fn parse(name: &str, options: &[(&str, &str)]) -> Result<Self, WorldError> {
        let info = list_scenes().iter().find(|s| s.name == name).ok_or_else(|| {
            WorldError::UnknownScene {
                name: name.into(),
                known: join(list_scenes().iter().map(|s| s.name)),
            }
        })?;
        for (option, _) in options {
            if !info.options.iter().any(|o| o.name == *option) {
                return Err(WorldError::UnknownOption {
                    scene: info.name,
                    option: (*option).into(),
                    known: join(info.options.iter().map(|o| o.name)),
                });
            }
        }
        let given = Given { info, options };
        let kind = match info.name {
            "sphere" => SceneKind::Sphere {
                plane_m: given.number("plane_m", 0.3, 5.0)?,
                radius_m: given.number("radius_mm", 1.0, 500.0)? * 1e-3,
            },
            "statue" | "turntable" => SceneKind::Statue { rpm: given.number("rpm", -60.0, 60.0)? },
            "part" => SceneKind::Part,
            "panel" => SceneKind::Panel,
            "wires" => SceneKind::Wires,
            "board" => SceneKind::Board {
                texture: BoardTexture::chessboard(
                    given.number("columns", 2.0, 100.0)? as usize,
                    given.number("rows", 2.0, 100.0)? as usize,
                    given.number("square_mm", 1.0, 500.0)? * 1e-3,
                ),
                rig_from_board: None,
            },
            "mesh" => SceneKind::Mesh {
                path: given.path()?,
                scale: given.number("scale", 1e-9, 1e9)?,
                is_z_up: given.choice("up", &["y", "z"])? == 1,
            },
            "moving-plane" => SceneKind::MovingPlane {
                speed_m_per_s: given.number("speed_mm_s", -1000.0, 1000.0)? * 1e-3,
            },
            _ => SceneKind::Plane,
        };
        Ok(Self {
            kind,
            distance_m: given.number("distance_m", 0.3, 5.0)?,
            tilt_deg: given.number("tilt_deg", -75.0, 75.0)?,
            turn_deg: given.number("turn_deg", -180.0, 180.0)?,
            roll_deg: given.number("roll_deg", -180.0, 180.0)?,
            shift_m: [
                given.number("x_mm", -2000.0, 2000.0)? * 1e-3,
                given.number("y_mm", -2000.0, 2000.0)? * 1e-3,
            ],
            material: given.material()?,
            albedo: given.number("albedo", 0.01, 1.0)?,
        })
    }
}

impl SceneSpec {
    /// A printed target at a pose in the sensor's frame
    /// (see [`SensorModel::left_from_rig`](super::SensorModel::left_from_rig)). A target that faces
    /// the sensor upright has the identity rotation: its x is to the right, its y down.
    #[must_use]
    pub fn board(texture: BoardTexture, rig_from_board: Isometry3<f64>) -> Self {
        Self::of_board(
            SceneKind::Board { texture, rig_from_board: Some(rig_from_board) },
            rig_from_board.translation.z,
        )
    }

    /// A printed target that is held still at each of these poses in turn for `dwell_s`, then from
    /// the first again.
    ///
    /// # Panics
    /// Without a pose, or when `dwell_s` is not positive.
    #[must_use]
    pub fn board_tour(
        texture: BoardTexture,
        rig_from_board: Vec<Isometry3<f64>>,
        dwell_s: f64,
    ) -> Self {
        assert!(!rig_from_board.is_empty() && dwell_s > 0.0, "a tour has poses and takes time");
        let distance_m = rig_from_board[0].translation.z;
        Self::of_board(SceneKind::BoardTour { texture, rig_from_board, dwell_s }, distance_m)
    }

    fn of_board(kind: SceneKind, distance_m: f64) -> Self {
        Self {
            kind,
            distance_m,
            tilt_deg: 0.0,
            turn_deg: 0.0,
            roll_deg: 0.0,
            shift_m: [0.0; 2],
            material: MaterialKind::Lambertian,
            albedo: 0.8,
        }
    }
}

/// A scene's options as given, over its defaults.
struct Given<'a> {
    info: &'static SceneInfo,
    options: &'a [(&'a str, &'a str)],
}

impl Given<'_> {
    /// The last value given, or the default. `None` for an option that the scene does not have.
    fn text(&self, option: &str) -> Option<(&'static str, &str)> {
        let info = self.info.options.iter().find(|o| o.name == option)?;
        let given = self.options.iter().rev().find(|(name, _)| *name == option);
        Some((info.name, given.map_or(info.default, |(_, value)| value)))
    }

    /// A number within limits; 0 for an option that the scene does not have.
    fn number(&self, option: &str, min: f64, max: f64) -> Result<f64, WorldError> {
        let Some((option, text)) = self.text(option) else { return Ok(0.0) };
        text.parse().ok().filter(|v: &f64| (min..=max).contains(v)).ok_or_else(|| {
            WorldError::BadOption {
                scene: self.info.name,
                option,
                value: text.into(),
                expected: format!("a number from {min} to {max}"),
            }
        })
    }

    /// The index of the given word among `words`.
    fn choice(&self, option: &str, words: &[&str]) -> Result<usize, WorldError> {
        let Some((option, text)) = self.text(option) else { return Ok(0) };
        words.iter().position(|w| *w == text).ok_or_else(|| WorldError::BadOption {
            scene: self.info.name,
            option,
            value: text.into(),
            expected: format!("one of {}", join(words.iter().copied())),
        })
    }

    fn material(&self) -> Result<MaterialKind, WorldError> {
        let kinds = [MaterialKind::Lambertian, MaterialKind::Glossy, MaterialKind::Metal];
        Ok(kinds[self.choice("material", &["lambertian", "glossy", "metal"])?])
    }

    fn path(&self) -> Result<PathBuf, WorldError> {
        match self.text("path") {
            Some((_, path)) if !path.is_empty() => Ok(path.into()),
            _ => Err(WorldError::MissingOption {
                scene: self.info.name,
                option: "path",
                expected: "an OBJ, STL or PLY file",
            }),
        }
    }
}

fn join<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scene_parses_with_its_defaults() {
        for info in list_scenes() {
            let spec = SceneSpec::parse(info.name, &[]);
            let needs_path = info.options.iter().any(|o| o.name == "path");
            assert!(spec.is_ok() || needs_path, "{}: {spec:?}", info.name);
        }
    }

    #[test]
    fn options_are_read_and_the_last_one_wins() {
        let spec = SceneSpec::parse("plane", &[("distance_m", "1.5"), ("distance_m", "2")]);
        assert_eq!(spec.expect("valid").distance_m, 2.0);
        let spec = SceneSpec::parse("moving-plane", &[("speed_mm_s", "-12.5")]).expect("valid");
        assert_eq!(spec.kind, SceneKind::MovingPlane { speed_m_per_s: -0.0125 });
    }

    #[test]
    fn errors_name_what_is_wrong_and_what_is_possible() {
        fn text(name: &str, options: &[(&str, &str)]) -> String {
            SceneSpec::parse(name, options).expect_err("invalid").to_string()
        }
        assert!(text("statu", &[]).contains("plane, sphere"));
        let unknown = text("plane", &[("speed_mm_s", "9")]);
        assert!(unknown.contains("speed_mm_s") && unknown.contains("distance_m"));
        for value in ["far", "", "NaN", "inf", "-1", "100"] {
            let options = [("distance_m", value)];
            let bad = text("plane", &options);
            assert!(bad.contains("distance_m") && bad.contains("0.3 to 5"), "{bad}");
        }
        assert!(text("plane", &[("material", "wood")]).contains("glossy"));
    }
}
