# `make demo` (watch it work), `make test` (everything CI runs), `make bench` (speed, beside its peers).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint layers unit smoke bench clean

demo: $(STAMP)
	$(BIN)/python examples/quickstart.py --out runs/quickstart

test: lint layers unit smoke

# Exact versions come from constraints.txt. On a machine without a GPU,
# `make demo PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"` saves the CUDA download.
$(STAMP): setup.py constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[examples,test]"
	touch $@

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

layers: $(STAMP)
	$(BIN)/lint-imports

unit: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 tests/filters/test_kalman.py --compiled

smoke: $(STAMP)
	for example in examples/*.py; do echo "== $$example --smoke" && $(BIN)/python $$example --smoke || exit 1; done

# Python 3.11 or later: jax. Ratios hold on a busy machine, absolute times do not.
bench: $(VENV)/.bench
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.speed

$(VENV)/.bench: $(STAMP)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[bench]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info runs
