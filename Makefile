# make demo, make test: everything they need is installed into .venv first.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed# holds the PYTHON that .venv was made with
PYTHON ?= $(or $(shell cat $(STAMP) 2>/dev/null),python3)

# .venv has a ROS 2 of its own: keep a sourced one out, and what a Python with the ROS wheels hands down.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

help:
	@echo 'make demo [ARGS=...]   run the demo (srtomo demo)'
	@echo 'make test [ARGS=...]   run the tests; test-slow: the long ones'
	@echo 'make rival             install pyTomoAO and pyRTC into build, and time the same work against them'
	@echo 'make soak              a million frames of gnao_ltao_sr with swaps and faults, each checked: 40 minutes at most'
	@echo 'make lint              ruff and mypy'
	@echo 'make install           only install into $(VENV), as all of the above do first'
	@echo 'make clean             remove $(VENV) and what the tools left'
	@echo 'PYTHON=python3.12      the Python to make $(VENV) with: 3.10 to 3.13'

demo: install
	$(BIN)/srtomo demo $(ARGS)

# Two files at a time: nodes and processes that are waited for leave a core idle.
test: install
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

test-slow: install
	$(BIN)/python -m pytest -m slow $(ARGS)

rival: install
	[ -x build/rival/bin/pip ] || $(PYTHON) -m venv build/rival
	build/rival/bin/pip install -q pyTomoAO==2.0.0
	OPENBLAS_NUM_THREADS=1 SRTOMO_RIVAL_PYTHON=$(CURDIR)/build/rival/bin/python \
		$(BIN)/python -m pytest -m slow -s tests/ops/test_rival_pytomoao.py $(ARGS)
	[ -x build/rival_pyrtc/bin/pip ] || $(PYTHON) -m venv build/rival_pyrtc
	build/rival_pyrtc/bin/pip install -q pyrtcao==2.1.0
	OPENBLAS_NUM_THREADS=1 SRTOMO_PYRTC_PYTHON=$(CURDIR)/build/rival_pyrtc/bin/python \
		$(BIN)/python -m pytest -m slow tests/ops/test_rival_pyrtc.py $(ARGS)

soak: install
	$(BIN)/srtomo bench soak gnao_ltao_sr --json soak.json $(ARGS)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The Debian packages without which .venv cannot be made, nor the messages be built.
missing:
	@command -v g++ >/dev/null || echo g++
	@$(PYTHON) -c '' 2>/dev/null || echo $(notdir $(PYTHON))
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || echo $(notdir $(PYTHON))-venv
	@$(PYTHON) -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null || \
		echo $(notdir $(PYTHON))-dev

# Editable: the Python sources are used where they are, only messages and frame path have to be compiled anew.
# A new .venv for another PYTHON, or where the last installation was cut off.
install: $(STAMP)
$(STAMP): pyproject.toml $(shell find msgs_schema srtomo_rtc/native) $(if $(filter-out $(PYTHON),$(shell cat $(STAMP) 2>/dev/null)),FORCE)
	@missing=$$($(MAKE) -s missing | xargs); \
	[ -z "$$missing" ] || { echo "srtomo: not everything is here that it is built with: apt-get install $$missing"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo 'srtomo: ROS 2 is there for Python 3.10 to 3.13, $(PYTHON) is none of these: PYTHON=python3.12'; exit 1; }
	@echo 'srtomo: installing into $(VENV), 1 to 3 minutes; pip writes to $(VENV)/install.log'
	@[ "$$(cat $@ 2>/dev/null)" = '$(PYTHON)' ] || $(PYTHON) -m venv --clear $(VENV)
	@while sleep 2; do printf .; done & trap "kill $$!" EXIT; \
	$(BIN)/python -m pip install --no-input -e '.[ros,test]' >$(VENV)/install.log 2>&1 || \
		{ echo; tail -40 $(VENV)/install.log; exit 1; }
	@echo ' done'; echo '$(PYTHON)' >$@

FORCE:
.PHONY: help demo test test-slow rival soak lint clean missing install FORCE
