//! Fused models as PLY and E57.

use std::io::{self, Cursor, Write};

use e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};

use crate::fuse::{Model, ModelPoint};

/// Writes a model as binary PLY: float x y z in metres and nx ny nz, float noise_mm, uchar intensity and
/// views.
///
/// # Errors
/// From `out`.
pub fn write_ply(out: &mut dyn Write, points: &[ModelPoint]) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment unit metre\n\
         comment frame of the first view: left camera (cam0), +x right, +y down, +z forward\n\
         comment noise_mm: one standard deviation along the normal by the noise model\n\
         element vertex {}\n\
         property float x\nproperty float y\nproperty float z\n\
         property float nx\nproperty float ny\nproperty float nz\n\
         property float noise_mm\nproperty uchar intensity\nproperty uchar views\nend_header\n",
        points.len()
    )?;
    for p in points {
        let mut bytes = [0; 30];
        let (at, n) = (p.point_m.cast::<f32>(), p.normal);
        for (k, value) in [at.x, at.y, at.z, n.x, n.y, n.z, p.noise_mm].into_iter().enumerate() {
            bytes[4 * k..4 * k + 4].copy_from_slice(&value.to_le_bytes());
        }
        (bytes[28], bytes[29]) = (p.intensity, p.views);
        out.write_all(&bytes)?;
    }
    Ok(())
}

/// Writes a model as ASTM E57: one cloud with cartesian coordinates in metres and intensity.
///
/// # Errors
/// From `out` or the encoder.
pub fn write_e57(out: &mut dyn Write, model: &Model) -> io::Result<()> {
    let mut file = Cursor::new(Vec::new());
    encode(&mut file, model).map_err(io::Error::other)?;
    out.write_all(file.get_ref())
}

fn encode(file: &mut Cursor<Vec<u8>>, model: &Model) -> e57::Result<()> {
    // Names that tell two different models apart: hashes of where their points are.
    let [first, second] = [1, 2].map(|salt| guid(model, salt));
    let mut writer = E57Writer::new(file, &first)?;
    let prototype = vec![
        Record::CARTESIAN_X_F32,
        Record::CARTESIAN_Y_F32,
        Record::CARTESIAN_Z_F32,
        Record {
            name: RecordName::Intensity,
            data_type: RecordDataType::Integer { min: 0, max: 255 },
        },
    ];
    let mut cloud = writer.add_pointcloud(&second, prototype)?;
    cloud.set_name(Some("fused model".into()));
    cloud.set_description(Some(format!("{} views fused by stspp", model.first_from_view.len())));
    for p in &model.points {
        let at = p.point_m.cast::<f32>();
        cloud.add_point(vec![
            RecordValue::Single(at.x),
            RecordValue::Single(at.y),
            RecordValue::Single(at.z),
            RecordValue::Integer(i64::from(p.intensity)),
        ])?;
    }
    cloud.finalize()?;
    writer.finalize()
}

/// An identifier of a model's points in the form of a UUID.
fn guid(model: &Model, salt: u64) -> String {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64 ^ salt;
    for p in &model.points {
        for c in p.point_m.coords.iter() {
            hash = (hash ^ c.to_bits()).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23);
        }
    }
    let low = hash.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    format!(
        "{{{:08x}-{:04x}-{:04x}-{:04x}-{:012x}}}",
        hash >> 32,
        hash >> 16 & 0xffff,
        hash & 0xffff,
        low >> 48,
        low & 0xffff_ffff_ffff
    )
}
