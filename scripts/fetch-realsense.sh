#!/bin/sh
# Installs a pinned librealsense2 into .deps/realsense, for the tests and for machines without the RealSense SDK.
#
# Debian has no package for it. The extension module in the wheel pyrealsense2 on the Python package
# index contains the whole library and exports its C functions. The script renames the module and
# adds a stub library that defines Python's C functions. None of these functions is ever called.
# Programs then link with the module as with the SDK's library. The script does nothing if the right
# version is already there.
set -eu

version=2.56.5
wheel=pyrealsense2==2.56.5.9235
sha256=76d384ea99f257b4697a82cb3581b05cc69fadfd0701021ad76da098a3e240f0
if [ "$(uname -s)-$(uname -m)" != Linux-x86_64 ]; then
    echo "fetch-realsense: no pinned library for $(uname -s) on $(uname -m): install the RealSense SDK 2.56" >&2
    exit 1
fi

cd "$(dirname "$0")/.."
folder=.deps/realsense
library=librealsense2.so.2.56
# This stamp is written last. It identifies all inputs, including this script.
stamp="$sha256 $(sha256sum scripts/fetch-realsense.sh | cut -d ' ' -f 1)"

if [ "$(cat "$folder/made-of" 2>/dev/null)" = "$stamp" ]; then
    exit 0
fi
for tool in cc nm patchelf; do
    if ! command -v "$tool" >/dev/null 2>&1; then
        echo "fetch-realsense: $tool is missing; run: scripts/install-packages.sh build realsense" >&2
        exit 1
    fi
done
if ! python3 -c 'import pip, ssl, zipfile' >/dev/null 2>&1; then
    echo "fetch-realsense: python3 with pip is missing; run: scripts/install-packages.sh realsense" >&2
    exit 1
fi

echo "fetch-realsense: downloading the wheel $wheel"
mkdir -p "$folder"
download=$(mktemp -d "$folder/download.XXXXXX")
trap 'rm -rf "$download"' EXIT
trap 'exit 130' HUP INT TERM
if ! python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --platform manylinux1_x86_64 --python-version 3.11 --implementation cp -d "$download" "$wheel"; then
    echo "fetch-realsense: pip could not download $wheel (message above); check the connection to the Python package index" >&2
    exit 1
fi
if [ "$(cat "$download"/*.whl | sha256sum | cut -d ' ' -f 1)" != "$sha256" ]; then
    echo "fetch-realsense: the wheel does not have the pinned sha256 $sha256; nothing was installed" >&2
    exit 1
fi
python3 - "$download" "$library" <<'PYTHON'
import pathlib, sys, zipfile
folder, library = pathlib.Path(sys.argv[1]), sys.argv[2]
wheel = zipfile.ZipFile(next(folder.glob("*.whl")))
module = next(name for name in wheel.namelist() if name.startswith("pyrealsense2/pyrealsense2.cpython"))
(folder / library).write_bytes(wheel.read(module))
PYTHON

# Symbols of Python's C interface are resolved when the library is loaded, so each needs a definition.
nm -D --undefined-only "$download/$library" | awk '$2 ~ /^_?Py/ { print "char " $2 "[64];" }' >"$download/no-python.c"
cc -shared -nostdlib -Wl,-soname,librealsense2-no-python.so -o "$download/librealsense2-no-python.so" "$download/no-python.c"
# Two separate calls are needed, because patchelf 0.14 applies only one of the two options in a
# single call.
patchelf --set-soname "$library" "$download/$library"
patchelf --add-needed librealsense2-no-python.so "$download/$library"
# shellcheck disable=SC2016
patchelf --set-rpath '$ORIGIN' "$download/$library"
cat >"$download/realsense2.pc" <<PC
Name: realsense2
Description: librealsense out of the wheel $wheel
Version: $version
Libs: -L\${pcfiledir} -lrealsense2 -lrealsense2-no-python
PC
chmod 755 "$download/$library" "$download/librealsense2-no-python.so"
mv "$download/$library" "$download/librealsense2-no-python.so" "$download/realsense2.pc" "$folder/"
ln -sf "$library" "$folder/librealsense2.so"
echo "$stamp" >"$folder/made-of"
echo "fetch-realsense: $folder/$library is installed"
