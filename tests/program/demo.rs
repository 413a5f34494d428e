//! Tests what `make demo` checks before the build.

use std::net::TcpListener;
use std::process::{Command, Output};

/// Runs the check of the `demo` target with these variables, without building anything.
fn check_demo(variables: &[&str]) -> Output {
    Command::new("make")
        .args(["--no-print-directory", "check-demo"])
        .args(variables)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("make is installed")
}

#[test]
fn rig_and_port_of_the_demo_are_checked_before_the_build() {
    // Another test may take a port between its choice and the check.
    const ATTEMPTS: usize = 20;
    let is_accepted = |rig: &&str| {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener.local_addr().expect("it is bound").port();
        drop(listener);
        let output = check_demo(&[rig, &format!("PORT={port}")]);
        output.status.success() && output.stderr.is_empty()
    };
    for rig in ["RIG=uncalibrated", "RIG=rigs/static-arm.toml"] {
        assert!((0..ATTEMPTS).any(|_| is_accepted(&rig)), "{rig}");
    }
    let used = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let used = format!("PORT={}", used.local_addr().expect("it is bound").port());
    for (variables, words) in [
        ([&*used, "RIG=tags"], "another program uses port "),
        (
            ["PORT=7007", "RIG=absent"],
            "there is no rig file rigs/absent.toml",
        ),
        (["PORT=0", "RIG=tags"], "PORT=0 is not a port"),
        (["PORT=65536", "RIG=tags"], "PORT=65536 is not a port"),
    ] {
        let output = check_demo(&variables);
        let printed = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !output.status.success() && printed.contains(words),
            "{variables:?}: {printed}"
        );
    }
}
