//! Boards before the simulated sensor: images as its cameras would take them.

use nalgebra::Isometry3;
use stspp_hil_sim::world::{
    BoardTexture, LightInterval, LightSource, SceneSpec, SensorModel, World, WorldError,
};

use super::{Board, Pattern};
use crate::accuracy::capture::raw_of;
use crate::recording::StereoPair;

/// Exposure under the floodlight that shows a white board at 1 m with half of full scale.
pub const EXPOSURE_US: u64 = 30_000;

/// The board as a printed target of the simulator.
pub fn texture(board: &Board) -> BoardTexture {
    match board.pattern {
        Pattern::Charuco => {
            let (columns, rows, is_black) = board.modules();
            let module_m = board.size_m()[0] / columns as f64;
            BoardTexture::new(columns, rows, module_m, is_black)
        }
        Pattern::Circles => {
            let mut rings = vec![false; board.columns * board.rows];
            for (column, row) in board.hollow() {
                rings[row * board.columns + column] = true;
            }
            let radius_m = board.disc_radius_m().unwrap_or(0.0);
            BoardTexture::discs(
                board.columns,
                board.rows,
                board.pitch_m,
                radius_m,
                board.hole_radius_m(),
                rings,
            )
        }
    }
}

/// A stereo pair of `texture` at a pose, lit by the floodlight for `exposure_us`.
///
/// # Errors
/// For a sensor that cannot be simulated.
pub fn pair(
    texture: &BoardTexture,
    model: &SensorModel,
    left_from_board: &Isometry3<f64>,
    exposure_us: u64,
    seed: u64,
) -> Result<StereoPair, WorldError> {
    let rig_from_board = model.left_from_rig().inverse() * left_from_board;
    let world = World::new(&SceneSpec::board(texture.clone(), rig_from_board), model.clone())?;
    let close_ns = exposure_us * 1000;
    let light = LightInterval { source: LightSource::Floodlight, on_ns: 0, off_ns: close_ns };
    let (left, right) = world.expose_pair(0, close_ns, &[light], seed);
    Ok(StereoPair { left: raw_of(left), right: raw_of(right) })
}
