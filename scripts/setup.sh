#!/usr/bin/env bash
# Makes .venv: with what the service, the command line and a demo need (`setup.sh demo`), or with everything that tests,
# lint and docs need too. Quick when nothing has changed since the last time.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-python3}
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo "regnf needs Python 3.11 or newer; set PYTHON to one." >&2
    exit 1
fi
scripts/system-packages.sh runtime

stamp=.venv/.regnf-setup
state=$(cat pyproject.toml constraints.txt scripts/setup.sh | sha256sum)
have() { [[ -f $1 && $(cat "$1") == "$state" ]]; }
if have "$stamp" || { [[ ${1-} == demo ]] && have "$stamp-demo"; }; then
    .venv/bin/python scripts/native_library.py # its C files may have changed
    exit 0
fi

[[ -x .venv/bin/python ]] || "$python" -m venv .venv
# Python compiles what is used, when it is: .venv is a quarter of a gigabyte smaller.
install=(.venv/bin/python -m pip --disable-pip-version-check --quiet install --no-compile -c constraints.txt)
echo "Installing into .venv (the first time takes a few minutes) ..."
# torch first and by its pinned version: an open range may resolve to another build.
"${install[@]}" torch
if compgen -G '.venv/lib/python*/site-packages/nvidia' >/dev/null && ! [[ -e /dev/nvidia0 ]]; then
    echo "torch came with 4 GB of libraries for GPUs, and this machine shows none: docs/start/install.md, for CPUs." >&2
fi
if [[ ${1-} == demo ]]; then
    "${install[@]}" -e '.[all]'
    stamp+=-demo
else
    "${install[@]}" -e '.[dev]'
    # The benchmark's peers weigh 2 MB, but not every machine has wheels of them: without them their tests are skipped.
    "${install[@]}" --only-binary kiss-matcher,small_gicp -e '.[benchmarks]' ||
        echo "The benchmark's optional packages do not install here; tests of them will be skipped." >&2
    # Makes a client from the contract, in a test. Last, because it asks for an older typer than ours; it works with ours.
    "${install[@]}" --no-deps openapi-python-client
fi
if ! .venv/bin/python -c 'import open3d' 2>.venv/open3d-error.txt; then
    echo "open3d does not load; a system library is missing:" >&2
    tail -n 1 .venv/open3d-error.txt >&2
    echo "On Debian or Ubuntu, as root: scripts/system-packages.sh runtime" >&2
    exit 1
fi
echo "$state" >"$stamp"
