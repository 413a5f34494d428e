#!/bin/sh
# Builds a kernel for the tests, once. Prints its path as the only line on stdout.
#   um    User-Mode Linux, which runs as an ordinary process, with cameras and virtual CAN buses: about 3.5 minutes on two cores
#   x86   kernel for QEMU, with the driver of real CAN cards: about 3.5 minutes
#
# usage: build-kernel.sh um|x86 FOLDER      FOLDER caches the kernel; remove it to rebuild
#
# The source is Debian's package linux-source-6.1, verified by apt. sources.sha256 contains the tested version. Other versions are
# used with a warning; different bytes of the tested version are rejected.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
folder=$2
case "$1" in
um) arch=um base=defconfig config=$here/kernel.config target=linux image=linux ;;
x86) arch=x86_64 base=tinyconfig config=$here/kernel-x86.config target=bzImage image=arch/x86/boot/bzImage ;;
*)
    echo "build-kernel: invalid kernel $1, expected um or x86" >&2
    exit 2
    ;;
esac
read -r sha256 archive package <<LINE
$(grep linux-source "$here/sources.sha256" | grep -v '^#')
LINE

if [ ! -r "$archive" ]; then
    echo "build-kernel: $archive is missing; run scripts/install-packages.sh hil" >&2
    exit 1
fi
found=$(sha256sum "$archive" | cut -d' ' -f1)
if [ "$found" != "$sha256" ]; then
    version=$(dpkg-query -W -f '${Package}=${Version}' linux-source-6.1 2>/dev/null || true)
    if [ "$version" = "$package" ]; then
        echo "build-kernel: $archive differs from $package: sha256 $found, expected $sha256" >&2
        exit 1
    fi
    echo "build-kernel: tested with $package, found ${version:-an unknown version}; continuing" >&2
fi

# The name of the kernel contains a hash of its inputs.
key=$(cat "$config" "$here/build-kernel.sh" | { cat; echo "$found"; } | sha256sum | cut -c1-16)
kernel=$folder/linux-$1-$key
if [ -s "$kernel" ]; then
    echo "$kernel"
    exit 0
fi

mkdir -p "$folder"
tree=$folder/source-$key
log=$folder/build-$key.log
echo "building the kernel for the tests ($1), once; log: $log" >&2
rm -rf "$tree"
mkdir "$tree"
tar --extract --file "$archive" --directory "$tree" --strip-components=1
(
    cd "$tree"
    # User-Mode Linux saves the floating-point state of a process in 2696 bytes. Processors with AMX have 11 KB of it, and their kernels
    # reject a smaller buffer (EFAULT: "ptrace set fp regs failed"). A larger buffer is accepted.
    if [ "$arch" = um ]; then
        sed -i 's/DEFINE_LONGS(HOST_FP_SIZE, 2696)/DEFINE_LONGS(HOST_FP_SIZE, 12288)/' arch/x86/um/user-offsets.c
        grep -q 'HOST_FP_SIZE, 12288' arch/x86/um/user-offsets.c || exit 1
    fi
    make ARCH=$arch $base
    grep -v '^#' "$config" | while IFS== read -r option value; do
        case "$value" in
        y) scripts/config --enable "$option" ;;
        n) scripts/config --disable "$option" ;;
        *) scripts/config --set-val "$option" "$value" ;;
        esac
    done
    make ARCH=$arch olddefconfig
    # An option that its dependencies have changed again would only show up much later, as a missing device or a slow build.
    grep -v '^#' "$config" | while IFS== read -r option value; do
        if [ "$(sed -n "s/^CONFIG_$option=//p" .config)" != "${value#n}" ]; then
            echo "the kernel configuration rejects CONFIG_$option=$value"
            exit 1
        fi
    done || exit 1
    make ARCH=$arch -j"$(nproc)" $target
) >"$log" 2>&1 </dev/null || {
    tail -n 15 "$log" >&2
    echo "build-kernel: failed, see $log" >&2
    exit 1
}
if [ "$image" = linux ]; then
    strip -o "$kernel.new" "$tree/$image"
else
    cp "$tree/$image" "$kernel.new"
fi
mv "$kernel.new" "$kernel"
rm -rf "$tree"
echo "$kernel"
