# make demo   environment, then a reconstruction of the embedded example by three methods
# make test   environment, then the test suite, a process per core up to four
# make lint   environment, then ruff and mypy
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python

.PHONY: demo test lint environment clean

demo: environment
	$(RUN) data/example/demo.py

test: environment
	$(RUN) -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

lint: environment
	$(RUN) -m ruff check
	$(RUN) -m mypy
	$(RUN) -m mypy --platform win32

environment: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q -c constraints.txt -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) runs
