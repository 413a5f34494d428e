#!/bin/sh
# Builds a User-Mode Linux kernel for the tests, once. This kernel runs as an ordinary process, with
# cameras and virtual CAN buses. The script prints the path of the kernel as the only line on
# stdout.
#
# usage: build-kernel.sh
#
# The kernel is kept in the user's cache folder ($XDG_CACHE_HOME/fieldrig/kernels), so that every
# checkout uses it. Its name contains a hash of everything that it is built from. To rebuild the
# kernel, remove it.
#
# The source is Debian's package linux-source-6.1, verified by apt. sources.sha256 contains the tested version. Other versions are
# used with a warning; different bytes of the tested version are rejected.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
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

folder=${XDG_CACHE_HOME:-$HOME/.cache}/fieldrig/kernels
mkdir -p "$folder"
# With this lock, two runs of the tests at the same time build a kernel only once.
exec 9>"$folder/lock"
flock 9

# The name of the kernel contains a hash of its inputs.
key=$(cat "$here/kernel.config" "$here/build-kernel.sh" | { cat; echo "$found"; } | sha256sum | cut -c1-16)
kernel=$folder/linux-um-$key
if [ -s "$kernel" ]; then
    echo "$kernel"
    exit 0
fi

source=$folder/source-$key
log=$folder/build-$key.log
echo "building the kernel for the tests, once; log: $log" >&2
rm -rf "$source"
mkdir "$source"
tar --extract --file "$archive" --directory "$source" --strip-components=1
(
    cd "$source"
    # User-Mode Linux saves the floating-point state of a process in 2696 bytes. On processors with
    # AMX, this state takes 11 KB, and the kernel of the host rejects a smaller buffer (EFAULT:
    # "ptrace set fp regs failed"). It accepts a larger buffer.
    sed -i 's/DEFINE_LONGS(HOST_FP_SIZE, 2696)/DEFINE_LONGS(HOST_FP_SIZE, 12288)/' arch/x86/um/user-offsets.c
    grep -q 'HOST_FP_SIZE, 12288' arch/x86/um/user-offsets.c || exit 1
    make ARCH=um tinyconfig
    grep -v '^#' "$here/kernel.config" | while IFS== read -r option value; do
        case "$value" in
        y) scripts/config --enable "$option" ;;
        n) scripts/config --disable "$option" ;;
        *) scripts/config --set-val "$option" "$value" ;;
        esac
    done
    make ARCH=um olddefconfig
    # The dependencies of an option may change it back. Without this check, the change would show up
    # much later, as a missing device or a slow build.
    grep -v '^#' "$here/kernel.config" | while IFS== read -r option value; do
        if [ "$(sed -n "s/^CONFIG_$option=//p" .config)" != "${value#n}" ]; then
            echo "the kernel configuration rejects CONFIG_$option=$value"
            exit 1
        fi
    done || exit 1
    make ARCH=um -j"$(nproc)" linux
) >"$log" 2>&1 </dev/null || {
    tail -n 15 "$log" >&2
    echo "build-kernel: failed, see $log" >&2
    exit 1
}
strip -o "$kernel.new" "$source/linux"
mv "$kernel.new" "$kernel"
rm -rf "$source" "$log"
echo "$kernel"
