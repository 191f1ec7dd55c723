"""Laws of what a reconstruction reports."""

import json
import math
import sys
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import pytest
import torch

from phydict.methods import METHODS
from phydict.posterior import Refinement
from phydict.reconstruction import describe
from phydict.xray import Ideal, Polychromatic
from phydict.xray.residuals import misfits, shared_norms

Y = torch.rand(3, 5, 4, generator=torch.Generator().manual_seed(0)) + 0.1


def test_misfit_is_zero_for_the_truth_one_for_nothing_and_proportional_between():
    assert misfits(Y, Y) == {"misfit": 0, "misfit_per_view": [0, 0, 0]}
    assert misfits(0 * Y, Y)["misfit"] == pytest.approx(1)
    assert misfits(1.1 * Y, Y)["misfit"] == pytest.approx(0.1, rel=1e-4)


def test_misfits_of_views_combine_to_the_whole():
    scaled = Y * torch.tensor([1.0, 1.3, 0.9])[:, None, None]
    said = misfits(Y, scaled)
    assert said["misfit_per_view"] == pytest.approx([0, 0.3 / 1.3, 0.1 / 0.9], abs=1e-6, rel=1e-4)
    sizes = scaled.flatten(1).norm(dim=1)
    residuals = torch.tensor(said["misfit_per_view"]) * sizes
    assert said["misfit"] == pytest.approx(float(residuals.norm() / sizes.norm()), rel=1e-5)


def test_what_neighbours_share_is_all_of_smooth_views_and_nothing_of_noise():
    smooth = torch.ones(2, 60, 50).cumsum(1) * torch.tensor([1.0, 3.0])[:, None, None]
    noise = torch.randn(2, 60, 50, generator=torch.Generator().manual_seed(0)) * smooth.mean()
    assert shared_norms(smooth) == pytest.approx(smooth.flatten(1).norm(dim=1), rel=0.02)
    assert (shared_norms(noise) < 0.15 * noise.flatten(1).norm(dim=1)).all()
    assert shared_norms(smooth + noise) == pytest.approx(shared_norms(smooth), rel=0.05)


def test_settings_of_any_kind_are_plain_json():
    @dataclass(frozen=True)
    class Mine:
        weights: Path = Path("a.safetensors")
        levels: tuple = (1, (Path("b"), 2.0))
        named: dict = field(default_factory=lambda: {"c": Path("d")})

    told = json.loads(json.dumps(describe(Mine())))
    assert told.pop("class").endswith(".Mine") and told.pop("code_crc32") and told == {
        "weights": "a.safetensors", "levels": [1, ["b", 2.0]], "named": {"c": "d"}}


def test_numbers_that_json_cannot_say_are_told_apart():
    @dataclass(frozen=True)
    class Mine:
        cap: float | None

    told = {json.dumps(describe(Mine(cap)), allow_nan=False) for cap in (math.inf, -math.inf, math.nan, None)}
    assert len(told) == 4


def test_shipped_settings_are_told_by_the_name_of_their_class_and_their_fields_alone():
    for settings in (*METHODS.values(), Refinement(), Ideal(), Polychromatic()):
        told = describe(settings)
        assert told["class"] == type(settings).__name__ and "code_crc32" not in json.dumps(told)


BASE = """
class Base:
    steps = 1
"""
OWN = """
from dataclasses import dataclass
from own_base import Base

@dataclass(frozen=True)
class Mine(Base):
    weight: float = 1.0
"""


def test_an_own_class_is_told_by_its_place_and_by_the_code_of_it_and_of_its_bases(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def told(base: str = BASE, own: str = OWN, module: str = "own_a") -> dict:
        for name, text in (("own_base", base), (module, own)):
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        return describe(import_module(module).Mine())

    first = told()
    assert first == told() and first["class"] == "own_a.Mine" and first["weight"] == 1.0
    others = [told(base=BASE + "    more = 2\n"), told(own=OWN + "    def solve(self): ...\n"), told(module="own_b")]
    assert all(other != first for other in others) and others[2]["class"] == "own_b.Mine"


def test_of_a_script_the_lines_of_the_class_count_and_without_lines_its_place(tmp_path, monkeypatch):
    script = tmp_path / "script.py"

    def told(text: str) -> dict:
        script.write_text(text)
        monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
        scope = {"__name__": "__main__"}
        exec(compile(text, script, "exec"), scope)
        return describe(scope["Mine"]())

    own = OWN.replace("(Base)", "").replace("from own_base import Base", "")
    first = told(own)
    assert first["class"] == "__main__.Mine" and first == told(own + "print\n") != told(own + "    more = 2\n")
    monkeypatch.delattr(sys.modules["__main__"], "__file__")
    scope = {"__name__": "__main__"}
    exec(own, scope)
    assert describe(scope["Mine"]()) == {"class": "__main__.Mine", "weight": 1.0}
