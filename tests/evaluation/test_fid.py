"""The Frechet distance of slices: closed forms, MONAI's figure, invariances, planes, and what its backbones refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from monai.data import MetaTensor
from monai.metrics import FIDMetric
from monai.transforms import CenterSpatialCrop, Compose, Spacing, SpatialPad
from torch.multiprocessing.reductions import StorageWeakRef
from torch.nn.functional import conv2d, interpolate

from phydict.evaluation import backbones
from phydict.evaluation import fid as fid_module
from phydict.evaluation.backbones import NORMALISATION, SliceFeatures, maisi_voxels
from phydict.evaluation.bootstrap import draws
from phydict.evaluation.fid import (
    NAMES,
    Moments,
    PlaneFID,
    SeedFeatures,
    StoredFeatures,
    case_features,
    distances,
    fid_rows,
    save_features,
)
from phydict.evaluation.planes import PLANES, slices
from phydict.evaluation.tables import fid_tables
from phydict.grid import Grid
from phydict.runtime.lpips_networks import load_lpips


def moments_of(x: torch.Tensor, repeats: torch.Tensor) -> Moments:
    """Those of features (N, d), each of which counts as often as `repeats` (N,) says."""
    moments = Moments(x.shape[1])
    for one, times in zip(x, repeats.tolist()):
        moments.add(Moments.of(one[None]), times)
    return moments


def frechet_distance(a: torch.Tensor, b: torch.Tensor, repeats: torch.Tensor | None = None) -> float:
    """The Frechet distance of features a (N, d) and b (M, d); repeats: how often each slice counts, of both (N = M)."""
    of, to = (Moments.of(x) if repeats is None else moments_of(x, repeats) for x in (a, b))
    return fid_module._distance(of, fid_module._reduced(to))


def fid(cases: dict, replicates: int = 0) -> dict:
    """{"fid_xy", "fid_yz", "fid_zx", "fid" (their mean)} over all slices of cases, as `distances` has them."""
    return distances({"": cases}, replicates)[""].estimates()


def normal(count: int, dimensions: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, dimensions, generator=torch.Generator().manual_seed(seed))


def patterns(hu: torch.Tensor, plane: str) -> torch.Tensor:
    """Eight figures of each slice: the mean answers of fixed random filters."""
    filters = torch.randn(8, 1, 3, 3, generator=torch.Generator().manual_seed(1))
    return conv2d(slices(hu, plane)[:, None] / 1000, filters).relu().mean((2, 3))


def volume(seed: int) -> torch.Tensor:
    coarse = torch.randn(1, 1, 8, 8, 8, generator=torch.Generator().manual_seed(seed))
    return 400 * interpolate(coarse, (24, 20, 16), mode="trilinear")[0, 0].clamp(-2, 2)


def blurred(hu: torch.Tensor, times: int) -> torch.Tensor:
    for _ in range(times):
        hu = torch.nn.functional.avg_pool3d(hu[None, None], 3, 1, 1, count_include_pad=False)[0, 0]
    return hu


@pytest.mark.parametrize("shape, spacing", [((5, 4, 20), (2.0, 3.0, 1.5)), ((24, 9, 3), (0.7, 1.75, 6.5)),
                                            ((16, 31, 33), (1.0, 0.5, 0.5))])
def test_maisis_voxels_are_those_of_monais_transforms_in_its_script(shape, spacing, monkeypatch):
    monkeypatch.setattr(backbones, "MAISI_SIDE", 16)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = 50.0, -20.0, 7.0
    hu = 300 * torch.randn(shape, generator=torch.Generator().manual_seed(1))
    as_in_the_script = Compose([Spacing((1.0, 1.0, 1.0), mode="bilinear"), SpatialPad((16, 16, 16), value=-1000),
                                CenterSpatialCrop((16, 16, 16))])
    wanted = as_in_the_script(MetaTensor(hu[None], affine=affine))[0].as_tensor()
    assert (wanted != -1000).float().mean() > 0.01
    torch.testing.assert_close(maisi_voxels(hu, Grid(shape, affine=affine)), wanted, atol=1e-3, rtol=0)


def of_volumes(change) -> dict:
    return {f"p{seed}": case_features(patterns, change(volume(seed)), volume(seed)) for seed in range(4)}


@pytest.mark.parametrize("count", [200, 5])
def test_a_set_is_at_no_distance_of_itself_and_a_shift_and_a_scale_have_closed_forms(count):
    x = normal(count, 12)
    spread = x.var(0).sum()
    assert frechet_distance(x, x) == pytest.approx(0, abs=1e-6)
    assert frechet_distance(x + 3, x) == pytest.approx(9 * 12, rel=1e-5)
    scaled = (x - x.mean(0)) * 2 + x.mean(0)
    assert frechet_distance(scaled, x) == pytest.approx(float(spread), rel=1e-5)


@pytest.mark.parametrize("counts, dimensions", [((300, 200), 16), ((9, 7), 16)])
def test_it_agrees_with_monai_also_for_fewer_slices_than_features(counts, dimensions):
    a, b = normal(counts[0], dimensions, 1), 1.5 * normal(counts[1], dimensions, 2) + 0.3
    assert frechet_distance(a, b) == pytest.approx(float(FIDMetric()(a, b)), rel=1e-4)


def test_a_slice_that_counts_twice_is_one_that_is_there_twice():
    a, b, repeats = normal(30, 6, 1), normal(30, 6, 2) + 1, torch.arange(30) % 3
    wanted = frechet_distance(*(x.repeat_interleave(repeats, 0) for x in (a, b)))
    assert frechet_distance(a, b, repeats) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("count, dimensions", [(40, 8), (12, 30), (60, 60)])
def test_it_is_the_singular_values_sum_for_weighted_slices_of_falling_variance(count, dimensions):
    scale = torch.exp(-0.05 * torch.arange(dimensions))
    a, b = normal(count, dimensions, 1) * scale, (1.2 * normal(count, dimensions, 2) + 0.1) * scale
    repeats = torch.arange(count) % 4
    x, y = (part.repeat_interleave(repeats, 0).double() for part in (a, b))
    roots = [(part - part.mean(0)) / (len(part) - 1) ** 0.5 for part in (x, y)]
    wanted = (x.mean(0) - y.mean(0)).square().sum() + sum(root.square().sum() for root in roots) - (
        2 * torch.linalg.svdvals(roots[0] @ roots[1].T).sum())
    assert frechet_distance(a, b, repeats) == pytest.approx(float(wanted), rel=1e-4)


def test_methods_are_paired_draw_by_draw_and_each_is_as_it_is_alone(monkeypatch):
    methods = {f"blur {n}": of_volumes(lambda hu, n=n: blurred(hu, n)) for n in (1, 2)}
    methods["three"] = {case: features for case, features in methods["blur 2"].items() if case != "p3"}
    summed = []
    plain = fid_module._reduced
    monkeypatch.setattr(fid_module, "_reduced", lambda moments: summed.append(1) or plain(moments))
    found = distances(methods, replicates=20)
    unlike = [len({(1,) * n, *map(tuple, draws(n, 20).tolist())}) for n in (4, 3)]
    assert len(summed) == 3 * sum(unlike)  # planes, draws, and sets of cases: two methods share a truth
    for label, cases in methods.items():
        alone = fid(cases, replicates=20)
        for name in NAMES:
            assert tuple(found[label].estimates()[name]) == pytest.approx(tuple(alone[name]))
    less = found["blur 2"].estimates(found["blur 1"])["fid"]
    drawn = found["blur 2"].values["fid"] - found["blur 1"].values["fid"]
    assert less.mean == pytest.approx(drawn[0]) and drawn[1:].min() <= less.low <= less.high <= drawn[1:].max()
    table, differences = fid_tables(fid_rows(found, "squeezenet", 20, NORMALISATION))
    assert [label for label, _, _ in table.lines] == ["blur 1", "blur 2", "three"]
    assert differences.title.endswith("less blur 1, draw by draw")
    assert [(label, values[-1]) for label, _, values in differences.lines] == [("blur 2", less)]
    assert len(fid_tables(fid_rows(distances(methods), "squeezenet", 0, NORMALISATION))) == 1


def test_methods_of_other_numbers_of_slices_are_each_as_alone_and_neither_paired_nor_ranked():
    methods = {"whole": of_volumes(lambda hu: blurred(hu, 1)), "half": {
        case: {plane: values[:, ::2] for plane, values in features.items()}
        for case, features in of_volumes(lambda hu: blurred(hu, 2)).items()}}
    found = distances(methods, replicates=20)
    rows = fid_rows(found, "squeezenet", 20, NORMALISATION)
    for row, (label, cases) in zip(rows, methods.items()):
        assert "less" not in row and row["slices_xy"] == {"whole": 64, "half": 32}[label]
        for name, alone in fid(cases, replicates=20).items():
            assert tuple(found[label].estimates()[name]) == pytest.approx(tuple(alone))
    (table,) = fid_tables(rows)
    assert "XY 64" in table.notes[0] and "XY 32" in table.notes[0] and "**" not in table.markdown()


def test_a_method_without_a_distance_is_compared_with_the_others_and_they_not_with_it():
    plain = of_volumes(lambda hu: blurred(hu, 1))
    broken = of_volumes(lambda hu: hu.clone().fill_(math.nan))
    rows = fid_rows(distances({"broken": broken, "one": plain, "two": of_volumes(lambda hu: blurred(hu, 2))}, 5),
                    "squeezenet", 5, NORMALISATION)
    assert [row.get("less") for row in rows] == ["one", None, "one"]
    assert len(fid_tables(fid_rows(distances({"a": broken, "b": broken}, 5), "squeezenet", 5, NORMALISATION))) == 1


def test_the_seeds_of_a_case_are_one_case_whose_truth_counts_once():
    one, two = (of_volumes(lambda hu, n=n: blurred(hu, n)) for n in (1, 2))
    cases = {case: SeedFeatures([one[case], two[case]]) for case in one}
    found = distances({"seeds": cases, "one": one}, replicates=5)
    for plane in PLANES:
        fake = torch.cat([features[plane][0] for of in (one, two) for features in of.values()])
        truth = torch.cat([features[plane][1] for features in one.values()])
        assert found["seeds"].values[f"fid_{plane}"][0] == pytest.approx(frechet_distance(fake, truth), rel=1e-6)
    seeds, single = rows = fid_rows(found, "squeezenet", 5, NORMALISATION)
    assert (seeds["cases"], seeds["patients"], seeds["slices_xy"], seeds["truth_slices_xy"]) == (4, 4, 128, 64)
    assert single["slices_xy"] == 64 and "less" not in seeds and "less" not in single  # of other numbers of slices
    notes = fid_tables(rows)[0].notes
    assert "4 cases, 2 seeds each, with XY 128, YZ 192, ZX 160 slices beside XY 64, YZ 96, ZX 80 of the" in notes[0]
    assert "4 cases with XY 64" in notes[0] and "5 draws of 4 patients;" in notes[1]


def test_several_cases_of_one_patient_say_why_they_have_no_intervals():
    cases = {f"p__{case}": features for case, features in of_volumes(lambda hu: blurred(hu, 1)).items()}
    (table,) = fid_tables(fid_rows(distances({"m": cases}, 5), "squeezenet", 5, NORMALISATION))
    assert table.notes[1].startswith("No intervals: all cases are of one patient")


def test_moments_of_parts_are_those_of_the_whole_whatever_their_order_and_how_often_they_count():
    x, repeats = 5 + normal(40, 6), torch.arange(40) // 10 % 3
    whole, streamed = Moments.of(x.repeat_interleave(repeats, 0)), Moments(6)
    for n in (2, 0, 3, 1):
        streamed.add(Moments.of(x[10 * n:10 * n + 10]), n % 3)
    assert streamed.count == whole.count == 30
    torch.testing.assert_close(streamed.mean, whole.mean)
    torch.testing.assert_close(streamed.covariance, x.repeat_interleave(repeats, 0).double().T.cov())
    torch.testing.assert_close(streamed.covariance, whole.covariance)


def test_how_many_draws_are_summed_up_at_once_changes_nothing_and_one_case_alone_is_in_memory(monkeypatch):
    class Watched(dict):
        def __getitem__(self, plane):
            assert all(earlier.expired() for earlier in read), "the features of another case are still in memory"
            values = super().__getitem__(plane).clone()
            read.append(StorageWeakRef(values.untyped_storage()))
            return values

    read: list = []
    cases = of_volumes(lambda hu: blurred(hu, 2))
    wanted = distances({"": cases}, replicates=30)[""].values
    for at_once in (1, 3):
        monkeypatch.setattr(fid_module, "BLOCK_BYTES", at_once * 8 * 8**2)
        found = distances({"": {case: Watched(features) for case, features in cases.items()}}, 30)[""].values
        assert read and all(found[name] == pytest.approx(wanted[name], rel=1e-9) for name in NAMES)


def test_a_volume_that_is_not_finite_shows():
    spoiled = of_volumes(lambda hu: hu.clone().fill_(math.nan))
    found = fid(spoiled, replicates=5)["fid"]
    assert math.isnan(found.mean) and math.isnan(found.low)


def test_it_is_nothing_for_the_truth_and_grows_with_blur():
    found = [fid(of_volumes(lambda hu, n=n: blurred(hu, n)))["fid"].mean for n in (0, 1, 3, 9)]
    assert found[0] == pytest.approx(0, abs=1e-6) and found == sorted(found) and found[1] > 1e-3


def test_the_mean_is_that_of_the_planes_and_the_interval_is_the_patients():
    found = fid(of_volumes(lambda hu: blurred(hu, 2)), replicates=50)
    assert found["fid"].mean == pytest.approx(sum(found[f"fid_{plane}"].mean for plane in PLANES) / 3)
    assert all(one.low < one.high for one in found.values())
    alone = fid({"p0": of_volumes(lambda hu: blurred(hu, 2))["p0"]}, replicates=50)
    assert math.isnan(alone["fid"].low)
    with pytest.raises(ValueError, match="no cases"):
        fid({})


@pytest.mark.parametrize("plane", PLANES)
def test_a_volume_that_is_the_same_along_an_axis_has_equal_slices_in_that_axis_plane_alone(plane):
    shape = [6, 5, 4]
    shape[PLANES[plane]] = 1
    hu = torch.randn(shape, generator=torch.Generator().manual_seed(0)).expand(6, 5, 4)
    equal = {name: bool((slices(hu, name) == slices(hu, name)[:1]).all()) for name in PLANES}
    assert equal == {name: name == plane for name in PLANES}
    assert {name: len(slices(hu, name)) for name in PLANES} == {"xy": 4, "yz": 6, "zx": 5}


def test_a_repeated_case_counts_once_and_compute_is_fid():
    metric, cases = PlaneFID(8), of_volumes(lambda hu: blurred(hu, 1))
    for index in (0, 1, 2, 3, 1):
        metric.update(index, cases[f"p{index}"])
    got, wanted = metric.compute(), fid(cases)
    for name, value in wanted.items():
        assert float(got[name]) == pytest.approx(value.mean, rel=1e-4)
    assert (got["fid_cases"], got["slices_xy"], got["slices_yz"]) == (4, 64, 96)


def test_processes_agree_on_a_case_that_fills_the_last_batch_and_keep_no_other_features():
    cases = of_volumes(lambda hu: blurred(hu, 1))
    parts = [PlaneFID(8) for _ in range(3)]
    for part, seen in zip(parts, ((0, 3), (1, 0), (2, 0))):  # as of four cases for three processes
        for index in seen:
            part.update(index, cases[f"p{index}"])
        assert len(part.xy) == 1 and part.xy[0].numel() == 16 * (2 + 2 * 8)
    gathered = {name: [state for part in parts for state in getattr(part, name)] for name in ("summed", *PLANES)}
    whole, gathered["sums"] = parts[0], torch.stack([part.sums for part in parts]).sum(0)
    for name, state in gathered.items():
        setattr(whole, name, state)
    got, wanted = whole.compute(), fid(cases)
    assert (got["fid_cases"], got["slices_xy"], got["slices_yz"]) == (4, 64, 96)
    assert all(float(got[name]) == pytest.approx(wanted[name].mean, rel=1e-4) for name in NAMES)
    whole.reset()
    whole.update(0, cases["p0"])
    assert whole.compute()["fid_cases"] == 1


def test_features_come_back_from_their_file_and_others_are_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(backbones.DIMENSIONS, "squeezenet", 8)
    features = of_volumes(lambda hu: hu)["p0"]
    save_features(tmp_path / "f.safetensors", features)
    assert all(torch.equal(features[plane], found) for plane, found in
               StoredFeatures(tmp_path / "f.safetensors", "squeezenet").items())
    with pytest.raises(ValueError, match="not hold features of the FID backbone radimagenet"):
        StoredFeatures(tmp_path / "f.safetensors", "radimagenet")
    (tmp_path / "f.safetensors").write_bytes(b"none")
    with pytest.raises(ValueError, match="missing or damaged"):
        StoredFeatures(tmp_path / "f.safetensors", "squeezenet")


@pytest.fixture(scope="module")
def radimagenet(tmp_path_factory):
    """A file with random weights of RadImageNet's ResNet50."""
    file = tmp_path_factory.mktemp("weights") / "RadImageNet-ResNet50_notop.pth"
    torch.manual_seed(0)
    torch.save(backbones._radimagenet().state_dict(), file)
    return file


def test_a_backbone_is_read_from_its_file_and_is_blind_to_a_scale_and_an_offset_of_hu(radimagenet):
    network = SliceFeatures("radimagenet", radimagenet)
    hu = volume(0)[:, :, :3].repeat_interleave(2, 0).repeat_interleave(2, 1)
    plain = network(hu, "xy")
    assert plain.shape == (3, 2048) and plain.abs().max() > 0
    assert torch.allclose(network(0.5 * hu + 100, "xy"), plain, rtol=1e-2, atol=1e-4)
    assert not torch.allclose(network(hu.flip(1), "xy"), plain, rtol=1e-2, atol=1e-4)
    assert not network.training and not any(weight.requires_grad for weight in network.parameters())


def test_squeezenet_takes_slices_from_its_least_side_on_and_refuses_smaller_ones_in_one_sentence(monkeypatch):
    monkeypatch.setattr(backbones, "load_lpips", lambda backbone, *_: load_lpips(backbone, True))
    network, side = SliceFeatures("squeezenet"), backbones.LEAST_SIDE
    assert all(network(torch.zeros(side, side, side), plane).shape == (side, 512) for plane in PLANES)
    with pytest.raises(ValueError, match=f"^slices of {side} x {side - 1} x {side} voxels are too small .* leave fid"):
        network(torch.zeros(side, side - 1, side), "zx")


def test_squeezenet_that_is_not_there_is_missed_for_fid_and_not_for_lpips(tmp_path, monkeypatch):
    def offline(*_, **__):
        raise OSError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(FileNotFoundError, match=r"^FID by squeezenet needs .* or leave fid out of the metrics$"):
        SliceFeatures("squeezenet")


def test_a_backbone_without_its_weights_or_with_anothers_is_refused(radimagenet, tmp_path):
    torch.save({"conv1.weight": torch.zeros(3)}, tmp_path / "other.pth")
    for name, weights, sentence in (
            ("radimagenet", None, "RadImageNet-ResNet50_notop.pth"), ("inception", None, "inception_v3_google"),
            ("radimagenet", tmp_path / "none.pth", "there is no file"), ("vgg", None, "fid.backbone is one of"),
            ("radimagenet", tmp_path / "other.pth", "conv1.weight is missing"),
            ("squeezenet", radimagenet, "leave it out")):
        with pytest.raises((ValueError, FileNotFoundError), match=sentence):
            SliceFeatures(name, weights)
