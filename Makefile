# make demo   environment, then a reconstruction of the embedded example by three methods
# make test   environment, then the test suite
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python

.PHONY: demo test environment clean

demo: environment
	$(RUN) data/example/demo.py

test: environment
	$(RUN) -m pytest

environment: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install -q -c constraints.txt -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) runs
