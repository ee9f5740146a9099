# Everything a newcomer, a developer and CI need. Each target makes the environment it needs.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LAB_KERNEL ?= auto# auto, host or uml: see docs/lab.md
LAB = $(PYTHON) deploy/lab/lab.py --kernel $(LAB_KERNEL)
OTHER_PYTHONS := 3.12 3.13 3.14
FUZZ ?= 1000000
LAB_BENCH = $(BIN)/python -m benchmarks buses
LAB_TESTS = $(BIN)/python -m pytest -m kernel_can --no-skips tests/drivers tests/lab

.DEFAULT_GOAL := help
.PHONY: help demo test nightly pythons lab install-check lint bench lab-bench proto clean

help: ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "hil needs Python 3.11 or newer; say which with: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP) ## an emulated arm tracks a trajectory over real frames; verdict and report
	$(BIN)/hil demo

# A host that stalls for a second can fail a test of real processes: what failed runs once more, alone.
# The tests that need a kernel with CAN run on one of their own: in the lab.
test: $(STAMP) lint ## everything CI runs
	$(BIN)/python -m pytest -m "not kernel_can" || \
	  $(BIN)/python -m pytest -m "not kernel_can" --last-failed --last-failed-no-failures none
	@$(LAB) --optional -- $(LAB_TESTS)

# The soak takes HIL_SOAK_S seconds (600), each fuzz test FUZZ frames. Nothing may run beside the soak.
# Every part runs, whatever fails; the worst exit status counts.
nightly: $(STAMP) pythons ## soak, whole scenarios twice and on other Pythons, long fuzzing: an hour or two
	HIL_FUZZ_FRAMES=$(FUZZ) $(BIN)/python -m tests.nightly.run

pythons: ## environments of other Pythons that the host has, for the tests of determinism
	@for v in $(OTHER_PYTHONS); do \
	  d=$(VENV)/pythons/$$v; test -x $$d/bin/python && continue; \
	  p=$$(command -v python$$v || ls -d $$HOME/.pyenv/versions/$$v.*/bin/python 2>/dev/null | tail -1); \
	  if [ -z "$$p" ]; then echo "no Python $$v on this host"; continue; fi; \
	  $$p -m venv $$d && $$d/bin/pip install --quiet --disable-pip-version-check -c constraints.txt . || \
	    { echo "Python $$v: the dependencies cannot be installed" >&2; rm -rf $$d; }; \
	done

lab: $(STAMP) ## the tests of SocketCAN on a real kernel with CAN
	@$(LAB) -- $(LAB_TESTS)

install-check: ## docs/install.md on a fresh Debian that boots: root and a Debian host
	@$(PYTHON) deploy/check_install.py

lint: $(STAMP) ## format, lint, types, import rules
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(STAMP) ## speed, as ratios against references in the same run
	$(BIN)/python -m benchmarks
	@test -e /sys/class/net/vcan0 || $(LAB) --optional -- $(LAB_BENCH)

lab-bench: $(STAMP) ## what vcan costs, on a real kernel with CAN
	@$(LAB) -- $(LAB_BENCH)

proto: $(STAMP) ## regenerate the telemetry classes from hil/proto/telemetry.proto
	cd hil/proto && ../../$(BIN)/python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. telemetry.proto

clean: ## remove the environment and everything generated
	rm -rf $(VENV) runs .mypy_cache .ruff_cache .pytest_cache .hypothesis *.egg-info
