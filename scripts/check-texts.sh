#!/bin/sh
# Checks the spelling of all files, and format and syntax of TOML files, with the programs that fetch-linters.sh installs. Settings are in
# _typos.toml and taplo.toml.
set -eu
cd "$(dirname "$0")/.."
linters=.deps/linters

# files [PATTERN]: prints the files of the repository, each followed by a NUL character. Files that git does not track belong to the
# user. Without git, such as in an archive of the source, prints all files except built and installed ones.
files() {
    if git ls-files --error-unmatch Makefile >/dev/null 2>&1; then
        # The inner shell expands the variables.
        # shellcheck disable=SC2016
        git ls-files -z "$@" | xargs -0 sh -c 'for file; do [ ! -f "$file" ] || printf "%s\0" "$file"; done' sh
    else
        find . \( -name target -o -name node_modules -o -name dist -o -name .deps -o -name runs -o -name .git \) -prune -o \
            -type f -name "${1-*}" -print0
    fi
}

if [ -x $linters/typos ]; then
    if ! files | xargs -0 $linters/typos --force-exclude; then
        echo "check-texts: correct the words above; if one of them is right, add it to _typos.toml" >&2
        exit 1
    fi
fi
if [ -x $linters/taplo ]; then
    export RUST_LOG=warn
    files '*.toml' | xargs -0 $linters/taplo lint
    if ! files '*.toml' | xargs -0 $linters/taplo fmt --check --diff; then
        echo "check-texts: to format these files, run: $linters/taplo fmt FILE..." >&2
        exit 1
    fi
fi
