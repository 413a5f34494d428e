#!/bin/sh
# Installs the pinned programs typos (spelling) and taplo (format of TOML) into .deps/linters, from their wheels on the Python package
# index. Does nothing if the right ones are already there. Needs python3 with pip (any version: the wheels are only unpacked); installs no
# Python package. Programs without a wheel for this processor are left out with a message.
set -eu
cd "$(dirname "$0")/.."
folder=.deps/linters

# fetch NAME VERSION SHA256 PLATFORM: installs the program of a wheel, unless that wheel is already installed.
fetch() {
    name=$1 version=$2 sha256=$3 platform=$4
    if [ -x "$folder/$name" ] && [ "$(cat "$folder/$name.sha256" 2>/dev/null)" = "$sha256" ]; then
        return 0
    fi
    if ! python3 -c 'import pip, ssl, zipfile' >/dev/null 2>&1; then
        echo "fetch-linters: python3 with pip is missing; run: scripts/install-packages.sh sim" >&2
        exit 1
    fi
    echo "fetch-linters: downloading the wheel $name==$version"
    mkdir -p "$folder"
    download=$(mktemp -d "$folder/download.XXXXXX")
    trap 'rm -rf "$download"' EXIT
    trap 'exit 130' HUP INT TERM
    if ! python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
        --platform "$platform" --python-version 3.11 -d "$download" "$name==$version"; then
        echo "fetch-linters: pip could not download $name==$version (message above); check the connection to the Python package index" >&2
        exit 1
    fi
    if [ "$(cat "$download"/*.whl | sha256sum | cut -d ' ' -f 1)" != "$sha256" ]; then
        echo "fetch-linters: the wheel $name==$version does not have the pinned sha256 $sha256; nothing was installed" >&2
        exit 1
    fi
    python3 - "$download" "$name" "$version" <<'PYTHON'
import pathlib, sys, zipfile
folder, name, version = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3]
wheel = zipfile.ZipFile(next(folder.glob("*.whl")))
(folder / name).write_bytes(wheel.read(f"{name}-{version}.data/scripts/{name}"))
PYTHON
    chmod 755 "$download/$name"
    mv "$download/$name" "$folder/$name"
    echo "$sha256" >"$folder/$name.sha256"
    rm -rf "$download"
    echo "fetch-linters: $folder/$name is installed"
}

case "$(uname -s)-$(uname -m)" in
Linux-x86_64)
    fetch typos 1.52.0 418fd85f7fc11dec14e5482e747f6e916af56da96207cde0cdd69540a4b389f6 manylinux_2_17_x86_64
    fetch taplo 0.9.3 33f12648f273478d7330cb3529c82f48f388501e1122e0bea78bce5ff5972b8b manylinux_2_17_x86_64
    ;;
Linux-aarch64)
    fetch typos 1.52.0 5e870133c7e9cace94183e4d638697004a1473e79abcd01b8f75e362049a9b5c manylinux_2_17_aarch64
    echo "skipped: the format of TOML files, because taplo has no wheel for $(uname -m)" >&2
    ;;
*)
    echo "skipped: spelling and the format of TOML files, because typos and taplo are not pinned for $(uname -s) on $(uname -m)" >&2
    ;;
esac
