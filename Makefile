# make demo   simulated devices, the gateway, a verdict after DEMO_SECONDS (0: until Ctrl-C)
# make test   the tests; needs only Python (3.11 or newer, with pip and venv)
# make check  the tests with coverage, ruff, mypy
# make translations   the catalogues of the menu, brought up to date with the code
# make manual  the manual pages and etc/rtugate.toml, brought up to date with the code
# make deb     the Debian package, in dist/; needs build-essential, debhelper and dh-python
# make bench  how fast it is, against a peer in the same run
# make system-test   what takes minutes; writes tests/system/LAST.md; TESTS="FILE ..." for some of it

PYTHON ?= python3
VENV ?= .venv
CONSTRAINTS ?= /dev/null
DEMO_SECONDS ?= 20
PYTEST_ARGS ?=

BIN = $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS)

.PHONY: demo test check translations manual deb bench system-test clean

demo: $(VENV)/.test
	$(BIN)/rtugate demo $(if $(filter-out 0,$(DEMO_SECONDS)),--seconds $(DEMO_SECONDS))

test: $(VENV)/.test
	$(BIN)/python -m pytest $(PYTEST_ARGS)

check: $(VENV)/.check
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	rm -f .coverage .coverage.*
	$(BIN)/python -m coverage run -m pytest $(PYTEST_ARGS)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python tests/coverage_floors.py

translations: $(VENV)/.test
	$(BIN)/python -m tests.hmi.catalogues

manual: $(VENV)/.test
	$(BIN)/python -m tests.manual

deb:
	sh packaging/build.sh dist

bench: $(VENV)/.test
	$(BIN)/python -m bench.run

system-test: $(VENV)/.system
	$(BIN)/python -m tests.system.run $(TESTS)

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "rtugate needs Python 3.11 or newer: make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.test: $(VENV)/bin/python pyproject.toml
	$(INSTALL) -e '.[test]'
	touch $@

$(VENV)/.check: $(VENV)/.test
	$(INSTALL) -e '.[test,check]'
	touch $@

$(VENV)/.system: $(VENV)/.test
	$(INSTALL) -e '.[test,system]'
	touch $@

clean:
	rm -rf $(VENV) .coverage .coverage.* .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
