#!/bin/sh
# Installs the system packages that are missing, and only those, with apt; says which and why.
# Without root it prints the one line to run and stops; where a package is there already it does nothing.
#
# usage: install-packages.sh GROUP...      groups: build gpu sim web nokhwa realsense hil
set -eu

missing=""
reasons=""

# need PACKAGE REASON: asks for a package unless dpkg knows it as installed.
need() {
    if [ "$(dpkg-query -W -f '${db:Status-Status}' "$1" 2>/dev/null)" = installed ]; then
        return
    fi
    missing="$missing $1"
    reasons="$reasons    $1: $2
"
}

# need_command COMMAND PACKAGE REASON: asks for a package unless the command is on the path, wherever it came from.
need_command() {
    command -v "$1" >/dev/null 2>&1 || need "$2" "$3"
}

# need_library LIBRARY PACKAGE REASON: asks for a package unless the dynamic linker finds the library.
need_library() {
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -q "$1 " || need "$2" "$3"
}

for group in "$@"; do
    case "$group" in
    build)
        need_command cc gcc "links Rust programs, compiles the C parts of a few crates"
        # Without the headers a C compiler is no use; gcc only recommends them.
        [ -e /usr/include/stdio.h ] || need libc6-dev "headers and start files of the C library"
        need_command pkg-config pkg-config "how build scripts find libraries"
        ;;
    gpu)
        need_library libvulkan.so.1 libvulkan1 "the Vulkan loader"
        if ! ls /usr/share/vulkan/icd.d/lvp_icd*.json >/dev/null 2>&1; then
            need mesa-vulkan-drivers "Vulkan in software (lavapipe), used where there is no GPU and by the tests"
        fi
        ;;
    sim)
        need_library libEGL.so.1 libegl1 "rendering without a display"
        need_library libEGL_mesa.so.0 libegl-mesa0 "rendering without a display, in software"
        need libgl1-mesa-dri "OpenGL in software, for the simulated cameras"
        if ! python3 -m pip --version >/dev/null 2>&1; then
            need python3-pip "downloads the MuJoCo wheel"
        fi
        ;;
    web)
        need_command node nodejs "bundles the web page"
        need_command npm npm "fetches what the web page is made of"
        ;;
    nokhwa)
        # Only Linux needs it: nokhwa's V4L2 is bound anew in each build.
        ls /usr/lib/llvm-*/lib/libclang*.so* >/dev/null 2>&1 || need libclang-dev "builds the feature nokhwa"
        ;;
    realsense)
        need_library libusb-1.0.so.0 libusb-1.0-0 "how librealsense2 speaks to cameras"
        need_library libudev.so.1 libudev1 "how librealsense2 finds cameras"
        need_command patchelf patchelf "names the pinned librealsense2 as programs look for it"
        need_command nm binutils "lists what the pinned librealsense2 wants of Python"
        if ! python3 -m pip --version >/dev/null 2>&1; then
            need python3-pip "downloads the RealSense wheel"
        fi
        ;;
    hil)
        # The virtual kernels of tests/hil are built of Debian 12's source; elsewhere its tests are skipped, with a line.
        if ! grep -q '^VERSION_CODENAME=bookworm$' /etc/os-release 2>/dev/null || [ "$(uname -m)" != x86_64 ]; then
            continue
        fi
        need linux-source-6.1 "the kernels that play cameras and CAN buses for the tests"
        need_command make make "builds it"
        need_command flex flex "builds it"
        need_command bison bison "builds it"
        need_command bc bc "builds it"
        need_command xz xz-utils "unpacks it"
        need libelf-dev "builds it"
        need libssl-dev "builds it"
        need busybox-static "starts the tests in it"
        need qemu-system-x86 "plays CAN cards for the tests"
        need iproute2 "sets these up"
        need python3-venv "holds the peers of Franka arms"
        ;;
    *)
        echo "install-packages: unknown group $group (build, gpu, sim, web, nokhwa, realsense, hil)" >&2
        exit 2
        ;;
    esac
done

if [ -z "$missing" ]; then
    exit 0
fi
# The list is words by design: shellcheck's quoting rule does not apply to $missing below.
line="apt-get update && apt-get install -y --no-install-recommends$missing"
printf 'missing system packages:\n%s' "$reasons" >&2
if ! command -v apt-get >/dev/null 2>&1; then
    echo "this system has no apt-get: install what these Debian packages hold with its own package manager" >&2
    exit 1
fi
if [ "$(id -u)" -ne 0 ]; then
    echo "not running as root; run this line, then try again:" >&2
    echo "    sudo sh -c '$line'" >&2
    exit 1
fi
echo "installing:$missing" >&2
export DEBIAN_FRONTEND=noninteractive
apt-get update -q
# shellcheck disable=SC2086
apt-get install -y -q --no-install-recommends $missing
