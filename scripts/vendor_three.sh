#!/usr/bin/env bash
# Rebuilds service/regnf_service/web/vendor/three.bundle.min.js: the parts of three.js that the result page imports, in one module.
# The npm package of three.js ships no minified modules, and its add-ons import it by the bare name `three`, which a
# browser resolves only through an inline import map; one bundle needs neither. Needs npm; run it to change versions.
set -euo pipefail

three_version=0.187.0
esbuild_version=0.28.2

cd "$(dirname "$0")/.."
vendor="$PWD/service/regnf_service/web/vendor"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

cp "$vendor/three.entry.js" "$work/entry.js"
cd "$work"
npm install --silent --no-save --no-package-lock --no-audit --no-fund "three@$three_version" "esbuild@$esbuild_version"
npx esbuild entry.js --bundle --minify --format=esm --target=es2022 --legal-comments=inline \
    --outfile="$vendor/three.bundle.min.js"
cp node_modules/three/LICENSE "$vendor/three.LICENSE"

cd "$vendor"
sha256sum three.bundle.min.js
echo "Put this digest and three $three_version into service/regnf_service/web/vendor/README.md." >&2
