# Everything from a fresh clone with only python3 and make: `make demo`, `make test`.
# Another Python: `make demo PYTHON=python3.11`; another environment: VENV=/some/where.

# The newest Python that starts here and can make an environment: a version manager's shim may
# only print an error. Looked for when it is needed, and not for `make help`.
STARTS := import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(or $(shell for python in python3.13 python3.12 python3.11 python3; do \
	$$python -c '$(STARTS)' >/dev/null 2>&1 && echo $$python && break; done),python3)
VENV   ?= .venv
DEMO   ?= demo
BIN    := $(VENV)/bin
# What is installed: the package, and all that its tests, lint and docs need.
STAMP  := $(VENV)/.installed
DEV    := $(VENV)/.installed-dev

# Software OpenGL must not start threads beside the workers, and nothing needs the network.
export LP_NUM_THREADS := 0
export DRAKE_ALLOW_NETWORK := none
# Each process is one worker, so a library of linear algebra must not start threads in it.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Containers often set this; each process of the tests would compile tests and package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: FORCE help install demo test test-fast test-nightly test-browser test-torch test-cluster \
	lint format docs docs-pages package release clean

help:            ## what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

install: $(DEV)  ## the virtual environment with the package and what its tests need

# An environment that was made here is made anew for another Python that was asked for, or for a
# newer one that was found. One of a newer Python is kept, and so is one that was not made here.
WHICH := import sys; print(*sys.version_info[:2], sys.base_prefix)
NEWER := import sys; a, b = ([*map(int, text.split()[:2])] for text in sys.argv[1:]); sys.exit(a <= b)
ASKED := $(filter command environment,$(origin PYTHON))

$(VENV)/pyvenv.cfg: FORCE
	@there=$$($(BIN)/python -c '$(WHICH)' 2>/dev/null); python='$(PYTHON)'; \
	wanted=$$($$python -c '$(WHICH)') || exit 1; \
	if test -z "$$there"; then \
	  $$python -m venv $(VENV); \
	elif test ! -e $(STAMP) || test "$$there" = "$$wanted"; then \
	  :; \
	elif test -n '$(ASKED)' || $$python -c '$(NEWER)' "$$wanted" "$$there"; then \
	  echo "$(VENV) was of Python $$there: made anew with $$wanted"; \
	  $$python -m venv --clear $(VENV); \
	fi

FORCE:

$(STAMP): pyproject.toml $(VENV)/pyvenv.cfg
	$(BIN)/python -m pip install --quiet --upgrade pip
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(DEV): $(STAMP)
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: $(STAMP)   ## a small dataset of built-in objects, its funnel and a contact sheet
	$(BIN)/drakegrasp doctor
	$(BIN)/python pipelines/demo.py $(DEMO)

test: $(DEV)   ## the tests of every change: the first tier, but for the pages in Chromium
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'not server and not nightly and not browser'

test-fast: $(DEV)  ## of these the ones without simulations and clusters
	$(BIN)/python -m pytest -n 2 -m 'not sim and not cluster and not slow and not nightly and not browser'

test-nightly: $(DEV)  ## the second tier: kills, hangs, full disks, spoilt files, repeats
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'nightly and not server'

# Without root or apt-get the tests of pages run where Chromium is there, and else skip.
test-browser: $(DEV)  ## the pages in Chromium, which it installs as root on Debian
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || \
	if test "$$(id -u)" = 0 && command -v apt-get >/dev/null; then \
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
	  apt-get install -y -qq --no-install-recommends chromium >/dev/null || \
	  echo "Chromium cannot be installed here: its tests skip"; \
	else \
	  echo "Chromium is not here, and only root can install it: its tests skip"; \
	fi
	$(BIN)/python -m pytest -m browser tests/page

# torch is large: only this target installs it, and without it the tests that it runs skip.
test-torch: $(DEV)  ## the baseline and the loaders for torch, which it installs
	$(BIN)/python -m pip install --quiet --editable '.[torch]'
	DRAKEGRASP_TORCH=1 $(BIN)/python -m pytest tests/test_baseline.py tests/dataset/test_torch_samples.py

test-cluster: $(DEV)  ## with a real SLURM, which it installs; as root, on Debian
	apt-get update -qq
	DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
	    slurm-wlm munge
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(BIN)/python -m pytest -m server

lint: $(DEV)   ## style, types, and docs that are made from code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python pipelines/docs/dataset_format.py --check docs/reference/dataset-format.md
	$(BIN)/python pipelines/docs/builtin_objects.py --check docs/reference/builtin-objects.md
	$(BIN)/python pipelines/docs/example_gallery.py --check docs/examples/index.md

format: $(DEV) ## let ruff lay out the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: docs-pages ## the site of the docs in site/; every link must lead somewhere
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs-pages: $(DEV)  ## write the pages of the docs that are made from code
	$(BIN)/python pipelines/docs/dataset_format.py docs/reference/dataset-format.md
	$(BIN)/python pipelines/docs/builtin_objects.py docs/reference/builtin-objects.md
	$(BIN)/python pipelines/docs/example_gallery.py docs/examples/index.md

# The wheel is built from the sdist, so what the sdist lacks the wheel lacks as well.
package: $(DEV)  ## sdist and wheel in dist/, and the wheel tried in an empty environment
	rm -rf dist
	$(BIN)/python -m build . >/dev/null
	$(BIN)/python pipelines/try_package.py dist/*.whl

release: package ## what `package` does with the sdist as well, and the command that tags the version
	$(BIN)/python pipelines/try_package.py dist/*.tar.gz
	$(BIN)/python pipelines/release.py

clean:           ## remove what was made here
	rm -rf $(VENV) $(DEMO) site build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
