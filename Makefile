# `make demo` (watch it work), `make test` (everything CI runs), `make test-all` (and what is slow), `make docs`
# (the site, in docs/_build/html), `make bench` (speed, beside its peers), `make fuzz` and `make soak` (reliability),
# `make test-nightly` (all tests beside the nightlies of torchrl and tensordict).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# uv makes the environment where it is installed, Python's own venv elsewhere.
ifneq ($(shell command -v uv),)
MAKE_VENV := uv venv --quiet --seed --allow-existing --python $(PYTHON)
else
MAKE_VENV := $(PYTHON) -c "import ensurepip" || { echo "python3 -m venv is missing: apt install python3-venv, or install uv"; exit 1; }; $(PYTHON) -m venv
endif

NIGHTLY_VENV := .venv-nightly
NIGHTLY_STAMP := $(NIGHTLY_VENV)/.installed

.PHONY: demo test test-all test-nightly lint layers unit unit-all smoke smoke-all bench fuzz soak docs clean

demo: $(STAMP)
	$(BIN)/denkf demo --out runs/demo

# Side by side, in this order: cores that one leaves idle, the next takes.
test: $(VENV)/.docs
	$(MAKE) --jobs=2 --output-sync=target lint layers docs unit smoke

test-all: $(VENV)/.docs
	$(MAKE) --jobs=2 --output-sync=target lint layers docs unit-all smoke-all

# Exact versions come from constraints.txt. On a machine without a GPU,
# `make demo PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"` saves the CUDA download.
$(STAMP): setup.py constraints.txt
	$(MAKE_VENV) $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[examples,test]"
	touch $@

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

layers: $(STAMP)
	$(BIN)/lint-imports

define suite
OMP_NUM_THREADS=1 $(1)/bin/python -m pytest -n 2 -rs
OMP_NUM_THREADS=1 $(1)/bin/python -m pytest -n 2 tests/filters/test_kalman.py --compiled
endef

unit: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -rs -m "not slow"

unit-all: $(STAMP)
	$(call suite,$(VENV))

# The tests beside the newest nightlies of torchrl and tensordict, or the ones asked for:
# `make test-nightly TORCHRL_NIGHTLY=2026.10.27 TENSORDICT_NIGHTLY=2026.10.26`. torch stays at its constraint:
# where the newest nightlies ask for another, pip takes the newest that do not. Prioritized replay, which nothing here
# uses, is missing: torchrl's C++ is built for torch's nightlies.
test-nightly: $(NIGHTLY_STAMP)
	$(NIGHTLY_VENV)/bin/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --upgrade \
		torchrl-nightly$(addprefix ==,$(TORCHRL_NIGHTLY)) tensordict-nightly$(addprefix ==,$(TENSORDICT_NIGHTLY))
	$(NIGHTLY_VENV)/bin/python -m pip list | grep -E "^(torch|torchrl|tensordict)(-nightly)? "
	$(call suite,$(NIGHTLY_VENV))

# The releases make way: they and the nightlies own the same files.
$(NIGHTLY_STAMP): setup.py constraints.txt
	rm -rf $(NIGHTLY_VENV)
	$(MAKE_VENV) $(NIGHTLY_VENV)
	$(NIGHTLY_VENV)/bin/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[examples,test]"
	$(NIGHTLY_VENV)/bin/python -m pip uninstall --quiet --yes torchrl tensordict
	touch $@

smoke: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.common.smoke

smoke-all: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.common.smoke --all

# Damaged inputs at every border: about a quarter of an hour. The tests run a sample.
fuzz: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.reliability fuzz

# Long runs, with kills and full disks: an hour; the part "disks" needs root.
soak: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.reliability soak

# Ratios hold on a busy machine, absolute times do not.
bench: $(VENV)/.bench
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.speed

$(VENV)/.bench: $(STAMP)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[bench]"
	touch $@

# Needs no network: formulas are drawn by the reader's browser. A warning is an error.
docs: $(VENV)/.docs
	OMP_NUM_THREADS=1 MPLBACKEND=agg $(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --constraint constraints.txt --editable ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) $(NIGHTLY_VENV) build dist *.egg-info runs docs/_build docs/gallery docs/reference/*.rst
