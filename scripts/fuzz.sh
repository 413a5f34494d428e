#!/usr/bin/env bash
# Fuzzes the parsers of wire and file formats. Usage: fuzz.sh SECONDS [TARGET...]; without TARGET, all of them.
#
# Runs the targets one after the other, for SECONDS each. Needs cargo-fuzz. Without a nightly compiler, the pinned one is used, with its
# unstable features turned on. Crashes are saved in fuzz/artifacts: fix the bug, and add the smallest input that triggers it to fuzz/seeds.
# The corpus stays in fuzz/corpus for the next run.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
seconds=$1
shift
cargo fuzz --version >/dev/null 2>&1 || {
    echo "cargo-fuzz is missing; run this command, then try again:" >&2
    echo "    cargo install --locked cargo-fuzz" >&2
    exit 1
}
cargo=(cargo)
if cargo +nightly --version >/dev/null 2>&1; then cargo=(cargo +nightly); else export RUSTC_BOOTSTRAP=1; fi
[ $# -gt 0 ] || mapfile -t all < <("${cargo[@]}" fuzz list)
found=()
for target in "${@:-${all[@]}}"; do
    seeds=()
    for folder in "fuzz/seeds/$target" $(case $target in rig) echo rigs ;; urdf) echo rigs/robots kinematics/tests/data ;; esac); do
        [ ! -d "$folder" ] || seeds+=("$folder")
    done
    echo "== $target"
    # Dead code of a dependency (pulp) does not compile with a sanitizer, so it is left out. If a
    # target does not exist or does not build, the script stops here, because this is not a finding
    # of fuzzing.
    "${cargo[@]}" fuzz build --strip-dead-code "$target"
    mkdir -p "fuzz/corpus/$target"
    "${cargo[@]}" fuzz run --strip-dead-code "$target" "fuzz/corpus/$target" "${seeds[@]}" -- \
        -max_total_time="$seconds" -timeout=5 -rss_limit_mb=2048 -max_len=8192 -print_final_stats=1 || found+=("$target")
done
[ ${#found[@]} -eq 0 ] || {
    echo "fuzzing found failures in: ${found[*]}" >&2
    exit 1
}
