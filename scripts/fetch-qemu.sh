#!/bin/sh
# Unpacks QEMU into .deps/qemu if its packages cannot be installed, because they conflict with the installed qemu-utils (see check_qemu in
# scripts/install-packages.sh, which installs the libraries). Does nothing otherwise, or if QEMU is already there. For Debian 12.
set -eu

cd "$(dirname "$0")/.."
folder=.deps/qemu
program=usr/bin/qemu-system-x86_64
module=usr/lib/x86_64-linux-gnu/qemu/accel-tcg-x86_64.so
if [ -x "/$program" ] || [ -x "$folder/$program" ] && [ -e "$folder/$module" ] || ! grep -q '^VERSION_CODENAME=bookworm$' /etc/os-release; then
    exit 0
fi
mkdir -p .deps
download=$(mktemp -d .deps/qemu.XXXXXX)
trap 'rm -rf "$download"' EXIT
trap 'exit 130' HUP INT TERM
echo "fetch-qemu: unpacking QEMU into $folder, because its packages conflict with the installed qemu-utils"
mkdir "$download/packages" "$download/root"
# `apt-get download` verifies the signatures. As root, it would otherwise switch to a user who may not write here.
if ! (cd "$download/packages" && apt-get download -q -o APT::Sandbox::User=root qemu-system-x86 qemu-system-common qemu-system-data seabios ipxe-qemu); then
    echo "fetch-qemu: apt-get could not download the packages, see its message above" >&2
    exit 1
fi
for package in "$download"/packages/*.deb; do
    dpkg --extract "$package" "$download/root"
done
rm -rf "$folder"
mv "$download/root" "$folder"
"$folder/$program" --version | head -n 1
