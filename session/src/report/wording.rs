//! The words of the report page: durations, names of images, losses, and counters.

use crate::verdict::ImageLoss;
use serde_json::Value;

/// A duration, such as `45.2 s`, `12 min 30 s` or `1 h 5 min`.
#[must_use]
pub(super) fn duration(secs: f64) -> String {
    if !(60.0..1e9).contains(&secs) {
        return format!("{secs:.1} s");
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between a minute and 1e9 s"
    )]
    let whole = secs.round() as u64;
    let (hours, minutes, secs) = (whole / 3600, whole / 60 % 60, whole % 60);
    match (hours, secs) {
        (0, 0) => format!("{minutes} min"),
        (0, _) => format!("{minutes} min {secs} s"),
        _ => format!("{hours} h {minutes} min"),
    }
}

/// Name of an image without a file: its camera, and its time after the first keyframe on a
/// stopwatch, such as `wrist at 2:10.5`.
#[must_use]
pub(crate) fn image_name(camera: &str, stamp_nanos: i64, first_nanos: i64) -> String {
    let tenths = stamp_nanos.saturating_sub(first_nanos) / 100_000_000;
    let sign = if tenths < 0 { "-" } else { "" };
    let tenths = tenths.unsigned_abs();
    let (minutes, tenths) = (tenths / 600, tenths % 600);
    format!(
        "{camera} at {sign}{minutes}:{:02}.{}",
        tenths / 10,
        tenths % 10
    )
}

/// What happened to the images that devices dropped, in one sentence; `None` if there were few.
///
/// * `report`: the content of `report.json`.
#[must_use]
pub(super) fn dropped_images(report: &Value) -> Option<String> {
    let loss = ImageLoss::of_report(report);
    let (n_dropped, n_all) = (loss.n_lost, loss.n_sent());
    loss.noticeable_frac().map(|dropped_frac| {
        format!(
            "{:.0} % of the images were dropped by the devices: {n_dropped} of {n_all} never reached fieldrig, because this \
             computer or the connection was too slow. Lower rate_hz or the size of the images, or use a faster computer",
            100.0 * dropped_frac
        )
    })
}

/// The name of a key of `report.json` on the page.
#[must_use]
pub(super) fn label(key: &str) -> String {
    let words = match key {
        "n_train" => "training images",
        "n_validation" => "validation images",
        "n_test" => "test images",
        "startup_secs" => "time before training",
        "keyframes" => "keyframes at the end",
        "evicted" => "keyframes removed because the store was full",
        "rejected" => "images that became no keyframe",
        "device_skipped" => "images dropped by devices",
        "color_skipped" => "color images dropped by devices",
        "range_scans" => "range scans used",
        "range_points" => "points of the range scans",
        "max_position_error_m" => "largest error of a camera position (simulation)",
        "resume_command" => "continue the run",
        "seed" => "random seed",
        other => return other.replace('_', " "),
    };
    words.to_owned()
}

/// The value of a key of `report.json` in words; `None` if the number needs none.
#[must_use]
pub(super) fn value_text(key: &str, value: &Value) -> Option<String> {
    let number = value.as_f64()?;
    match key {
        "max_position_error_m" => Some(format!("{:.2} mm", 1e3 * number)),
        "startup_secs" => Some(duration(number)),
        _ => None,
    }
}

/// Whether a key of `report.json` is left out of the page, such as the count of a device that the
/// rig does not have.
#[must_use]
pub(super) fn is_omitted(key: &str, value: &Value) -> bool {
    matches!(
        key,
        "range_scans" | "range_points" | "evicted" | "device_skipped" | "color_skipped"
    ) && value.as_u64() == Some(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn durations_are_in_minutes_and_hours() {
        let texts = [0.0, 45.25, 59.96, 60.0, 750.2, 3599.7, 3900.0, f64::NAN].map(duration);
        let expected = [
            "0.0 s",
            "45.2 s",
            "60.0 s",
            "1 min",
            "12 min 30 s",
            "1 h 0 min",
            "1 h 5 min",
            "NaN s",
        ];
        assert_eq!(texts, expected);
    }

    #[test]
    fn images_are_named_by_camera_and_time() {
        let first = 1_700_000_000_000_000_000;
        let name = |millis: i64| image_name("wrist", first + millis * 1_000_000, first);
        assert_eq!(
            [0, 9_990, 130_500, 4_000_000, -1_500].map(name),
            [
                "wrist at 0:00.0",
                "wrist at 0:09.9",
                "wrist at 2:10.5",
                "wrist at 66:40.0",
                "wrist at -0:01.5"
            ]
        );
        assert_eq!(
            image_name("a", i64::MIN, i64::MAX).len(),
            "a at -".len() + 14
        );
    }

    #[test]
    fn dropped_images_are_described_if_they_are_many() {
        let report = |n_dropped: u64| json!({ "keyframes": 400, "evicted": 1532, "rejected": { "blurred": 721 }, "device_skipped": n_dropped });
        let text = dropped_images(&report(18_343)).expect("many");
        assert!(
            text.starts_with("87 % of the images were dropped by the devices: 18343 of 20996"),
            "{text}"
        );
        assert_eq!(dropped_images(&report(9)), None);
        assert_eq!(dropped_images(&Value::Null), None);
    }
}
