//! Intrinsics as JSON.

use crate::json_object::JsonObject;
use kinematics::{Intrinsics, Lens};
use messages::BadInput;
use nalgebra::DMatrix;
use serde::Serialize;

/// Intrinsics in JSON files, as `calibrate intrinsics` prints them. Pixel centers are at +0.5.
#[derive(Clone, Debug, Serialize)]
pub struct LensFile {
    /// `pinhole`, `brown_conrady` (five or eight coefficients) or `kannala_brandt`, as in rig
    /// files. With distortion coefficients, the default is `brown_conrady`. Without coefficients,
    /// it is `pinhole`.
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    /// Width and height of the images.
    pub size_px: Option<[u32; 2]>,
    /// Focal lengths.
    pub focal_px: [f64; 2],
    /// Principal point.
    pub principal_px: [f64; 2],
    /// Coefficients in OpenCV's order.
    pub distortion: Vec<f64>,
    /// Covariance of all these parameters, row by row. It is empty if it is unknown.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    covariance: Vec<f64>,
    /// Standard deviations of parameters, by the index of the parameter. They are used if the
    /// covariance is unknown.
    #[serde(skip)]
    sigmas: Vec<(usize, f64)>,
}

const PINHOLE: &str = "pinhole";
const BROWN_CONRADY: &str = "brown_conrady";
const KANNALA_BRANDT: &str = "kannala_brandt";

impl LensFile {
    /// Keys of a file with intrinsics. They include the unused keys that `calibrate intrinsics
    /// --json` prints.
    pub(crate) const KEYS: [&'static str; 17] = [
        "focal_px",
        "principal_px",
        "distortion",
        "lens",
        "model",
        "size_px",
        "coefficients",
        "rms_px",
        "noise_px",
        "sigma",
        "covariance",
        "rejected",
        "images",
        "coverage",
        "projection_sigma_px",
        "trials",
        "next_view",
    ];

    pub(crate) fn read(object: &JsonObject<'_>) -> Result<Self, BadInput> {
        let size_px = match object.array::<2>("size_px")? {
            Some([width, height]) => Some([side(object, width)?, side(object, height)?]),
            None => None,
        };
        let model = match (object.text("model")?, object.text("lens")?) {
            (Some(model), Some(lens)) if model != lens => {
                let why = format!(
                    "{lens:?}, but model is {model:?}; both mean the lens model: keep one of them"
                );
                return Err(object.invalid("lens", why));
            }
            (model, lens) => model.or(lens),
        };
        Ok(Self {
            model: model.map(str::to_owned),
            size_px,
            focal_px: object.required("focal_px", object.array("focal_px")?)?,
            principal_px: object.required("principal_px", object.array("principal_px")?)?,
            distortion: object.numbers("distortion")?.unwrap_or_default(),
            covariance: object.numbers("covariance")?.unwrap_or_default(),
            sigmas: object
                .object("sigma", &param_names(model))?
                .map_or(Ok(Vec::new()), |sigma| sigmas(&sigma, model))?,
        })
    }

    /// The intrinsics without their uncertainty.
    pub fn of(intrinsics: &Intrinsics) -> Self {
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
            covariance: Vec::new(),
            sigmas: Vec::new(),
        }
    }

    /// The intrinsics with the covariance of their parameters.
    #[must_use]
    pub fn with_covariance(self, covariance: &DMatrix<f64>) -> Self {
        // The matrix is symmetric, so the order of rows and columns does not matter.
        Self {
            covariance: covariance.as_slice().to_vec(),
            ..self
        }
    }

    /// Covariance of [`Intrinsics::params`]. If only standard deviations are given, the parameters
    /// are assumed to be independent, and parameters without a standard deviation are assumed to be
    /// exact.
    pub(crate) fn covariance(
        &self,
        intrinsics: &Intrinsics,
    ) -> Result<Option<DMatrix<f64>>, BadInput> {
        let n = intrinsics.params().len();
        let name = |ix: usize| param_names(self.model.as_deref())[ix];
        // A standard deviation of a coefficient that the lens lacks probably belongs to another
        // lens.
        if let Some((ix, _)) = self.sigmas.iter().find(|(ix, _)| *ix >= n) {
            let params = param_names(self.model.as_deref())[..n].join(", ");
            return Err(BadInput(format!(
                "intrinsics.sigma.{}: the lens has only {params}",
                name(*ix)
            )));
        }
        let given = covariance_of(&self.covariance, intrinsics)
            .map_err(|error| BadInput(format!("intrinsics.covariance: {error}")))?;
        let Some(given) = given else {
            let mut independent = DMatrix::zeros(n, n);
            for (ix, sigma) in &self.sigmas {
                independent[(*ix, *ix)] = sigma * sigma;
            }
            // Without standard deviations, the uncertainty is unknown, not zero.
            return Ok((!self.sigmas.is_empty()).then_some(independent));
        };
        /// Maximum relative difference of two standard deviations that should be equal. They may be
        /// rounded.
        const MAX_DIFFERENCE: f64 = 0.01;
        // Files often contain both the covariance and the standard deviations, and one of them may
        // have been edited.
        for (ix, sigma) in &self.sigmas {
            let of_covariance = given[(*ix, *ix)].max(0.0).sqrt();
            if (sigma - of_covariance).abs() > MAX_DIFFERENCE * sigma.max(of_covariance) {
                return Err(BadInput(format!(
                    "intrinsics.sigma.{} is {sigma}, but intrinsics.covariance means {of_covariance}; remove the wrong one",
                    name(*ix)
                )));
            }
        }
        Ok(Some(given))
    }

    /// The intrinsics for images of the given size.
    pub(crate) fn intrinsics(&self, size_px: [u32; 2]) -> Result<Intrinsics, BadInput> {
        let [width, height] = size_px;
        // Intrinsics are not scaled to another resolution, because many cameras crop the image
        // instead of scaling it.
        if let Some(own) = self.size_px.filter(|own| *own != size_px) {
            return Err(BadInput(format!(
                "the intrinsics are for images of {}x{} pixels, but the images have {width}x{height}; calibrate this resolution",
                own[0], own[1]
            )));
        }
        // The principal point of a lens is near the center of its images.
        const CENTRAL_FRAC: std::ops::RangeInclusive<f64> = 0.25..=0.75;
        if (0..2).any(|axis| {
            !CENTRAL_FRAC.contains(&(self.principal_px[axis] / f64::from(size_px[axis])))
        }) {
            return Err(BadInput(format!(
                "principal_px {:?} is far from the center of images of {width}x{height} pixels; the intrinsics are probably for another resolution",
                self.principal_px
            )));
        }
        let intrinsics = Intrinsics {
            size_px,
            focal_px: self.focal_px,
            principal_px: self.principal_px,
            lens: self.lens()?,
            rectified: false,
        };
        intrinsics
            .validate()
            .map_err(|error| BadInput(format!("intrinsics: {error}")))?;
        Ok(intrinsics)
    }

    fn lens(&self) -> Result<Lens, BadInput> {
        let k = &self.distortion;
        let default = if k.is_empty() { PINHOLE } else { BROWN_CONRADY };
        let model = self.model.as_deref().unwrap_or(default);
        let too_many = |max| too_many(k.len(), model, max);
        match model {
            PINHOLE if k.is_empty() => Ok(Lens::Pinhole),
            PINHOLE => Err(too_many(0)),
            BROWN_CONRADY if k.len() <= 5 => Ok(Lens::BrownConrady(padded(k))),
            BROWN_CONRADY if k.len() <= 8 => Ok(Lens::RationalBrownConrady(padded(k))),
            BROWN_CONRADY => Err(too_many(8)),
            KANNALA_BRANDT if k.len() <= 4 => Ok(Lens::KannalaBrandt(padded(k))),
            KANNALA_BRANDT => Err(too_many(4)),
            other => Err(BadInput(format!(
                "intrinsics: unknown model {other:?}, expected {PINHOLE}, {BROWN_CONRADY} or {KANNALA_BRANDT}"
            ))),
        }
    }

    /// Name of the lens model, as in rig files.
    pub fn model_name(&self) -> &str {
        self.model.as_deref().unwrap_or(PINHOLE)
    }

    /// The value of `intrinsics` in a rig file.
    pub fn to_toml(&self) -> String {
        let distortion = if self.distortion.is_empty() {
            String::new()
        } else {
            format!(", distortion = [{}]", list(&self.distortion))
        };
        format!(
            "{{ focal_px = [{}], principal_px = [{}], lens = \"{}\"{distortion} }}",
            list(&self.focal_px),
            list(&self.principal_px),
            self.model_name()
        )
    }
}

/// A width or height of an image.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a whole number in the range"
)]
fn side(object: &JsonObject<'_>, value: f64) -> Result<u32, BadInput> {
    let is_side = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
    is_side
        .then_some(value as u32)
        .ok_or_else(|| object.invalid("size_px", "must be whole numbers above 0"))
}

/// The error for `n` coefficients of a model that has at most `max`.
fn too_many(n: usize, model: &str, max: usize) -> BadInput {
    BadInput(format!(
        "intrinsics: {n} distortion coefficients; {model} has at most {max}"
    ))
}

fn list(values: &[f64]) -> String {
    values
        .iter()
        .map(f64::to_string)
        .collect::<Vec<_>>()
        .join(", ")
}

/// Names of focal lengths and principal point. The next constants are the names of the coefficients
/// of both kinds of lenses in OpenCV's order.
const PLANE_NAMES: [&str; 4] = ["fx", "fy", "cx", "cy"];
const BROWN_CONRADY_NAMES: [&str; 8] = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
const KANNALA_BRANDT_NAMES: [&str; 4] = ["k1", "k2", "k3", "k4"];

/// Names of the parameters of a lens model, in the order of [`Intrinsics::params`]. A lens may have
/// only the first of these parameters.
pub(crate) fn param_names(model: Option<&str>) -> Vec<&'static str> {
    let coefficients: &[&str] = if model == Some(KANNALA_BRANDT) {
        &KANNALA_BRANDT_NAMES
    } else {
        &BROWN_CONRADY_NAMES
    };
    PLANE_NAMES.iter().chain(coefficients).copied().collect()
}

/// Standard deviations with the indices of their parameters.
fn sigmas(sigma: &JsonObject<'_>, model: Option<&str>) -> Result<Vec<(usize, f64)>, BadInput> {
    let names = param_names(model).into_iter().enumerate();
    let given = names.filter_map(|(ix, name)| sigma.get(name).map(|value| (ix, name, value)));
    given
        .map(
            |(ix, name, value)| match value.as_f64().filter(|value| *value >= 0.0) {
                Some(value) => Ok((ix, value)),
                None => Err(sigma.invalid(name, "expected a number of at least 0")),
            },
        )
        .collect()
}

/// The matrix of a list. `None` if it is empty.
pub(crate) fn covariance_of(
    list: &[f64],
    intrinsics: &Intrinsics,
) -> Result<Option<DMatrix<f64>>, String> {
    let n = intrinsics.params().len();
    match list.len() {
        0 => Ok(None),
        n_given if n_given == n * n => Ok(Some(DMatrix::from_row_slice(n, n, list))),
        n_given => Err(format!(
            "{n_given} numbers, but the lens has {n} parameters: expected {} numbers",
            n * n
        )),
    }
}

/// The coefficients, followed by zeros.
fn padded<const N: usize>(coefficients: &[f64]) -> [f64; N] {
    std::array::from_fn(|ix| coefficients.get(ix).copied().unwrap_or(0.0))
}
