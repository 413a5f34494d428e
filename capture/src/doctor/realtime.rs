//! Checks real-time priority.

use super::{Finding, field};
use std::path::Path;

/// Checks the real-time priority that this user may request. Arms at 1 kHz need it.
pub(super) fn realtime(proc: &Path) -> Finding {
    let limit = field(&proc.join("self/limits"), "Max realtime priority");
    match limit.as_deref() {
        None => Finding::ok("real time", "not reported by the kernel"),
        Some("0") => {
            let message =
                "real-time priority is not allowed; only arms controlled at 1 kHz need it";
            let remedy = r#"echo "$USER - rtprio 99" | sudo tee -a /etc/security/limits.conf, then log in again"#;
            Finding::warn("real time", message, remedy)
        }
        Some(limit) => Finding::ok("real time", format!("priority up to {limit}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::doctor::Verdict;
    use crate::doctor::testing::folder_with;

    #[test]
    fn missing_real_time_priority_is_reported_with_remedy() {
        let denied = folder_with(
            "self/limits",
            "Max nice priority         0          0\nMax realtime priority     0       0\n",
        );
        let finding = realtime(denied.path());
        assert_eq!(finding.verdict, Verdict::Warn);
        assert!(finding.remedy.expect("a remedy").contains("rtprio"));
        let allowed = folder_with("self/limits", "Max realtime priority     99      99\n");
        assert_eq!(realtime(allowed.path()).verdict, Verdict::Ok);
    }
}
