# Everything a newcomer, a developer and CI need. Each target makes the environment it needs.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
LAB_KERNEL ?= auto# auto, host or uml: see docs/lab.md
LAB = $(PYTHON) deploy/lab/lab.py --kernel $(LAB_KERNEL)
LAB_TESTS = $(BIN)/python -m pytest -m kernel_can --no-skips tests/drivers tests/lab

.DEFAULT_GOAL := help
.PHONY: help demo test lab lint bench proto clean

help: ## show the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

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

lab: $(STAMP) ## the tests of SocketCAN on a real kernel with CAN
	@$(LAB) -- $(LAB_TESTS)

lint: $(STAMP) ## format, lint, types, import rules
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(STAMP) ## speed, as ratios against references in the same run
	$(BIN)/python -m benchmarks

proto: $(STAMP) ## regenerate the telemetry classes from hil/proto/telemetry.proto
	cd hil/proto && ../../$(BIN)/python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. telemetry.proto

clean: ## remove the environment and everything generated
	rm -rf $(VENV) runs .mypy_cache .ruff_cache .pytest_cache .hypothesis *.egg-info
