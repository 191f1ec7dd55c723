"""Every test of ablations knows the method `trace`."""

from __future__ import annotations

import pytest

from ablation.runs import Trace
from phydict.methods import METHODS


@pytest.fixture(autouse=True)
def trace(monkeypatch):
    monkeypatch.setitem(METHODS, "trace", Trace())
    monkeypatch.setattr(Trace, "given", [])
    return Trace
