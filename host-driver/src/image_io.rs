//! PNG files: grey images in, grey and colour images out.

use std::fs::File;
use std::io::{self, BufReader, Write};
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType, Compression, Decoder, DecodingError, Encoder, EncodingError, Info};
use stspp_matcher::Image;

use crate::raw::{RawImage, RawPixels};

/// Largest side of an image that is read.
const SIDE_MAX_PX: u32 = 16_384;

/// Why an image could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file ends before the image does.
    #[error("{}: truncated PNG: the file ends before the image does", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
    },
    /// The file is not a valid PNG.
    #[error("{}: expected a PNG image: {message}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What the decoder says.
        message: String,
    },
    /// The image is one that cannot be used.
    #[error("{}: {field}: expected {expected}, got {got}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// "colour type", "bit depth", "size".
        field: &'static str,
        /// What it has to be.
        expected: String,
        /// What it is.
        got: String,
    },
}

/// What a grey PNG's header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GrayHeader {
    /// Width and height in pixels.
    pub size_px: [usize; 2],
    /// 8 or 16.
    pub container_bits: u8,
}

/// Reads the header of a grey PNG.
///
/// # Errors
/// When it is none of 8 or 16 bits.
pub fn read_gray_header(path: &Path) -> Result<GrayHeader, ImageError> {
    let file =
        File::open(path).map_err(|source| ImageError::Read { path: path.to_owned(), source })?;
    let mut decoder = Decoder::new(BufReader::new(file));
    let info = decoder.read_header_info().map_err(|e| decoding(path, e))?;
    header(path, info)
}

fn header(path: &Path, info: &Info<'_>) -> Result<GrayHeader, ImageError> {
    let field = |field, expected: &str, got: String| {
        Err(ImageError::Field { path: path.to_owned(), field, expected: expected.into(), got })
    };
    if info.color_type != ColorType::Grayscale {
        return field("colour type", "gray without alpha", format!("{:?}", info.color_type));
    }
    let container_bits = match info.bit_depth {
        BitDepth::Eight => 8,
        BitDepth::Sixteen => 16,
        other => return field("bit depth", "8 or 16", format!("{}", other as u8)),
    };
    if info.width > SIDE_MAX_PX || info.height > SIDE_MAX_PX {
        let got = format!("{} x {}", info.width, info.height);
        return field("size", "at most 16384 px a side", got);
    }
    Ok(GrayHeader { size_px: [info.width as usize, info.height as usize], container_bits })
}

fn decoding(path: &Path, error: DecodingError) -> ImageError {
    let path = path.to_owned();
    match error {
        DecodingError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
            ImageError::Truncated { path }
        }
        DecodingError::IoError(source) => ImageError::Read { path, source },
        other => ImageError::Format { path, message: other.to_string() },
    }
}

/// Reads a grey PNG of 8 or 16 bits. 16-bit images are given 16 significant bits: only the recording
/// knows how many the camera had.
///
/// # Errors
/// When the file is missing, truncated, no PNG, or not grey.
pub fn read_gray(path: &Path) -> Result<RawImage, ImageError> {
    let file =
        File::open(path).map_err(|source| ImageError::Read { path: path.to_owned(), source })?;
    decode_gray(path, BufReader::new(file))
}

/// Decodes a grey PNG from `source`; `path` is for error messages.
///
/// # Errors
/// As [`read_gray`].
pub fn decode_gray(
    path: &Path,
    source: impl io::BufRead + io::Seek,
) -> Result<RawImage, ImageError> {
    let mut decoder = Decoder::new(source);
    decoder.set_ignore_text_chunk(true);
    let GrayHeader { size_px: [width, height], container_bits } =
        header(path, decoder.read_header_info().map_err(|e| decoding(path, e))?)?;
    let mut reader = decoder.read_info().map_err(|e| decoding(path, e))?;
    let mut bytes = vec![0; width * height * usize::from(container_bits / 8)];
    reader.next_frame(&mut bytes).map_err(|e| decoding(path, e))?;
    // The pixels are there; what follows must still be a whole file.
    reader.finish().map_err(|e| decoding(path, e))?;
    let wrong_size = || ImageError::Format {
        path: path.to_owned(),
        message: "the image data do not fit the header's size".into(),
    };
    if container_bits == 8 {
        let pixels = Image::from_vec(width, height, bytes).ok_or_else(wrong_size)?;
        return Ok(RawImage::gray8(pixels));
    }
    let pixels = bytes.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
    let pixels = Image::from_vec(width, height, pixels).ok_or_else(wrong_size)?;
    Ok(RawImage::gray16(pixels, 16))
}

/// A line of text in a PNG file: keyword and text.
pub type Text<'a> = (&'a str, &'a str);

fn encode(
    out: &mut dyn Write,
    size: (usize, usize),
    color: ColorType,
    depth: BitDepth,
    data: &[u8],
    texts: &[Text<'_>],
) -> io::Result<()> {
    let too_large = |_| io::Error::other("an image side beyond 32 bits");
    let width = u32::try_from(size.0).map_err(too_large)?;
    let height = u32::try_from(size.1).map_err(too_large)?;
    let mut encoder = Encoder::new(out, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    let write = move || -> Result<(), EncodingError> {
        for (keyword, text) in texts {
            encoder.add_text_chunk((*keyword).into(), (*text).into())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(data)?;
        writer.finish()
    };
    write().map_err(|e| match e {
        EncodingError::IoError(e) => e,
        other => io::Error::other(other),
    })
}

/// Writes an 8-bit grey PNG.
///
/// # Errors
/// From `out`.
pub fn write_gray8(out: &mut dyn Write, image: &Image<u8>, texts: &[Text<'_>]) -> io::Result<()> {
    let size = (image.width(), image.height());
    encode(out, size, ColorType::Grayscale, BitDepth::Eight, image.as_slice(), texts)
}

/// Writes a 16-bit grey PNG.
///
/// # Errors
/// From `out`.
pub fn write_gray16(out: &mut dyn Write, image: &Image<u16>, texts: &[Text<'_>]) -> io::Result<()> {
    let bytes: Vec<u8> = image.as_slice().iter().flat_map(|v| v.to_be_bytes()).collect();
    let size = (image.width(), image.height());
    encode(out, size, ColorType::Grayscale, BitDepth::Sixteen, &bytes, texts)
}

/// Writes an 8-bit RGB PNG.
///
/// # Errors
/// From `out`.
pub fn write_rgb8(
    out: &mut dyn Write,
    image: &Image<[u8; 3]>,
    texts: &[Text<'_>],
) -> io::Result<()> {
    let size = (image.width(), image.height());
    encode(out, size, ColorType::Rgb, BitDepth::Eight, image.as_slice().as_flattened(), texts)
}

/// Writes a raw camera image as grey PNG of its container's bits.
///
/// # Errors
/// From `out`.
pub fn write_raw(out: &mut dyn Write, image: &RawImage) -> io::Result<()> {
    match &image.pixels {
        RawPixels::Gray8(pixels) => write_gray8(out, pixels, &[]),
        RawPixels::Gray16(pixels) => write_gray16(out, pixels, &[]),
    }
}
