"""Each of several test processes computes on one thread: two on two cores would slow each other down."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch and numba are imported
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """A folder for the prepared cases of a file's trainings."""
    return tmp_path_factory.mktemp("cache")
