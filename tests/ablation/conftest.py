"""Every test of ablations knows the method `trace`, and draws plots where it asks for `plots` alone."""

from __future__ import annotations

import pytest

from ablation.runs import Trace
from phydict.methods import METHODS


@pytest.fixture(scope="session", autouse=True)
def known_phantoms(phantoms_made_once) -> None:
    """Tests here reconstruct the same few phantoms."""


@pytest.fixture(autouse=True)
def trace(monkeypatch):
    monkeypatch.setitem(METHODS, "trace", Trace())
    monkeypatch.setattr(Trace, "given", [])
    return Trace


@pytest.fixture
def plots():
    """Has runs draw their plots."""


@pytest.fixture(autouse=True)
def plots_where_asked_for(request):
    if "plots" not in request.fixturenames:
        request.getfixturevalue("without_plots")
