PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SHELL := /bin/sh

# Two test processes of one BLAS thread each: on two cores more threads only wait for one another.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Where the surroundings forbid caches of bytecode, every command that a test starts compiles the library anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo check test long slow mutations lint schema figures cards picture docs locked audit matrix dist clean

# One stamp per set of extras, so that `make demo` installs no test packages.
$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: $(VENV)/bin/python pyproject.toml
	$(BIN)/pip install -q --disable-pip-version-check -e '.[all]'
	touch $@

$(VENV)/.test: $(VENV)/bin/python pyproject.toml lab/pyproject.toml
	$(BIN)/pip install -q --disable-pip-version-check -e '.[test,lint]' -e ./lab
	touch $@ $(VENV)/.core

demo: $(VENV)/.core
	$(BIN)/worldstate demo --out out/demo

# While working: the core first, so that what it breaks shows within seconds, then the rest of what every commit
# can break. Types are fast with a warm cache.
check: $(VENV)/.test
	$(BIN)/python -m pytest -x -n 2 --dist loadgroup tests/core
	$(BIN)/ruff check .
	$(BIN)/mypy -p worldstate
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -x -n 2 --dist loadgroup tests/frontend tests/ground tests/house/test_house.py tests/house/test_readme.py

# The library's tests and the laboratory's.
test: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadgroup

# Whole commands, pages that are run as they stand, streets that are simulated: CI runs these as well.
long: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "long and not slow"

slow: $(VENV)/.test
	$(BIN)/python -m pytest -m slow --hypothesis-profile=anew

# Whether the core's tests notice an error of sign, factor or order, and a published quantity that stands still.
mutations: $(VENV)/.test
	$(BIN)/python tests/core/run_mutations.py
	$(BIN)/python tests/core/run_mutations.py --freeze

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/mypy -p worldstate
	MYPYPATH=lab $(BIN)/mypy -p worldstate_lab
	$(BIN)/lint-imports
	$(BIN)/python -m pytest tests/house/test_docs.py -k "who or lines_of_a_page or glossary"

# After a change of the types of snapshots or scenes.
schema: $(VENV)/.core
	$(BIN)/python docs/_ext/json_schema.py

# After a change of a template in docs/templates, or `worldstate-lab ... --results docs/evidence/results.json`.
figures:
	$(PYTHON) docs/_ext/figures.py

# After a change of a model that ships: its card.
cards: $(VENV)/.core
	$(BIN)/python docs/_ext/model_cards.py

# The moving picture of README.md, from the recording of `make demo`.
picture: demo
	$(BIN)/python tools/picture.py out/demo docs/guide/approach.webp

# Warnings are errors, and a page that would load something from the network is one too.
$(VENV)/.docs: $(VENV)/bin/python pyproject.toml
	$(BIN)/pip install -q --disable-pip-version-check -e '.[docs]'
	touch $@ $(VENV)/.core

docs: $(VENV)/.docs
	$(BIN)/sphinx-build -q -W --keep-going -b html -d out/doctrees docs out/docs
	@! grep -rnE '(src|srcset)="https?:|<link[^>]*href="https?:|url\(.?https?:|@import' out/docs --include='*.html' --include='*.css'
	@echo out/docs/index.html

# What is installed here becomes what CI tests; from an empty environment, `make clean` first, the newest.
locked: $(VENV)/.test $(VENV)/.docs
	head -2 locked.txt > out.locked
	$(BIN)/pip freeze --all --exclude-editable | grep -v '^pip==' | grep '==' >> out.locked
	mv out.locked locked.txt

# Known vulnerabilities of those versions. It needs an index of advisories: a version that could not be looked up
# is a failure, and so is a list without any, else an audit of nothing would pass.
audit:
	grep -q '^[A-Za-z].*==' locked.txt
	$(PYTHON) -m venv out/audit
	out/audit/bin/pip install -q --disable-pip-version-check pip-audit
	out/audit/bin/pip-audit --strict -r locked.txt --no-deps --disable-pip

# Oldest and newest releases of what the library needs, on every Python from 3.11 to 3.13 that is here.
matrix:
	.ci/matrix

# Wheel and sdist, tried in an empty environment.
dist:
	.ci/dist $(PYTHON)

clean:
	rm -rf $(VENV) out build dist *.egg-info
