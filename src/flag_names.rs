//! Names of flags in the messages of libraries, which know only the settings.

use messages::Setting;

/// The flag that sets something.
pub(crate) fn flag(setting: Setting) -> &'static str {
    match setting {
        Setting::Camera => "--camera",
        Setting::Count => "--count",
        Setting::Crop => "--crop",
        Setting::DepthFrom => "--depth-from",
        Setting::Disturb => "--disturb",
        Setting::DriftPpm => "--drift-ppm",
        Setting::FixedMillis => "--fixed-millis",
        Setting::Holdout => "--holdout",
        Setting::JitterMillis => "--jitter-millis",
        Setting::Keyframes => "--keyframes",
        Setting::Levels => "--levels",
        Setting::Listen => "--listen",
        Setting::MaxBytes => "--max-bytes",
        Setting::MaxSplats => "--max-splats",
        Setting::Only => "--only",
        Setting::Out => "--out",
        Setting::Params => "--params",
        Setting::Peer => "--peer",
        Setting::Pose => "--pose",
        Setting::RateHz => "--rate-hz",
        Setting::Rates => "--rates",
        Setting::Recover => "--recover",
        Setting::Refine => "--refine",
        Setting::Report => "--report",
        Setting::Resume => "--resume",
        Setting::Rig => "--rig",
        Setting::Samples => "--samples",
        Setting::Scale => "--scale",
        Setting::Seconds => "--seconds",
        Setting::SettleSeconds => "--settle-seconds",
        Setting::Share => "--share",
        Setting::Sim => "--sim",
        Setting::Size => "--size",
        Setting::Splats => "--splats",
        Setting::Target => "--target",
        Setting::To => "--to",
        Setting::WithIntrinsics => "--with-intrinsics",
        Setting::WriteRig => "--write-rig",
    }
}
