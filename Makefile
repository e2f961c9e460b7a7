# Everything from a fresh clone with only python3 and make: `make demo`, `make test`.
# Another Python: `make demo PYTHON=python3.13`; another environment: VENV=/some/where.

PYTHON ?= python3
VENV   ?= .venv
DEMO   ?= demo
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

# Software OpenGL must not start threads beside the workers, and nothing needs the network.
export LP_NUM_THREADS := 0
export DRAKE_ALLOW_NETWORK := none

.PHONY: help install demo test test-fast test-cluster lint format docs clean

help:            ## what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

install: $(STAMP)  ## the virtual environment with the package and what its tests need

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: $(STAMP)   ## a small dataset of built-in objects, its funnel and a contact sheet
	$(BIN)/drakegrasp doctor
	$(BIN)/python pipelines/demo.py $(DEMO)

test: $(STAMP)   ## the whole test suite
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-fast: $(STAMP)  ## without simulations and clusters
	$(BIN)/python -m pytest -n 2 -m 'not sim and not cluster and not slow'

test-cluster: $(STAMP)  ## with a real SLURM and a real sshd, which it installs; as root, on Debian
	apt-get update -qq
	DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
	    slurm-wlm munge openssh-server openssh-client
	$(BIN)/python -m pip install --quiet --editable '.[dev,slurm,ssh,tls]'
	$(BIN)/python -m pytest -m server

lint: $(STAMP)   ## style, types, and docs that are made from code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python pipelines/docs/dataset_format.py --check docs/reference/dataset-format.md

format: $(STAMP) ## let ruff lay out the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP)   ## write the docs that are made from code
	$(BIN)/python pipelines/docs/dataset_format.py docs/reference/dataset-format.md

clean:           ## remove what was made here
	rm -rf $(VENV) $(DEMO) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
