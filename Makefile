# Two commands matter: `make demo` and `make test`. Each sets up what it needs.
.PHONY: setup demo test test-long lint docs sbom clean

setup:
	@scripts/setup.sh

demo:
	@scripts/setup.sh demo
	@.venv/bin/regnf demo --state-dir .demo

test: setup
	@scripts/system-packages.sh test
	@scripts/run-tests.sh

test-long: setup
	@scripts/system-packages.sh test
	@scripts/run-tests.sh -m long

lint: setup
	@scripts/lint.sh

docs: setup
	@.venv/bin/python -m mkdocs build --strict --quiet && echo "build/site/index.html"

sbom: setup
	@scripts/sbom.sh

clean:
	rm -rf .venv .demo build *.egg-info .mypy_cache .ruff_cache .pytest_cache
