//! Errors of calibration.

use messages::ErrorClass;

/// An error of calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A bug: the alignment thread panicked.
    #[error("internal error: the alignment thread ended without a result")]
    AlignmentPanicked,
    /// A residual cannot be computed from the initial parameters.
    #[error(
        "least squares: a residual of block {block_ix} is not defined at the initial parameters; they must be closer to the solution"
    )]
    UndefinedResidual {
        /// Index of the block of residuals.
        block_ix: usize,
    },
    /// The number of residuals does not exceed the number of parameters.
    #[error(
        "least squares: {n_residuals} residuals cannot determine {n_params} parameters; more measurements are needed"
    )]
    TooFewResiduals {
        /// Number of scalar residuals.
        n_residuals: usize,
        /// Number of parameters.
        n_params: usize,
    },
    /// The number of sizes differs from the number of images.
    #[error("calibration from targets: {n_images} images, but {n_sizes} image sizes")]
    ImageSizes {
        /// Number of images.
        n_images: usize,
        /// Number of sizes.
        n_sizes: usize,
    },
    /// Images differ in size.
    #[error(
        "images have different sizes: {first} is {}x{}, {other} is {}x{}; calibrate each camera and each resolution separately",
        first_px[0], first_px[1], other_px[0], other_px[1]
    )]
    MixedImageSizes {
        /// Name of the first image.
        first: String,
        /// Its size, pixels.
        first_px: [u32; 2],
        /// Name of the first image with another size.
        other: String,
        /// Its size, pixels.
        other_px: [u32; 2],
    },
    /// An image without pixels.
    #[error("image {image}: its size is zero")]
    EmptyImage {
        /// Name of the image.
        image: String,
    },
    /// A coordinate is NaN or infinite.
    #[error("image {image}: a detected point is not finite")]
    NonFinitePoint {
        /// Name of the image.
        image: String,
    },
    /// The points of the target are in the wrong unit.
    #[error(
        "the target is {size_m} m wide, expected 0.002 to 10 m; its dimensions must be in meters"
    )]
    TargetSize {
        /// Longer side of the target, meters.
        size_m: String,
    },
    /// The points of the target are not in one plane.
    #[error(
        "the target is not flat: its points differ by {depth_mm} mm in z; calibration needs a flat target"
    )]
    TargetNotFlat {
        /// Range of the z coordinates, millimeters.
        depth_mm: String,
    },
    /// Too few images show the target.
    #[error(
        "{n_images} different images with a usable target, expected at least {min_images}; take 15 to 20 images with the target in all parts of the image, tilted in different directions"
    )]
    TooFewImages {
        /// Number of usable images.
        n_images: usize,
        /// Minimum number.
        min_images: usize,
    },
    /// No lens model fits the points.
    #[error(
        "no lens model of this kind fits the detected points; check the layout of the target and the requested model"
    )]
    NoLensFits,
    /// The points of most images do not fit a flat target.
    #[error(
        "the detected points do not fit the target: the median error is {error_px} px; check the number of rows and columns of the target, and that it is flat"
    )]
    TargetMismatch {
        /// Median error of the best lens model, pixels.
        error_px: String,
    },
    /// The images do not determine the focal length.
    #[error(
        "the images do not determine the focal length (standard deviation {sigma_percent} %): the target is tilted by at most {max_tilt_deg} degrees; add images with the target tilted by 20 to 45 degrees to the left, right, top and bottom"
    )]
    FocalLengthUnobservable {
        /// Standard deviation of the focal length, percent.
        sigma_percent: String,
        /// Largest angle between the target and the image plane, degrees.
        max_tilt_deg: String,
    },
    /// The images do not determine the principal point.
    #[error(
        "the images do not determine the principal point (standard deviation {sigma_px} px): the target is tilted by at most {max_tilt_deg} degrees; add images with the target tilted by 20 to 45 degrees in different directions"
    )]
    PrincipalPointUnobservable {
        /// Standard deviation of the principal point, pixels.
        sigma_px: String,
        /// Largest angle between the target and the image plane, degrees.
        max_tilt_deg: String,
    },
    /// The input of a hand-eye calibration is invalid.
    #[error("hand-eye: {why}")]
    HandEyeInput {
        /// What is wrong, with the value found and the value expected.
        why: String,
    },
    /// The input of a time offset estimation is invalid.
    #[error("time offset: {why}")]
    TimeOffsetInput {
        /// What is wrong, with the value found and the value expected.
        why: String,
    },
    /// The measurements do not determine the result, or they contain a mistake that explains why
    /// they disagree.
    #[error("calibration refused: {0}")]
    Refused(Box<Refusal>),
}

impl Error {
    /// Whether the input is invalid, the measurements are insufficient, or the calibration failed.
    pub fn class(&self) -> ErrorClass {
        match self {
            Self::AlignmentPanicked | Self::UndefinedResidual { .. } => ErrorClass::Failed,
            Self::ImageSizes { .. }
            | Self::MixedImageSizes { .. }
            | Self::EmptyImage { .. }
            | Self::NonFinitePoint { .. }
            | Self::TargetSize { .. }
            | Self::TargetNotFlat { .. }
            | Self::HandEyeInput { .. }
            | Self::TimeOffsetInput { .. } => ErrorClass::BadInput,
            Self::TooFewResiduals { .. }
            | Self::TooFewImages { .. }
            | Self::NoLensFits
            | Self::TargetMismatch { .. }
            | Self::FocalLengthUnobservable { .. }
            | Self::PrincipalPointUnobservable { .. }
            | Self::Refused(_) => ErrorClass::InsufficientData,
        }
    }
}

/// Why no calibration is returned although the input is valid.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// What is missing or wrong, with values.
    pub why: String,
    /// Unit vector in the flange frame. It is the only observed axis of rotation, or the direction
    /// that is not observable. It is `None` if the reason does not concern an axis.
    pub axis: Option<[f64; 3]>,
    /// The motion or correction that would help.
    pub motion: String,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; {}", self.why, self.motion)
    }
}

impl From<Refusal> for Error {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(Box::new(refusal))
    }
}

impl Refusal {
    pub(crate) fn new(why: impl Into<String>, motion: impl Into<String>) -> Self {
        Self {
            why: why.into(),
            axis: None,
            motion: motion.into(),
        }
    }

    /// Adds warnings, because they may describe the cause. For example, wrong samples enlarge the
    /// uncertainty.
    ///
    /// * `except`: a warning that is reported in another way.
    pub(crate) fn with_warnings(self, warnings: &[String], except: Option<&str>) -> Self {
        let added = warnings
            .iter()
            .filter(|warning| Some(warning.as_str()) != except);
        let why = std::iter::once(&self.why)
            .chain(added)
            .cloned()
            .collect::<Vec<_>>()
            .join("; ");
        Self { why, ..self }
    }
}
