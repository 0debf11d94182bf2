//! Reference meshes: OBJ, STL and PLY files as triangles.

use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};

use nalgebra::Point3;

use crate::export::ply;

/// Largest file that is read.
const FILE_MAX: u64 = 4 << 30;
/// Most triangles: the search tree of more takes over 4 GiB.
const TRIANGLES_MAX: usize = 20_000_000;

/// A triangle's corners, metres.
pub type Triangle = [Point3<f64>; 3];

/// Why a mesh cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshFileError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The content is not what the name says.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        problem: String,
    },
}

/// What a reference file holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Reference {
    /// Triangles of a mesh.
    Mesh(Vec<Triangle>),
    /// Points of a cloud (a PLY file without faces).
    Cloud(Vec<Point3<f64>>),
}

/// Reads a reference and multiplies its coordinates by `scale` (0.001 for millimetres).
///
/// # Errors
/// Names the file and what is wrong.
pub fn read(path: &Path, scale: f64) -> Result<Reference, MeshFileError> {
    let content = |problem: String| MeshFileError::Content { path: path.to_owned(), problem };
    let opened = File::open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
    let (size, file) =
        opened.map_err(|source| MeshFileError::Read { path: path.to_owned(), source })?;
    if size > FILE_MAX {
        return Err(content("is larger than 4 GiB; simplify the mesh".into()));
    }
    let mut file = BufReader::new(file);
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    let scaled = |p: [f64; 3]| Point3::from(p.map(|c| c * scale));
    let (vertices, faces): (Vec<Point3<f64>>, Vec<[u32; 3]>) = match extension.as_str() {
        "ply" => {
            let mesh = ply::read_mesh(&mut file).map_err(|e| content(e.to_string()))?;
            (mesh.vertices.into_iter().map(scaled).collect(), mesh.faces)
        }
        "stl" => {
            let mesh = stl_io::read_stl(&mut file)
                .map_err(|e| content(format!("is not a valid STL file: {e}")))?;
            let faces = mesh.faces.iter().map(|f| f.vertices.map(|i| i as u32)).collect();
            (mesh.vertices.iter().map(|v| scaled(v.0.map(f64::from))).collect(), faces)
        }
        "obj" => obj(&mut file, &scaled).map_err(content)?,
        other => {
            let problem = format!("has the extension \"{other}\"; ply, stl and obj can be read");
            return Err(content(problem));
        }
    };
    if faces.is_empty() && extension == "ply" {
        return Ok(Reference::Cloud(vertices));
    }
    if faces.is_empty() {
        return Err(content("has no triangles".into()));
    }
    if faces.len() > TRIANGLES_MAX {
        let problem = format!(
            "has {} triangles, at most {TRIANGLES_MAX} are taken; simplify it",
            faces.len()
        );
        return Err(content(problem));
    }
    let triangles: Option<Vec<Triangle>> = faces
        .iter()
        .map(|f| {
            let [a, b, c] = f.map(|i| vertices.get(i as usize).copied());
            Some([a?, b?, c?])
        })
        .collect();
    triangles.map(Reference::Mesh).ok_or_else(|| content("a face names a missing vertex".into()))
}

type Indexed = (Vec<Point3<f64>>, Vec<[u32; 3]>);

fn obj(
    file: &mut BufReader<File>,
    scaled: &dyn Fn([f64; 3]) -> Point3<f64>,
) -> Result<Indexed, String> {
    let options = tobj::LoadOptions { triangulate: true, ..tobj::LoadOptions::default() };
    // Materials do not matter here, and their files are not looked for.
    let (models, _) = tobj::load_obj_buf(file, &options, |_| Ok((Vec::new(), Default::default())))
        .map_err(|e| format!("is not a valid OBJ file: {e}"))?;
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for model in models {
        let first = vertices.len() as u32;
        let positions = model.mesh.positions.chunks_exact(3);
        vertices.extend(positions.map(|p| scaled([p[0], p[1], p[2]])));
        let corners = model.mesh.indices.chunks_exact(3);
        faces.extend(corners.map(|t| [t[0] + first, t[1] + first, t[2] + first]));
    }
    Ok((vertices, faces))
}
