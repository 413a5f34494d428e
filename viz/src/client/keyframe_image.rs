//! Photographs of keyframes, on request: the images on which the models are trained.

use crate::Hub;
use crate::client::protocol::KeyframeImageMessage;
use crate::client::server_message::{
    BinaryHeader, ColorPart, KeyframeImageHeader, MaskPart, frame,
};
use crate::pictures::jpeg::{Chroma, JpegError, Layout, Pixels, downscale, encode};
use crate::pictures::view_request::InvalidRequest;
use crate::pose::row_major;
use crate::topics::keyframes::{PublishedKeyframes, SharedLog};
use crate::topics::published_data::KeyframePose;
use crate::topics::subscriptions::fitted;
use flate2::Compression;
use flate2::write::ZlibEncoder;
use keyframe::{Keyframe, split_name};
use kinematics::Stamp;
use std::borrow::Cow;
use std::io::Write;
use std::sync::Arc;
use tokio::sync::Semaphore;

/// Maximum width and height of photographs that are sent. Larger photographs would take too long to
/// send.
pub(crate) const MAX_PHOTOGRAPH_PX: u32 = 2048;
/// Maximum width and height for clients that request no other size.
const DEFAULT_PHOTOGRAPH_PX: u32 = 1280;
/// Minimum value of a requested maximum size.
const MIN_PHOTOGRAPH_PX: u32 = 16;
/// JPEG quality. Clients compare photographs with pictures of the model, so the compression errors
/// must be smaller than the errors of a good model.
const QUALITY: u8 = 92;
/// Valid pixels form few large regions, so higher levels gain little.
const DEFLATE_LEVEL: u32 = 3;
/// Value of valid pixels in the mask.
const VALID: u8 = 255;

/// Reads a keyframe that is not in memory, by camera and stamp; `None` if it is not stored. The
/// error is one sentence.
pub type ReadKeyframe = dyn Fn(&str, Stamp) -> Result<Option<Keyframe>, String> + Send + Sync;

/// Where keyframes that are not in memory come from.
#[derive(Clone, Default)]
struct KeyframeReader(Option<Arc<ReadKeyframe>>);

/// A validated request for a photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct KeyframeImageRequest {
    /// Number chosen by the client.
    pub(crate) id: u64,
    /// Number of the keyframe in the list.
    pub(crate) keyframe: u64,
    /// Maximum width and height.
    pub(crate) max_px: [u32; 2],
}

/// Reason why there is no photograph.
#[derive(Debug, thiserror::Error)]
pub(crate) enum KeyframeImageError {
    #[error("there is no keyframe with the number {number}; it may have been removed")]
    Unknown { number: u64 },
    #[error("the photograph of this keyframe is not stored")]
    NotStored,
    #[error("the photograph of this keyframe cannot be read: {0}")]
    Read(String),
    #[error("the previous photograph was not sent yet; request one at a time")]
    Busy,
    #[error("the keyframe has {got} bytes of pixels, expected {needed}")]
    Length { got: usize, needed: usize },
    #[error("the server is stopping")]
    Stopping,
    #[error(transparent)]
    Jpeg(#[from] JpegError),
    #[error("the mask cannot be compressed: {0}")]
    Mask(#[from] std::io::Error),
    #[error("the photograph cannot be encoded: {0}")]
    Task(#[from] tokio::task::JoinError),
}

impl KeyframeImageRequest {
    /// Checks a message.
    pub(crate) fn check(message: &KeyframeImageMessage) -> Result<Self, InvalidRequest> {
        let KeyframeImageMessage {
            id,
            keyframe,
            size_px,
        } = *message;
        let size_px = size_px.unwrap_or([DEFAULT_PHOTOGRAPH_PX; 2]);
        if size_px.iter().any(|side| *side < MIN_PHOTOGRAPH_PX) {
            return Err(InvalidRequest::ImageSize {
                got: size_px,
                min: MIN_PHOTOGRAPH_PX,
            });
        }
        Ok(Self {
            id,
            keyframe,
            max_px: size_px.map(|side| side.min(MAX_PHOTOGRAPH_PX)),
        })
    }
}

/// The binary message with the photograph of a keyframe. It is read and encoded on a thread for
/// blocking tasks, once one of the `photographs` of the server may begin.
pub(crate) async fn encode_photograph(
    photographs: Arc<Semaphore>,
    hub: Hub,
    request: KeyframeImageRequest,
) -> Result<Vec<u8>, KeyframeImageError> {
    let permit = photographs.acquire_owned().await;
    let permit = permit.map_err(|_| KeyframeImageError::Stopping)?;
    let encoding = tokio::task::spawn_blocking(move || {
        let _permit = permit;
        let pose = listed(&hub, request.keyframe)?;
        let keyframe = source(&hub, &pose)?;
        pack(&keyframe, &request)
    });
    encoding.await?
}

/// The entry of the list of keyframes with this number.
fn listed(hub: &Hub, number: u64) -> Result<KeyframePose, KeyframeImageError> {
    let log = hub.latest::<SharedLog>();
    let log = log.borrow();
    let pose = log.as_ref().and_then(|log| log.get(number));
    pose.cloned().ok_or(KeyframeImageError::Unknown { number })
}

/// The keyframe in memory, or else on disk.
fn source(hub: &Hub, pose: &KeyframePose) -> Result<Arc<Keyframe>, KeyframeImageError> {
    if let Some(keyframe) = hub.keyframes().source(&pose.camera, pose.stamp) {
        return Ok(keyframe);
    }
    let KeyframeReader(reader) = hub.latest::<KeyframeReader>().borrow().clone();
    let read = reader.ok_or(KeyframeImageError::NotStored)?;
    let keyframe = read(&pose.camera, pose.stamp).map_err(KeyframeImageError::Read)?;
    keyframe.map(Arc::new).ok_or(KeyframeImageError::NotStored)
}

impl PublishedKeyframes<'_> {
    /// Sets the function that reads keyframes which are not in memory: those that
    /// [`Self::set_sources`] has not set, and those that were dropped since. The function is called
    /// on threads for blocking tasks. The poses of its keyframes are in the page's world.
    pub fn set_reader(&self, read: Arc<ReadKeyframe>) {
        self.hub.latest().send_replace(KeyframeReader(Some(read)));
    }
}

/// Encodes a photograph with its mask.
fn pack(
    keyframe: &Keyframe,
    request: &KeyframeImageRequest,
) -> Result<Vec<u8>, KeyframeImageError> {
    let [width, height] = keyframe.size_px;
    let needed = 4 * width as usize * height as usize;
    let got = keyframe.rgba_srgb.len();
    if got != needed {
        return Err(KeyframeImageError::Length { got, needed });
    }
    let size_px = fitted(keyframe.size_px, request.max_px);
    let jpeg = encode(
        &photograph(keyframe, size_px)?.pixels(),
        QUALITY,
        Chroma::Full,
    )?;
    let mask = mask(keyframe, size_px).map(|mask| compressed(&mask));
    let mask = mask.transpose()?;
    let header = KeyframeImageHeader {
        id: request.id,
        keyframe: request.keyframe,
        camera: &keyframe.camera,
        stamp_nanos: keyframe.stamp.0,
        size_px,
        full_size_px: keyframe.size_px,
        split: split_name(keyframe.split),
        has_depth: keyframe.depth.is_some(),
        reported_world_from_camera: row_major(&keyframe.world_from_camera),
        speed_m_s: keyframe.twist.as_ref().map(|twist| twist.linear_m_s.norm()),
        turn_rad_s: keyframe
            .twist
            .as_ref()
            .map(|twist| twist.angular_rad_s.norm()),
        readout_secs: keyframe.readout_secs,
        color: ColorPart {
            format: "jpeg",
            offset: 0,
            bytes: jpeg.len(),
        },
        mask: mask.as_ref().map(|mask| MaskPart {
            offset: jpeg.len(),
            bytes: mask.len(),
        }),
    };
    Ok(frame(
        &BinaryHeader::KeyframeImage(&header),
        &[&jpeg, mask.as_deref().unwrap_or_default()],
    ))
}

/// The pixels of a photograph in the size in which it is sent.
struct Photograph<'a> {
    size_px: [u32; 2],
    layout: Layout,
    bytes: Cow<'a, [u8]>,
}

impl Photograph<'_> {
    fn pixels(&self) -> Pixels<'_> {
        Pixels {
            size_px: self.size_px,
            layout: self.layout,
            bytes: &self.bytes,
        }
    }
}

fn photograph(keyframe: &Keyframe, size_px: [u32; 2]) -> Result<Photograph<'_>, JpegError> {
    let full = Photograph {
        size_px: keyframe.size_px,
        layout: Layout::Rgba,
        bytes: Cow::Borrowed(&keyframe.rgba_srgb),
    };
    if size_px == keyframe.size_px {
        return Ok(full);
    }
    Ok(Photograph {
        size_px,
        layout: Layout::Rgb,
        bytes: Cow::Owned(downscale(&full.pixels(), size_px)?),
    })
}

/// A byte per pixel of an image of this size. The byte is 0 if the pixel covers a pixel that is
/// masked or left empty by undistortion, and otherwise [`VALID`]. `None` if all pixels are valid.
fn mask(keyframe: &Keyframe, size_px: [u32; 2]) -> Option<Vec<u8>> {
    let alpha = || keyframe.rgba_srgb.iter().skip(3).step_by(4);
    if alpha().all(|alpha| *alpha == u8::MAX) {
        return None;
    }
    let [full_width, full_height] = keyframe.size_px.map(u64::from);
    let [width, height] = size_px.map(u64::from);
    let mut mask = vec![VALID; pixel_ix(width * height)];
    for (ix, alpha) in (0..).zip(alpha()) {
        if *alpha != u8::MAX {
            let x: u64 = (ix % full_width) * width / full_width;
            let y = (ix / full_width) * height / full_height;
            mask[pixel_ix(y * width + x)] = 0;
        }
    }
    Some(mask)
}

fn pixel_ix(ix: u64) -> usize {
    usize::try_from(ix).expect("an image in memory has fewer pixels")
}

fn compressed(mask: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::new(DEFLATE_LEVEL));
    encoder.write_all(mask)?;
    encoder.finish()
}

#[cfg(test)]
mod tests {
    use super::{KeyframeImageRequest, MAX_PHOTOGRAPH_PX, mask, pack};
    use crate::client::protocol::KeyframeImageMessage;
    use keyframe::{Keyframe, Split};
    use kinematics::{Stamp, Transform};

    /// A gray image, whose pixels are masked for which this returns true.
    fn keyframe(size_px: [u32; 2], is_masked: impl Fn([u32; 2]) -> bool) -> Keyframe {
        let [width, height] = size_px;
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
        Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(5),
            size_px,
            focal_px: [f64::from(width); 2],
            principal_px: [0.5 * f64::from(width), 0.5 * f64::from(height)],
            rgba_srgb: pixels
                .flat_map(|pixel| [90, 90, 90, if is_masked(pixel) { 0 } else { 255 }])
                .collect(),
            depth: None,
            world_from_camera: Transform::identity(),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Test,
            truth: None,
            robot: None,
        }
    }

    fn message(size_px: Option<[u32; 2]>) -> KeyframeImageMessage {
        KeyframeImageMessage {
            id: 3,
            keyframe: 8,
            size_px,
        }
    }

    #[test]
    fn the_maximum_size_is_limited_on_both_sides() {
        let checked = |size_px| KeyframeImageRequest::check(&message(size_px));
        let max_px = |size_px| checked(size_px).map(|request| request.max_px).ok();
        assert_eq!(max_px(None), Some([1280, 1280]));
        assert_eq!(max_px(Some([16, u32::MAX])), Some([16, MAX_PHOTOGRAPH_PX]));
        let error = checked(Some([640, 15])).expect_err("too small");
        assert!(error.to_string().contains("at least 16"), "{error}");
    }

    #[test]
    fn a_pixel_that_covers_a_masked_one_is_masked() {
        assert_eq!(mask(&keyframe([6, 4], |_| false), [3, 2]), None);
        let corner = keyframe([6, 4], |[x, y]| x == 5 && y == 0);
        assert_eq!(
            mask(&corner, [3, 2]),
            Some(vec![255, 255, 0, 255, 255, 255])
        );
        assert_eq!(
            mask(&corner, [6, 4]).map(|mask| mask.iter().filter(|value| **value == 0).count()),
            Some(1)
        );
    }

    #[test]
    fn incomplete_pixels_are_an_error() {
        let request = KeyframeImageRequest::check(&message(None)).expect("valid");
        let whole = keyframe([6, 4], |_| false);
        assert!(pack(&whole, &request).is_ok());
        let cut = Keyframe {
            rgba_srgb: whole.rgba_srgb[1..].into(),
            ..whole
        };
        let error = pack(&cut, &request).expect_err("a byte is missing");
        assert!(error.to_string().contains("95 bytes"), "{error}");
    }
}
