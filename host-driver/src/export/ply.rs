//! Point clouds as binary PLY: float x y z in metres in the left camera's frame, float zncc, uchar
//! intensity, and float depth_rate in metres per second along +z where the cloud has it.

use std::io::{self, BufRead, Write};

use nalgebra::Point3;

use crate::PointCloud;

/// Longest header that is read, in lines.
const HEADER_LINES_MAX: usize = 200;
/// Longest header line that is read, in bytes.
const HEADER_LINE_MAX: u64 = 1024;
/// Most bytes of a point as [`write`] writes it.
const POINT_BYTES: usize = 21;

/// Writes a cloud.
///
/// # Errors
/// From `out`.
pub fn write(out: &mut dyn Write, cloud: &PointCloud) -> io::Result<()> {
    let rates = &cloud.depth_rate_m_per_s;
    let (comment, property) = if rates.is_empty() {
        ("", "")
    } else {
        (
            "comment depth_rate is the speed along +z in metre per second\n",
            "property float depth_rate\n",
        )
    };
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment unit metre\n\
         comment frame left camera (cam0, unrectified) optical: +x right, +y down, +z forward\n\
         comment zncc is the similarity of the matched subset, intensity that of the left camera\n\
         {comment}\
         element vertex {}\n\
         property float x\nproperty float y\nproperty float z\n\
         property float zncc\nproperty uchar intensity\n{property}end_header\n",
        cloud.len()
    )?;
    let mut bytes = Vec::with_capacity(POINT_BYTES * 4096);
    let points = cloud.points_left_m.iter().zip(&cloud.zncc).zip(&cloud.intensity);
    for (i, ((point, zncc), intensity)) in points.enumerate() {
        for value in [point.x, point.y, point.z, *zncc] {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        bytes.push(*intensity);
        if let Some(rate) = rates.get(i) {
            bytes.extend_from_slice(&rate.to_le_bytes());
        }
        if bytes.len() + POINT_BYTES > bytes.capacity() {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)
}

/// Why a PLY file could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlyError {
    /// The source cannot be read.
    #[error("cannot be read: {0}")]
    Read(#[from] io::Error),
    /// The header is not one of a point cloud.
    #[error("header line {line}: expected {expected}, got `{got}`")]
    Header {
        /// Line, from 1.
        line: usize,
        /// What was expected.
        expected: &'static str,
        /// The line.
        got: String,
    },
    /// The points end early or hold no number.
    #[error("point {index} of {count}: {reason}")]
    Point {
        /// Index of the point.
        index: usize,
        /// Points that the header announces.
        count: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// A face is none.
    #[error("face {index} of {count}: {reason}")]
    Face {
        /// Index of the face.
        index: usize,
        /// Faces that the header announces.
        count: usize,
        /// What is wrong.
        reason: &'static str,
    },
}

/// Writes points with a colour and a signed deviation each, for viewers: float x y z in metres, float
/// deviation_mm, uchar red green blue.
///
/// # Errors
/// From `out`.
pub fn write_coloured(
    out: &mut dyn Write,
    points_m: &[Point3<f64>],
    deviation_m: &[f64],
    colours: &[[u8; 3]],
) -> io::Result<()> {
    let count = points_m.len().min(deviation_m.len()).min(colours.len());
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\n\
         comment unit metre, deviation in millimetres, nan where the reference is far\n\
         element vertex {count}\n\
         property float x\nproperty float y\nproperty float z\nproperty float deviation_mm\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )?;
    for ((point, deviation), colour) in points_m.iter().zip(deviation_m).zip(colours) {
        let mut bytes = [0; 19];
        for (k, value) in [point.x, point.y, point.z, deviation * 1e3].into_iter().enumerate() {
            bytes[4 * k..4 * k + 4].copy_from_slice(&(value as f32).to_le_bytes());
        }
        bytes[16..].copy_from_slice(colour);
        out.write_all(&bytes)?;
    }
    Ok(())
}

#[derive(Clone, Copy, PartialEq)]
enum Format {
    Ascii,
    Little,
    Big,
}

/// A scalar property: its role and its type.
#[derive(Clone, Copy)]
struct Property {
    role: Option<usize>,
    kind: Kind,
}

#[derive(Clone, Copy)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value of `bytes`, which are as many as [`Self::size`].
    fn decode(self, bytes: &[u8], big: bool) -> f64 {
        let mut le = [0_u8; 8];
        le[..bytes.len()].copy_from_slice(bytes);
        if big {
            le[..bytes.len()].reverse();
        }
        let [a, b, c, d, ..] = le;
        match self {
            Self::I8 => f64::from(a.cast_signed()),
            Self::U8 => f64::from(a),
            Self::I16 => f64::from(i16::from_le_bytes([a, b])),
            Self::U16 => f64::from(u16::from_le_bytes([a, b])),
            Self::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Self::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Self::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Self::F64 => f64::from_le_bytes(le),
        }
    }
}

/// Roles of properties in the order of a point's values.
const ROLES: [&str; 5] = ["x", "y", "z", "zncc", "intensity"];

/// Reads the points of a PLY file, ours or another program's: ASCII or binary, positions of any scalar
/// type. Missing ZNCC is 1, missing intensity 255. Elements after the points are left unread.
///
/// # Errors
/// Names the header line or the point.
pub fn read(source: &mut dyn BufRead) -> Result<PointCloud, PlyError> {
    let header = read_header(source)?;
    let mut cloud = PointCloud::default();
    read_points(source, &header, &mut |[x, y, z, zncc, intensity]| {
        cloud.points_left_m.push(Point3::new(x as f32, y as f32, z as f32));
        cloud.zncc.push(zncc as f32);
        cloud.intensity.push(intensity as u8);
    })?;
    Ok(cloud)
}

/// Vertices and triangles of a PLY file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PlyMesh {
    /// Positions in the file's units.
    pub vertices: Vec<[f64; 3]>,
    /// Indices of each triangle's corners; faces of more corners are fans. Empty for a point cloud.
    pub faces: Vec<[u32; 3]>,
}

/// Reads vertices and, if the element after them is `face`, its triangles.
///
/// # Errors
/// Names the header line, the point or the face.
pub fn read_mesh(source: &mut dyn BufRead) -> Result<PlyMesh, PlyError> {
    let header = read_header(source)?;
    let mut mesh = PlyMesh::default();
    read_points(source, &header, &mut |[x, y, z, ..]| mesh.vertices.push([x, y, z]))?;
    let Some((count, properties)) = &header.faces else { return Ok(mesh) };
    let mut words = Words { format: header.format, line: Vec::new(), at: 0 };
    for index in 0..*count {
        let wrong = |reason| PlyError::Face { index, count: *count, reason };
        let mut corners: Vec<f64> = Vec::new();
        words.next_line(source)?;
        for property in properties {
            let mut next = |kind| {
                words
                    .next(source, kind)
                    .map_err(|e| e.unwrap_or_else(|| wrong("the file ends within it")))
            };
            match property {
                FaceProperty::Scalar(kind) => {
                    next(*kind)?;
                }
                FaceProperty::List { length, item, is_corners } => {
                    let length = next(*length)?;
                    if !(0.0..=1e4).contains(&length) {
                        return Err(wrong("a list that long is none of corners"));
                    }
                    for _ in 0..length as usize {
                        let value = next(*item)?;
                        if *is_corners {
                            corners.push(value);
                        }
                    }
                }
            }
        }
        if corners.iter().any(|c| *c < 0.0 || *c >= mesh.vertices.len() as f64) {
            return Err(wrong("a corner is no vertex"));
        }
        for k in 2..corners.len() {
            mesh.faces.push([corners[0], corners[k - 1], corners[k]].map(|c| c as u32));
        }
    }
    Ok(mesh)
}

/// Values of an element with lists, one after the other.
struct Words {
    format: Format,
    line: Vec<f64>,
    at: usize,
}

impl Words {
    fn next_line(&mut self, source: &mut dyn BufRead) -> io::Result<()> {
        if self.format == Format::Ascii {
            let mut text = String::new();
            io::Read::take(&mut *source, 1 << 20).read_line(&mut text)?;
            self.line = text.split_ascii_whitespace().map_while(|w| w.parse().ok()).collect();
            self.at = 0;
        }
        Ok(())
    }

    /// The next value; an error without a cause is the end.
    fn next(&mut self, source: &mut dyn BufRead, kind: Kind) -> Result<f64, Option<PlyError>> {
        if self.format == Format::Ascii {
            self.at += 1;
            return self.line.get(self.at - 1).copied().ok_or(None);
        }
        let mut bytes = [0; 8];
        let raw = &mut bytes[..kind.size()];
        source.read_exact(raw).map_err(|e| match e.kind() {
            io::ErrorKind::UnexpectedEof => None,
            _ => Some(e.into()),
        })?;
        Ok(kind.decode(raw, self.format == Format::Big))
    }
}

fn read_points(
    source: &mut dyn BufRead,
    header: &Header,
    each: &mut dyn FnMut([f64; 5]),
) -> Result<(), PlyError> {
    let Header { format, count, properties, .. } = header;
    let (format, count) = (*format, *count);
    let mut text = String::new();
    let mut bytes = vec![0; properties.iter().map(|p| p.kind.size()).sum()];
    for index in 0..count {
        let wrong = |reason| PlyError::Point { index, count, reason };
        let mut values = [f64::NAN, f64::NAN, f64::NAN, 1.0, 255.0];
        if format == Format::Ascii {
            text.clear();
            if io::Read::take(&mut *source, 1 << 16).read_line(&mut text)? == 0 {
                return Err(wrong("the file ends before it"));
            }
            let mut words = text.split_ascii_whitespace();
            for property in properties {
                let word = words.next().ok_or_else(|| wrong("fewer values than properties"))?;
                let value = word.parse().map_err(|_| wrong("a value is no number"))?;
                if let Some(role) = property.role {
                    values[role] = value;
                }
            }
        } else {
            source.read_exact(&mut bytes).map_err(|e| match e.kind() {
                io::ErrorKind::UnexpectedEof => wrong("the file ends before it"),
                _ => e.into(),
            })?;
            let mut at = 0;
            for property in properties {
                let raw = &bytes[at..at + property.kind.size()];
                if let Some(role) = property.role {
                    values[role] = property.kind.decode(raw, format == Format::Big);
                }
                at += raw.len();
            }
        }
        each(values);
    }
    Ok(())
}

/// What the header of a PLY file announces.
struct Header {
    format: Format,
    count: usize,
    properties: Vec<Property>,
    /// Faces right after the points: their number and properties.
    faces: Option<(usize, Vec<FaceProperty>)>,
}

/// A property of a face.
enum FaceProperty {
    Scalar(Kind),
    List { length: Kind, item: Kind, is_corners: bool },
}

fn read_header(source: &mut dyn BufRead) -> Result<Header, PlyError> {
    let mut format = None;
    let mut faces: Option<(usize, Vec<FaceProperty>)> = None;
    let mut elements = 0;
    let mut in_faces = false;
    let mut count = None;
    let mut in_vertex = false;
    let mut properties = Vec::new();
    let mut found = [false; ROLES.len()];
    for number in 1..=HEADER_LINES_MAX {
        let mut raw = Vec::new();
        io::Read::take(&mut *source, HEADER_LINE_MAX).read_until(b'\n', &mut raw)?;
        let line = String::from_utf8_lossy(&raw).trim_end().to_owned();
        let wrong = |expected| PlyError::Header {
            line: number,
            expected,
            got: line.chars().take(60).collect(),
        };
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match (&words[..], number) {
            (["ply"], 1) => {}
            (_, 1) => return Err(wrong("`ply`")),
            (["format", name, "1.0"], _) => {
                format = Some(match *name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::Little,
                    "binary_big_endian" => Format::Big,
                    _ => return Err(wrong("ascii, binary_little_endian or binary_big_endian")),
                });
            }
            (["comment" | "obj_info", ..], _) => {}
            (["element", "vertex", n], _) if count.is_none() => {
                count = Some(n.parse().map_err(|_| wrong("a number of points"))?);
                in_vertex = true;
                elements = 1;
            }
            (["element", ..], _) if count.is_none() => {
                return Err(wrong("the points (`element vertex`) first"));
            }
            (["element", name, n], _) => {
                elements += 1;
                in_vertex = false;
                in_faces = elements == 2 && *name == "face";
                if in_faces {
                    faces = Some((n.parse().map_err(|_| wrong("a number of faces"))?, Vec::new()));
                }
            }
            (["property", "list", ..], _) if in_vertex => {
                return Err(wrong("scalar properties of points"));
            }
            (["property", kind, name], _) if in_vertex => {
                let kind = Kind::parse(kind).ok_or_else(|| wrong("a scalar type"))?;
                let role = ROLES.iter().position(|role| role == name);
                if let Some(role) = role {
                    found[role] = true;
                }
                properties.push(Property { role, kind });
            }
            (["property", "list", length, item, name], _) if in_faces => {
                let kind = |name: &str| Kind::parse(name).ok_or_else(|| wrong("a scalar type"));
                let is_corners = matches!(*name, "vertex_indices" | "vertex_index");
                let (length, item) = (kind(length)?, kind(item)?);
                if let Some((_, properties)) = &mut faces {
                    properties.push(FaceProperty::List { length, item, is_corners });
                }
            }
            (["property", kind, _], _) if in_faces => {
                let kind = Kind::parse(kind).ok_or_else(|| wrong("a scalar type"))?;
                if let Some((_, properties)) = &mut faces {
                    properties.push(FaceProperty::Scalar(kind));
                }
            }
            (["property", ..], _) if !in_vertex => {}
            (["end_header"], _) => {
                let (Some(format), Some(count)) = (format, count) else {
                    return Err(wrong("`format` and `element vertex` before it"));
                };
                if found[..3] != [true; 3] {
                    return Err(wrong("properties x, y and z before it"));
                }
                return Ok(Header { format, count, properties, faces });
            }
            _ => return Err(wrong("a PLY header line")),
        }
    }
    let expected = "`end_header` within the first 200 lines";
    Err(PlyError::Header { line: HEADER_LINES_MAX, expected, got: String::new() })
}
