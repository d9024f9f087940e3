PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SHELL := /bin/sh

# Two test processes with one BLAS thread each: on two cores, more threads only wait for each other.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# If the environment forbids bytecode caches, every command of a test compiles the library again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo check test long slow mutations lint schema figures cards picture docs locked audit matrix dist clean

# One stamp file per set of extras, so that `make demo` does not install test packages.
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

# For use during work: the core's tests come first, so that a defect there appears within seconds. The type check
# is fast with a warm cache.
check: $(VENV)/.test
	$(BIN)/python -m pytest -x -n 2 --dist loadgroup tests/core
	$(BIN)/ruff check .
	$(BIN)/mypy -p worldstate
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -x -n 2 --dist loadgroup tests/frontend tests/ground tests/house/test_house.py tests/house/test_docs.py

# The tests of the library and of the laboratory.
test: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadgroup

# Complete commands, the programs of the pages, and simulated streets. CI also runs these.
long: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "long and not slow"

slow: $(VENV)/.test
	$(BIN)/python -m pytest -m slow --hypothesis-profile=anew

# Check that the core's tests detect a wrong sign, factor or order.
mutations: $(VENV)/.test
	$(BIN)/python tests/core/test_mutations.py

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/mypy -p worldstate
	MYPYPATH=lab $(BIN)/mypy -p worldstate_lab
	$(BIN)/lint-imports
	$(BIN)/python tools/prose.py
	$(BIN)/python -m pytest tests/house/test_docs.py -k "who or read_as_text or glossary"

# For use after a change of the types of snapshots or scenes.
schema: $(VENV)/.core
	$(BIN)/python docs/_ext/json_schema.py

# After a change of a template in docs/templates, or `worldstate-lab ... --results docs/evidence/results.json`.
figures:
	$(PYTHON) docs/_ext/figures.py

# Write the cards of the models, after a change of a model that ships.
cards: $(VENV)/.core
	$(BIN)/python docs/_ext/model_cards.py

# Draw the moving picture of README.md from the recording of `make demo`.
picture: demo
	$(BIN)/python tools/picture.py out/demo docs/guide/approach.webp

# Warnings are errors, and so is a page that loads a file from the network.
$(VENV)/.docs: $(VENV)/bin/python pyproject.toml
	$(BIN)/pip install -q --disable-pip-version-check -e '.[docs]'
	touch $@ $(VENV)/.core

docs: $(VENV)/.docs
	$(BIN)/sphinx-build -q -W --keep-going -b html -d out/doctrees docs out/docs
	@! grep -rnE '(src|srcset)="https?:|<link[^>]*href="https?:|url\(.?https?:|@import' out/docs --include='*.html' --include='*.css'
	@echo out/docs/index.html

# Record the installed versions as those that CI tests. For the newest versions, run `make clean` first.
locked: $(VENV)/.test $(VENV)/.docs
	head -2 locked.txt > out.locked
	$(BIN)/pip freeze --all --exclude-editable | grep -v '^pip==' | grep '==' >> out.locked
	mv out.locked locked.txt

# Compare those versions with known vulnerabilities. A version that the index of advisories does not contain is a
# failure; so is an empty list.
audit:
	grep -q '^[A-Za-z].*==' locked.txt
	$(PYTHON) -m venv out/audit
	out/audit/bin/pip install -q --disable-pip-version-check pip-audit
	out/audit/bin/pip-audit --strict -r locked.txt --no-deps --disable-pip

# Test with the oldest and newest releases of the dependencies, on every installed Python from 3.11 to 3.13.
matrix:
	.ci/matrix

# Build wheel and sdist, and test them in an empty environment.
dist:
	.ci/dist $(PYTHON)

clean:
	rm -rf $(VENV) out build dist *.egg-info
