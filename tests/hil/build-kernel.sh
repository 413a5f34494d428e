#!/bin/sh
# Builds a kernel of the tests, once. Prints its path as the only line on stdout.
#   um    User-Mode Linux, an ordinary program, with cameras and virtual CAN buses: about 4 minutes on two cores
#   x86   what QEMU boots, with the driver of real CAN cards: about 3 minutes
#
# usage: build-kernel.sh um|x86 FOLDER      the folder keeps the kernel, a cache: remove it to build anew
#
# The source is Debian's package linux-source-6.1, which apt checks; sources.sha256 says which version was tried. Another
# version is told and used, other bytes of the same version are refused.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
folder=$2
case "$1" in
um) arch=um base=defconfig config=$here/kernel.config target=linux image=linux ;;
x86) arch=x86_64 base=tinyconfig config=$here/kernel-x86.config target=bzImage image=arch/x86/boot/bzImage ;;
*)
    echo "build-kernel: um or x86, not $1" >&2
    exit 2
    ;;
esac
read -r sha256 archive package <<LINE
$(grep linux-source "$here/sources.sha256" | grep -v '^#')
LINE

if [ ! -r "$archive" ]; then
    echo "build-kernel: $archive is missing: scripts/install-packages.sh hil" >&2
    exit 1
fi
found=$(sha256sum "$archive" | cut -d' ' -f1)
if [ "$found" != "$sha256" ]; then
    version=$(dpkg-query -W -f '${Package}=${Version}' linux-source-6.1 2>/dev/null || true)
    if [ "$version" = "$package" ]; then
        echo "build-kernel: $archive is not that of $package: sha256 $found, expected $sha256" >&2
        exit 1
    fi
    echo "build-kernel: tried with $package, here is ${version:-a source of unknown version}; going on" >&2
fi

# What the kernel is made of names it.
key=$(cat "$config" "$here/build-kernel.sh" | { cat; echo "$found"; } | sha256sum | cut -c1-16)
kernel=$folder/linux-$1-$key
if [ -s "$kernel" ]; then
    echo "$kernel"
    exit 0
fi

mkdir -p "$folder"
tree=$folder/source-$key
log=$folder/build-$key.log
echo "building the kernel of the tests ($1), once; its log: $log" >&2
rm -rf "$tree"
mkdir "$tree"
tar --extract --file "$archive" --directory "$tree" --strip-components=1
(
    cd "$tree"
    # User-Mode Linux keeps the floating-point state of a process in 2696 bytes. Processors with AMX have 11 KB of it, and their kernels
    # refuse to set less than all (EFAULT: "ptrace set fp regs failed"); what is more than all is no error.
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
    # An option that its conditions took away again would show as a missing device much later.
    grep -v '^#' "$config" | while IFS== read -r option value; do
        if [ "$value" != n ] && ! grep -q "^CONFIG_$option=$value" .config; then
            echo "the kernel does not take CONFIG_$option=$value"
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
