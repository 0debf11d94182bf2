//! What may follow `sim:`.

use stspp_hil_sim::world::{SceneSpec, SensorModel, list_scenes};

use super::boards::{self, BoardTour};
use crate::{Error, UriError};

/// Scene when none is named: the paper's Figure 2.
pub const DEFAULT_SCENE: &str = "sphere";

/// Options of the sensor; a scene has its own besides.
const KNOWN: &str =
    "seed, scale, bits, pace, rig, mcu, trigger_hz, and the scene's own (stspp list --scenes)";

/// Options of the sensor: name, default, what it does.
pub const SENSOR_OPTIONS: &[(&str, &str, &str)] = &[
    ("seed", "1", "dot layouts, tolerances and noise; a whole number"),
    ("scale", "1", "cameras with 1/scale of the pixels in each direction; 1, 2, 4, 8 or 16"),
    ("bits", "8", "bits of a pixel; 8, 10 or 12"),
    ("pace", "fast", "fast: time passes as frames are consumed; real: as on the wall"),
    ("rig", "default", "default, or a whole number for a rig with other optics and poses"),
    ("mcu", "none", "none: the firmware's logic in process; f330 or f350: its binary, emulated"),
    ("trigger_hz", "0", "edges a second at the controller's trigger-in; 0: nothing is connected"),
];

/// How fast simulated time passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pace {
    /// As fast as frames are consumed: nothing is ever too slow, and nothing is dropped.
    #[default]
    Fast,
    /// As fast as wall time, so that a slow consumer loses frames as it would with hardware.
    Real,
}

/// What runs the sensor's controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SimMcu {
    /// The firmware's logic, in process.
    #[default]
    InProcess,
    /// The firmware's binary on an emulated GD32F330, over its serial link.
    F330,
    /// The firmware's binary on an emulated GD32F350, over USB.
    F350,
}

/// A simulated sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct SimOptions {
    /// What stands before it.
    pub scene: SceneSpec,
    /// Name of the scene.
    pub scene_name: String,
    /// Seed of dot layouts, tolerances and noise.
    pub seed: u64,
    /// The cameras have 1/scale of the pixels in each direction.
    pub scale: usize,
    /// Bits of a pixel: 8, 10 or 12.
    pub bits: u8,
    /// How fast time passes.
    pub pace: Pace,
    /// Another rig, with perturbed optics and poses, for each seed.
    pub rig_seed: Option<u64>,
    /// What runs its controller.
    pub mcu: SimMcu,
    /// Rising edges a second at trigger-in, from a machine that is connected there; 0 for none.
    pub trigger_hz: f64,
}

impl SimOptions {
    /// The default sensor before `scene` (the default scene when `None`), with options as (name,
    /// value) pairs.
    ///
    /// # Errors
    /// An unknown scene or option, or a value that it does not take.
    pub fn parse(scene: Option<&str>, options: &[(String, String)]) -> Result<Self, Error> {
        let scene_name = scene.unwrap_or(DEFAULT_SCENE);
        let mut seed = 1;
        let mut scale = 1;
        let mut bits = 8;
        let mut pace = Pace::default();
        let mut rig_seed = None;
        let mut mcu = SimMcu::default();
        let mut trigger_hz = 0.0;
        let mut of_scene = Vec::new();
        for (name, value) in options {
            let wrong = |expected: &str| UriError::OptionValue {
                name: name.clone(),
                value: value.clone(),
                expected: expected.to_owned(),
            };
            let number = |expected| value.parse::<u64>().map_err(|_| wrong(expected));
            match name.as_str() {
                "seed" => seed = number("a whole number")?,
                "rig" if value == "default" => rig_seed = None,
                "rig" => rig_seed = Some(number("default or a whole number")?),
                "scale" => {
                    let expected = "1, 2, 4, 8 or 16";
                    scale = match number(expected)? {
                        scale @ (1 | 2 | 4 | 8 | 16) => scale as usize,
                        _ => return Err(wrong(expected).into()),
                    };
                }
                "bits" => {
                    bits = match value.as_str() {
                        "8" => 8,
                        "10" => 10,
                        "12" => 12,
                        _ => return Err(wrong("8, 10 or 12").into()),
                    };
                }
                "pace" => {
                    pace = match value.as_str() {
                        "fast" => Pace::Fast,
                        "real" => Pace::Real,
                        _ => return Err(wrong("fast or real").into()),
                    };
                }
                "mcu" => {
                    mcu = match value.as_str() {
                        "none" => SimMcu::InProcess,
                        "f330" => SimMcu::F330,
                        "f350" => SimMcu::F350,
                        _ => return Err(wrong("none, f330 or f350").into()),
                    };
                }
                "trigger_hz" => {
                    let expected = "a number of edges a second, at most 1000";
                    trigger_hz = match value.parse() {
                        Ok(hz @ 0.0..=1000.0) => hz,
                        _ => return Err(wrong(expected).into()),
                    };
                }
                _ => of_scene.push((name.as_str(), value.as_str())),
            }
        }
        if scene_name == boards::NAME {
            let tour = BoardTour::parse(&of_scene)?;
            let model = model(seed, scale, bits, rig_seed);
            let scene_name = scene_name.to_owned();
            let scene = tour.scene(&model);
            return Ok(Self {
                scene,
                scene_name,
                seed,
                scale,
                bits,
                pace,
                rig_seed,
                mcu,
                trigger_hz,
            });
        }
        let known = list_scenes().iter().find(|s| s.name == scene_name);
        let unknown = of_scene
            .iter()
            .find(|(name, _)| known.is_some_and(|s| !s.options.iter().any(|o| o.name == *name)));
        if let Some((name, _)) = unknown {
            let name = (*name).to_owned();
            return Err(UriError::OptionUnknown { scheme: "sim", name, known: KNOWN }.into());
        }
        let scene = SceneSpec::parse(scene_name, &of_scene)
            .map_err(|error| Error::Simulation(error.to_string()))?;
        let scene_name = scene_name.to_owned();
        Ok(Self { scene, scene_name, seed, scale, bits, pace, rig_seed, mcu, trigger_hz })
    }

    /// The sensor's optics and electronics.
    pub fn model(&self) -> SensorModel {
        model(self.seed, self.scale, self.bits, self.rig_seed)
    }
}

fn model(seed: u64, scale: usize, bits: u8, rig_seed: Option<u64>) -> SensorModel {
    let model = match rig_seed {
        Some(seed) => SensorModel::perturbed(seed),
        None => SensorModel::with_seed(seed),
    };
    let model = model.with_bits(bits);
    if scale > 1 { model.scaled_down(scale) } else { model }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SourceUri;

    fn parse(uri: &str) -> Result<SimOptions, String> {
        match uri.parse::<SourceUri>().unwrap() {
            SourceUri::Sim { scene, options } => {
                SimOptions::parse(scene.as_deref(), &options).map_err(|error| error.to_string())
            }
            _ => unreachable!(),
        }
    }

    #[test]
    fn options_of_sensor_and_scene_are_told_apart() {
        let options = parse("sim:plane?distance_m=1.5&seed=7&scale=4&bits=10&pace=real").unwrap();
        assert_eq!((options.seed, options.scale, options.bits), (7, 4, 10));
        assert_eq!(options.pace, Pace::Real);
        assert_eq!(options.scene.distance_m, 1.5);
        assert_eq!(options.model().left.width, 320);
        assert_eq!(parse("sim:").unwrap().scene_name, DEFAULT_SCENE);
    }

    #[test]
    fn what_is_wrong_is_named() {
        assert!(parse("sim:nowhere").unwrap_err().contains("nowhere"));
        assert!(parse("sim:plane?colour=red").unwrap_err().contains("colour"));
        assert!(parse("sim:plane?scale=3").unwrap_err().contains("1, 2, 4, 8 or 16"));
        assert!(parse("sim:plane?bits=9").unwrap_err().contains("8, 10 or 12"));
        assert!(parse("sim:plane?mcu=avr").unwrap_err().contains("f330 or f350"));
        assert!(parse("sim:plane?pace=slow").unwrap_err().contains("fast or real"));
        assert!(parse("sim:plane?trigger_hz=-1").unwrap_err().contains("edges a second"));
        assert!(parse("sim:plane?distance_m=far").unwrap_err().contains("distance_m"));
    }
}
