#!/bin/sh
# Fetches Debian's own kernel for the tests in QEMU, and makes its first root folder, once. Prints
# the folder of both as the only line on stdout:
#   vmlinuz    the kernel
#   initrd     loads the modules, then mounts the root folder of the tests from the host (9p) and starts its /init
#
# usage: debian-kernel.sh
#
# The files are kept in the user's cache folder ($XDG_CACHE_HOME/fieldrig/kernels). apt downloads and verifies the package; it is unpacked,
# not installed.
set -eu

# Modules in the order in which they are loaded: the root folder from the host, then the CAN cards.
modules="virtio_ring virtio virtio_pci_modern_dev virtio_pci_legacy_dev virtio_pci netfs fscache 9pnet 9pnet_virtio 9p
    can can-raw can-dev sja1000 kvaser_pci"

here=$(cd "$(dirname "$0")" && pwd)
package=$(apt-cache depends linux-image-amd64 | sed -n 's/^ *Depends: \(linux-image-6\.1\.[^ ]*\)$/\1/p')
if [ -z "$package" ]; then
    echo "debian-kernel: apt does not know linux-image-amd64; run: apt-get update" >&2
    exit 1
fi
cache=${XDG_CACHE_HOME:-$HOME/.cache}/fieldrig/kernels
mkdir -p "$cache"
# With this lock, two runs of the tests at the same time fetch the kernel only once.
exec 9>"$cache/lock"
flock 9

# The name contains a hash of this script, which defines the contents.
folder=$cache/$package-$(sha256sum "$here/debian-kernel.sh" | cut -c1-16)
if [ -s "$folder/initrd" ]; then
    echo "$folder"
    exit 0
fi
work=$(mktemp -d "$cache/unpack.XXXXXX")
trap 'rm -rf "$work"' EXIT
trap 'exit 130' HUP INT TERM
echo "fetching the kernel for the tests in QEMU ($package), once" >&2
chmod 755 "$work"
if ! (cd "$work" && apt-get download -q "$package" >"$work/log" 2>&1); then
    # The download fails if the list of packages is older than the newest security update.
    echo "debian-kernel: apt cannot download $package; run: apt-get update" >&2
    tail -n 3 "$work/log" >&2
    exit 1
fi
dpkg-deb --extract "$work"/*.deb "$work/package"
mkdir -p "$work/root/bin" "$work/root/proc" "$work/root/modules" "$work/root/host" "$work/made"
cp /usr/bin/busybox "$work/root/bin/busybox"
for module in $modules; do
    found=$(find "$work/package/lib/modules" -name "$module.ko")
    [ -n "$found" ] || { echo "debian-kernel: $package has no module $module" >&2; exit 1; }
    cp "$found" "$work/root/modules/"
done
cat >"$work/root/init" <<INIT
#!/bin/busybox sh
for module in $(echo $modules); do
    /bin/busybox insmod /modules/\$module.ko
done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,cache=loose,msize=262144,ro root /host
exec /bin/busybox switch_root /host /init
INIT
chmod 755 "$work/root/init"
ln -s busybox "$work/root/bin/sh"
(cd "$work/root" && find . | busybox cpio -o -H newc 2>"$work/log") >"$work/made/initrd"
cp "$work"/package/boot/vmlinuz-* "$work/made/vmlinuz"
rm -rf "$folder"
mv "$work/made" "$folder"
echo "$folder"
