# Every target makes .venv first, with the extras it needs (scripts/venv.sh); PYTHON=... names the interpreter to make it with.
SHELL := /bin/bash
BIN := .venv/bin
# Modules stay compiled: the installation has compiled none (scripts/venv.sh), and every process would do it again.
unexport PYTHONDONTWRITEBYTECODE
RUN ?= runs/demo
# Worker processes of the demo and of the tests; each needs up to 3 GB.
JOBS ?= $(shell awk -v n=$$(nproc) '/MemAvailable/ { m = int($$2 / 3e6); print m < 1 ? 1 : m < n ? m : n }' /proc/meminfo)

# By `worksteal` a worker that dies fails its test alone; by `loadscope` and `loadfile` the run would hang.
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist worksteal --durations=25 --durations-min=1

# Left to `make test-all` (CONTRIBUTING.md).
THOROUGH := slow or door or training or scripts

# Of the gate: the run, and what it says.
GATE := build/gate

# Where LLVM is installed, each process of the tests would compile Mitsuba's integrators. The tests of LLVM choose their own variant.
test test-all: export ATTNWARP_MITSUBA ?= scalar_rgb

# What is compiled or checked once for all checkouts: kernels by the text of their sources (attnwarp/numba_cache.py), types.
KEPT ?= $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/attnwarp/checkouts
test test-all gate baseline: export NUMBA_CACHE_DIR ?= $(KEPT)/kernels
test test-all gate baseline: export NUMBA_CACHE_LOCATOR_CLASSES ?= attnwarp.numba_cache.BySource,InTreeCacheLocator,UserWideCacheLocator

.PHONY: demo test test-all gate baseline bench docs lint checks kernels kernels-float64 measured venv clean count

## an edit carried, what the mask is for, accuracy against time: runs/demo/report.html
demo:
	@scripts/venv.sh edit,eval
	$(BIN)/attnwarp-eval run demo --jobs $(JOBS) --out $(RUN)

## lint, types, layers, the gate, and the tests that fit in a coffee break (CONTRIBUTING.md)
test: checks
	$(PYTEST) -m "not ($(THOROUGH))"

## everything, the thorough checks too
test-all: checks
	@scripts/browser.sh
	$(PYTEST)

## did a change make the figures of warp, masks and depth worse? (docs/measuring/gate.md)
gate: measured
	$(BIN)/attnwarp-eval compare reports/baseline/gate.jsonl $(GATE) --markdown $(GATE)/compare.md \
		--html $(GATE)/compare.html --json $(GATE)/compare.json

## accept the figures as they are: writes reports/baseline/ anew and prints what changed
baseline: measured
	$(BIN)/attnwarp-eval compare reports/baseline/gate.jsonl $(GATE) --update

# In an empty folder with an empty cache, so that no figure of former code comes back; by the variant of Mitsuba that needs
# no LLVM, since pictures of others differ in their noise.
measured: kernels
	@rm -rf $(GATE)
	ATTNWARP_CACHE=$(GATE)/derived ATTNWARP_MITSUBA=scalar_rgb $(BIN)/attnwarp-eval run gate --out $(GATE)

## the benchmarks that need nothing but this machine, one after the other
BENCHMARKS := before editing injection render warp
bench: venv
	@for name in $(BENCHMARKS); do $(BIN)/python -m "benchmarks.$$name" || exit; done

## the documents and the reference of both packages as a site: build/site/index.html
docs: venv
	$(BIN)/mkdocs build --strict --quiet

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@[ -d .mypy_cache ] || tar -xf $(KEPT)/mypy.tar 2>/dev/null || rm -rf .mypy_cache
	$(BIN)/mypy
	-@mkdir -p $(KEPT) && tar -cf $(KEPT)/mypy.tar.$$$$ .mypy_cache && mv $(KEPT)/mypy.tar.$$$$ $(KEPT)/mypy.tar
	$(BIN)/lint-imports
	$(BIN)/python -m scripts.check_docstrings

# Lint on one core; on another the kernels are compiled, which each worker of the tests would do for itself, and the gate
# uses them. Lint ends first, so that what else would be done by each worker follows it: other kernels, and modules compiled
# by collecting the tests once. Output comes a target at a time, so that it does not mix.
checks: venv
	@$(MAKE) --no-print-directory -j2 --output-sync=target build/collected.txt gate

kernels: venv
	@$(BIN)/python -m scripts.compile_kernels

kernels-float64: lint
	@$(BIN)/python -m scripts.compile_kernels float64

# Once an installation: later changes of a few modules are compiled by the workers.
.venv/.installed-dev: venv ;
build/collected.txt: .venv/.installed-dev | kernels-float64
	@mkdir -p build
	@$(BIN)/python -m pytest --collect-only -qq > $@ || { tail -60 $@; rm $@; exit 1; }

## lines of code by package, without docstrings, comments and blank lines
count:
	@python3 scripts/count_code.py

venv:
	@scripts/venv.sh

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache
