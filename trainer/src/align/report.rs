//! What alignment found, in words and numbers a person can use.

use super::fit::Fit;
use super::layout::Term;
use super::solve::Solved;
use super::{LEAST_JUDGES, Model, Scene};
use crate::splat::{CameraFix, Candidate, Trial};
use nalgebra::{DVector, Vector3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What alignment found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// By camera; empty where nothing was kept.
    pub fixes: BTreeMap<String, CameraFix>,
    /// What was kept, with its uncertainty.
    pub found: Vec<Found>,
    /// What the motion does not show of what was kept; it stays at zero.
    pub unseen: Vec<Unseen>,
    /// What was tried, and how much better it predicts the selection images.
    pub trials: Vec<Trial>,
    /// Pairs of images that were compared.
    pub n_pairs: usize,
}

/// A correction. Deviations are standard ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "kebab-case")]
pub enum Found {
    /// The camera sits elsewhere on what carries it: a turn about an axis and a way, both in its own axes as the input has them.
    HandEye(Moved),
    /// The depth frame sits elsewhere in the color frame, in whose axes this is told.
    DepthPose(Moved),
    /// Images were taken later than their stamps say.
    Delay(Number),
    /// Readings of depth want this factor, less 1.
    DepthScale(Number),
    /// The readout takes longer, seconds.
    Readout(Number),
    /// What is to be added to a joint's reading.
    Joint {
        /// In the order of the chain's moving joints.
        joint_ix: usize,
        /// Radians or metres.
        value: f64,
        /// Radians or metres.
        sigma: f64,
        /// Share of it that only shows together with something else, 0 to 1.
        unseen_share: f64,
    },
    /// The lens.
    Lens {
        /// Name of the camera.
        camera: String,
        /// Factors on the focal lengths, less 1.
        focal_frac: [f64; 2],
        /// Their deviations.
        focal_sigma: [f64; 2],
        /// Shift of the principal point, in focal lengths.
        principal_focals: [f64; 2],
        /// Their deviations.
        principal_sigma: [f64; 2],
    },
    /// Images that were moved on their own.
    ImagePoses {
        /// Name of the camera.
        camera: String,
        /// How many.
        n_images: usize,
        /// Root of the mean square, metres.
        rms_m: f64,
        /// Root of the mean square, radians.
        rms_rad: f64,
    },
}

/// A rigid motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Moved {
    /// Name of the camera.
    pub camera: String,
    /// Radians.
    pub turn_rad: f64,
    /// Radians.
    pub turn_sigma_rad: f64,
    /// Of length one; zero where nothing turned.
    pub turn_axis: [f64; 3],
    /// Metres.
    pub shift_m: f64,
    /// Metres.
    pub shift_sigma_m: f64,
    /// Of length one; zero where nothing moved.
    pub shift_axis: [f64; 3],
}

/// One number of one camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Number {
    /// Name of the camera.
    pub camera: String,
    /// Seconds, or a share of one.
    pub value: f64,
    /// In the same unit.
    pub sigma: f64,
}

/// A direction that the motion does not show: a change of all these together leaves every pair as it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Unseen {
    /// Words, one part each.
    pub parts: Vec<String>,
}

pub(super) fn alignment(scene: &Scene, kept: &Model, trials: Vec<Trial>, unseen: Vec<Unseen>) -> Alignment {
    let mut found = Vec::new();
    if let Some(fit) = &kept.fit {
        for (ix, term) in fit.layout.terms.iter().enumerate() {
            found.extend(self::found(scene, kept, &fit.solved, ix, *term));
        }
    }
    if kept.set.image_poses {
        found.extend(scene.cameras.iter().enumerate().map(|(camera, name)| {
            let drift = &kept.corrections.fixes[camera].drift;
            let rms = |parts: std::ops::Range<usize>| {
                let squares = drift.values().map(|drift| drift[parts.clone()].iter().map(|x| x * x).sum::<f64>());
                (squares.sum::<f64>() / drift.len().max(1) as f64).sqrt()
            };
            Found::ImagePoses { camera: name.to_string(), n_images: drift.len(), rms_m: rms(3..6), rms_rad: rms(0..3) }
        }));
    }
    let fixes = scene.cameras.iter().zip(&kept.corrections.fixes).map(|(name, fix)| (name.to_string(), fix.clone()));
    let fixes = if kept.set.any() { fixes.collect() } else { BTreeMap::new() };
    Alignment { fixes, found, unseen, trials, n_pairs: scene.pairs.len() }
}

/// What is said where a term's first number stands.
fn found(scene: &Scene, kept: &Model, solved: &Solved, ix: usize, term: Term) -> Option<Found> {
    let fix = |camera: usize| &kept.corrections.fixes[camera];
    let name = |camera: usize| scene.cameras[camera].to_string();
    let number = |camera: usize, value: f64| Number { camera: name(camera), value, sigma: solved.sigma(ix) };
    Some(match term {
        Term::Mount(camera, 0) => {
            let was = crate::splat::moved(fix(camera).turn_rad.into(), fix(camera).shift_m.into()).inverse();
            Found::HandEye(moved(name(camera), was.rotation.scaled_axis(), was.translation.vector, solved, ix))
        }
        Term::DepthPose(camera, 0) => {
            let (turn, shift) = (fix(camera).depth_turn_rad.into(), fix(camera).depth_shift_m.into());
            Found::DepthPose(moved(name(camera), turn, shift, solved, ix))
        }
        Term::Delay(camera) => Found::Delay(number(camera, fix(camera).delay_secs)),
        Term::DepthScale(camera) => Found::DepthScale(number(camera, fix(camera).log_depth_scale.exp_m1())),
        Term::Readout(camera) => Found::Readout(number(camera, fix(camera).readout_secs)),
        Term::Joint(joint_ix) => Found::Joint {
            joint_ix,
            value: kept.corrections.value(term),
            sigma: solved.sigma(ix),
            unseen_share: solved.unseen_share(ix),
        },
        Term::Lens(camera, 0) => Found::Lens {
            camera: name(camera),
            focal_frac: fix(camera).log_focal.map(f64::exp_m1),
            focal_sigma: [solved.sigma(ix), solved.sigma(ix + 1)],
            principal_focals: fix(camera).principal_focals,
            principal_sigma: [solved.sigma(ix + 2), solved.sigma(ix + 3)],
        },
        Term::Mount(..) | Term::DepthPose(..) | Term::Lens(..) => return None,
    })
}

fn moved(camera: String, turn: Vector3<f64>, shift: Vector3<f64>, solved: &Solved, begin: usize) -> Moved {
    let part = |vector: Vector3<f64>, begin: usize| {
        let axis = vector.try_normalize(0.0).unwrap_or_else(Vector3::zeros);
        let mut weights = DVector::zeros(solved.step.len());
        weights.rows_mut(begin, 3).copy_from(&axis);
        (vector.norm(), solved.variance(&weights).sqrt(), axis.into())
    };
    let (turn_rad, turn_sigma_rad, turn_axis) = part(turn, begin + 3);
    let (shift_m, shift_sigma_m, shift_axis) = part(shift, begin);
    Moved { camera, turn_rad, turn_sigma_rad, turn_axis, shift_m, shift_sigma_m, shift_axis }
}

/// Directions that a fit cannot tell.
pub(super) fn unseen(scene: &Scene, fit: &Fit) -> Vec<Unseen> {
    let carries_way = |ix: usize| !matches!(fit.layout.terms[ix], Term::Mount(_, 0..3) | Term::DepthPose(_, 0..3));
    let directions = fit.solved.unseen(carries_way);
    directions.iter().map(|direction| named(scene, &fit.layout.terms, direction)).collect()
}

fn named(scene: &Scene, terms: &[Term], direction: &DVector<f64>) -> Unseen {
    /// Parts below this share of the largest are left out.
    const SMALL: f64 = 0.1;
    let scaled: Vec<f64> = terms.iter().enumerate().map(|(ix, term)| direction[ix] / term.scale()).collect();
    let largest = scaled.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
    let matters = |ix: usize, n: usize| scaled[ix..ix + n].iter().any(|value| value.abs() > SMALL * largest);
    let axis = |ix: usize| {
        let along = Vector3::from_fn(|row, _| direction[ix + row]).normalize();
        format!("({:.2} {:.2} {:.2})", along.x, along.y, along.z)
    };
    let mut parts = Vec::new();
    for (ix, term) in terms.iter().enumerate() {
        let name = |camera: usize| &scene.cameras[camera];
        parts.extend(match *term {
            Term::Mount(camera, 0) if matters(ix, 3) => {
                Some(format!("translation of camera {:?} along {} of its own axes", name(camera), axis(ix)))
            }
            Term::Mount(camera, 3) if matters(ix, 3) => {
                Some(format!("turn of camera {:?} about {} of its own axes", name(camera), axis(ix)))
            }
            Term::DepthPose(camera, 0) if matters(ix, 3) => {
                Some(format!("translation of the depth frame of camera {:?} along {}", name(camera), axis(ix)))
            }
            Term::DepthPose(camera, 3) if matters(ix, 3) => {
                Some(format!("turn of the depth frame of camera {:?} about {}", name(camera), axis(ix)))
            }
            Term::Joint(joint) if matters(ix, 1) => Some(format!("offset of joint {joint}")),
            Term::Delay(camera) if matters(ix, 1) => Some(format!("delay of camera {:?}", name(camera))),
            Term::DepthScale(camera) if matters(ix, 1) => {
                Some(format!("scale of the depth of camera {:?}", name(camera)))
            }
            Term::Readout(camera) if matters(ix, 1) => Some(format!("readout time of camera {:?}", name(camera))),
            Term::Lens(camera, part) if matters(ix, 1) => {
                let what = [
                    "focal length along x",
                    "focal length along y",
                    "principal point along x",
                    "principal point along y",
                ];
                Some(format!("{} of camera {:?}", what[part], name(camera)))
            }
            _ => None,
        });
    }
    Unseen { parts }
}

impl Alignment {
    /// Whether anything was kept.
    pub fn is_any(&self) -> bool {
        !self.fixes.is_empty()
    }

    /// Whether there were enough images to tell what pays.
    pub fn is_judged(&self) -> bool {
        self.trials.iter().all(|trial| trial.n_images >= LEAST_JUDGES)
    }

    /// Whether images got poses of their own.
    pub fn has_image_poses(&self) -> bool {
        let of_images = |terms: &Candidate| matches!(terms, Candidate::Cameras(terms) if terms.image_poses);
        self.trials.iter().any(|trial| trial.kept && of_images(&trial.candidate))
    }

    /// One line each: what was found, what cannot be seen, what was tried and not needed.
    pub fn lines(&self) -> Vec<String> {
        let mut lines: Vec<String> = self.found.iter().map(ToString::to_string).collect();
        lines.extend(self.unseen.iter().map(|unseen| format!("cannot be seen in this motion: {unseen}")));
        for trial in &self.trials {
            lines.push(format!(
                "{}: {:+.2} dB (standard error {:.2}) on {} selection images: {}",
                trial.candidate,
                trial.gain_db,
                trial.standard_error_db,
                trial.n_images,
                match trial.kept {
                    true => "kept",
                    false if trial.n_images < LEAST_JUDGES => "too few to judge by",
                    false => "not needed",
                }
            ));
        }
        lines
    }
}

impl std::fmt::Display for Unseen {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.parts.join(" together with "))
    }
}

impl std::fmt::Display for Moved {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [ax, ay, az] = self.turn_axis;
        let [sx, sy, sz] = self.shift_axis;
        write!(
            f,
            "turned by {:.3} +- {:.3} degrees about ({ax:.2} {ay:.2} {az:.2}), moved by {:.2} +- {:.2} mm along ({sx:.2} {sy:.2} {sz:.2})",
            self.turn_rad.to_degrees(),
            self.turn_sigma_rad.to_degrees(),
            1e3 * self.shift_m,
            1e3 * self.shift_sigma_m,
        )
    }
}

impl std::fmt::Display for Found {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::HandEye(moved) => write!(f, "hand-eye of {}: {moved}", moved.camera),
            Self::DepthPose(moved) => write!(f, "depth frame of {}: {moved}", moved.camera),
            Self::Delay(Number { camera, value, sigma }) => {
                write!(f, "delay of {camera}: {:.2} +- {:.2} ms", 1e3 * value, 1e3 * sigma)
            }
            Self::DepthScale(Number { camera, value, sigma }) => {
                write!(f, "depth of {camera}: times {:.4} +- {sigma:.4}", 1.0 + value)
            }
            Self::Readout(Number { camera, value, sigma }) => {
                write!(f, "readout of {camera}: {:+.2} +- {:.2} ms", 1e3 * value, 1e3 * sigma)
            }
            Self::Joint { joint_ix, value, sigma, unseen_share } => {
                let (value, sigma) = (value.to_degrees(), sigma.to_degrees());
                write!(f, "offset of joint {joint_ix}: {value:+.3} +- {sigma:.3} degrees")?;
                if *unseen_share > 0.1 {
                    f.write_str(", of which a part cannot be told from something else")
                } else {
                    Ok(())
                }
            }
            Self::Lens { camera, focal_frac, focal_sigma, principal_focals, principal_sigma } => {
                let percent = |value: f64| 100.0 * value;
                write!(
                    f,
                    "lens of {camera}: focal lengths {:+.3} +- {:.3} % and {:+.3} +- {:.3} %, principal point by {:+.3} +- {:.3} % and {:+.3} +- {:.3} % of them",
                    percent(focal_frac[0]),
                    percent(focal_sigma[0]),
                    percent(focal_frac[1]),
                    percent(focal_sigma[1]),
                    percent(principal_focals[0]),
                    percent(principal_sigma[0]),
                    percent(principal_focals[1]),
                    percent(principal_sigma[1]),
                )
            }
            Self::ImagePoses { camera, n_images, rms_m, rms_rad } => write!(
                f,
                "poses of {n_images} images of {camera}: moved by {:.2} mm and {:.3} degrees (root mean square)",
                1e3 * rms_m,
                rms_rad.to_degrees()
            ),
        }
    }
}
