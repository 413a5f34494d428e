//! Checks the bandwidth of the USB ports of cameras.

use super::Finding;
use drivers::v4l2;

/// Checks that the USB port has enough bandwidth for all modes of a camera.
pub(super) fn usb(camera: &v4l2::FoundCamera) -> Option<Finding> {
    let bandwidth = format!("{:.1} MB/s", camera.usb_bytes_per_sec()? * 1e-6);
    let name = format!("{} ({})", camera.name, camera.node.display());
    let unsupported = camera.modes_exceeding_usb();
    if unsupported.is_empty() {
        return Some(Finding::ok(
            "usb",
            format!("{name}: its port carries {bandwidth}, enough for all modes"),
        ));
    }
    let message = format!(
        "{name}: its port carries at most {bandwidth}, too little for {}",
        unsupported.join(", ")
    );
    let remedy = "use v4l2.format = \"mjpeg\", a smaller size, a lower rate, or a USB 3 port; `lsusb -t` shows which devices share a port";
    Some(Finding::warn("usb", message, remedy))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;

    #[test]
    fn insufficient_usb_bandwidth_is_reported() {
        let mut camera = v4l2::FoundCamera {
            node: "/dev/video0".into(),
            name: "1440p".into(),
            bus: "usb-1".into(),
            serial: None,
            links: Vec::new(),
            usb_mbits: Some(480.0),
            modes: vec![v4l2::Mode::new(
                v4l2::V4l2Format::Yuyv,
                [2560, 1440],
                &[30.0],
            )],
        };
        let finding = usb(&camera).expect("a camera on USB");
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(
            finding.message.contains("24.6 MB/s") && finding.message.contains("221 MB/s"),
            "{}",
            finding.message
        );
        camera.usb_mbits = Some(5000.0);
        assert_eq!(usb(&camera).expect("a camera on USB").verdict, Verdict::Ok);
        camera.usb_mbits = None;
        assert_eq!(usb(&camera), None);
    }
}
