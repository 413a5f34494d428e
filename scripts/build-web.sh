#!/bin/sh
# Bundles the web page that the binary embeds into viz/web/dist. Needs Node.js 18 or newer with npm.
set -eu
cd "$(dirname "$0")/../viz/web"
if ! node -e 'process.exit(parseInt(process.versions.node) < 18 ? 1 : 0)' >/dev/null 2>&1 || ! npm --version >/dev/null 2>&1; then
    echo "build-web: the web page needs Node.js 18 or newer with npm; found $(node --version 2>/dev/null || echo no node)," \
        "npm $(npm --version 2>/dev/null || echo missing); run: scripts/install-packages.sh web" >&2
    exit 1
fi
# Packages are installed again only when the lock file changed.
if [ ! -e node_modules/.installed ] || ! cmp -s package-lock.json node_modules/.installed; then
    npm ci --no-fund --no-audit
    cp package-lock.json node_modules/.installed
fi
npm run --silent check
npm run --silent build
