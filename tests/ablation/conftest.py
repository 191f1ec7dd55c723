"""Every test of ablations knows the method `trace`, and draws plots where it asks for `plots` alone."""

from __future__ import annotations

import pytest

from ablation.runs import Trace
from phydict.methods import METHODS


@pytest.fixture(autouse=True)
def trace(monkeypatch):
    monkeypatch.setitem(METHODS, "trace", Trace())
    monkeypatch.setattr(Trace, "given", [])
    return Trace


@pytest.fixture
def plots():
    """Has runs draw their plots, which take longer than most methods here."""


@pytest.fixture(autouse=True)
def without_plots(request, monkeypatch):
    if "plots" not in request.fixturenames:
        monkeypatch.setattr("phydict.ablation.command.write_plots", lambda *_: [])
