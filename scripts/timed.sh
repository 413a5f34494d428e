#!/bin/sh
# Runs a command and appends its duration to a list that scripts/run-tests.py reports.
#
# usage: timed.sh FILE NAME COMMAND [ARGUMENT]...      FILE gets one line per step: name, tab, seconds
set -eu
file=$1
name=$2
shift 2
mkdir -p "$(dirname "$file")"
began=$(date +%s%N)
status=0
"$@" || status=$?
printf '%s\t%s\n' "$name" "$(awk -v nanos="$(($(date +%s%N) - began))" 'BEGIN { printf "%.1f", nanos / 1e9 }')" >>"$file"
exit $status
