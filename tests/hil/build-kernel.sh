#!/bin/sh
# Builds the User-Mode Linux kernel that plays cameras and CAN buses for the tests, once: about 4 minutes on two cores.
# Prints the path of the kernel, an ordinary program, as its only line on stdout.
#
# usage: build-kernel.sh FOLDER      the folder keeps the kernel, a cache: remove it to build anew
#
# The source is Debian's package linux-source-6.1, which apt checks; sources.sha256 says which version was tried. Another
# version is told and used, other bytes of the same version are refused.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
folder=$1
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
key=$(cat "$here/kernel.config" "$here/build-kernel.sh" | { cat; echo "$found"; } | sha256sum | cut -c1-16)
kernel=$folder/linux-$key
if [ -x "$kernel" ]; then
    echo "$kernel"
    exit 0
fi

mkdir -p "$folder"
tree=$folder/source-$key
log=$folder/build-$key.log
echo "building the kernel of the tests, once; its log: $log" >&2
rm -rf "$tree"
mkdir "$tree"
tar --extract --file "$archive" --directory "$tree" --strip-components=1
(
    cd "$tree"
    make ARCH=um defconfig
    grep -v '^#' "$here/kernel.config" | while IFS== read -r option value; do
        if [ "$value" = y ]; then scripts/config --enable "$option"; else scripts/config --disable "$option"; fi
    done
    make ARCH=um olddefconfig
    # An option that its conditions took away again would show as a missing device much later.
    grep -v '^#' "$here/kernel.config" | while IFS== read -r option value; do
        if [ "$value" = y ] && ! grep -q "^CONFIG_$option=y" .config; then
            echo "the kernel does not take CONFIG_$option=y"
            exit 1
        fi
    done
    make ARCH=um -j"$(nproc)" linux
) >"$log" 2>&1 </dev/null || {
    tail -n 15 "$log" >&2
    echo "build-kernel: failed, see $log" >&2
    exit 1
}
strip -o "$kernel.new" "$tree/linux"
mv "$kernel.new" "$kernel"
rm -rf "$tree"
echo "$kernel"
