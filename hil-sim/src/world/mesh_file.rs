//! A user's mesh: OBJ, STL or PLY.

use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::Path;

use nalgebra::Vector3;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use super::error::WorldError;
use super::trimesh::{TriangleMesh, Triangles};

/// Files beyond this are not meant for a scene of 2 m.
const LARGEST_FILE: u64 = 1 << 30;
/// Sizes of a mesh that make sense before the sensor.
const SIZES_M: std::ops::RangeInclusive<f64> = 1e-3..=20.0;

/// Reads a mesh, multiplies it by `scale` and moves the middle of its box to the origin. Vertical
/// axis and front are the file's own.
pub(crate) fn load(path: &Path, scale: f64) -> Result<TriangleMesh, WorldError> {
    let fail = |problem: String| WorldError::Mesh { path: path.into(), problem };
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|file| file.take(LARGEST_FILE + 1).read_to_end(&mut bytes))
        .map_err(|e| fail(format!("cannot be read: {e}")))?;
    if bytes.len() as u64 > LARGEST_FILE {
        return Err(fail("is larger than 1 GiB; simplify it".into()));
    }
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    let triangles = match extension.as_str() {
        "obj" => obj(&bytes),
        "stl" => stl(&bytes),
        "ply" => ply(&bytes),
        other => Err(format!("has the extension \"{other}\"; obj, stl and ply can be read")),
    };
    triangles.and_then(|t| placed(t, scale)).map(TriangleMesh::new).map_err(fail)
}

fn obj(bytes: &[u8]) -> Result<Triangles, String> {
    let options = tobj::LoadOptions { triangulate: true, ..tobj::LoadOptions::default() };
    // Materials do not matter here, and their files are not looked for.
    let (models, _) = tobj::load_obj_buf(&mut Cursor::new(bytes), &options, |_| {
        Ok((Vec::new(), Default::default()))
    })
    .map_err(|e| format!("is not a valid OBJ file: {e}"))?;
    let mut all = Triangles::default();
    for model in models {
        let first = all.vertices.len() as u32;
        let positions = model.mesh.positions.chunks_exact(3);
        all.vertices.extend(positions.map(|p| Vector3::new(p[0], p[1], p[2])));
        let corners = model.mesh.indices.chunks_exact(3);
        all.indices.extend(corners.map(|t| [t[0] + first, t[1] + first, t[2] + first]));
    }
    Ok(all)
}

fn stl(bytes: &[u8]) -> Result<Triangles, String> {
    let mesh = stl_io::read_stl(&mut Cursor::new(bytes))
        .map_err(|e| format!("is not a valid STL file: {e}"))?;
    Ok(Triangles {
        vertices: mesh.vertices.iter().map(|v| Vector3::from(v.0.map(f64::from))).collect(),
        indices: mesh.faces.iter().map(|f| f.vertices.map(|i| i as u32)).collect(),
    })
}

/// What a PLY vertex holds of interest.
struct PlyVertex([f64; 3]);

/// What a PLY face holds of interest.
struct PlyFace(Vec<u32>);

impl PropertyAccess for PlyVertex {
    fn new() -> Self {
        Self([f64::NAN; 3])
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == name) else {
            return PropertyAccessResult::Ignored;
        };
        self.0[axis] = match property {
            Property::Float(v) => f64::from(v),
            Property::Double(v) => v,
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for PlyFace {
    fn new() -> Self {
        Self(Vec::new())
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        match property.to_u32_list() {
            Some(list) => {
                self.0 = list;
                PropertyAccessResult::Set
            }
            None => PropertyAccessResult::UnsupportedType,
        }
    }
}

fn ply(bytes: &[u8]) -> Result<Triangles, String> {
    let invalid = |e: &dyn std::fmt::Display| format!("is not a valid PLY file: {e}");
    let mut reader = Reader::new(BufReader::new(Cursor::new(bytes)));
    let vertices = Parser::<PlyVertex>::new();
    let faces = Parser::<PlyFace>::new();
    let header = vertices.read_header(&mut reader).map_err(|e| invalid(&e))?;
    for (name, element) in &header.elements {
        // Every element takes at least a byte: a larger count is a broken or hostile header.
        if element.count as u64 > bytes.len() as u64 {
            return Err(format!("announces {} {name} elements, which cannot fit", element.count));
        }
    }
    let mut all = Triangles::default();
    for (name, element) in &header.elements {
        if name == "vertex" {
            let list = vertices
                .read_payload_for_element(&mut reader, element, &header)
                .map_err(|e| invalid(&e))?;
            all.vertices = list.into_iter().map(|v| Vector3::from(v.0)).collect();
        } else {
            let list = faces
                .read_payload_for_element(&mut reader, element, &header)
                .map_err(|e| invalid(&e))?;
            if name == "face" {
                // Polygons as fans.
                all.indices = list
                    .iter()
                    .flat_map(|f| f.0.windows(2).skip(1).map(|w| [f.0[0], w[0], w[1]]))
                    .collect();
            }
        }
    }
    Ok(all)
}

/// Checks a mesh, drops what has no area, and brings it to size and place.
fn placed(mut mesh: Triangles, scale: f64) -> Result<Triangles, String> {
    let count = mesh.vertices.len();
    if mesh.indices.is_empty() {
        return Err(format!("holds {count} vertices but no triangles; a surface is needed"));
    }
    if let Some(t) = mesh.indices.iter().find(|t| t.iter().any(|&i| i as usize >= count)) {
        return Err(format!("has a face {t:?} beyond its {count} vertices"));
    }
    if let Some(i) = mesh.vertices.iter().position(|v| v.iter().any(|c| !c.is_finite())) {
        return Err(format!("has a vertex {i} without finite coordinates x, y, z"));
    }
    let (mut min, mut max) = (Vector3::repeat(f64::MAX), Vector3::repeat(f64::MIN));
    for &i in mesh.indices.iter().flatten() {
        min = min.inf(&mesh.vertices[i as usize]);
        max = max.sup(&mesh.vertices[i as usize]);
    }
    let size = (max - min).norm() * scale;
    if !SIZES_M.contains(&size) {
        let hint = if size > 20.0 { "0.001 if it is in millimetres" } else { "a larger one" };
        return Err(format!(
            "is {size:.3e} m large with scale {scale}; the option scale is metres per unit of the \
             file: give {hint}"
        ));
    }
    let middle = (min + max) / 2.0;
    mesh.vertices.iter_mut().for_each(|v| *v = (*v - middle) * scale);
    let vertices = &mesh.vertices;
    mesh.indices.retain(|t| {
        let [a, b, c] = t.map(|i| vertices[i as usize]);
        (b - a).cross(&(c - a)).norm() > 1e-16
    });
    if mesh.indices.is_empty() {
        return Err("holds only triangles without area".into());
    }
    Ok(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::noise::KeyedRng;

    const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\nf 1 2 5\n";
    const STL: &str = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n\
        vertex 0 1 0\nendloop\nendfacet\nendsolid s\n";
    const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\n\
        property float y\nproperty float z\nproperty uchar red\nelement face 1\n\
        property list uchar int vertex_indices\nend_header\n0 0 0 1\n1 0 0 2\n1 1 0 3\n0 1 0 4\n\
        4 0 1 2 3\n";

    fn binary_ply() -> Vec<u8> {
        let mut bytes = PLY
            .split("0 0 0 1")
            .next()
            .expect("a header")
            .replace("ascii", "binary_little_endian")
            .into_bytes();
        for [x, y, z] in [[0.0_f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]] {
            [x, y, z].iter().for_each(|c| bytes.extend(c.to_le_bytes()));
            bytes.push(7);
        }
        bytes.push(4);
        (0..4_i32).for_each(|i| bytes.extend(i.to_le_bytes()));
        bytes
    }

    fn binary_stl() -> Vec<u8> {
        let mut bytes = vec![0_u8; 80];
        bytes.extend(1_u32.to_le_bytes());
        for c in [0.0_f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0] {
            bytes.extend(c.to_le_bytes());
        }
        bytes.extend([0, 0]);
        bytes
    }

    type Format = fn(&[u8]) -> Result<Triangles, String>;

    fn samples() -> Vec<(&'static str, Format, Vec<u8>, usize)> {
        vec![
            ("obj", obj as Format, OBJ.into(), 3),
            ("ascii stl", stl, STL.into(), 1),
            ("binary stl", stl, binary_stl(), 1),
            ("ascii ply", ply, PLY.into(), 2),
            ("binary ply", ply, binary_ply(), 2),
        ]
    }

    #[test]
    fn all_formats_give_centred_and_scaled_triangles() {
        for (name, format, bytes, count) in samples() {
            let mesh = format(&bytes).and_then(|t| placed(t, 0.5)).expect(name);
            assert_eq!(mesh.indices.len(), count, "{name}");
            let widest = mesh.vertices.iter().map(|v| v.amax()).fold(0.0, f64::max);
            assert!((widest - 0.25).abs() < 1e-7, "{name}: {widest}");
        }
    }

    #[test]
    fn broken_files_are_refused_or_read_but_never_panic() {
        let mut rng = KeyedRng::new(21);
        for (_, format, bytes, _) in samples() {
            for cut in 0..bytes.len() {
                let _ = format(&bytes[..cut]).and_then(|t| placed(t, 1.0));
            }
            for _ in 0..600 {
                let mut broken = bytes.clone();
                for _ in 0..1 + rng.next_u64() % 4 {
                    let at = (rng.next_u64() % broken.len() as u64) as usize;
                    broken[at] = rng.next_u64() as u8;
                }
                let _ = format(&broken).and_then(|t| placed(t, 1.0)).map(TriangleMesh::new);
            }
        }
    }

    #[test]
    fn errors_name_the_file_and_the_problem() {
        let folder = std::env::temp_dir().join(format!("stspp-mesh-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let fails = |name: &str, content: &str, scale: f64| {
            let path = folder.join(name);
            std::fs::write(&path, content).expect("written");
            let error = load(&path, scale).err().expect("refused").to_string();
            assert!(error.contains(name), "{error}");
            error
        };
        assert!(fails("a.step", "x", 1.0).contains("obj, stl and ply"));
        assert!(fails("a.obj", "v 0 0 0\n", 1.0).contains("no triangles"));
        assert!(fails("b.obj", "v 0 0 0\nv 1 0 0\nf 1 2 9\n", 1.0).contains("valid OBJ"));
        assert!(
            fails("a.ply", &PLY.replace("0 1 2 3\n", "0 1 2 9\n"), 1.0).contains("beyond its 4")
        );
        assert!(
            fails("b.ply", &PLY.replace("vertex 4", "vertex 4000000000"), 1.0)
                .contains("cannot fit")
        );
        assert!(fails("c.ply", &PLY.replace("float z", "float depth"), 1.0).contains("finite"));
        assert!(fails("a.stl", STL, 1000.0).contains("millimetres"));
        assert!(fails("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", 1.0).contains("area"));
        let missing = load(&folder.join("none.stl"), 1.0).err().expect("refused").to_string();
        assert!(missing.contains("none.stl") && missing.contains("cannot be read"));
        std::fs::remove_dir_all(&folder).expect("removed");
    }
}
