//! Extracts complete JPEG files from camera buffers. A buffer may be truncated, hold two images,
//! lack Huffman tables, or have extra bytes around the image.
//!
//! Source: ITU-T T.81, annex B (markers) and annex K.3 (the tables that motion JPEG omits).

use std::borrow::Cow;

/// The reason why a buffer contains no complete JPEG image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum JpegError {
    /// The buffer contains no start marker.
    #[error("no JPEG start marker found")]
    NoStartMarker,
    /// The buffer ends, or another image starts, before the end of the image.
    #[error("the JPEG is truncated")]
    Truncated,
    /// The image ends without scan data.
    #[error("the JPEG contains no scan data")]
    NoScanData,
}

const START_OF_IMAGE: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
const HUFFMAN_TABLES: u8 = 0xc4;
/// Frame types that the standard tables can decode: baseline and extended sequential with Huffman
/// coding.
const SEQUENTIAL_FRAMES: [u8; 2] = [0xc0, 0xc1];

/// Returns the first complete image of a buffer, from its first marker to its last. Adds the
/// standard Huffman tables if the image has none.
///
/// Bytes before and after the image are dropped. Images that are truncated by the start of another
/// image are dropped, too. A thumbnail inside a segment is part of the surrounding image. The image
/// data is not decoded.
pub fn first_image(buffer: &[u8]) -> Result<Cow<'_, [u8]>, JpegError> {
    let mut reason = JpegError::NoStartMarker;
    let mut start = 0;
    while let Some(offset) = buffer[start..]
        .windows(2)
        .position(|pair| pair == [0xff, START_OF_IMAGE])
    {
        start += offset;
        match scan_markers(buffer, start) {
            Ok(ImageExtent {
                end,
                first_scan,
                needs_tables: true,
            }) => {
                return Ok([
                    &buffer[start..first_scan],
                    &STANDARD_TABLES,
                    &buffer[first_scan..end],
                ]
                .concat()
                .into());
            }
            Ok(ImageExtent { end, .. }) => return Ok(buffer[start..end].into()),
            // Motion JPEG drivers may deliver the rest of one image and the next one in the same
            // buffer.
            Err((error, resume)) => {
                // The first failure is the most informative. Later ones are often caused by the
                // remains of the first image.
                if reason == JpegError::NoStartMarker {
                    reason = error;
                }
                start = resume;
            }
        }
    }
    Err(reason)
}

/// Index just after the first complete image of a buffer, or `None` if there is none.
#[cfg(feature = "nokhwa")]
pub(crate) fn first_image_end(buffer: &[u8]) -> Option<usize> {
    let starts = buffer
        .windows(2)
        .enumerate()
        .filter(|(_, pair)| *pair == [0xff, START_OF_IMAGE]);
    starts
        .map(|(start, _)| start)
        .find_map(|start| scan_markers(buffer, start).ok())
        .map(|complete| complete.end)
}

/// Extent of an image in its buffer.
struct ImageExtent {
    /// Index just after its last marker.
    end: usize,
    /// Index of the marker of its first scan.
    first_scan: usize,
    /// Whether the standard Huffman tables must be added. This is so if the image has no tables
    /// before its first scan, and if the standard tables fit its frame type.
    needs_tables: bool,
}

/// Walks the markers of the image that starts at `start`. On failure, returns the reason and the
/// index at which to search for the next image.
fn scan_markers(buffer: &[u8], start: usize) -> Result<ImageExtent, (JpegError, usize)> {
    let mut position = start + 2;
    let mut first_scan = None;
    let mut has_tables = false;
    let mut is_sequential = false;
    loop {
        // The loop searches for the next marker instead of expecting it at this position. The
        // search skips stray bytes between segments. It also skips coded data, which contain no
        // markers because a 0 follows each 0xff.
        let (marker_at, marker) =
            next_marker(buffer, position).ok_or((JpegError::Truncated, buffer.len()))?;
        position = marker_at + 2;
        match (marker, first_scan) {
            // A start marker outside of a segment begins another image. A start marker inside a
            // segment, such as that of a thumbnail, has been skipped with its segment.
            (START_OF_IMAGE, _) => return Err((JpegError::Truncated, marker_at)),
            (END_OF_IMAGE, None) => return Err((JpegError::NoScanData, position)),
            (END_OF_IMAGE, Some(first_scan)) => {
                return Ok(ImageExtent {
                    end: position,
                    first_scan,
                    needs_tables: is_sequential && !has_tables,
                });
            }
            // Tables after the first scan begins do not help to decode it.
            (HUFFMAN_TABLES, None) => has_tables = true,
            (START_OF_SCAN, None) => first_scan = Some(marker_at),
            (frame, _) if SEQUENTIAL_FRAMES.contains(&frame) => is_sequential = true,
            _ => {}
        }
        // The length includes its own two bytes.
        let &[high, low, ..] = &buffer[position..] else {
            return Err((JpegError::Truncated, buffer.len()));
        };
        // A length below 2 is invalid. Using 2 instead still advances the position, so the loop
        // ends.
        position += usize::from(u16::from_be_bytes([high, low])).max(2);
        if position > buffer.len() {
            return Err((JpegError::Truncated, buffer.len()));
        }
    }
}

/// Index and code of the next marker, ignoring restart markers and the private marker 0x01.
fn next_marker(buffer: &[u8], from: usize) -> Option<(usize, u8)> {
    let is_marker = |code: u8| !matches!(code, 0x00 | 0x01 | 0xd0..=0xd7 | 0xff);
    let offset = buffer[from..]
        .windows(2)
        .position(|pair| pair[0] == 0xff && is_marker(pair[1]))?;
    Some((from + offset, buffer[from + offset + 1]))
}

/// One segment with the tables of annex K.3: luminance and chrominance, DC and AC.
static STANDARD_TABLES: [u8; 420] = [
    0xff, 0xc4, 0x01, 0xa2, // Marker and length.
    // K.3, luminance DC.
    0x00, //
    0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, //
    0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, //
    // K.5, luminance AC.
    0x10, //
    0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125, //
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07,
    0x22, 0x71, //
    0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33,
    0x62, 0x72, //
    0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35,
    0x36, 0x37, //
    0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57,
    0x58, 0x59, //
    0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79,
    0x7a, 0x83, //
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
    0xa2, 0xa3, //
    0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, //
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
    0xe1, 0xe2, //
    0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8,
    0xf9, 0xfa, //
    // K.4, chrominance DC.
    0x01, //
    0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, //
    0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, //
    // K.6, chrominance AC.
    0x11, //
    0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119, //
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71,
    0x13, 0x22, //
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62,
    0x72, 0xd1, //
    0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a,
    0x35, 0x36, //
    0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56,
    0x57, 0x58, //
    0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78,
    0x79, 0x7a, //
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98,
    0x99, 0x9a, //
    0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8,
    0xb9, 0xba, //
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8,
    0xd9, 0xda, //
    0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8,
    0xf9, 0xfa, //
];

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ExtendedColorType, ImageFormat};

    /// An image of 48x40 pixels with segments as written by the encoder of the `image` crate.
    fn jpeg() -> Vec<u8> {
        let rgb: Vec<u8> = (0..3 * 48 * 40)
            .map(|ix: u32| (ix * ix % 251) as u8)
            .collect();
        let mut file = std::io::Cursor::new(Vec::new());
        image::write_buffer_with_format(
            &mut file,
            &rgb,
            48,
            40,
            ExtendedColorType::Rgb8,
            ImageFormat::Jpeg,
        )
        .expect("a small image");
        file.into_inner()
    }

    /// The file without its segments of the given marker.
    fn without_segments(jpeg: &[u8], marker: u8) -> Vec<u8> {
        let mut remaining = jpeg[..2].to_vec();
        let mut position = 2;
        while jpeg[position + 1] != START_OF_SCAN {
            let end = position
                + 2
                + usize::from(u16::from_be_bytes([jpeg[position + 2], jpeg[position + 3]]));
            if jpeg[position + 1] != marker {
                remaining.extend(&jpeg[position..end]);
            }
            position = end;
        }
        remaining.extend(&jpeg[position..]);
        remaining
    }

    fn pixels(jpeg: &[u8]) -> Vec<u8> {
        let decoded = image::load_from_memory_with_format(jpeg, ImageFormat::Jpeg);
        decoded.expect("a complete file").into_rgb8().into_raw()
    }

    #[test]
    fn missing_huffman_tables_are_inserted() {
        let complete = jpeg();
        let without_tables = without_segments(&complete, HUFFMAN_TABLES);
        assert!(complete.len() - without_tables.len() >= STANDARD_TABLES.len());
        assert!(
            image::load_from_memory_with_format(&without_tables, ImageFormat::Jpeg).is_err(),
            "the image decodes without the tables"
        );
        let repaired = first_image(&without_tables).expect("complete except for its tables");
        assert_eq!(pixels(&repaired), pixels(&complete));
    }

    #[test]
    fn complete_image_is_borrowed_without_surrounding_bytes() {
        let complete = jpeg();
        for (prefix, suffix) in [
            (&b""[..], &b""[..]),
            (b"\xff\xffabc", b""),
            (b"", b"\0\0\0"),
            (b"\xff\xd9", b"\xff"),
        ] {
            let buffer = [prefix, &complete, suffix].concat();
            assert!(matches!(first_image(&buffer), Ok(Cow::Borrowed(slice)) if slice == complete));
        }
        // Restart markers and stuffed 0xff bytes in the coded data do not end the image.
        let mut coded = complete.clone();
        coded.splice(
            complete.len() - 2..complete.len() - 2,
            [0xff, 0xd3, 0xff, 0x00, 0xff, 0xff],
        );
        assert_eq!(first_image(&coded).as_deref(), Ok(&coded[..]));
    }

    #[test]
    fn first_complete_image_of_two_is_found() {
        let (first, second) = (jpeg(), without_segments(&jpeg(), 0xe0));
        assert_ne!(first, second);
        assert_eq!(
            first_image(&[&first[..], &second].concat()).as_deref(),
            Ok(&first[..])
        );
        // Cuts inside a segment are not tested, because the length of the segment would reach into
        // the second image.
        for n_bytes in [2, 20, first.len() / 2, first.len() - 2] {
            let buffer = [&first[..n_bytes], &second].concat();
            assert_eq!(
                first_image(&buffer).as_deref(),
                Ok(&second[..]),
                "cut at {n_bytes}"
            );
        }
    }

    #[test]
    fn truncated_image_is_rejected_at_any_length() {
        let complete = jpeg();
        for n_bytes in (0..complete.len())
            .step_by(97)
            .chain(0..40)
            .chain(complete.len() - 40..complete.len())
        {
            let error = if n_bytes < 2 {
                JpegError::NoStartMarker
            } else {
                JpegError::Truncated
            };
            assert_eq!(
                first_image(&complete[..n_bytes]),
                Err(error),
                "{n_bytes} of {} bytes",
                complete.len()
            );
        }
        // Missing bytes anywhere never cause a panic.
        for dropped_at in (0..complete.len()).step_by(97) {
            let _ = first_image(
                &[
                    &complete[..dropped_at],
                    &complete[(dropped_at + 61).min(complete.len())..],
                ]
                .concat(),
            );
        }
    }

    #[test]
    fn embedded_thumbnail_is_part_of_the_image() {
        let complete = jpeg();
        let segment = [
            &[0xff, 0xe1, 0, 6][..],
            &[0xff, START_OF_IMAGE, 0xff, END_OF_IMAGE],
        ]
        .concat();
        let with_thumbnail = [&complete[..2], &segment, &complete[2..]].concat();
        assert_eq!(
            first_image(&with_thumbnail).as_deref(),
            Ok(&with_thumbnail[..])
        );
        assert_eq!(
            first_image(&with_thumbnail[..with_thumbnail.len() - 100]),
            Err(JpegError::Truncated)
        );
        assert_eq!(first_image(&segment[4..]), Err(JpegError::NoScanData));
    }
}
