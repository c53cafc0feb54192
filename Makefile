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
	@echo 'make sanitize          run the frame path in C under address, undefined-behaviour and thread sanitizers'
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
	@timeout --foreground --signal=INT --kill-after=120 2400 \
		$(BIN)/srtomo bench soak gnao_ltao_sr --json soak.json $(ARGS) || { status=$$?; \
		[ $$status != 124 ] || echo 'make soak: not done after 40 minutes, which is all it may take'; exit $$status; }

# A build of its own for each, which Python loads instead of the installed one. Python itself is not instrumented, so the
# sanitizer's library has to be loaded first, and what Python never frees is no leak. Reports go past pytest's capture.
SANITIZED := $(patsubst %,tests/rtc/test_%.py,closed_sensors crew faults hrtc latency limits loop lowrank \
	ring_from_c several_exposures threads tip_tilt vmm)
sanitize: install build/sanitize/address/libsrtomo_frame.so build/sanitize/thread/libsrtomo_frame.so
	SRTOMO_FRAME_PATH=$(CURDIR)/build/sanitize/address LD_PRELOAD=$$(gcc -print-file-name=libasan.so) \
		ASAN_OPTIONS=detect_leaks=0 $(BIN)/python -m pytest --capture=sys $(SANITIZED)
	SRTOMO_FRAME_PATH=$(CURDIR)/build/sanitize/thread LD_PRELOAD=$$(gcc -print-file-name=libtsan.so) \
		TSAN_OPTIONS=exitcode=66 $(BIN)/python -m pytest --capture=sys tests/rtc/test_crew.py tests/rtc/test_threads.py

build/sanitize/address/libsrtomo_frame.so: SANITIZER := -fsanitize=address,undefined -fno-sanitize-recover=undefined
build/sanitize/thread/libsrtomo_frame.so: SANITIZER := -fsanitize=thread -Wno-tsan
build/sanitize/%/libsrtomo_frame.so: $(wildcard srtomo_rtc/native/*.[ch])
	mkdir -p $(@D)
	gcc -std=gnu11 -g -O2 -fno-omit-frame-pointer -ffp-contract=off $(SANITIZER) -shared -fPIC -pthread \
		$(filter-out %/ros.c,$(filter %.c,$^)) -lm -o $@

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
.PHONY: help demo test test-slow rival soak sanitize lint clean missing install FORCE
