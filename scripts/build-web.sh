#!/bin/sh
# Bundles the web page that the binary embeds into viz/web/dist. Needs Node.js 18 or newer with npm.
set -eu
"$(dirname "$0")/install-web.sh" build
cd "$(dirname "$0")/../viz/web"
npm run --silent check
npm run --silent build
