# `make demo` shows a shipped policy, `make run` runs the main job, `make test` checks what matters in minutes,
# `make test-all` runs every test. Each sets up .venv on first use.
PYTHON ?= python3
ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed
READY_DEV := $(VENV)/.installed-dev
READY_DOCS := $(VENV)/.installed-docs
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt

.PHONY: demo run test test-rest test-long test-all test-lerobot fuzz docs dist setup clean

demo: $(READY)
	$(BIN)/mjstack experiment=demo $(ARGS)

run: $(READY)
	$(BIN)/python scripts/run.py robot=so101 nworld=32 $(ARGS)

# Two processes on two cores: with threads of their own as well they would wait for each other. A file's tests share what
# they build, so a process takes whole files. pip left no bytecode: without this, where the shell forbids writing it, each
# process that a test starts compiles torch's.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --max-worker-restart=0 --durations=20

# Lint, types, and the tests without which nobody would trust a package; the examples are among them.
test: $(READY_DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2
	$(PYTEST) -m "not full and not long"

# The tests that `make test` leaves out.
test-rest: $(READY_DEV)
	$(PYTEST) -m "full and not long"

# Trainings and several ranks that take long, and the notebook.
test-long: $(READY_DEV)
	$(PIP) --editable '.[notebook]'
	$(PYTEST) -m long

test-all: test test-rest test-long

# Odd command lines, damaged folders and small files that stand for much, many more than test-rest tries.
fuzz: $(READY_DEV)
	PYTHONPATH=tests/helpers $(BIN)/python tests/commands/test_fuzz.py commands 0-999
	PYTHONPATH=tests/helpers $(BIN)/python tests/commands/test_fuzz.py folders 0-499
	PYTHONPATH=tests/helpers $(BIN)/python tests/commands/test_fuzz.py datasets 0-199

# In an environment of its own with LeRobot, which it makes: some 6 GB, and Python 3.12 or 3.13.
test-lerobot:
	PYTHON=$(PYTHON) tools/check_lerobot.sh $(ARGS)

# build/site/index.html opens from the disk. The build fetches nothing.
docs: $(READY_DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Wheel and sdist in dist/, tried in empty environments of three Pythons: half an hour, and some 7 GB for a while.
dist: $(READY_DEV)
	$(BIN)/python tools/check_dist.py $(ARGS)

setup: $(READY_DEV)

# Installed again only when what is to be installed changes.
$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) torch
	$(PIP) --editable '.[video,web]'
	touch $@

# What it installs has all that $(READY) has: once, not one after the other.
$(READY_DEV): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) torch --editable '.[dev]'
	touch $(READY) $@

$(READY_DOCS): $(READY)
	$(PIP) --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
