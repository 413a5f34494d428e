//! Intrinsics as JSON.

use crate::exit::BadArgument;
use kinematics::{Intrinsics, Lens};
use serde::{Deserialize, Serialize};

/// Intrinsics in JSON files, as `calibrate intrinsics` prints them. Pixel centers are at +0.5.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct LensFile {
    /// `pinhole`, `brown_conrady` (five or eight coefficients) or `kannala_brandt`, as in rig files; by default, pinhole
    /// without distortion coefficients, and `brown_conrady` with them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) model: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) size_px: Option<[u32; 2]>,
    pub(super) focal_px: [f64; 2],
    pub(super) principal_px: [f64; 2],
    /// Coefficients in OpenCV's order.
    #[serde(default)]
    pub(super) distortion: Vec<f64>,
}

const PINHOLE: &str = "pinhole";
const BROWN_CONRADY: &str = "brown_conrady";
const KANNALA_BRANDT: &str = "kannala_brandt";

impl LensFile {
    pub(super) fn of(intrinsics: &Intrinsics) -> Self {
        let (model, distortion) = match &intrinsics.lens {
            Lens::Pinhole => (PINHOLE, Vec::new()),
            Lens::BrownConrady(k) => (BROWN_CONRADY, k.to_vec()),
            Lens::RationalBrownConrady(k) => (BROWN_CONRADY, k.to_vec()),
            Lens::KannalaBrandt(k) => (KANNALA_BRANDT, k.to_vec()),
        };
        Self {
            model: Some(model.to_owned()),
            size_px: Some(intrinsics.size_px),
            focal_px: intrinsics.focal_px,
            principal_px: intrinsics.principal_px,
            distortion,
        }
    }

    /// The intrinsics. Without a size, the image is assumed to be symmetric about the principal point.
    pub(super) fn intrinsics(&self) -> Result<Intrinsics, BadArgument> {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a number of pixels, clamped")]
        let size = |axis: usize| (2.0 * self.principal_px[axis]).round().clamp(1.0, 1e5) as u32;
        let intrinsics = Intrinsics {
            size_px: self.size_px.unwrap_or_else(|| [size(0), size(1)]),
            focal_px: self.focal_px,
            principal_px: self.principal_px,
            lens: self.lens()?,
            rectified: false,
        };
        intrinsics.validate().map_err(|error| BadArgument(format!("intrinsics: {error}")))?;
        Ok(intrinsics)
    }

    fn lens(&self) -> Result<Lens, BadArgument> {
        let k = &self.distortion;
        let default = if k.is_empty() { PINHOLE } else { BROWN_CONRADY };
        // Results of `calibrate intrinsics` may list the coefficients after the name.
        let model = self.model.as_deref().and_then(|model| model.split_whitespace().next()).unwrap_or(default);
        let too_many = |max: usize| {
            BadArgument(format!("intrinsics: {} distortion coefficients; {model} has at most {max}", k.len()))
        };
        match model {
            PINHOLE if k.is_empty() => Ok(Lens::Pinhole),
            PINHOLE => Err(too_many(0)),
            BROWN_CONRADY if k.len() <= 5 => Ok(Lens::BrownConrady(padded(k))),
            BROWN_CONRADY if k.len() <= 8 => Ok(Lens::RationalBrownConrady(padded(k))),
            BROWN_CONRADY => Err(too_many(8)),
            KANNALA_BRANDT if k.len() <= 4 => Ok(Lens::KannalaBrandt(padded(k))),
            KANNALA_BRANDT => Err(too_many(4)),
            other => Err(BadArgument(format!(
                "intrinsics: unknown model {other:?}, expected {PINHOLE}, {BROWN_CONRADY} or {KANNALA_BRANDT}"
            ))),
        }
    }

    pub(super) fn model_name(&self) -> &str {
        self.model.as_deref().unwrap_or(PINHOLE)
    }

    /// The value of `intrinsics` in a rig file.
    pub(super) fn to_toml(&self) -> String {
        let list = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
        let distortion = match self.distortion.is_empty() {
            true => String::new(),
            false => format!(", distortion = [{}]", list(&self.distortion)),
        };
        format!(
            "{{ focal_px = [{}], principal_px = [{}], lens = \"{}\"{distortion} }}",
            list(&self.focal_px),
            list(&self.principal_px),
            self.model_name()
        )
    }
}

/// The coefficients, followed by zeros.
fn padded<const N: usize>(coefficients: &[f64]) -> [f64; N] {
    std::array::from_fn(|ix| coefficients.get(ix).copied().unwrap_or(0.0))
}
