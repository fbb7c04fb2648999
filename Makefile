# make install: the environment in .venv; make demo: the whole job on shipped data; make test: all checks.
SHELL := /bin/bash
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
STAMP := .venv/.installed
# threads of torch and numba that spin while they wait take the cores from each other
export OMP_WAIT_POLICY ?= passive

.PHONY: install demo test clean
.DEFAULT_GOAL := install

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: expected Python 3.11 or newer, found " + sys.version.split()[0] + "; name one with PYTHON=...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: install
	$(BIN)/splatgraft run data/demo/project.toml --out demo

test:
	.ci/run

clean:
	rm -rf demo build .pytest_cache .ruff_cache .hypothesis
