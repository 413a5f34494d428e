#!/bin/sh
# Installs missing system packages with apt, and nothing else. Prints which packages it installs and why. Without root it prints the command
# to run and fails. If nothing is missing, it does nothing and prints nothing. For Debian 12, Debian 13 and Ubuntu 24.04.
# scripts/test-install.sh tests it on systems that lack all or some of the packages.
#
# Each check looks for the file or command that a build or program uses (a header, a library for this processor, a command that runs), not
# for a package name. This detects incomplete packages and accepts software from other sources.
#
# usage: install-packages.sh [--check] GROUP... [--optional GROUP...]      groups: build gpu sim web nokhwa realsense browser hil
#   --check       print what is missing and fail; install nothing
#   --optional    the groups after it are optional: if their packages cannot be installed, print a message and succeed
set -eu

PATH="$PATH:/usr/sbin:/sbin"
export PATH

# Names of the missing packages, one line of text for each, and the number of missing packages that are not optional.
missing=""
reasons=""
required=0
is_optional=false

# need PACKAGE REASON: adds a missing package.
need() {
    case "$missing " in
    *" $1 "*) return 0 ;;
    esac
    missing="$missing $1"
    reasons="$reasons    $1: $2
"
    $is_optional || required=$((required + 1))
}

# need_package PACKAGE REASON: adds the package unless dpkg lists it as installed for this processor.
need_package() {
    dpkg-query -W -f '${db:Status-Status} ${Architecture}\n' "$1" 2>/dev/null |
        grep -qxE "installed ($(dpkg --print-architecture)|all)" || need "$1" "$2"
}

# need_command COMMAND PACKAGE REASON: adds the package unless the command is on the path, regardless of its source.
need_command() {
    command -v "$1" >/dev/null 2>&1 || need "$2" "$3"
}

# need_file FILE PACKAGE REASON: adds the package unless the file is readable.
need_file() {
    [ -r "$1" ] || need "$2" "$3"
}

# elf_machine FILE: prints word size and processor from the header of a program or library; fails for other files.
elf_machine() {
    [ "$(head -c 4 "$1" 2>/dev/null | od -An -c | tr -d ' ')" = '177ELF' ] || return 1
    od -An -tx1 -j4 -N1 "$1"
    od -An -tx1 -j18 -N2 "$1"
}

# is_native FILE: whether programs of this system can load a library. This check is needed because
# 32-bit libraries are often installed, too.
is_native() {
    [ -r "$1" ] && [ "$(elf_machine "$1")" = "$(elf_machine /bin/sh)" ]
}

# has_library LIBRARY: whether the dynamic linker finds a library for this processor.
has_library() {
    for path in $(ldconfig -p 2>/dev/null | awk -v name="$1" '$1 == name { print $NF }'); do
        ! is_native "$path" || return 0
    done
    return 1
}

need_library() {
    has_library "$1" || need "$2" "$3"
}

# links SOURCE [FLAG...]: whether the C compiler can build a program from this source.
links() {
    source=$1
    shift
    object=$(mktemp)
    status=0
    printf '%b' "$source" | cc -x c - -o "$object" "$@" >/dev/null 2>&1 || status=1
    rm -f "$object"
    return $status
}

# has_lavapipe: whether the Vulkan loader finds Mesa's software driver, for this processor.
has_lavapipe() {
    for manifest in /usr/local/share/vulkan/icd.d/lvp_icd*.json /usr/share/vulkan/icd.d/lvp_icd*.json /etc/vulkan/icd.d/lvp_icd*.json; do
        [ -r "$manifest" ] || continue
        library=$(sed -n 's/.*"library_path" *: *"\([^"]*\)".*/\1/p' "$manifest")
        case "$library" in
        */*) ! is_native "$library" || return 0 ;;
        *) ! has_library "$library" || return 0 ;;
        esac
    done
    return 1
}

# python_has CODE: whether python3 is installed and runs this code.
python_has() {
    python3 -c "$1" >/dev/null 2>&1
}

# need_pip REASON: adds pip unless it supports the platform of the wheels (manylinux_2_28, since pip 20.3) and Python can unpack wheels.
need_pip() {
    python_has 'import pip, ssl, sys, zipfile; sys.exit(int(pip.__version__.split(".")[0]) < 21)' || need python3-pip "$1"
}

# libclang_files: prints candidates for libclang in the order of the crate clang-sys. If LIBCLANG_PATH is set, it is the only folder;
# otherwise the folders are those of llvm-config, of the linker and of the system.
libclang_files() {
    if [ -f "${LIBCLANG_PATH-}" ]; then
        echo "$LIBCLANG_PATH"
        return 0
    fi
    if [ -n "${LIBCLANG_PATH-}" ]; then
        set -- "$LIBCLANG_PATH"
    else
        prefix=$("${LLVM_CONFIG_PATH:-llvm-config}" --prefix 2>/dev/null || true)
        # Word splitting is intended.
        # shellcheck disable=SC2046
        set -- ${prefix:+"$prefix/bin" "$prefix/lib" "$prefix/lib64"} \
            $(echo "${LD_LIBRARY_PATH-}:${LIBRARY_PATH-}" | tr ':' ' ') \
            /usr/local/llvm*/lib* /usr/local/lib*/*/* /usr/local/lib*/* /usr/local/lib* /usr/lib*/*/* /usr/lib*/* /usr/lib*
    fi
    for folder in "$@"; do
        for file in "$folder"/libclang.so "$folder"/libclang-*.so "$folder"/libclang.so.* "$folder"/libclang-*.so.*; do
            [ ! -f "$file" ] || echo "$file"
        done
    done
}

# libclangs: prints the version (0 if the file name has none) and path of each libclang that can be loaded.
libclangs() {
    libclang_files | while read -r file; do
        name=${file##*/}
        case "$name" in
        *-cpp.*) continue ;; # A different library: the C++ interface of clang.
        libclang-*) version=${name#libclang-} version=${version%%.so*} ;;
        libclang.so.*) version=${name#libclang.so.} ;;
        *) version=0 ;;
        esac
        ! is_native "$file" || echo "$version $file"
    done
}

# check_libclang: checks for the files that the crate bindgen needs: libclang, and the headers of the same clang (stddef.h and others).
check_libclang() {
    # clang-sys takes the highest version; among equal versions, the first folder wins.
    chosen=$(libclangs | sort -s -t ' ' -k 1,1Vr | head -n 1)
    if [ -z "$chosen" ]; then
        need libclang-dev "builds the feature nokhwa (bindgen loads libclang)"
        return 0
    fi
    # If there is a clang command, bindgen uses its search paths.
    if echo '#include <stddef.h>' | clang -x c -fsyntax-only - >/dev/null 2>&1; then
        return 0
    fi
    library=${chosen#* }
    real=$(readlink -f "$library")
    version=$(echo "$library $real" | sed -nE 's#.*libclang-([0-9]+)[.0-9]*\.so.*#\1#p')
    for folder in "$(dirname "$library")" "$(dirname "$real")" ${version:+"/usr/lib/llvm-$version/lib"} /usr/lib; do
        for header in "$folder/clang/$version"*/include/stddef.h; do
            [ ! -r "$header" ] || return 0
        done
    done
    need "libclang${version:+-common-$version}-dev" "headers of clang ${version:+$version }for $library"
}

# qemu_libraries: prints the packages of all libraries that QEMU of Debian 12 loads.
qemu_libraries() {
    echo libaio1 libasound2 libbpf1 libbrlapi0.8 libc6 libcacard0 libcap-ng0 libcapstone4 libepoxy0 libfdt1 libfuse3-3 \
        libgbm1 libgcc-s1 libglib2.0-0 libgmp10 libgnutls30 libhogweed6 libibverbs1 libjpeg62-turbo libncursesw6 \
        libnettle8 libnuma1 libpixman-1-0 libpmem1 libpng16-16 librdmacm1 libsasl2-2 libseccomp2 libslirp0 libsndio7.0 \
        libspice-server1 libtinfo6 libudev1 liburing2 libusb-1.0-0 libusbredirparser1 libvdeplug2 libzstd1 zlib1g
}

# check_qemu: checks for QEMU. A newer qemu-utils, such as that of backports, conflicts with the
# QEMU of Debian 12. The newer package is not removed. Instead, only QEMU's libraries are installed,
# and scripts/fetch-qemu.sh unpacks QEMU into .deps/qemu.
check_qemu() {
    installed=$(dpkg-query -W -f '${Version}' qemu-utils 2>/dev/null || true)
    if [ -x /usr/bin/qemu-system-x86_64 ] || [ -z "$installed" ] || dpkg --compare-versions "$installed" lt 1:8.0; then
        need_file /usr/bin/qemu-system-x86_64 qemu-system-x86 "emulates CAN cards for the tests"
    else
        for package in $(qemu_libraries); do
            need_package "$package" "used by QEMU, which emulates CAN cards for the tests"
        done
    fi
}

# check GROUP: adds the missing packages of a group.
check() {
    case "$1" in
    build)
        # A C compiler needs headers and start files, but the package gcc only recommends them.
        if ! links '#include <stdio.h>\n#include <linux/videodev2.h>\nint main(void) { return puts(""); }\n'; then
            if echo 'int nothing;' | cc -x c -c -o /dev/null - >/dev/null 2>&1; then
                need libc6-dev "headers and start files of the C library"
            else
                need gcc "links Rust programs and compiles the C parts of some crates"
                need_package libc6-dev "headers and start files of the C library"
            fi
        fi
        pkg-config --version >/dev/null 2>&1 || need pkg-config "lets build scripts find libraries"
        ;;
    gpu)
        need_library libvulkan.so.1 libvulkan1 "the Vulkan loader"
        has_lavapipe || need mesa-vulkan-drivers "Vulkan in software (lavapipe), used without a GPU and by the tests"
        ;;
    sim)
        need_library libEGL.so.1 libegl1 "rendering without a display"
        need_library libEGL_mesa.so.0 libegl-mesa0 "rendering without a display, in software"
        need_package libgl1-mesa-dri "OpenGL in software, for the simulated cameras"
        need_pip "downloads the MuJoCo wheel"
        ;;
    web)
        node -e 'process.exit(parseInt(process.versions.node) < 18 ? 1 : 0)' >/dev/null 2>&1 ||
            need nodejs "bundles the web page (Node.js 18 or newer)"
        npm_major=$(npm --version 2>/dev/null | cut -d . -f 1)
        [ "${npm_major:-0}" -ge 7 ] || need npm "downloads the libraries of the web page (npm 7 or newer)"
        ;;
    nokhwa)
        # This check is needed only on Linux, where every build generates nokhwa's V4L2 bindings.
        check_libclang
        ;;
    realsense)
        need_library libusb-1.0.so.0 libusb-1.0-0 "used by librealsense2 to access cameras"
        need_library libudev.so.1 libudev1 "used by librealsense2 to find cameras"
        need_command patchelf patchelf "renames the pinned librealsense2 for the linker"
        need_command nm binutils "lists the Python functions that the pinned librealsense2 imports"
        need_pip "downloads the RealSense wheel"
        ;;
    browser)
        command -v chromium >/dev/null 2>&1 || command -v google-chrome >/dev/null 2>&1 ||
            need_command chromium-browser chromium "opens the page in the tests"
        ;;
    hil)
        if ! hil_is_supported; then
            return 0
        fi
        need_file /usr/src/linux-source-6.1.tar.xz linux-source-6.1 "source of the kernel that emulates cameras and CAN buses for the tests"
        need_command make make "builds this kernel"
        need_command flex flex "builds this kernel"
        need_command bison bison "builds this kernel"
        need_command bc bc "builds this kernel"
        need_command xz xz-utils "unpacks their source"
        need_package busybox-static "starts the tests in the virtual machines"
        check_qemu
        need_file /usr/sbin/ip iproute2 "sets up the CAN cards"
        python_has 'import ensurepip, venv' || need python3-venv "runs the Franka simulator and libfranka for the tests"
        ;;
    *)
        echo "install-packages: unknown group $1 (build, gpu, sim, web, nokhwa, realsense, browser, hil)" >&2
        exit 2
        ;;
    esac
}

# The virtual machines of tests/hil use the kernel of Debian 12 and its source.
hil_is_supported() {
    grep -q '^VERSION_CODENAME=bookworm$' /etc/os-release 2>/dev/null && [ "$(uname -m)" = x86_64 ]
}

# check_all: fills `missing`, `reasons` and `required` for all groups named.
check_all() {
    missing="" reasons="" required=0 is_optional=false
    for group in $groups; do
        case "$group" in
        --optional) is_optional=true ;;
        *) check "$group" ;;
        esac
    done
}

# give_up: exits because packages are missing. This is a failure unless all of them are optional.
give_up() {
    if [ "$required" -eq 0 ]; then
        echo "continuing without them: the tests that use them are skipped" >&2
        exit 0
    fi
    exit 1
}

only_check=false
if [ "${1-}" = --check ]; then
    only_check=true
    shift
fi
groups=$*
check_all
case " $groups " in
*" hil "*)
    hil_is_supported || $only_check ||
        echo "skipping the tests in virtual kernels: they require Debian 12 on x86-64" >&2
    ;;
esac
if [ -z "$missing" ]; then
    exit 0
fi
printf 'missing system packages:\n%s' "$reasons" >&2
if $only_check; then
    exit 1
fi
if ! command -v apt-get >/dev/null 2>&1; then
    echo "apt-get not found: install the equivalents of these Debian packages with the package manager of this system" >&2
    give_up
fi
# If another apt holds the lock, this command waits for it. The command never removes a package of
# this computer.
install="apt-get install -y -q --no-install-recommends --no-remove -o DPkg::Lock::Timeout=300"
# Because of the `;`, the installation continues even if a repository is unreachable.
line="apt-get update -q; $install$missing"
# An interrupted installation must be finished first, together with its dependencies.
if [ -n "$(dpkg --audit 2>/dev/null)" ]; then
    line="dpkg --configure -a; apt-get update -q; $install --fix-broken; $install$missing"
fi
if [ "$(id -u)" -ne 0 ]; then
    echo "not running as root; run this command, then try again:" >&2
    if command -v sudo >/dev/null 2>&1; then
        echo "    sudo sh -c '$line'" >&2
    else
        echo "    su - -c '$line'" >&2
    fi
    give_up
fi
echo "installing:$missing" >&2
export DEBIAN_FRONTEND=noninteractive
requested=$missing
if ! sh -c "$line" >&2; then
    echo "apt-get could not install all of$requested; see its message above. If packages would be removed, they conflict with" >&2
    echo "installed ones: upgrade or remove those yourself, then try again" >&2
    give_up
fi
hash -r
check_all
if [ -n "$missing" ]; then
    # A common cause is another copy earlier on the path, such as an old Node.js in /usr/local or a Python without
    # pip.
    printf 'installed, but still not usable:\n%s' "$reasons" >&2
    for command in cc pkg-config python3 node npm; do
        echo "    $command is $(command -v $command || echo not found)" >&2
    done
    echo "put /usr/bin first on the path, or repair these packages with: apt-get install --reinstall$missing" >&2
    give_up
fi
