#!/bin/sh
# Fails on to-do markers without an issue number. A marker must be followed by the number in parentheses, then by what to do and why.
set -eu
cd "$(dirname "$0")/.."

# The pattern is written so that this file does not match itself.
found=$(find src kinematics drivers sim trainer viz tests scripts rigs \
    -name node_modules -prune -o -name dist -prune -o -type f \
    \( -name '*.rs' -o -name '*.wgsl' -o -name '*.ts' -o -name '*.toml' -o -name '*.sh' -o -name '*.xml' \) -print0 |
    xargs -0 grep -nE '(^|[^A-Za-z.])(TO''DO|FIX''ME|XX''X)([^(A-Za-z]|$)|TO''DO\([^#]' || true)
if [ -n "$found" ]; then
    echo "to-do markers without an issue number (write TO""DO(#123): what to do and why):" >&2
    echo "$found" >&2
    exit 1
fi
