# Every target sets itself up: a fresh machine needs Python 3.11, pip and make.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what it imports, once, and not all that is installed.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# Programs of benchmarks/, in the order they run.
BENCHMARKS := deploy learner collection evaluation planners file_maps whole_job scaling_learner scaling_world

# Tests run side by side, a worker a core; a file's tests stay together, since they share what they have trained.
# Files begin in the order of tests/conftest.py: those that take longest first.
WORKERS ?= logical
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: help install setup train smoke play test test-slow chromium check format bench notebooks pictures tables docs clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | awk -F '|' '{ printf "%-16s %s\n", $$1, $$2 }'

train: install ## train a risk-conditioned agent: two cores, about 25 minutes
	$(BIN)/python -m rcdsac_trl.train +algo=rcdsac_cvar

smoke: install ## rehearse the whole training in a minute or two; it learns nothing
	$(BIN)/python -m rcdsac_trl.train +algo=rcdsac_cvar preset=smoke

play: install ## drive a shipped agent on a page in your browser; Ctrl-C ends it
	$(BIN)/python -m rcdsac_trl.play

test: setup chromium ## run the tests
	$(PYTEST)

# Tests of the page open it in the system's Chromium. Where that is missing and may not be installed, they skip.
chromium: ## install the browser that some tests open, where that may be done
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get -qq update && \
	  DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends chromium >/dev/null; then exit 0; fi; \
	echo "There is no Chromium, and it could not be installed from here: tests of the page in a browser will skip."; \
	echo "To run them too: sudo apt-get install chromium"

# One after another: they start clusters of their own, and count on the cores.
test-slow: test ## run those that take minutes as well
	$(BIN)/python -m pytest -m slow

bench: setup ## measure how fast it is
	for name in $(BENCHMARKS); do $(BIN)/python benchmarks/$$name.py || exit 1; done

check: setup ## look for mistakes of style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

notebooks: setup ## run the notebooks anew, in place
	$(BIN)/jupyter execute --inplace notebooks/*.ipynb

tables: setup ## write the tables of README.md and docs/ and the cards of weights/ anew, from weights/ and results/
	$(BIN)/python docs/tables.py

docs: setup ## build the documentation as a site: build/docs/html/index.html
	$(BIN)/python -m sphinx -E -W --keep-going -q -d build/docs/doctrees docs build/docs/html
	@echo "Open build/docs/html/index.html in a browser."

pictures: setup ## draw the pictures of docs/images anew that need no measurement: some minutes, and Chromium
	$(BIN)/python -m rcdsac_trl.draw_maps split=validation count=4 out=docs/images/maps.png
	for name in sensor_pictures learning_study results_figures scaling_figures ways office_film play_film; do $(BIN)/python docs/images/$$name.py || exit 1; done

format: setup ## let ruff repair what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(VENV)/.installed ## make .venv with what trains and drives; train, smoke and play do it by themselves

setup: $(VENV)/.complete ## install what tests and documentation need, too; every other target does it by itself

$(VENV)/.installed: pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing: install Python 3.11, or name it with make PYTHON=/path/to/python"; exit 2; }
	$(PYTHON) -m venv $(VENV)
# Torch goes first: what depends on it would otherwise pick a version, and a build, of its own.
	$(INSTALL) torch
	$(INSTALL) -e '.[play]'
	@touch $@

$(VENV)/.complete: $(VENV)/.installed
	$(INSTALL) -e '.[dev]'
	@touch $@

clean: ## remove .venv, caches and the site
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build/docs docs/reference
