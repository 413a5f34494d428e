//! A validated render request of a client, and its stages.

use crate::client::protocol::{BoxMessage, DepthFormat, Output, ProjectionMessage, RenderMessage};
use crate::pose::from_row_major;
use kinematics::Transform;
use model_files::Aabb;
use std::sync::Arc;
use std::time::Instant;
use trainer::{Projection, RenderRequest};

/// Maximum width and height that a client may request, pixels. It covers common screens, and limits
/// the memory for the colors of a picture to 64 MiB.
pub(crate) const MAX_SIZE_PX: u32 = 4096;
/// Maximum number of stages of a request. Each of them is a picture that must be rendered.
const MAX_STAGES: usize = 8;
/// Default stages: fractions of the full width and height, rendered in order.
pub(crate) const DEFAULT_STAGES: [f64; 3] = [0.1, 0.5, 1.0];
/// Default near limit, meters.
const DEFAULT_NEAR_M: f64 = 0.01;
/// Default far limit, meters.
const DEFAULT_FAR_M: f64 = 100.0;

/// Maximum length of the name of a view, bytes.
const MAX_VIEW_BYTES: usize = 64;

/// The reason why a message is invalid, which is sent to the client.
#[derive(Debug, thiserror::Error)]
pub(crate) enum InvalidRequest {
    #[error("cannot parse the message: {0}")]
    Json(#[from] serde_json::Error),
    #[error("this message requires the role operator, and you are connected as viewer")]
    NotOperator,
    #[error(
        "{field} is not a rigid transform; expected 16 numbers, row major, with an orthonormal rotation and last row 0 0 0 1"
    )]
    NotRigid { field: &'static str },
    #[error("size_px is {got:?}, each side must be 1 to {MAX_SIZE_PX}")]
    Size { got: [u32; 2] },
    #[error("stages must be 1 to {MAX_STAGES} scales above 0 and at most 1")]
    Stages,
    #[error("near_m {near_m} and far_m {far_m} must be finite with 0 < near_m < far_m")]
    NearFar { near_m: f64, far_m: f64 },
    #[error(
        "a pinhole projection needs either focal_px above 0 or vertical_fov_rad between 0 and pi, and a finite principal_px"
    )]
    Pinhole,
    #[error("{field} needs finite corners with min_m below max_m on every axis")]
    Corners { field: &'static str },
    #[error("box is required for the action erase and not allowed for other actions")]
    EditBox,
    #[error("{max} edits are waiting, which is the maximum; wait until they are applied")]
    Edits { max: usize },
    #[error("outputs must name color, depth or both")]
    NoOutput,
    #[error("background_srgb must be three numbers from 0 to 1")]
    Background,
    #[error("the name of the view has {got} bytes, expected at most {MAX_VIEW_BYTES}")]
    ViewName { got: usize },
    #[error(
        "{max} views have pending requests, which is the maximum; wait for a picture of one of them"
    )]
    Views { max: usize },
    #[error("shown_millis is {got}, expected a time on the server's clock, 0 or more")]
    ShownTime { got: f64 },
    #[error("topic is {got:?}, expected {}", messages::listed(known, "or"))]
    Topic {
        got: String,
        known: Vec<&'static str>,
    },
    #[error("rate_hz is {got}, expected 0 to {max}", max = crate::client::protocol::MAX_RATE_HZ)]
    Rate { got: f64 },
    #[error("camera and size_px apply only to the topic live_images")]
    NotImages,
    #[error("method and max_bytes_per_sec apply only to the topic model_chunks")]
    NotChunks,
    #[error("the topic model_chunks needs method, the name of the model")]
    NoMethod,
    #[error("max_bytes_per_sec is {got}, expected 10000 to 1000000000")]
    ByteRate { got: f64 },
    #[error("size_px is {got:?}, each side must be at least {min}")]
    ImageSize { got: [u32; 2], min: u32 },
    #[error(
        "at most {max} cameras can have a subscription of their own, with names of at most {max_bytes} bytes"
    )]
    Cameras { max: usize, max_bytes: usize },
}

/// A validated render message.
#[derive(Clone, Debug)]
pub(crate) struct ViewRequest {
    /// Number chosen by the client.
    pub(crate) id: u64,
    /// Name of the view; empty by default.
    pub(crate) view: Arc<str>,
    /// When it was received.
    pub(crate) received: Instant,
    /// Requested model; the first model if `None`.
    pub(crate) method: Option<String>,
    /// The request at full size.
    pub(crate) request: RenderRequest,
    /// Linear scales, in rendering order.
    pub(crate) stages: Vec<f64>,
    /// Whether color is requested.
    pub(crate) color: bool,
    /// Whether depth is requested, and its encoding.
    pub(crate) depth: Option<DepthFormat>,
}

impl ViewRequest {
    /// Validates a client's message.
    pub(crate) fn check(message: &RenderMessage) -> Result<Self, InvalidRequest> {
        let outputs = message.outputs.as_deref().unwrap_or(&[Output::Color]);
        if outputs.is_empty() {
            return Err(InvalidRequest::NoOutput);
        }
        // The size is checked first, because other values are computed from it.
        let size_px = checked_size(message.size_px)?;
        let (near_m, far_m) = checked_range(
            message.near_m.unwrap_or(DEFAULT_NEAR_M),
            message.far_m.unwrap_or(DEFAULT_FAR_M),
        )?;
        Ok(Self {
            id: message.id,
            view: checked_view(message.view.as_deref().unwrap_or_default())?,
            received: Instant::now(),
            method: message.method.clone(),
            request: RenderRequest {
                world_from_camera: rigid(&message.world_from_camera, "world_from_camera")?,
                size_px,
                projection: checked_projection(&message.projection, size_px)?,
                shutter: None,
                near_m,
                far_m,
                crop: message
                    .crop
                    .as_ref()
                    .map(|crop| checked_box(crop, "crop"))
                    .transpose()?,
                edits: Arc::default(),
                background_srgb: checked_background(message.background_srgb.unwrap_or([0.0; 3]))?,
                appearance_of: None,
                depth: outputs.contains(&Output::Depth),
            },
            stages: checked_stages(message.stages.as_deref().unwrap_or(&DEFAULT_STAGES))?,
            color: outputs.contains(&Output::Color),
            depth: outputs
                .contains(&Output::Depth)
                .then(|| message.depth_format.unwrap_or_default()),
        })
    }

    /// The request of one stage. It has the same field of view and fewer pixels.
    pub(crate) fn stage_request(&self, stage: usize) -> RenderRequest {
        let full = self.request.size_px.map(f64::from);
        let scale = self.stages[stage];
        let size_px = self.request.size_px.map(|n| scaled(n, scale));
        // The ratio is computed from the rounded size, which is not exactly `scale` times the full
        // size. Otherwise, the stages would be shifted relative to each other by up to half a
        // pixel.
        let ratio = [
            f64::from(size_px[0]) / full[0],
            f64::from(size_px[1]) / full[1],
        ];
        let projection = match self.request.projection {
            Projection::Pinhole {
                focal_px,
                principal_px,
            } => Projection::Pinhole {
                focal_px: [focal_px[0] * ratio[0], focal_px[1] * ratio[1]],
                principal_px: [principal_px[0] * ratio[0], principal_px[1] * ratio[1]],
            },
            Projection::Equirectangular => Projection::Equirectangular,
        };
        RenderRequest {
            size_px,
            projection,
            ..self.request.clone()
        }
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "0 < scale <= 1 keeps the product in u32"
)]
fn scaled(n: u32, scale: f64) -> u32 {
    (f64::from(n) * scale).round().max(1.0) as u32
}

fn rigid(rows: &[f64; 16], field: &'static str) -> Result<Transform, InvalidRequest> {
    from_row_major(rows).ok_or(InvalidRequest::NotRigid { field })
}

fn checked_view(name: &str) -> Result<Arc<str>, InvalidRequest> {
    if name.len() <= MAX_VIEW_BYTES {
        Ok(name.into())
    } else {
        Err(InvalidRequest::ViewName { got: name.len() })
    }
}

fn checked_size(size_px: [u32; 2]) -> Result<[u32; 2], InvalidRequest> {
    let fits = size_px.iter().all(|n| (1..=MAX_SIZE_PX).contains(n));
    if fits {
        Ok(size_px)
    } else {
        Err(InvalidRequest::Size { got: size_px })
    }
}

fn checked_range(near_m: f64, far_m: f64) -> Result<(f64, f64), InvalidRequest> {
    // This check and the checks below are written so that NaN is rejected.
    let fits = near_m > 0.0 && near_m < far_m && far_m.is_finite();
    if fits {
        Ok((near_m, far_m))
    } else {
        Err(InvalidRequest::NearFar { near_m, far_m })
    }
}

fn checked_stages(stages: &[f64]) -> Result<Vec<f64>, InvalidRequest> {
    let fits = (1..=MAX_STAGES).contains(&stages.len())
        && stages.iter().all(|scale| *scale > 0.0 && *scale <= 1.0);
    if fits {
        Ok(stages.to_vec())
    } else {
        Err(InvalidRequest::Stages)
    }
}

fn checked_projection(
    message: &ProjectionMessage,
    size_px: [u32; 2],
) -> Result<Projection, InvalidRequest> {
    let ProjectionMessage::Pinhole {
        focal_px,
        principal_px,
        vertical_fov_rad,
    } = *message
    else {
        return Ok(Projection::Equirectangular);
    };
    let [width, height] = size_px.map(f64::from);
    // If both were given, they could contradict each other.
    let focal_px = match (focal_px, vertical_fov_rad) {
        (Some(focal_px), None) => focal_px,
        (None, Some(angle)) if angle > 0.0 && angle < std::f64::consts::PI => {
            // Half the height is seen under half the angle. Pixels are square.
            [0.5 * height / (0.5 * angle).tan(); 2]
        }
        _ => return Err(InvalidRequest::Pinhole),
    };
    let principal_px = principal_px.unwrap_or([0.5 * width, 0.5 * height]);
    let fits = focal_px.iter().all(|f| *f > 0.0 && f.is_finite())
        && principal_px.iter().all(|c| c.is_finite());
    if fits {
        Ok(Projection::Pinhole {
            focal_px,
            principal_px,
        })
    } else {
        Err(InvalidRequest::Pinhole)
    }
}

/// Checks a box in the field of this name.
pub(crate) fn checked_box(
    message: &BoxMessage,
    field: &'static str,
) -> Result<Aabb, InvalidRequest> {
    let world_from_box = match &message.world_from_box {
        Some(rows) => rigid(rows, "world_from_box")?,
        None => Transform::identity(),
    };
    // The difference of two finite corners can be infinite.
    let fits = message
        .min_m
        .iter()
        .zip(&message.max_m)
        .all(|(min, max)| min < max && (max - min).is_finite());
    if fits {
        Ok(Aabb {
            world_from_box,
            min_m: message.min_m,
            max_m: message.max_m,
        })
    } else {
        Err(InvalidRequest::Corners { field })
    }
}

fn checked_background(color: [f32; 3]) -> Result<[f32; 3], InvalidRequest> {
    let fits = color.iter().all(|c| (0.0..=1.0).contains(c));
    if fits {
        Ok(color)
    } else {
        Err(InvalidRequest::Background)
    }
}

#[cfg(test)]
mod tests {
    use super::{InvalidRequest, ViewRequest};
    use crate::client::protocol::RenderMessage;
    use serde_json::{Value, json};
    use trainer::Projection;

    fn message(change: impl FnOnce(&mut Value)) -> Result<ViewRequest, InvalidRequest> {
        let mut value = json!({
            "id": 7, "size_px": [1280, 720],
            "world_from_camera": [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 2, 0, 0, 0, 1],
            "projection": {"kind": "pinhole", "focal_px": [900.0, 910.0], "principal_px": [630.0, 365.0]},
        });
        change(&mut value);
        ViewRequest::check(&serde_json::from_value::<RenderMessage>(value)?)
    }

    #[test]
    fn stages_keep_the_field_of_view() {
        let view_request = message(|_| ()).expect("valid");
        assert_eq!(view_request.stages, [0.1, 0.5, 1.0]);
        let sizes: Vec<_> = (0..3)
            .map(|stage| view_request.stage_request(stage).size_px)
            .collect();
        assert_eq!(sizes, [[128, 72], [640, 360], [1280, 720]]);
        let Projection::Pinhole {
            focal_px,
            principal_px,
        } = view_request.stage_request(0).projection
        else {
            panic!("a pinhole stays one");
        };
        for (got, expected) in focal_px
            .iter()
            .chain(&principal_px)
            .zip([90.0, 91.0, 63.0, 36.5])
        {
            assert!((got - expected).abs() < 1e-9, "{got} instead of {expected}");
        }
        assert!(view_request.color && view_request.depth.is_none());
    }

    #[test]
    fn the_smallest_stage_has_at_least_one_pixel() {
        let view_request = message(|value| {
            value["size_px"] = json!([3, 1]);
            value["stages"] = json!([0.01]);
        });
        assert_eq!(
            view_request.expect("valid").stage_request(0).size_px,
            [1, 1]
        );
    }

    #[test]
    fn a_field_of_view_becomes_a_focal_length() {
        for (degrees, expected_px) in [(90.0_f64, 360.0), (45.0, 360.0 / (2.0_f64.sqrt() - 1.0))] {
            let projection = json!({"kind": "pinhole", "vertical_fov_rad": degrees.to_radians()});
            let view_request = message(|value| value["projection"] = projection).expect("valid");
            let Projection::Pinhole {
                focal_px,
                principal_px,
            } = view_request.request.projection
            else {
                panic!("a pinhole stays one");
            };
            assert!(
                focal_px
                    .iter()
                    .all(|focal| (focal - expected_px).abs() < 1e-9),
                "{focal_px:?}"
            );
            assert_eq!(principal_px, [640.0, 360.0]);
        }
    }

    #[test]
    fn errors_name_the_invalid_field() {
        let cases: [(&str, Value, &str); 13] = [
            ("view", json!("v".repeat(65)), "view has 65 bytes"),
            (
                "world_from_camera",
                json!([2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]),
                "world_from_camera",
            ),
            ("world_from_camera", json!([1, 2, 3]), "length"),
            ("size_px", json!([0, 720]), "size_px"),
            ("size_px", json!([1280, 5000]), "size_px"),
            ("stages", json!([]), "stages"),
            ("stages", json!([0.5, 1.5]), "stages"),
            ("near_m", json!(-1.0), "near_m"),
            ("projection", json!({"kind": "pinhole"}), "focal_px"),
            ("projection", json!({"kind": "fisheye"}), "fisheye"),
            (
                "crop",
                json!({"min_m": [0, 0, 0], "max_m": [1, 0, 1]}),
                "crop",
            ),
            ("background_srgb", json!([0.0, 2.0, 0.0]), "background_srgb"),
            ("colour", json!(true), "colour"),
        ];
        for (field, wrong, named) in cases {
            let error = message(|value| value[field] = wrong.clone())
                .expect_err(field)
                .to_string();
            assert!(error.contains(named), "{field} = {wrong}: {error}");
        }
    }
}
