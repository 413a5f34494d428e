#!/bin/sh
# Checks that cargo is installed and new enough for rust-toolchain.toml; otherwise prints the command to run and fails.
set -eu
cd "$(dirname "$0")/.."
required=$(sed -n 's/^channel = "\(.*\)"$/\1/p' rust-toolchain.toml)

# print_rustup: prints how to install Rust. A fresh Debian has no curl.
print_rustup() {
    if ! command -v curl >/dev/null 2>&1; then
        echo "    apt-get update && apt-get install -y --no-install-recommends curl ca-certificates    # as root" >&2
    fi
    echo "    curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y && . \"\$HOME/.cargo/env\"" >&2
}

if ! command -v cargo >/dev/null 2>&1; then
    if [ -x "${CARGO_HOME:-$HOME/.cargo}/bin/cargo" ]; then
        echo "cargo is installed but not on the path; run this command, then try again:" >&2
        echo "    . \"${CARGO_HOME:-$HOME/.cargo}/env\"" >&2
    else
        echo "cargo is missing; run this command, then try again:" >&2
        print_rustup
    fi
    exit 1
fi
# With rustup, this downloads the pinned toolchain if it is missing. Its messages are shown.
if ! found=$(cargo --version); then
    echo "cargo does not run; with rustup, run this command, then try again:" >&2
    echo "    rustup toolchain install $required --profile minimal --component clippy --component rustfmt" >&2
    exit 1
fi
found=$(echo "$found" | cut -d ' ' -f 2)
if [ "$(printf '%s\n' "$required" "${found%%-*}" | sort -V | head -n 1)" != "$required" ]; then
    echo "$(command -v cargo) is version $found, but $required or newer is needed (Debian's package is older); run this command, then try again:" >&2
    print_rustup
    exit 1
fi
