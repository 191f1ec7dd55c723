"""The paper's tables: each of their rows is run by one command, or says what it lacks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from prior.tiny import tiny_prior

from phydict.ablation.spec import read_specification
from phydict.cli.infer import main
from phydict.evaluation import read_csv
from phydict.prior import save_prior

SMALL = ["detector=24", "views=3", "method.iterations=2", "method.ec_steps=1", "method.levels=2", "method.burn_in=0",
         "method.likelihood.reward.lpips=0", "method.final_likelihood.reward.lpips=0"]
"""Settings that make a row quick, and need no file of weights."""


@pytest.mark.filterwarnings("always:1 of 1 reports are longer")
def test_every_row_of_the_first_table_is_run_or_says_what_it_lacks(tmp_path, capsys):
    save_prior(tiny_prior(), tmp_path / "tiny.safetensors")
    main(["ablate", "-c", "table1", "--phantoms", "1", "--out", str(tmp_path / "out"), "--device", "cpu",
          "--metrics=[clip]", "--set", f"prior={tmp_path / 'tiny.safetensors'}", "simulator=ideal",
          "X-ray2CTPA.method.file=null", *SMALL])
    rows = {row["method"]: row for row in read_csv(tmp_path / "out" / "results.csv")}
    refused = {"X-ray2CTPA", "X2CT", "Lifted", "phydict_learned"}
    assert {name for name, row in rows.items() if row["status"] != "ok"} == refused
    assert "configs/rivals/" in rows["X-ray2CTPA"]["error"] and "--set" in rows["X-ray2CTPA"]["error"]
    assert "reports are longer" in rows["Ours"]["warning"] and "warning" not in rows["Ours w/o text"]
    assert all("64" in rows[name]["error"] for name in ("Lifted", "X2CT"))  # voxels a side, where these are few
    assert "refiner" in rows["phydict_learned"]["error"]  # which a base prior is not
    assert rows["Ours w/o text"]["misfit"] != rows["Ours"]["misfit"] and rows["Ours w/o EC"]["network_calls"] == 2
    assert "CT-CLIP's checkpoint was not given" in (tmp_path / "out" / "tables.md").read_text()


@pytest.mark.parametrize("table, column, values", [
    ("table2", "delta", [0.1, 0.2, 0.5, 0.8, 0.85, 0.9, 0.95, 0.99]), ("table3", "views", [2, 4, 8, 16, 32])])
def test_the_other_tables_have_the_papers_rows(table, column, values):
    trials = read_specification(table, phantoms=1).trials
    assert [trial.columns[column] for trial in trials] == values
    assert all(trial.method.likelihood.reward.lpips == 1 for trial in trials)  # as in the paper's text


@pytest.mark.parametrize("table", ["table1", "table2", "table3"])
def test_what_leaves_lpips_out_of_the_papers_tables_is_a_setting_of_each(table):
    text = (Path(__file__).parents[1] / "configs" / "README.md").read_text(encoding="utf-8")
    (given,) = re.findall(r"`--set (method\.likelihood\.[^`]*)`", text)
    rewards = [stage.reward for trial in read_specification(table, given.split(), phantoms=1).trials
               for stage in (getattr(trial.method, name, None) for name in ("likelihood", "final_likelihood"))
               if hasattr(stage, "reward")]
    assert rewards and all(reward.lpips == 0 for reward in rewards)


def test_a_setting_of_one_changed_method_is_given_to_it_alone(tmp_path):
    changes = ["Ours.method.iterations=7", "Prior.method.iterations=9"]
    methods = {trial.name: trial.method for trial in read_specification("table1", changes, phantoms=1).trials}
    assert methods["Ours"].iterations == 7 and methods["Prior"].iterations == 9
    assert methods["Ours w/o EC"].iterations == 50
    with pytest.raises(ValueError, match=r"method\.fill"):
        read_specification("table1", ["X2CT.method.fill=a"], phantoms=1)
    with pytest.raises(ValueError, match="no rival's file"):
        read_specification("table1", [f"X2CT.method.file={tmp_path / 'none.safetensors'}"], phantoms=1)
