"""The defaults of the methods without a prior are the settings that the committed tuning found best."""

import pytest
from benchmark.tune_baselines import FILE, SCENES, SCENES_OF, SETTINGS, best, text

from phydict.evaluation import read_csv
from phydict.methods import METHODS

EVALUATION = ("LIDC-IDRI-0001", "LIDC-IDRI-0008", "LIDC-IDRI-0314", "NLST-101287")
ROWS = read_csv(FILE)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_default_is_the_best_of_its_grid(name):
    assert text(METHODS[name]) == best(ROWS)[name]


def test_every_setting_was_tried_on_every_case_and_all_xrays():
    tried = {(row["case"], row["xrays"], row["views"], row["settings"]) for row in ROWS}
    cases = {row["case"] for row in ROWS}
    assert len(cases) >= 3
    planned = [(*scene, m) for name, methods in SETTINGS.items() for scene in SCENES_OF.get(name, SCENES)
               for m in methods]
    assert tried == {(c, kind, v, text(m)) for c in cases for kind, v, m in planned}


def test_no_case_of_the_evaluation_was_used():
    assert not {row["case"] for row in ROWS} & set(EVALUATION)
