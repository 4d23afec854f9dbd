#!/usr/bin/env bash
# Runs the tests, in several processes, and beside them the linter and the type checker.
#   scripts/run-tests.sh
#   scripts/run-tests.sh -m long    a part of the tests, by pytest's options, and no linter
# One process more than there are cores, since many tests wait; REGNF_TEST_PROCESSES says otherwise.
set -uo pipefail
cd "$(dirname "$0")/.."

# Several workers and hundreds of short processes import the same modules: what one compiles, the others read.
unset PYTHONDONTWRITEBYTECODE

cores=$(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc)
checks=$(mktemp)
if [[ $# -eq 0 ]]; then
    scripts/lint.sh >"$checks" 2>&1 &
else
    true &
fi
linter=$!
trap 'kill $linter 2>/dev/null; rm -f "$checks"' EXIT

.venv/bin/python -m pytest --numprocesses "${REGNF_TEST_PROCESSES:-$((cores + 1))}" \
    --dist loadgroup --no-loadscope-reorder "$@"
tests=$?
wait $linter
lint=$?
cat "$checks"
if [[ $tests -ne 0 || $lint -ne 0 ]]; then
    echo "Failed: $([[ $tests -eq 0 ]] || echo -n "tests ")$([[ $lint -eq 0 ]] || echo -n "lint or types (above)")" >&2
    exit 1
fi
