#!/bin/sh
# Tests the installation scripts in debootstrap chroots of Debian that lack all or some of the packages.
#
# For each state, the script sets up a chroot and checks install-packages.sh: with --check, it names exactly the missing packages; without
# root, it prints one command to run and fails; as root, it installs the packages; a second run prints nothing. Then the script uses the
# installed packages: it links a C program, opens Vulkan and EGL, generates bindings, and bundles and tests the page.
#
# Needs root, debootstrap, network, and 4 GB in FOLDER. It is much faster if FOLDER is in memory, such as /dev/shm/test-install. Not part of
# `make test`.
#
# usage: test-install.sh [bookworm|trixie]... [STATE]...      default: both systems and all states
#   FOLDER=/tmp/test-install   folder for chroots and downloaded packages; kept for the next run
#   MIRROR=ADDRESS             mirror of Debian's packages [default: the first one in this machine's apt settings]
#   FILES=FOLDER               files copied over each chroot, for apt settings, proxies and certificates
#   BUILD_SCRIPT=FILE          build script of the crate v4l2-sys-mit, a program that generates bindings [default: the one in the target
#                              folder, which `cargo build -p drivers --features nokhwa` builds]
# Variables for proxies and certificates (http_proxy, https_proxy, no_proxy, SSL_CERT_FILE, PIP_CERT, NODE_EXTRA_CA_CERTS,
# npm_config_cafile) are passed on.
set -eu
cd "$(dirname "$0")/.."

folder=${FOLDER:-/tmp/test-install}
mirror=${MIRROR:-$(apt-cache policy | awk '$2 ~ /^http/ && $2 !~ /security/ { print $2; exit }')}
[ -n "$mirror" ] || { echo "test-install: no Debian mirror in apt's settings; set MIRROR=ADDRESS" >&2; exit 1; }
suites="" states=""
for word in "$@"; do
    case "$word" in
    bookworm | trixie) suites="$suites $word" ;;
    *) states="$states $word" ;;
    esac
done
if [ "$(id -u)" -ne 0 ] || ! command -v debootstrap >/dev/null 2>&1; then
    echo "test-install: needs root and debootstrap (apt-get install debootstrap)" >&2
    exit 1
fi
build_script=${BUILD_SCRIPT:-$(find target -path '*/build/v4l2-sys-mit-*/build-script-build' 2>/dev/null | head -n 1)}
[ -n "$build_script" ] || echo "test-install: skipping the generation of bindings: no build script of v4l2-sys-mit, see BUILD_SCRIPT"
root=$folder/root
n_failed=0 n_passed=0
failed=""

unmount() {
    for mounted in proc var/cache/apt/archives; do
        ! mountpoint -q "$root/$mounted" || umount "$root/$mounted"
    done
}

discard() {
    unmount
    rm -rf --one-file-system "$root"
}
trap unmount EXIT
trap 'exit 130' HUP INT TERM

# make_base: makes a minimal system of the suite, once.
make_base() {
    base=$folder/$suite
    if [ ! -e "$base/.complete" ]; then
        echo "creating a minimal $suite"
        rm -rf --one-file-system "$base"
        mkdir -p "$folder/$suite-debs"
        debootstrap --variant=minbase "$suite" "$base" "$mirror" >"$folder/$suite.log" 2>&1 || {
            tail -n 5 "$folder/$suite.log" >&2
            echo "test-install: debootstrap failed, see $folder/$suite.log" >&2
            exit 1
        }
        printf 'deb %s %s main\ndeb %s %s-updates main\n' "$mirror" "$suite" "$mirror" "$suite" >"$base/etc/apt/sources.list"
        # Same state as a machine that has never run apt-get update.
        rm -rf "$base"/var/lib/apt/lists/* "$base"/var/cache/apt/archives/*.deb
        touch "$base/.complete"
    fi
}

# make_root: copies the minimal system and prepares it for running scripts, with the checkout in /src.
make_root() {
    discard
    cp -a --reflink=auto "$base" "$root"
    cp /etc/resolv.conf "$root/etc/resolv.conf"
    [ -z "${FILES-}" ] || cp -a "$FILES/." "$root/"
    mkdir -p "$root/src" "$root/var/cache/apt/archives"
    # dpkg does not need to sync packages to the disk, because the chroot is temporary.
    echo force-unsafe-io >"$root/etc/dpkg/dpkg.cfg.d/unsafe-io"
    git ls-files -z -co --exclude-standard | tar --create --null --ignore-failed-read --files-from=- 2>/dev/null |
        tar --extract --directory "$root/src" --no-same-owner
    mount -t proc proc "$root/proc"
    mkdir -p "$folder/$suite-debs/partial"
    mount --bind "$folder/$suite-debs" "$root/var/cache/apt/archives"
}

# inside COMMANDS: runs COMMANDS in /src of the chroot, as root or as the user named in $user.
user=root
inside() {
    set -- "cd /src; $1"
    for variable in http_proxy https_proxy no_proxy SSL_CERT_FILE PIP_CERT NODE_EXTRA_CA_CERTS npm_config_cafile; do
        eval "value=\${$variable-}"
        [ -z "$value" ] || set -- "$@" "$variable=$value"
    done
    commands=$1
    shift
    case $user in
    root) as= ;;
    *) as="setpriv --reuid=$user --clear-groups" ;;
    esac
    # Word splitting is intended.
    # shellcheck disable=SC2086
    chroot "$root" $as env -i HOME=/tmp LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive \
        PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "$@" sh -c "$commands"
}

# fail TEXT: records a failure of this state.
fail() {
    echo "FAILED $suite $name: $1"
    problems=$((problems + 1))
}

# state NAME GROUPS PACKAGES: sets up a system with the commands on stdin, then installs GROUPS. PACKAGES are those expected to be missing.
# Variables: `unusable=true`: another program hides an installed one; `run_line=true`: instead of running the script as root, run the
# command that it prints without root; `environment`: environment variables for the script.
state() {
    name=$1 groups=$2 expected=$3
    equipment=$(cat)
    case "$states " in
    " " | *" $name "*) ;;
    *) return ;;
    esac
    problems=0
    log=$folder/$suite-$name.log
    make_root
    if ! inside "set -e; $equipment" >"$log" 2>&1; then
        fail "the state could not be set up, see $log"
        finish
        return
    fi

    found=$(inside "$environment scripts/install-packages.sh --check $groups" 2>&1 |
        sed -n 's/^    \([^ :]*\): .*/\1/p' | sort | xargs)
    [ "$found" = "$expected" ] || fail "expected '$expected' to be missing, found '$found'"

    status=0
    user=65534
    inside "$environment scripts/install-packages.sh $groups" >"$folder/out" 2>&1 || status=$?
    user=root
    lines=$(grep -cE '^ +(sudo|su) .*apt-get install' "$folder/out" || true)
    [ "$status $lines" = "$([ -n "$expected" ] && echo 1 1 || echo 0 0)" ] || fail "without root: exit code $status, $lines commands to run"

    status=0
    if $run_line; then
        # Run the printed command, as a user would.
        line=$(sed -nE "s/^ +(sudo sh|su -) -c '(.*)'$/\2/p" "$folder/out")
        inside "$line" >>"$log" 2>&1 || status=$?
    else
        inside "$environment scripts/install-packages.sh $groups" >>"$log" 2>&1 || status=$?
    fi
    if $unusable; then
        [ "$status" -eq 1 ] || fail "exit code $status, expected 1: the installed program is hidden"
        grep -q 'installed, but still not usable' "$log" || fail "no message that the installed packages are not usable, see $log"
    else
        [ "$status" -eq 0 ] || fail "as root: exit code $status, see $log"
        inside "$environment scripts/install-packages.sh --check $groups" >"$folder/out" 2>&1 || fail "still missing: $(cat "$folder/out")"
        inside "$environment scripts/install-packages.sh $groups" 2>&1 | grep -v '^skipping the tests in virtual kernels' >"$folder/out" || true
        [ ! -s "$folder/out" ] || fail "a second run prints: $(cat "$folder/out")"
        for group in $groups; do
            case $group in build | gpu | sim | web | nokhwa | realsense | browser | hil) "use_$group" ;; esac
        done
    fi
    finish
}

# finish: counts the state as passed or failed.
finish() {
    if [ $problems -eq 0 ]; then
        n_passed=$((n_passed + 1))
        echo "passed $suite $name"
    else
        n_failed=$((n_failed + 1))
        failed="$failed $suite/$name"
    fi
}

# cargo_state: tests check-cargo.sh without cargo, with a cargo that is not on the path, with Debian's older one, and with the right one.
cargo_state() {
    name=cargo
    case "$states " in
    " " | *" $name "*) ;;
    *) return ;;
    esac
    problems=0
    make_root
    required=$(sed -n 's/^channel = "\(.*\)"$/\1/p' rust-toolchain.toml)
    # prints EXPECTED COMMANDS: runs COMMANDS, then check-cargo.sh. It must fail and print the pattern EXPECTED, or pass if EXPECTED is
    # empty.
    prints() {
        status=0
        inside "$2; scripts/check-cargo.sh" >"$folder/out" 2>&1 || status=$?
        if [ -n "$1" ]; then
            [ "$status" -eq 1 ] || fail "exit code $status, expected 1, after: $2"
            grep -q "$1" "$folder/out" || fail "expected '$1', printed: $(cat "$folder/out")"
        else
            [ "$status$(cat "$folder/out")" = 0 ] || fail "exit code $status after: $2: $(cat "$folder/out")"
        fi
    }
    prints 'cargo is missing' true
    prints 'apt-get install .* curl' true
    prints 'sh.rustup.rs' true
    mkdir -p "$root/tmp/.cargo/bin"
    # reports FILE VERSION: prints commands that install a fake cargo of this version as FILE.
    reports() {
        printf '%s\n' "printf '#!/bin/sh\\necho cargo $2\\n' >$1; chmod +x $1"
    }
    prints 'not on the path' "$(reports /tmp/.cargo/bin/cargo "$required")"
    prints 'is version 1.85.1' "$(reports /usr/local/bin/cargo 1.85.1)"
    prints 'does not run' "printf '#!/bin/sh\nexit 1\n' >/usr/local/bin/cargo"
    prints '' "$(reports /usr/local/bin/cargo "$required")"
    prints '' "$(reports /usr/local/bin/cargo 2.0.0-nightly)"
    finish
}

# The functions below use the packages that a group installed.

# use_c NAME: links and runs the program on stdin, if the group build was installed too.
use_c() {
    cat >"$root/tmp/use.c"
    case " $groups " in
    *" build "*) inside "cc -o /tmp/use /tmp/use.c && /tmp/use" >>"$log" 2>&1 || fail "$1, see $log" ;;
    esac
}

use_build() {
    use_c "a C program does not link" <<'C'
#include <linux/videodev2.h>
#include <stdio.h>
int main(void) { return printf("a C program runs: %d\n", V4L2_CAP_VIDEO_CAPTURE) < 0; }
C
}

use_gpu() {
    use_c "Vulkan finds no device" <<'C'
#include <dlfcn.h>
#include <stdio.h>
typedef void *(*Find)(void *, const char *);
int main(void) {
    void *library = dlopen("libvulkan.so.1", RTLD_NOW);
    if (!library) return puts(dlerror()), 1;
    Find find = (Find)dlsym(library, "vkGetInstanceProcAddr");
    int (*create)(const void *, const void *, void **) = find(0, "vkCreateInstance");
    struct { int type; const void *next; int flags; const void *app; int n_layers; void *layers; int n_extensions; void *extensions; } info = {1};
    void *instance = 0;
    int n_devices = 0, code = create(&info, 0, &instance);
    if (code) return printf("vkCreateInstance: %d\n", code), 1;
    int (*count)(void *, int *, void *) = find(instance, "vkEnumeratePhysicalDevices");
    code = count(instance, &n_devices, 0);
    printf("Vulkan devices: %d\n", n_devices);
    return code || n_devices < 1;
}
C
}

use_sim() {
    use_c "EGL does not start" <<'C'
#include <dlfcn.h>
#include <stdio.h>
int main(void) {
    void *library = dlopen("libEGL.so.1", RTLD_NOW);
    if (!library) return puts(dlerror()), 1;
    void *(*find)(const char *) = (void *(*)(const char *))dlsym(library, "eglGetProcAddress");
    void *(*get)(int, void *, const int *) = find("eglGetPlatformDisplayEXT");
    int (*start)(void *, int *, int *) = (int (*)(void *, int *, int *))dlsym(library, "eglInitialize");
    int (*bind)(int) = (int (*)(int))dlsym(library, "eglBindAPI");
    int (*choose)(void *, const int *, void **, int, int *) = (int (*)(void *, const int *, void **, int, int *))dlsym(library, "eglChooseConfig");
    void *(*context)(void *, void *, void *, const int *) = (void *(*)(void *, void *, void *, const int *))dlsym(library, "eglCreateContext");
    int major = 0, minor = 0, n = 0, attributes[] = {0x3033, 0x0001, 0x3040, 0x0008, 0x3038};
    void *display = get(0x31DD, 0, 0), *config = 0;
    if (!display || !start(display, &major, &minor)) return puts("no surfaceless display"), 1;
    printf("EGL %d.%d\n", major, minor);
    if (!bind(0x30A2) || !choose(display, attributes, &config, 1, &n) || n < 1) return puts("no OpenGL configuration"), 1;
    return context(display, config, 0, 0) ? 0 : (puts("no OpenGL context"), 1);
}
C
    inside scripts/fetch-mujoco.sh >>"$log" 2>&1 || fail "fetch-mujoco.sh, see $log"
    [ -z "$(inside scripts/fetch-mujoco.sh 2>&1)" ] || fail "a second fetch-mujoco.sh does not recognize the installed library"
    inside 'scripts/fetch-linters.sh && scripts/check-texts.sh' >>"$log" 2>&1 || fail "fetch-linters.sh or check-texts.sh, see $log"
    if inside scripts/fetch-linters.sh 2>&1 | grep -qv '^skipped'; then
        fail "a second fetch-linters.sh does not recognize the installed programs"
    fi
}

use_web() {
    inside scripts/build-web.sh >>"$log" 2>&1 || fail "build-web.sh, see $log"
    [ -s "$root/src/viz/web/dist/app.js" ] || fail "there is no bundle"
    inside scripts/check-web.sh >>"$log" 2>&1 || fail "check-web.sh, see $log"
}

use_nokhwa() {
    [ -n "$build_script" ] || return 0
    cp "$build_script" "$root/tmp/generate"
    echo '#include <linux/videodev2.h>' >"$root/tmp/wrapper.h"
    target=$(uname -m)-unknown-linux-gnu
    case " $groups " in
    *" build "*) ;;
    *) inside "apt-get install -y -q --no-install-recommends linux-libc-dev libc6-dev" >>"$log" 2>&1 ;;
    esac
    inside "cd /tmp; env $environment OUT_DIR=/tmp TARGET=$target HOST=$target ./generate" >>"$log" 2>&1 || fail "bindings are not generated, see $log"
    grep -q v4l2_capability "$root"/tmp/*.rs || fail "bindings have no v4l2_capability"
}

use_realsense() {
    case " $groups " in
    *" build "*) ;;
    *) return 0 ;;
    esac
    inside scripts/fetch-realsense.sh >>"$log" 2>&1 || fail "fetch-realsense.sh, see $log"
    cp "$root/src/.deps/realsense/realsense2.pc" "$root/tmp/" 2>/dev/null || true
    echo 'int rs2_get_api_version(void **); int main(void) { void *error = 0; return rs2_get_api_version(&error) < 25600; }' >"$root/tmp/use.c"
    inside 'cc -o /tmp/use /tmp/use.c -L.deps/realsense -lrealsense2 -lrealsense2-no-python && LD_LIBRARY_PATH=.deps/realsense /tmp/use' \
        >>"$log" 2>&1 || fail "a program with librealsense2 does not run, see $log"
}

use_browser() {
    inside 'chromium --headless --no-sandbox --disable-gpu --dump-dom "data:text/html,<p>it works</p>"' 2>>"$log" | grep -q 'it works' ||
        fail "Chromium does not open a page, see $log"
}

use_hil() {
    [ "$suite" = bookworm ] || return 0
    inside 'tar --list --file /usr/src/linux-source-6.1.tar.xz | head -n 1 && python3 -m venv /tmp/venv && /tmp/venv/bin/pip --version &&
        qemu-system-x86_64 --version && ip -V && busybox true' >>"$log" 2>&1 || fail "the tools of the group hil do not run, see $log"
}

# Start of the command that installs packages when a state is set up.
install="apt-get update -q; apt-get install -y -q --no-install-recommends"

for suite in ${suites:-bookworm trixie}; do
    mkdir -p "$folder"
    make_base
    unusable=false run_line=false environment=""
    build="gcc libc6-dev pkg-config"
    case $suite in
    bookworm)
        llvm=14
        hil="bc bison busybox-static flex iproute2 linux-source-6.1 make python3-venv qemu-system-x86 xz-utils"
        runtime="libudev1 libusb-1.0-0"
        ;;
    trixie)
        llvm=19 hil="" runtime="libudev1 libusb-1.0-0"
        ;;
    esac
    sorted() {
        echo "$@" | tr ' ' '\n' | sort | xargs
    }
    gpu="libvulkan1 mesa-vulkan-drivers" sim="libegl-mesa0 libegl1 libgl1-mesa-dri python3-pip"

    state bare "build gpu sim web nokhwa realsense browser hil" \
        "$(sorted "$build" "$gpu" "$sim" nodejs npm libclang-dev binutils libusb-1.0-0 patchelf chromium "$hil")" </dev/null

    cargo_state

    # The command that is printed without root must install everything.
    run_line=true
    state printed-line "build gpu sim web nokhwa" "$(sorted "$build" "$gpu" "$sim" nodejs npm libclang-dev)" </dev/null
    run_line=false

    state gcc-without-headers "build" libc6-dev <<EQUIP
        $install gcc pkg-config
EQUIP
    state vulkan-loader-only "build gpu" mesa-vulkan-drivers <<EQUIP
        $install $build libvulkan1
EQUIP
    # 32-bit libraries have the same names.
    state libraries-of-another-processor "build gpu sim" "$(sorted "$gpu" "$sim")" <<EQUIP
        dpkg --add-architecture i386
        $install $build libvulkan1:i386 mesa-vulkan-drivers:i386 libegl1:i386 libegl-mesa0:i386 libgl1-mesa-dri:i386
EQUIP
    state node-without-npm "web" npm <<EQUIP
        $install nodejs
EQUIP
    state python-minimal "sim realsense" "$(sorted binutils libegl-mesa0 libegl1 libgl1-mesa-dri libusb-1.0-0 patchelf python3-pip)" <<EQUIP
        $install python3-minimal
EQUIP
    state python-without-pip-or-venv "sim hil" "$(sorted "$sim" "$hil")" <<EQUIP
        $install python3
EQUIP
    # An LLVM installation with libclang-cpp.so, but without libclang.so.
    state llvm-without-libclang "nokhwa" libclang-dev <<EQUIP
        $install llvm-$llvm-dev
        ls /usr/lib/llvm-$llvm/lib/libclang-cpp*.so*
EQUIP
    state libclang-without-its-headers "nokhwa" "libclang-common-$llvm-dev" <<EQUIP
        $install libclang1-$llvm
EQUIP
    environment=LIBCLANG_PATH=/opt/clang/lib
    state libclang-of-the-environment "nokhwa" "" <<EQUIP
        $install libclang-dev
        mkdir -p /opt/clang/lib
        cp -aL /usr/lib/llvm-$llvm/lib/libclang.so /usr/lib/llvm-$llvm/lib/clang /opt/clang/lib/
        apt-get purge -y 'libclang*'
EQUIP
    environment=""
    if [ "$suite" = bookworm ]; then
        # clang-sys takes the newest version, whose headers are missing.
        state newer-libclang-without-its-headers "nokhwa" libclang-common-16-dev <<EQUIP
            $install libclang-dev libclang1-16
EQUIP
    fi
    # Libraries that programs load at run time, without the -dev packages that builds need.
    state libraries-without-headers "build realsense hil" "$(sorted patchelf python3-pip "$hil")" <<EQUIP
        $install $build $runtime
EQUIP
    state interrupted-installation "build sim" "$(sorted libegl-mesa0 libegl1 libgl1-mesa-dri python3-pip)" <<EQUIP
        $install $build
        cd /tmp; apt-get download -q libgl1-mesa-dri
        dpkg --unpack --force-depends libgl1-mesa-dri*.deb
EQUIP
    state unreachable-repository "realsense" "$(sorted binutils libusb-1.0-0 patchelf python3-pip)" <<EQUIP
        echo 'deb http://127.0.0.1:9/debian nowhere main' >/etc/apt/sources.list.d/nowhere.list
EQUIP
    # Another copy comes first on the path.
    unusable=true
    state hidden-node "web" "nodejs npm" <<EQUIP
        printf '#!/bin/sh\necho v16.20.0; exit 1\n' >/usr/local/bin/node; chmod +x /usr/local/bin/node
EQUIP
    unusable=false
done
discard
echo "$n_passed states passed, $n_failed failed$failed"
[ $n_failed -eq 0 ]
