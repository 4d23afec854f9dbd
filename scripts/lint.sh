#!/usr/bin/env bash
# The linter, the formatter and the type checker; each is asked, whatever the others say.
cd "$(dirname "$0")/.." || exit
failed=0
.venv/bin/ruff check . || failed=1
.venv/bin/ruff format --check . || failed=1
.venv/bin/mypy || failed=1
exit $failed
