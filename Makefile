# make see: a walking robot in the browser; make demo: the main job on the built-in room, with a page
# that shows it grow; make loop: the closed loop with the shipped policy; make test: all tests. All
# install first.
SHELL := /bin/bash
# the first interpreter that runs, is new enough and can make environments
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
  $$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 \
  && { echo $$p; break; }; done)
BIN := .venv/bin
# of make demo: demo, or tiny for a first look with fewer pictures and a minute of training
PRESET ?= demo

.PHONY: see demo loop test lint install clean
see: install
	$(BIN)/python launch/view.py --task nerf_nav --policy shipped

demo: install
	$(BIN)/python launch/make_scene.py --capture builtin --preset $(PRESET) --out out/$(PRESET) \
	  --viewer
	@echo "open out/$(PRESET)/report.html"

# the closed loop on a weak knee at reduced size: 7 trials, motions of 6 s, 10 minutes of training by
# a walker that copes with that knee, as searching for one takes minutes
loop: install
	$(BIN)/python launch/close_loop.py --robot virtual --hidden motor_gain@l_knee:0.15 \
	  --policy shipped --trials 7 --seconds 6 --minutes 10 --teacher tall --out out/make_loop
	@echo "open out/make_loop/loop.html"

test: install lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadscope --durations 15

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

install: .venv/installed

.venv/installed: setup.cfg pyproject.toml
	@test -n "$(PYTHON)" || { echo "error: found no Python 3.11 or newer that has the venv module:" \
	  "install the packages python3 and python3-venv, or say make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON) is older than Python 3.11 or has no venv module (package python3-venv)"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[all,test,dev]'
	@touch $@

clean:
	rm -rf .venv out build *.egg-info
