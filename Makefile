# Every target makes and fills .venv by itself; nothing else needs to be installed first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
FILLED := $(VENV)/.filled
export OMP_NUM_THREADS := 1

.PHONY: demo demo-video test quick bench lint wheel lerobot clean

demo: $(FILLED)  ## calibrate a rope to the recording in the package
	$(BIN)/torchdlo calibrate torchdlo/data/sample_rope --out demo/model.json
	@echo "Look at demo/report.html (its picture alone: demo/report.png)."

demo-video: $(FILLED)  ## calibrate a rope to films of it
	$(BIN)/torchdlo calibrate torchdlo/data/sample_film --out demo-video/model.json
	@echo "Look at demo-video/report.html (its picture alone: demo-video/report.png)."

test: $(FILLED)
	$(BIN)/python -m pytest -n 2

quick: $(FILLED)  ## the tests that say most in less than three minutes
	$(BIN)/python -m pytest -n 2 -m "quick and not slow and not compile"

wheel:  ## build it, install it elsewhere, and use it there
	PYTHON=$(PYTHON) .ci/wheel

bench: $(FILLED)
	$(BIN)/python experiments/bench_rod.py --quick

lint: $(FILLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy torchdlo

# LeRobot excludes our version of torch, so it gets an environment of its own: 5.4 GB, Python 3.12. Not a part of CI.
LEROBOT_PYTHON ?= python3.12
LEROBOT := .venv-lerobot

lerobot: $(FILLED) $(LEROBOT)/.filled  ## read and train on a data set of ours with LeRobot itself
	rm -rf runs/lerobot
	PYTHONPATH=. $(BIN)/python tests/agents/data/lerobot_case.py runs/lerobot/case
	$(LEROBOT)/bin/python experiments/lerobot/accept.py runs/lerobot/case
	$(LEROBOT)/bin/lerobot-doctor check runs/lerobot/case
	PYTHONPATH=. $(BIN)/python tests/agents/data/lerobot_case.py runs/lerobot/again --record "lerobot 0.6.1"

$(LEROBOT)/.filled:
	$(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[dataset,training]==0.6.1' lerobot-doctor==0.2.0
	touch $@

clean:
	rm -rf $(VENV) $(LEROBOT) demo demo-video build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Filled again when what it holds changes.
$(FILLED): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "torchdlo needs Python 3.11 or newer: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[all,dev]'
	touch $(FILLED)
