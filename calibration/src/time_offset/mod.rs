//! Time offset between two pose streams of rigidly joined bodies, such as a camera and a tracked
//! marker or an arm.
//!
//! The correlation of rotation rates gives an initial offset. A continuous-time fit refines it
//! together with the rotation between the bodies. The stated uncertainty allows for errors that are
//! correlated in time.

mod coarse;
mod fine;
mod profile;
mod quaternion_order;
mod stamps;
mod stream;
#[cfg(test)]
mod tests;

pub use profile::{MotionProfile, motion_profile};

use crate::Error;
use crate::hand_eye::{
    BoardObservation, HandEyeInput, HandEyeOptions, HandEyeSample, Refusal, Scatter, Setup,
    calibrate_hand_eye,
};
use kinematics::Transform;
use stream::Stream;

/// A pose of a body at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// Time on the clock of the stream, seconds.
    pub secs: f64,
    /// `reference_from_body`, for example `world_from_camera`.
    pub pose: Transform,
}

/// Options of [`estimate_time_offset`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOffsetOptions {
    /// Also estimates the rigid transform between the bodies.
    pub hand_eye: bool,
    /// Largest absolute offset that is searched, seconds. `None` searches all offsets at which the
    /// recordings overlap.
    pub max_offset_secs: Option<f64>,
    /// Maximum standard deviation of the offset, seconds. A less certain offset is refused.
    pub max_sigma_secs: f64,
}

impl Default for TimeOffsetOptions {
    fn default() -> Self {
        Self {
            hand_eye: false,
            max_offset_secs: None,
            max_sigma_secs: 0.02,
        }
    }
}

/// Result of [`estimate_time_offset`].
#[derive(Clone, Debug)]
pub struct TimeOffset {
    /// Seconds to add to B's clock to get A's clock. If the clocks drift, this is the value at
    /// `mid_secs`.
    pub offset_secs: f64,
    /// Standard deviation of the offset.
    pub sigma_secs: f64,
    /// Drift of A's clock relative to B's clock and its standard deviation, parts per million.
    /// `None` if the drift is smaller than three standard deviations. A's clock is at `secs_b +
    /// offset_secs + 1e-6 * drift * (secs_b - mid_secs)`.
    pub drift_ppm: Option<[f64; 2]>,
    /// Middle of the overlap on B's clock.
    pub mid_secs: f64,
    /// RMS difference of the orientations after alignment, degrees.
    pub rms_deg: f64,
    /// Differences of the orientations after alignment. Each entry is a time on B's clock in
    /// seconds and a difference in degrees.
    pub residuals: Vec<[f64; 2]>,
    /// The transform between the bodies, or the reason for its refusal. `None` if it was not
    /// requested.
    pub hand_eye: Option<Result<BodyTransform, Refusal>>,
}

/// The rigid transform between two bodies.
#[derive(Clone, Debug)]
pub struct BodyTransform {
    /// Pose of body B in the frame of body A.
    pub a_body_from_b_body: Transform,
    /// Standard deviations of the position along B's axes, millimeters.
    pub sigma_mm: [f64; 3],
    /// Standard deviations of the rotation around B's axes, degrees.
    pub sigma_deg: [f64; 3],
    /// Scatter of B's reference frame in A's reference frame.
    pub scatter: Scatter,
}

/// Estimates the time offset between two streams of poses.
///
/// The streams may have different rates, gaps, outliers and clocks with different zeros, but must
/// overlap in time.
///
/// # Errors
/// Returns [`Error::Refused`] if the motion does not determine the offset, and
/// [`Error::TimeOffsetInput`] if a stream is invalid.
///
/// ```
/// use calibration::time_offset::{PoseSample, TimeOffsetOptions, estimate_time_offset};
/// use kinematics::Transform;
/// use nalgebra::Vector3;
///
/// let at = |secs: f64| {
///     let rotation = Vector3::new((1.3 * secs).sin(), (0.9 * secs * secs).cos() * 0.4, (2.1 * secs).cos() * 0.5);
///     Transform::new(Vector3::zeros(), rotation)
/// };
/// let stream = |step_secs: f64, clock_secs: f64| -> Vec<PoseSample> {
///     (0..).map(|ix| f64::from(ix) * step_secs).take_while(|secs| *secs < 8.0)
///         .map(|secs| PoseSample { secs: secs + clock_secs, pose: at(secs) }).collect()
/// };
/// let offset = estimate_time_offset(&stream(0.01, 100.0), &stream(0.033, 0.25), &TimeOffsetOptions::default())?;
/// assert!((offset.offset_secs - 99.75).abs() < 1e-3);
/// # Ok::<(), calibration::Error>(())
/// ```
pub fn estimate_time_offset(
    a: &[PoseSample],
    b: &[PoseSample],
    options: &TimeOffsetOptions,
) -> Result<TimeOffset, Error> {
    // The orientations are always checked, because streams with wrong quaternions may give an
    // offset with large residuals.
    let found = estimate(a, b, options);
    match quaternion_order::mistake(a, b, options, found.as_ref()) {
        Some(refusal) => Err(Error::Refused(Box::new(refusal))),
        None => found,
    }
}

/// The estimate for streams as they are given.
fn estimate(
    a: &[PoseSample],
    b: &[PoseSample],
    options: &TimeOffsetOptions,
) -> Result<TimeOffset, Error> {
    let refused = |refusal| Error::Refused(Box::new(refusal));
    let a = Stream::new("A", a)?;
    let b = Stream::new("B", b)?;
    let coarse = coarse::correlate(&a, &b, options.max_offset_secs).map_err(refused)?;
    // The stream with the higher rate is interpolated, because its interpolation errors are
    // smaller.
    let is_swapped = b.step_secs() < a.step_secs();
    let (interpolated, points) = if is_swapped { (&b, &a) } else { (&a, &b) };
    let sign = if is_swapped { -1.0 } else { 1.0 };
    let (coarse, fine) =
        refine_best(interpolated, points, &coarse, sign).map_err(|error| match &error {
            Error::Refused(_) => coarse::clock_rate_mistake(&a, &b).map_or(error, refused),
            _ => error,
        })?;
    let offset_secs = sign * fine.offset_secs;
    // A stream and its inverse have the same rotation rates, but different orientations. If one
    // stream is inverted, the initial offset is right, and the fit of the orientations moves away
    // from it.
    if (offset_secs - coarse.offset_secs).abs() > 10.0 * coarse.step_secs {
        return Err(refused(Refusal::new(
            format!(
                "the offsets from rotation rates ({:.3} s) and from orientations ({offset_secs:.3} s) disagree",
                coarse.offset_secs
            ),
            "check that both streams are poses of the bodies (reference_from_body), not their inverses",
        )));
    }
    // An offset near the limit may exceed the limit because of its error.
    const MAX_SIGMAS: f64 = 3.0;
    let is_beyond = |most: &f64| offset_secs.abs() > most + MAX_SIGMAS * fine.sigma_secs;
    if let Some(most) = options.max_offset_secs.filter(is_beyond) {
        return Err(refused(Refusal::new(
            format!(
                "the offset is {offset_secs:.3} s, which is more than the largest offset to search ({most} s)"
            ),
            "search larger offsets",
        )));
    }
    // The condition is written so that NaN is refused.
    let is_certain = fine.sigma_secs <= options.max_sigma_secs;
    if !is_certain {
        return Err(refused(Refusal::new(
            format!(
                "the offset is uncertain by {:.1} ms (at most {:.1} ms): the rotation changes too slowly for the noise of the poses",
                1e3 * fine.sigma_secs,
                1e3 * options.max_sigma_secs
            ),
            "rotate the bodies faster and with more changes of direction",
        )));
    }
    // The fit describes A's time at points of B. With swapped streams, its times are on A's clock.
    let mid_secs = if is_swapped {
        fine.mid_secs + fine.offset_secs
    } else {
        fine.mid_secs
    };
    let drift = fine.drift.map_or(0.0, |[drift, _]| sign * drift);
    let secs_a = |secs_b: f64| secs_b + offset_secs + drift * (secs_b - mid_secs);
    let secs_b = |secs: f64| {
        if is_swapped {
            secs + fine.offset_secs
        } else {
            secs
        }
    };
    let residuals = fine
        .residuals
        .iter()
        .map(|[secs, rad]| [secs_b(*secs), rad.to_degrees()])
        .collect();
    Ok(TimeOffset {
        offset_secs,
        sigma_secs: fine.sigma_secs,
        drift_ppm: fine
            .drift
            .map(|[drift, sigma]| [1e6 * sign * drift, 1e6 * sigma]),
        mid_secs,
        rms_deg: fine.rms_rad.to_degrees(),
        residuals,
        hand_eye: options
            .hand_eye
            .then(|| body_transform(&a, &b, secs_a))
            .transpose()?,
    })
}

/// The refined offset with the smallest residuals, and the offset from which it started.
///
/// # Errors
/// Fails if no offset fits, or if another offset fits equally well.
fn refine_best(
    interpolated: &Stream,
    points: &Stream,
    starts: &[coarse::Coarse],
    sign: f64,
) -> Result<(coarse::Coarse, fine::Fine), Error> {
    /// Residuals of a wrong offset exceed the noise by a large factor.
    const SIMILAR: f64 = 1.5;
    /// Smaller differences are below the resolution of all tracking systems.
    const EXACT_RAD: f64 = 1e-4;
    /// Largest residual relative to the motion. For unrelated motions, this ratio is about 1.
    const MAX_RESIDUAL_FRAC: f64 = 0.25;
    /// Largest residual per axis of rigidly joined bodies, about 5 degrees.
    const MAX_RESIDUAL_RAD: f64 = 0.09;
    let mut found: Vec<(coarse::Coarse, fine::Fine)> = Vec::new();
    let mut first_error = None;
    for start in starts {
        match fine::refine(interpolated, points, sign * start.offset_secs) {
            Ok(fine) => found.push((*start, fine)),
            Err(error) => first_error = first_error.or(Some(error)),
        }
    }
    found.sort_by(|p, q| p.1.median_rad.total_cmp(&q.1.median_rad));
    let refused = |why: String, motion: &str| Error::Refused(Box::new(Refusal::new(why, motion)));
    let mut ranked = found.into_iter();
    let Some((start, best)) = ranked.next() else {
        let why = || Error::TimeOffsetInput {
            why: "there is no initial offset".to_owned(),
        };
        return Err(first_error.unwrap_or_else(why));
    };
    if best.median_rad > (MAX_RESIDUAL_FRAC * best.motion_rad).min(MAX_RESIDUAL_RAD) {
        return Err(refused(
            format!(
                "after alignment, the orientations still differ by {:.1} degrees of {:.1} degrees of motion",
                best.median_rad.to_degrees(),
                best.motion_rad.to_degrees()
            ),
            "check that both bodies are rigidly joined and recorded at the same time, and that both streams are reference_from_body with the quaternion order x, y, z, w",
        ));
    }
    let is_other =
        |fine: &fine::Fine| (fine.offset_secs - best.offset_secs).abs() > 5.0 * start.step_secs;
    if let Some((_, other)) = ranked
        .find(|(_, fine)| is_other(fine) && fine.median_rad < SIMILAR * best.median_rad + EXACT_RAD)
    {
        return Err(refused(
            format!(
                "the motion repeats: offsets that differ by {:.2} s fit equally well",
                (other.offset_secs - best.offset_secs).abs()
            ),
            "move irregularly, or limit the offset that is searched",
        ));
    }
    Ok((start, best))
}

/// Transform between the bodies from poses at the same times. The inner error is a refusal.
fn body_transform(
    a: &Stream,
    b: &Stream,
    secs_a: impl Fn(f64) -> f64,
) -> Result<Result<BodyTransform, Refusal>, Error> {
    /// Additional poses would not be independent of these poses. They would only take more time.
    const MAX_SAMPLES: usize = 50;
    let pairs: Vec<(f64, Transform, Transform)> = b
        .samples
        .iter()
        .filter_map(|sample| Some((sample.secs, a.at(secs_a(sample.secs))?, sample.pose)))
        .collect();
    let stride = pairs.len().div_ceil(MAX_SAMPLES).max(1);
    let samples = pairs
        .iter()
        .step_by(stride)
        .map(|(secs, a_pose, b_pose)| HandEyeSample {
            name: format!("{secs:.3}"),
            base_from_flange: *a_pose,
            board: BoardObservation::Pose(b_pose.inverse()),
            joints: None,
        });
    let input = HandEyeInput {
        setup: Setup::EyeInHand,
        samples: samples.collect(),
        intrinsics: None,
        intrinsics_covariance: None,
        board_symmetries: &[],
        chain: None,
        options: HandEyeOptions {
            board_is_seen: false,
            ..HandEyeOptions::default()
        },
    };
    match calibrate_hand_eye(&input) {
        Ok(found) => Ok(Ok(BodyTransform {
            a_body_from_b_body: found.parent_from_camera,
            sigma_mm: found.sigma_mm,
            sigma_deg: found.sigma_deg,
            scatter: found.scatter,
        })),
        Err(Error::Refused(refusal)) => {
            // The hand-eye calibration names its own input. Longer names come first, because
            // shorter names are parts of them.
            let names = [
                ("base_from_flange", "stream A"),
                ("camera_from_board", "the inverse of stream B"),
                ("the flange", "body A"),
                ("flange", "body A"),
                ("the board", "stream B"),
            ];
            let named = |text: &str| {
                names
                    .iter()
                    .fold(text.to_owned(), |text, (from, to)| text.replace(from, to))
            };
            Ok(Err(Refusal {
                why: named(&refusal.why),
                axis: refusal.axis,
                motion: named(&refusal.motion),
            }))
        }
        Err(error) => Err(error),
    }
}
