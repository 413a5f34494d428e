#!/bin/sh
# Opens the bundled page in headless Chromium and checks its contents. Skipped if Chromium or Node.js is missing.
set -eu
cd "$(dirname "$0")/.."
if ! command -v node >/dev/null 2>&1; then
    echo "web page test skipped: Node.js is not installed"
    exit 0
fi
if ! command -v chromium >/dev/null 2>&1 && ! command -v chromium-browser >/dev/null 2>&1 \
    && ! command -v google-chrome >/dev/null 2>&1; then
    echo "web page test skipped: Chromium is not installed"
    exit 0
fi
scripts/build-web.sh
cargo test -p viz --test page --test robot_page -- --nocapture
