#!/bin/sh
# Installs the pinned MuJoCo library into .deps/mujoco, from its wheel on the Python package index. Does nothing if
# the right library is already there. Needs python3 with pip (any version: the wheel is only unpacked); installs no
# Python package.
set -eu

version=3.17.0
case "$(uname -s)-$(uname -m)" in
Linux-x86_64)
    platform=manylinux_2_28_x86_64
    sha256=23496b023ee80fb61ab71167e94bc649f9941710fde96b18bb8204fb332523ad
    ;;
Linux-aarch64)
    platform=manylinux_2_28_aarch64
    sha256=e2edd0204fb9229f75f332a4fcd1a32345bb9f90651dc0fddfa20ec0670db789
    ;;
*)
    echo "fetch-mujoco: no pinned MuJoCo library for $(uname -s) on $(uname -m); build without --features sim" >&2
    exit 1
    ;;
esac

cd "$(dirname "$0")/.."
folder=.deps/mujoco
library=libmujoco.so.$version

is_right() {
    [ -f "$1" ] && [ "$(sha256sum "$1" | cut -d ' ' -f 1)" = "$sha256" ]
}

link_names() {
    ln -sf "$library" "$folder/libmujoco.so"
}

if is_right "$folder/$library"; then
    link_names
    exit 0
fi
if ! python3 -c 'import pip, ssl, zipfile' >/dev/null 2>&1; then
    echo "fetch-mujoco: python3 with pip is missing; run: scripts/install-packages.sh sim" >&2
    exit 1
fi

echo "fetch-mujoco: downloading the MuJoCo $version wheel"
mkdir -p "$folder"
download=$(mktemp -d "$folder/download.XXXXXX")
trap 'rm -rf "$download"' EXIT
trap 'exit 130' HUP INT TERM
if ! python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --platform "$platform" --python-version 3.12 -d "$download" "mujoco==$version"; then
    echo "fetch-mujoco: pip could not download mujoco==$version (message above); check the connection to the Python package index" >&2
    exit 1
fi
python3 - "$download" "$library" <<'PYTHON'
import pathlib, sys, zipfile
folder, library = pathlib.Path(sys.argv[1]), sys.argv[2]
wheel = next(folder.glob("*.whl"))
(folder / library).write_bytes(zipfile.ZipFile(wheel).read("mujoco/" + library))
PYTHON
if ! is_right "$download/$library"; then
    echo "fetch-mujoco: $library does not have the pinned sha256 $sha256; nothing was installed" >&2
    exit 1
fi
chmod 755 "$download/$library"
mv "$download/$library" "$folder/$library"
link_names
echo "fetch-mujoco: $folder/$library is installed"
