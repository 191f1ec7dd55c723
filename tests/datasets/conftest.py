"""The thoraxes of `ct_files`, each made once."""

import numpy as np
import pytest
from ct_files import large_thorax_hu, thorax_hu


@pytest.fixture(scope="session")
def thorax() -> np.ndarray:
    return thorax_hu()


@pytest.fixture(scope="session")
def chest() -> np.ndarray:
    return large_thorax_hu()
