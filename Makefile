PYTHON ?= python3

# one thread in every library, as in workers, so that results of tests and benchmarks do
# not depend on the number of CPUs
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Python writes bytecode, so that the processes started by tests need not compile modules
unexport PYTHONDONTWRITEBYTECODE
BIN := .venv/bin

.PHONY: help setup browser demo test mutants bench site size synthetic check clean

help:  ## show this help
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' Makefile

setup: .venv/.ready  ## install missing system packages, and Python packages into .venv

.venv/.ready: pyproject.toml constraints.txt tools/extensions.py $(shell find harness problems solvers -name "*.pyx" -o -name "*.pxi" -o -name "*.pxd" -o -name "*.h")
	@tools/setup.sh $(PYTHON)
	@touch $@

browser: setup .venv/.browser  ## install chromium and its driver, for the tests of the report's page

.venv/.browser: .venv/.ready
	@tools/setup.sh $(PYTHON) browser
	@touch $@

site: setup .venv/.site  ## build the documentation site in out/site; runs its notebooks
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

.venv/.site: .venv/.ready
	@tools/setup.sh $(PYTHON) docs
	@touch $@

demo: setup  ## compare solvers on the demo suite; replaces earlier results in out/make-demo
	@$(BIN)/mortarbench run suites/demo.toml --out out/make-demo --fresh

test: setup browser  ## check, and run the tests on all CPUs
	@$(MAKE) --no-print-directory -j2 check tests

.PHONY: tests
tests:
	$(BIN)/pytest -q -n auto --dist loadscope

mutants: setup  ## make small changes to chosen modules; their tests must fail (minutes)
	@$(BIN)/python tools/mutants.py

bench: setup  ## time our own kernels (pytest-benchmark)
	$(BIN)/pytest benchmarks --benchmark-warmup=on \
	    --benchmark-sort=name --benchmark-columns=min,median,iqr,rounds

size: setup  ## measure time and memory up to 1.6 million unknowns (minutes)
	$(BIN)/python benchmarks/size.py

synthetic: setup  ## measure time and memory of journals and reports up to 100 000 records
	$(BIN)/python benchmarks/synthetic_results.py

check: setup  ## format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:  ## remove .venv, results and caches
	rm -rf .venv out .mypy_cache .ruff_cache .pytest_cache .import_linter_cache \
	    .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
