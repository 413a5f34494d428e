#!/bin/sh
# Checks the source of the web page: lint, types of the tests, unit tests. Needs Node.js 18 or newer with npm.
set -eu
"$(dirname "$0")/install-web.sh" check
cd "$(dirname "$0")/../viz/web"
npm run --silent lint
npm run --silent test
