# make install: the environment in .venv; make demo: the whole job on shipped data; make test: all checks;
# make blender: Blender as a Python module in .venv-blender, for `splatgraft synth --blender-python`;
# make browser: Chromium, for the editor's tests.
SHELL := /bin/bash
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
STAMP := .venv/.installed
# threads of torch and numba that spin while they wait take the cores from each other
export OMP_WAIT_POLICY ?= passive

.PHONY: install demo test blender browser clean
.DEFAULT_GOAL := install

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "make: expected Python 3.11 or newer, found " + sys.version.split()[0] + "; name one with PYTHON=...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: install
	$(BIN)/splatgraft run data/demo/project.toml --out demo

# Blender's wheel is for Python 3.11 alone and 1 GiB large: an environment of its own
BLENDER_PYTHON ?= $(shell command -v python3.11)
blender: .venv-blender/.installed

.venv-blender/.installed: constraints.txt
	@test -n "$(BLENDER_PYTHON)" || { echo "make: expected Python 3.11 for bpy, found none; name one with BLENDER_PYTHON=..."; exit 1; }
	$(BLENDER_PYTHON) -m venv .venv-blender
	.venv-blender/bin/python -m pip install --quiet --disable-pip-version-check 'bpy==4.2.23' numpy==2.4.6
	@touch $@

# Debian's Chromium with software OpenGL, for the stories of the editor
browser:
	@command -v chromium >/dev/null || { apt-get update -qq && \
	  apt-get install -y -qq --no-install-recommends chromium libgl1-mesa-dri libegl1 >/dev/null; }

test:
	.ci/run

# the documentation site in build/site; strict: a broken link, a missing page or an unexplained message ends it
.PHONY: docs
docs: install
	@$(BIN)/python -c 'import mkdocs, mkdocstrings' 2>/dev/null || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --quiet --strict
	@echo "build/site/index.html"

clean:
	rm -rf demo build .pytest_cache .ruff_cache .hypothesis
