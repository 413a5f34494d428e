#!/bin/sh
# Installs the npm packages of the web page, unless they are installed already. Needs Node.js 18 or newer with npm.
#
# usage: install-web.sh build|check      build: what bundling the page needs; check: also the lint and types for tests
set -eu
cd "$(dirname "$0")/../viz/web"
case "${1-}" in
build) omit=--omit=dev ;;
check) omit= ;;
*)
    echo "usage: install-web.sh build|check" >&2
    exit 2
    ;;
esac
if ! node -e 'process.exit(parseInt(process.versions.node) < 18 ? 1 : 0)' >/dev/null 2>&1 || ! npm --version >/dev/null 2>&1; then
    echo "install-web: the web page needs Node.js 18 or newer with npm; found $(node --version 2>/dev/null || echo no node)," \
        "npm $(npm --version 2>/dev/null || echo missing); run: scripts/install-packages.sh web" >&2
    exit 1
fi
# Packages are installed again only when the lock file has changed. The packages for checks include
# the packages for the build.
for installed in check "$1"; do
    if cmp -s package-lock.json "node_modules/.installed-$installed"; then
        exit 0
    fi
done
# Word splitting is intended: the variable may be empty.
# shellcheck disable=SC2086
npm ci $omit --no-fund --no-audit
cp package-lock.json "node_modules/.installed-$1"
