#!/usr/bin/env bash
# Runs every test, in several processes, and beside them the linter and the type checker.
#   scripts/run-tests.sh [pytest's options]
# One process more than there are cores, since many tests wait; REGNF_TEST_PROCESSES says otherwise.
set -uo pipefail
cd "$(dirname "$0")/.."

processes=${REGNF_TEST_PROCESSES:-$(($(nproc) + 1))}
checks=$(mktemp)
trap 'rm -f "$checks"' EXIT

make --no-print-directory lint >"$checks" 2>&1 &
.venv/bin/python -m pytest --numprocesses "$processes" --dist loadgroup --no-loadscope-reorder "$@"
tests=$?
wait $!
lint=$?
cat "$checks"
if [[ $tests -ne 0 || $lint -ne 0 ]]; then
    echo "Failed: $([[ $tests -eq 0 ]] || echo -n "tests ")$([[ $lint -eq 0 ]] || echo -n "lint or types (above)")" >&2
    exit 1
fi
