"""The defaults of the methods without a prior are the settings that the committed tuning found best."""

import pytest
from benchmark.tune_baselines import FILE, MANY, OF_MANY, SETTINGS, VIEWS, best, text

from phydict.evaluation import read_csv
from phydict.methods import METHODS

EVALUATION = ("LIDC-IDRI-0001", "LIDC-IDRI-0008", "LIDC-IDRI-0314", "NLST-101287")
ROWS = read_csv(FILE)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_default_is_the_best_of_its_grid(name):
    assert text(METHODS[name]) == best(ROWS)[name]


def test_every_setting_was_tried_on_every_case_and_number_of_views():
    tried = {(row["case"], row["views"], row["settings"]) for row in ROWS}
    cases = {row["case"] for row in ROWS}
    assert len(cases) >= 3
    planned = [(v, m) for views, settings in ((VIEWS, SETTINGS), (MANY, OF_MANY)) for v in views
               for methods in settings.values() for m in methods]
    assert tried == {(c, v, text(m)) for c in cases for v, m in planned}


def test_no_case_of_the_evaluation_was_used():
    assert not {row["case"] for row in ROWS} & set(EVALUATION)
