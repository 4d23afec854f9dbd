#!/usr/bin/env bash
# Builds the wheel and uses it as a stranger does: a clean virtual environment, `pip install "regnf[all]"`, `regnf demo`.
#   scripts/try-wheel.sh [EXTRA]     EXTRA: all (default), engine, service, or none
# Needs the package index that pip is configured for. tests/packaging does the same without an index.
set -euo pipefail
cd "$(dirname "$0")/.."

extra=${1:-all}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

scripts/setup.sh
.venv/bin/python -m build --wheel --no-isolation --outdir "$work" . >/dev/null
wheel=$(ls "$work"/*.whl)
"${PYTHON:-python3}" -m venv "$work/venv"
pip=("$work/venv/bin/python" -m pip --disable-pip-version-check --quiet)
if [[ $extra == all || $extra == engine ]]; then
    "${pip[@]}" install --constraint constraints.txt torch # an open range may resolve to gigabytes of GPU libraries
fi
wanted=$wheel
[[ $extra == none ]] || wanted="$wheel[$extra]"
"${pip[@]}" install --constraint constraints.txt "$wanted"

cd "$work"
case $extra in
    all) venv/bin/regnf demo --exit ;;
    engine) venv/bin/python -c 'import regnf_core.library' ;;
    service) venv/bin/python -c 'import regnf_service.server' ;;
    *) venv/bin/regnf --version ;;
esac
echo "The wheel works with: $extra"
