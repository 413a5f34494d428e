//! Lenses and image sizes in rig files.

use super::key::{Key, choices, keys};
use super::pose::MAX_COORDINATE;
use super::section::Section;
use kinematics::{Intrinsics, Lens};
use serde_json::json;
use toml::Value;

/// Placeholder until the camera reports its intrinsics. It is also used in a rig with missing keys,
/// which is never returned.
pub(super) const PLACEHOLDER_INTRINSICS: Intrinsics = Intrinsics {
    size_px: [1, 1],
    focal_px: [1.0; 2],
    principal_px: [0.5; 2],
    lens: Lens::Pinhole,
    rectified: true,
};

keys! {
    /// The keys in tables named `intrinsics`.
    struct LensKeys {
        /// Focal lengths along x and y, pixels.
        focal_px: [f64; 2], in 1.0..=1e6, required "focal length along x and y in pixels";
        /// Principal point, pixels; the center of the first pixel is (0.5, 0.5).
        principal_px: [f64; 2], in -MAX_COORDINATE..=3.0 * MAX_COORDINATE,
            required "principal point in pixels; the center of the first pixel is (0.5, 0.5)";
        /// Lens model.
        lens: LensModel = LensModel::Pinhole;
        /// Distortion coefficients in the order of OpenCV: k1, k2, p1, p2, k3 and optionally k4, k5,
        /// k6 for `brown_conrady`; k1, k2, k3, k4 for `kannala_brandt`; none for a pinhole.
        distortion: Vec<f64> = Vec::new();
    }
}

/// A lens model without its coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LensModel {
    Pinhole,
    BrownConrady,
    KannalaBrandt,
}

choices! {
    LensModel { Pinhole = "pinhole", BrownConrady = "brown_conrady", KannalaBrandt = "kannala_brandt" }
}

/// The table `intrinsics`, without image size and `rectified`, which are keys of the camera.
impl Key for Intrinsics {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        let LensKeys {
            focal_px,
            principal_px,
            lens,
            distortion,
        } = keys.get(key, ())?;
        let lens = match (lens, &distortion[..]) {
            // Some drivers print a pinhole as five zeros.
            (LensModel::Pinhole, coefficients) if coefficients.iter().all(|k| *k == 0.0) => {
                Ok(Lens::Pinhole)
            }
            (LensModel::Pinhole, _) => {
                Err("none with lens = \"pinhole\"; set lens to brown_conrady or kannala_brandt")
            }
            (LensModel::BrownConrady, [k1, k2, p1, p2, k3]) => {
                Ok(Lens::BrownConrady([*k1, *k2, *p1, *p2, *k3]))
            }
            (LensModel::BrownConrady, [k1, k2, p1, p2, k3, k4, k5, k6]) => {
                Ok(Lens::RationalBrownConrady([
                    *k1, *k2, *p1, *p2, *k3, *k4, *k5, *k6,
                ]))
            }
            (LensModel::KannalaBrandt, [k1, k2, k3, k4]) => {
                Ok(Lens::KannalaBrandt([*k1, *k2, *k3, *k4]))
            }
            _ => Err(
                "5 (k1, k2, p1, p2, k3) or 8 (k1, k2, p1, p2, k3, k4, k5, k6) for brown_conrady, 4 (k1, k2, k3, k4) for kannala_brandt",
            ),
        };
        match lens {
            Ok(lens) => Some(Self {
                focal_px,
                principal_px,
                lens,
                ..PLACEHOLDER_INTRINSICS
            }),
            Err(allowed) => keys.invalid(
                &format!("{key}.distortion"),
                &Value::from(distortion),
                allowed,
            ),
        }
    }

    fn write(&self) -> Option<Value> {
        let (lens, distortion): (_, &[f64]) = match &self.lens {
            Lens::Pinhole => (LensModel::Pinhole, &[]),
            Lens::BrownConrady(k) => (LensModel::BrownConrady, k),
            Lens::RationalBrownConrady(k) => (LensModel::BrownConrady, k),
            Lens::KannalaBrandt(k) => (LensModel::KannalaBrandt, k),
        };
        let Self {
            focal_px,
            principal_px,
            ..
        } = *self;
        LensKeys {
            focal_px,
            principal_px,
            lens,
            distortion: distortion.to_vec(),
        }
        .write()
    }

    fn schema((): ()) -> serde_json::Value {
        LensKeys::schema(())
    }
}

/// Width and height in pixels.
impl Key for [u32; 2] {
    type Limits = ();

    fn read(keys: &mut Section<'_>, key: &'static str, (): ()) -> Option<Self> {
        let [width, height] = keys.get::<[f64; 2]>(key, 8.0..=16384.0)?;
        if width.fract() != 0.0 || height.fract() != 0.0 {
            return keys.invalid(key, &Value::from(vec![width, height]), "whole numbers");
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "whole numbers up to 16384"
        )]
        Some([width as u32, height as u32])
    }

    fn write(&self) -> Option<Value> {
        Some(self.map(i64::from).to_vec().into())
    }

    fn schema((): ()) -> serde_json::Value {
        let side = u32::schema(8..=16384);
        json!({ "type": "array", "items": side, "minItems": 2, "maxItems": 2 })
    }
}
