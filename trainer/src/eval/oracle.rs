//! Compares the metrics of fieldrig with independent libraries on the shared picture pairs.

#[cfg(feature = "lpips")]
use super::Lpips;
use super::{PixelPair, psnr, ssim};
use serde_json::Value;
use std::path::Path;

/// Both implementations compute the same integers.
const PSNR_TOLERANCE_DB: f64 = 1e-6;
/// The metric of fieldrig blurs in f32, and agrees with the f64 reference to a few 1e-6.
const SSIM_TOLERANCE: f64 = 1e-4;
/// 26 convolutions in f32 sum in a different order.
#[cfg(feature = "lpips")]
const LPIPS_TOLERANCE: f64 = 1e-4;

struct Picture {
    size_px: [u32; 2],
    rgba: Vec<u8>,
}

/// Loads the picture with this base name.
fn picture(folder: &Path, name: &str) -> Picture {
    let base = Path::new(name).file_name().unwrap();
    let image = image::open(folder.join(base)).unwrap().into_rgba8();
    Picture {
        size_px: [image.width(), image.height()],
        rgba: image.into_raw(),
    }
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Whether the value agrees. Prints the value if it does not.
fn agrees(what: &str, got: f64, expected: f64, tolerance: f64) -> bool {
    let all_agree = (got - expected).abs() <= tolerance;
    if !all_agree {
        eprintln!("{what}: got {got}, expected {expected}");
    }
    all_agree
}

#[test]
fn metrics_agree_with_the_oracle() {
    let Some(folder) = test_support::data_folder("metrics") else {
        return;
    };
    #[cfg(feature = "lpips")]
    let lpips = Lpips::load(&folder.join("lpips_squeeze_v0.1.safetensors")).unwrap();
    let rows = json(&folder.join("oracle_metrics.json"));
    let mut all_agree = true;
    for row in rows.as_array().unwrap() {
        let a = row["a"].as_str().unwrap();
        let b = row["b"].as_str().unwrap();
        let first = picture(&folder, a);
        let second = picture(&folder, b);
        let pair = PixelPair::new(first.size_px, &first.rgba, &second.rgba).unwrap();
        let expected = |column: &str| row[column].as_f64().unwrap();
        all_agree &= agrees(
            b,
            psnr(&pair).unwrap(),
            expected("psnr_skimage_255"),
            PSNR_TOLERANCE_DB,
        );
        all_agree &= agrees(
            b,
            ssim(&pair).unwrap(),
            expected("ssim_3dgs_valid_crop5"),
            SSIM_TOLERANCE,
        );
        #[cfg(feature = "lpips")]
        {
            all_agree &= agrees(
                b,
                lpips.distance(&pair).unwrap(),
                expected("lpips_squeeze_v0.1"),
                LPIPS_TOLERANCE,
            );
        }
    }
    assert!(all_agree, "see the values above");
    assert_eq!(rows.as_array().unwrap().len(), 3);
}

#[cfg(feature = "lpips")]
#[test]
fn lpips_matches_the_oracle_pair_by_pair() {
    let Some(folder) = test_support::data_folder("metrics") else {
        return;
    };
    let lpips = Lpips::load(&folder.join("lpips_squeeze_v0.1.safetensors")).unwrap();
    for (names, row) in json(&folder.join("oracle_lpips_squeeze_ex.json"))
        .as_object()
        .unwrap()
    {
        let (a, b) = names.split_once('|').unwrap();
        let first = picture(&folder, a);
        let second = picture(&folder, b);
        let pair = PixelPair::new(first.size_px, &first.rgba, &second.rgba).unwrap();
        let expected = row["lpips_squeeze_v0.1"].as_f64().unwrap();
        assert!(agrees(
            names,
            lpips.distance(&pair).unwrap(),
            expected,
            LPIPS_TOLERANCE
        ));
    }
}

#[test]
fn slightly_brighter_picture_does_not_agree() {
    let Some(folder) = test_support::data_folder("metrics") else {
        return;
    };
    let a = picture(&folder, "fox_a.png");
    let b = picture(&folder, "fox_b_noise.png");
    // The picture is one level brighter everywhere. This is hardly visible, but every metric must
    // detect it.
    let brighter: Vec<u8> = b
        .rgba
        .iter()
        .map(|&value| value.saturating_add(1))
        .collect();
    let right = PixelPair::new(a.size_px, &a.rgba, &b.rgba).unwrap();
    let wrong = PixelPair::new(a.size_px, &a.rgba, &brighter).unwrap();
    assert!(!agrees(
        "psnr",
        psnr(&wrong).unwrap(),
        psnr(&right).unwrap(),
        PSNR_TOLERANCE_DB
    ));
    assert!(!agrees(
        "ssim",
        ssim(&wrong).unwrap(),
        ssim(&right).unwrap(),
        SSIM_TOLERANCE
    ));
    #[cfg(feature = "lpips")]
    {
        let lpips = Lpips::load(&folder.join("lpips_squeeze_v0.1.safetensors")).unwrap();
        let got = lpips.distance(&wrong).unwrap();
        let expected = lpips.distance(&right).unwrap();
        assert!(!agrees("lpips", got, expected, LPIPS_TOLERANCE));
    }
}

#[cfg(feature = "lpips")]
#[test]
fn lpips_ignores_masked_pixels_and_rejects_small_pictures() {
    let Some(folder) = test_support::data_folder("metrics") else {
        return;
    };
    let lpips = Lpips::load(&folder.join("lpips_squeeze_v0.1.safetensors")).unwrap();
    let a = picture(&folder, "fox_a.png");
    let mut b = picture(&folder, "fox_a.png");
    for pixel in b.rgba.chunks_exact_mut(4).take(5000) {
        pixel.copy_from_slice(&[255, 0, 255, 0]);
    }
    assert_eq!(
        lpips
            .distance(&PixelPair::new(a.size_px, &a.rgba, &b.rgba).unwrap())
            .unwrap(),
        0.0
    );
    let small = vec![255; 63 * 80 * 4];
    let error = lpips
        .distance(&PixelPair::new([63, 80], &small, &small).unwrap())
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "LPIPS needs pictures of at least 64x64 pixels, got 63x80"
    );
}
