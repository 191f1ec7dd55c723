"""What a specification of an ablation means, and what it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from command_lines import refusal
from prior.tiny import tiny_prior

from ablation.runs import TINY, write
from phydict.ablation import read_specification
from phydict.ablation.nested import changed
from phydict.ablation.trials import Trial, prior_of, refined_from
from phydict.cli.infer import main
from phydict.datasets import CTSource
from phydict.evaluation import read_csv
from phydict.grid import Grid
from phydict.inference import ReconstructionData
from phydict.methods import METHODS
from phydict.posterior import DAPS, SplitGibbs
from phydict.prior import Prior, save_prior
from phydict.runtime.files import alone_in
from phydict.units import HUWindow

ROOT = Path(__file__).parents[2]


def test_a_setting_that_means_nothing_to_a_method_does_not_multiply_it(tmp_path):
    trials = read_specification(write(
        tmp_path, base=TINY | {"voxels": 64}, axes={"method": ["sirt", "phydict_fast"], "guidance": [1, 2],
                                                    "method.t_start": [0.2, 0.4]})).trials
    assert [trial.name for trial in trials] == ["sirt"] + ["phydict_fast"] * 4
    assert "guidance" not in trials[0].columns and trials[-1].columns["method.t_start"] == 0.4
    assert trials[-1].guidance == 2.0 and trials[-1].method.t_start == 0.4


def test_named_variants_change_a_method_under_the_axes(tmp_path):
    methods = {"mine": {"of": "phydict_paper", "method.likelihood.reward.lpips": 0, "method.iterations": 7}}
    one, two = read_specification(write(tmp_path, base={}, methods=methods,
                                        axes={"method.init_args.iterations": [7], "views": [2, 4]})).trials
    assert (one.name, two.name) == ("mine", "mine") and (one.method.iterations, two.method.iterations) == (7, 7)
    assert one.method.likelihood.reward.lpips == 0
    assert changed(one.method, {"likelihood.reward.lpips": 1.0, "iterations": 50}, "method") == METHODS["phydict_paper"]


@pytest.mark.parametrize("name, value, values", [("method.weight", 8.0e-4, [8.0e-4, 0.1]), ("views", 2, [4])])
def test_an_axis_takes_the_place_of_no_changed_methods_own_setting(tmp_path, name, value, values):
    file = write(tmp_path, base={"voxels": 16}, methods={"weak": {"of": "tv", name: value}},
                 axes={"method": ["tv", "weak"], name.replace("method.", "method.init_args."): values})
    with pytest.raises(ValueError, match=rf"methods.weak gives {name} {value}, but an axis gives it {values[-1]}: "):
        read_specification(file)
    trials = read_specification(file, [f"{name}=[3,5]"]).trials  # which takes the place of both
    assert [(trial.name, trial.columns[name]) for trial in trials] == [
        (method, value) for method in ("tv", "weak") for value in (3, 5)]


def test_a_precision_is_of_networks_alone_and_the_automatic_one_is_as_none_given(tmp_path):
    def trials(**base) -> list:
        return read_specification(write(tmp_path, base={"voxels": 64} | base,
                                        axes={"method": ["sirt", "phydict_fast"]})).trials

    (sirt, fast), (_, auto), (same, single) = trials(), trials(precision="auto"), trials(precision="float32")
    assert sirt.identity() == same.identity() and fast.identity() == auto.identity() and fast.columns == auto.columns
    assert single.identity() == fast.identity() | {"precision": "float32"}
    assert single.columns == fast.columns | {"networks.precision": "float32"} and same.columns == sirt.columns
    with pytest.raises(ValueError, match="precision is auto, float32 or bfloat16, but 'half' was given"):
        trials(precision="half")
    with pytest.raises(ValueError, match="the setting precision means nothing"):
        read_specification(write(tmp_path, axes={"method": ["sirt"], "precision": ["float32"]}))


def test_a_precision_beside_another_one_of_the_method_is_refused(tmp_path):
    def rival(**base) -> Trial:
        (trial,) = read_specification(write(tmp_path, base={"voxels": 16} | base, axes={
            "method": ["phydict.rivals.TrainedRival"]})).trials
        return trial

    assert rival(**{"method.precision": "float32"}).method.precision == "float32"
    assert rival(**{"method.precision": "float32", "precision": "float32"}).precision == "float32"
    with pytest.raises(ValueError, match="precision is bfloat16, but method.precision float32: leave one of the two"):
        rival(**{"method.precision": "float32", "precision": "bfloat16"})


def test_a_row_tells_the_voxels_and_the_window_that_it_was_scored_on(tmp_path):
    def told(prior: Prior, **base) -> list[dict]:
        save_prior(prior, tmp_path / "tiny.safetensors")
        prior_of.cache_clear()
        return [trial.scored_columns() for trial in read_specification(write(
            tmp_path, base=TINY | {"voxels": None, "prior": str(tmp_path / "tiny.safetensors")} | base,
            axes={"method": ["phydict_fast", "tv"]})).trials]

    prior, short = tiny_prior(False), tiny_prior(False)
    short.grid, short.window = Grid.cube(16, 320.0), HUWindow(-1000, 300)
    assert told(prior) == [{"grid": "16x16x16", "window": "[-1000, 600]"}] * 2
    assert told(short) == [{"grid": "16x16x16 of 20 mm", "window": "[-1000, 300]"}] * 2
    assert told(prior, voxels=8, side=200.0)[0]["grid"] == "8x8x8"  # which these settings tell


def test_a_box_of_three_equal_sides_is_told_as_one_of_a_single_number(tmp_path):
    one, three, flat = (read_specification(write(tmp_path, base=TINY | box, axes={"method": ["sirt"]})).trials[0]
                        for box in ({"voxels": 16, "side": 200}, {"voxels": [16, 16, 16], "side": [200, 200, 200]},
                                    {"voxels": [16, 16, 8], "side": [200, 200, 100]}))
    assert one.columns == three.columns and one.identity() == three.identity()
    assert (one.columns["voxels"], one.columns["side"]) == (16, 200)
    assert (flat.columns["voxels"], flat.columns["side"]) == ((16, 16, 8), (200, 200, 100))


@pytest.mark.parametrize("file", sorted((ROOT / "configs" / "ablate").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_shipped_comparison_is_one(file):
    assert read_specification(file, phantoms=1).trials


def test_an_orbits_setting_means_nothing_beside_a_geometry_file(tmp_path):
    with pytest.raises(ValueError, match="the setting views means nothing"):
        read_specification(write(tmp_path, base={"method": "sirt", "voxels": 16, "geometry": "arc_90", "views": 3}))


def test_the_cts_of_a_folder_are_chosen_as_in_a_test_of_their_own(tmp_path, cts, capsys):
    def ids(data: ReconstructionData) -> list[str]:
        return [case for case, *_ in data.test_cases(Grid.cube(16), HUWindow())]

    (tmp_path / "none.txt").write_text("patient0.nii.gz\n")
    source, content = {"exclude": str(tmp_path / "none.txt")}, {"axes": {"method": ["trace"]}, "phantoms": None}
    wanted = ids(ReconstructionData(cts=str(cts), source=CTSource(**source)))
    assert wanted == ["patient1"]
    whole = write(tmp_path, cts=str(cts), **content)
    assert len(ids(read_specification(whole).trials[0].data)) == 2
    given = read_specification(whole, source=source), read_specification(whole, cts=str(cts), source=source)
    told = read_specification(write(tmp_path, cts=str(cts), source=source, **content))
    for specification in (*given, told):
        assert [ids(trial.data) for trial in specification.trials] == [wanted]
    main(["ablate", "-c", str(write(tmp_path, cts=str(cts), **content)), "--device", "cpu",
          f"--source.exclude={source['exclude']}"])
    assert [row["case"] for row in read_csv(tmp_path / "out" / "results.csv")] == wanted


@pytest.mark.parametrize("content, words", [
    ({"source": {"fix": True}}, "source has no setting 'fix': use reports, metadata, fixed"),
    ({"source": {"fixed": "perhaps"}}, "source.fixed takes a value of type bool"), ({"source": [1]}, "source is a map"),
    ({"source": {"reports": "a"}, "reports": "b"}, "as reports and as source.reports: leave one")],
    ids=["name", "type", "list", "twice"])
def test_cts_that_cannot_be_meant_are_one_sentence(tmp_path, content, words):
    with pytest.raises(ValueError, match=words):
        read_specification(write(tmp_path, axes={"method": ["sirt"]}, **content))


def test_set_takes_the_place_of_a_files_axis_base_and_product(tmp_path):
    file = write(tmp_path, products=[{"base": {"seed": 3}, "axes": {"method": ["sirt", "tv"], "views": [2, 4]}},
                                     {"axes": {"method": ["cgls"]}}])
    trials = read_specification(file, ["method=[sirt,cgls]", "views=5", "seed=[1,2]", "voxels=24"]).trials
    assert {(t.name, t.data.beam.views, t.seed, t.voxels.scored.shape[0]) for t in trials} == {
        (name, 5, seed, 24) for name in ("sirt", "cgls") for seed in (1, 2)}


def test_set_takes_the_place_of_what_changed_methods_set_and_their_own_set_that_of_both(tmp_path):
    methods = {name: {"of": "sirt", "method.init_args.iterations": count} for name, count in (
        ("a", 2), ("b", 3), ("b, 1.5 mm", 4))}
    file = write(tmp_path, methods=methods)
    trials = read_specification(file, ["method.iterations=5", "b.method.iterations=7",
                                       "b, 1.5 mm.method.iterations=8"]).trials
    assert [(trial.name, trial.method.iterations) for trial in trials] == [("a", 5), ("b", 7), ("b, 1.5 mm", 8)]


@pytest.mark.parametrize("changes, words", [
    (["views"], "name=value"), (["=3"], "name=value"), (["views=[2"], "value of views is not valid YAML"),
    (["view=3"], "no setting 'view'"), (["projector=lines"], "no projector 'lines'"), (["method.steps=2"], "nothing"),
    (["method=[no_module.Sampler]"], "no_module.Sampler cannot be made .*importable"), (["method=[sart]"], "'sart'"),
    (["method=[pathlib.Path]"], "pathlib.Path is no method"), (["method=[sys.exit]"], "sys.exit is no method"),
    (["views=[]"], "at least one value")])
def test_a_set_that_cannot_be_meant_is_one_sentence(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words):
        read_specification(write(tmp_path, axes={"method": ["sirt"]}), changes)


def test_settings_that_hold_each_other_are_changed_together():
    method = changed(METHODS["pnp_dm"], {"iterations": 8, "burn_in": 6}, "method")
    assert (method.iterations, method.burn_in) == (8, 6)
    assert changed(DAPS(), {"likelihood": {"class_path": "phydict.posterior.ExactDraw"}, "likelihood.iterations": 3},
                   "method").likelihood.iterations == 3


def test_delta_keeps_the_length_of_a_step():
    paper = METHODS["phydict_paper"]
    assert refined_from(paper, 0.8) == paper
    for delta in (0.1, 0.5, 0.99):
        method = refined_from(SplitGibbs(100), delta)
        assert method.ec_delta / method.ec_steps == pytest.approx(1 / 100)
    assert refined_from(paper, 0.0).steps() == paper.iterations


@pytest.mark.parametrize("content, words", [
    ({"axes": {"veiws": [2]}}, ["'veiws'", "views"]),
    ({"axes": {"method": ["sirt"], "veiws": [2]}}, ["'veiws'", "views"]),
    ({"axes": {"method": ["sart"]}}, ["'sart'", "sirt"]), ({"axes": {"method": [["sirt"]]}}, ["['sirt']"]),
    ({"axes": {"method": []}}, ["method", "at least one"]), ({"axes": {"method": "sirt"}}, ["list", "'sirt'"]),
    ({"axes": {"method": ["sirt"], "views": ["two"]}}, ["views", "int", "'two'"]),
    ({"axes": {"method": ["sirt"], "views": [0]}}, ["one view"]),
    ({"axes": {"method": ["sirt"], "views": [None]}}, ["views", "None"]),
    ({"axes": {"method": ["sirt"], "method.iterations": [2.5]}}, ["method.iterations", "2.5"]),
    ({"axes": {"method": ["sirt"], "method.steps": [2]}}, ["method.steps", "iterations"]),
    ({"axes": {"method": ["tv"], "method.iterations": [0]}}, ["FISTATV.iterations", "1 or more"]),
    ({"axes": {"method": ["sirt"], "delta": [0.5]}}, ["delta"]),
    ({"axes": {"method": ["sirt"], "simulator": ["real"]}}, ["'real'", "polychromatic"]),
    ({"axes": {"method": ["sirt"], "simulator.kvp": [80]}}, ["simulator.kvp", "photons"]),
    ({"axes": {"method": ["sirt", "prior_only"], "voxels": [16, 24]}}, ["one grid"]),
    ({"base": {"side": 200.0}, "axes": {"method": ["sirt"]}}, ["side", "give them too"]),
    ({"axes": {"method": ["sirt"]}, "cts": "folder"}, ["one of the two"]),
    ({"axes": {}}, ["no method"]), ({"products": []}, ["products"]), ({"products": [{"axis": {}}]}, ["'axis'"]),
    ({"axes": {"method": ["sirt"]}, "products": []}, ["not both"]), ({"axs": {}}, ["'axs'"]),
    ({"methods": {"mine": {"of": "sart"}}}, ["'sart'"]), ({"methods": {"mine": {}}}, ["'mine'"]),
    ({"methods": {"mine": {"of": "sirt", "method.iteration": 2}}}, ["method.iteration ", "iterations"]),
    ({"methods": {"mine": {"of": "sirt", "method": {"iterations": 2}}}, "base": TINY | {"method": "mine"}},
     ["methods.mine gives method {'iterations': 2}", "called `of`"]),
    ({"base": TINY | {"method.iteration": 3}, "axes": {"method": ["sirt"]}}, ["method.iteration "]),
    ({"axes": {"method": ["phydict_fast"], "method.iterations": [1]}}, ["phydict_fast: ", "2 iterations"]),
    ({"base": TINY | {"simulation_voxels": 40}, "axes": {"method": ["sirt"]}}, ["simulation_voxels", "the 16", "40"]),
    ({"axes": {"method": ["phydict_fast"], "samples": [0]}}, ["samples", "1 or more", "0"]),
    ({"axes": [1]}, ["axes", "mapping"])], ids=lambda value: str(value)[:60] if isinstance(value, dict) else "")
def test_a_specification_that_cannot_be_meant_is_one_sentence(tmp_path, capsys, content, words):
    said = refusal(capsys, main, ["ablate", "-c", str(write(tmp_path, **content))])
    assert "spec.yaml" in said and all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_arguments_and_files_that_cannot_be_meant_are_one_sentence(tmp_path, capsys):
    assert "nowhere.yaml" in refusal(capsys, main, ["ablate", "-c", str(tmp_path / "nowhere.yaml")])
    file = write(tmp_path, axes={"method": ["trace"]})
    assert "nowhere" in refusal(capsys, main, ["ablate", "-c", str(file), "--cts", str(tmp_path / "nowhere")])
    assert not (tmp_path / "out").exists()
    said = refusal(capsys, main, ["ablate", "-c", str(file), "-c", "pareto"])
    assert "one file says what to compare" in said and "spec.yaml and pareto" in said
    (tmp_path / "bad.yaml").write_text("axes: [")
    assert "bad.yaml is not valid YAML" in refusal(capsys, main, ["ablate", "-c", str(tmp_path / "bad.yaml")])
    (tmp_path / "bad.yaml").write_text("axes:\n\tviews: [2]\n")
    assert "line 2 is indented by a tab" in refusal(capsys, main, ["ablate", "-c", str(tmp_path / "bad.yaml")])
    (tmp_path / "out").mkdir()
    with alone_in(tmp_path / "out", "out"):
        assert "another run" in refusal(capsys, main, ["ablate", "-c", str(file)])
    (tmp_path / "out" / "results.csv").write_text("case,method\na,b\n")
    assert "another out" in refusal(capsys, main, ["ablate", "-c", str(file)])


@pytest.mark.parametrize("config", sorted((ROOT / "configs" / "ablate").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_committed_specification_can_be_run(config):
    specification = read_specification(config, phantoms=1)
    assert len(specification.trials) >= 5
    if config.stem == "pareto":
        told = yaml.safe_load(config.read_text())["methods"]
        for views in (2, 8):
            names = {trial.name for trial in specification.trials if trial.data.beam.views == views}
            of = {told.get(name, {}).get("of", name) for name in names}
            assert of >= set(METHODS) - {"trace"} - ({"phydict_released"} if views == 2 else set())


@pytest.mark.parametrize("content, words", [
    ({"methods": {"mine": {"of": "trace", "methodnull.x": 1}}}, "methodnull.x means nothing"),
    ({"products": [{"axes": {"method": ["trace"], "seed": list(range(n))}} for n in (2, 1999)]}, "2,001 combinations"),
    ({"axes": {"method": ["trace"], "views": ["9" * 500]}}, "an orbit needs at least one view")], ids=["part",
    "products", "long"])
def test_what_a_specification_cannot_mean_is_one_short_sentence(tmp_path, content, words):
    with pytest.raises(ValueError, match=words) as caught:
        read_specification(write(tmp_path, **content))
    assert len(str(caught.value)) < 400
