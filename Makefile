# make demo | test | lint | colcon | lock | clean. Everything runs in .venv, made from requirements.lock.
PYTHON ?= python3
PYTEST_ARGS ?= -n 2 --dist loadgroup
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := msgs_py segmenter mapper matcher
PACKAGES := $(PACKAGES:%=src/buildloc_%) src/buildloc src/buildloc_eval
LOCKED := $(VENV)/.locked
INSTALLED := $(VENV)/.installed

# A sourced ROS installation must not shine through the virtual environment.
unexport PYTHONPATH

.PHONY: help install demo test lint format colcon lock clean
help:
	@sed -n 's/^#: *//p' $(MAKEFILE_LIST)

#: make install    .venv with everything in it, buildloc among it
install: $(INSTALLED)

$(LOCKED): requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "buildloc needs Python 3.11 or newer; run: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "Python's venv module is missing; run: sudo apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	awk '/^[^ #]/ { keep = /^(pip|setuptools)==/ } keep' requirements.lock > $(VENV)/build.lock
	$(BIN)/python -m pip install --quiet --require-hashes -r $(VENV)/build.lock
	$(BIN)/python -m pip install --quiet --require-hashes --no-build-isolation -r requirements.lock
	@touch $@

$(INSTALLED): $(LOCKED) $(wildcard $(PACKAGES:%=%/setup.py) $(PACKAGES:%=%/setup.cfg))
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --no-deps --no-build-isolation $(PACKAGES:%=-e %)
	@touch $@

#: make demo       database, nodes, replay of the sample bag; fixes and a picture in out/demo
demo: $(INSTALLED)
	$(BIN)/buildloc demo --out out/demo

#: make test       every test; PYTEST_ARGS='-n 0 -k name' selects
test: $(INSTALLED)
	$(BIN)/pytest $(PYTEST_ARGS)

#: make lint       ruff, mypy --strict, hadolint
lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/hadolint Dockerfile

#: make format     what ruff can put right
format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

#: make colcon     build the ROS workspace as apt users do
colcon: $(INSTALLED)
	cd ros2_ws && $(abspath $(BIN))/colcon build

#: make lock       pin requirements*.in again, from PyPI alone
lock: $(INSTALLED)
	PIP_CONFIG_FILE=/dev/null PIP_FIND_LINKS= PIP_EXTRA_INDEX_URL= $(BIN)/pip-compile --quiet --upgrade \
	  --index-url https://pypi.org/simple --generate-hashes --allow-unsafe --strip-extras \
	  --no-emit-index-url --no-emit-find-links --no-annotate --no-header \
	  --output-file requirements.lock requirements.in requirements-dev.in

#: make clean      remove everything made here, .venv too
clean:
	rm -rf $(VENV) build out ros2_ws/build ros2_ws/install ros2_ws/log
	rm -rf .mypy_cache .pytest_cache .ruff_cache .hypothesis src/*/build src/*/*.egg-info
	find src test training -name __pycache__ -type d -prune -exec rm -rf {} +
