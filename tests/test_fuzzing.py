"""Whatever a user's file holds, it is read or refused in one sentence that names it."""

import tempfile
from pathlib import Path

import pytest
from fuzzing import TARGETS, check, contents
from hypothesis import HealthCheck, given, settings


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_are_read_or_refused_in_one_sentence(name):
    with tempfile.TemporaryDirectory() as folder:
        @settings(max_examples=60, deadline=None, derandomize=True, database=None,
                  suppress_health_check=list(HealthCheck))
        @given(contents(name))
        def holds(content):
            check(TARGETS[name], content, Path(folder))

        holds()


@pytest.mark.parametrize("name", TARGETS)
def test_the_samples_of_the_fuzzers_are_read(name, tmp_path):
    read = [check(TARGETS[name], sample, tmp_path) for sample in TARGETS[name].samples()]
    assert any(read)
