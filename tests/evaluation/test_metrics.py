"""What the metrics promise: exact values in known cases, an independent SSIM, statistics per case, DDP."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from processes import FORKS
from scipy.ndimage import correlate1d

from phydict.evaluation.fid import PlaneFID
from phydict.evaluation.metrics import CaseMetrics, ssim_window, volume_metrics
from phydict.evaluation.planes import PLANES


def smooth_case(seed: int, shape=(20, 18, 16)):
    """A volume of soft structures in HU and a noisy reconstruction of it, both inside [-1000, 1000]."""
    make = torch.Generator().manual_seed(seed)
    truth = torch.nn.functional.interpolate(torch.randn(1, 1, 5, 5, 5, generator=make), shape, mode="trilinear")
    truth = 300 * truth.clamp(-2.5, 2.5)
    return truth, (truth + 60 * torch.randn(truth.shape, generator=make)).clamp(-990, 990)


def reference_ssim_map(x, y, data_range):
    """The SSIM map written from the formula with separable float64 filters and mirrored borders."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)

    def blur(a):
        for axis in range(3):
            a = correlate1d(a, taps / taps.sum(), axis=axis, mode="mirror")
        return a

    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    mx, my = blur(x), blur(y)
    sxx, syy, sxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (2 * mx * my + c1) * (2 * sxy + c2) / ((mx**2 + my**2 + c1) * (sxx + syy + c2))


def test_identical_volumes_are_perfect():
    truth, _ = smooth_case(0)
    got = volume_metrics(truth, truth.clone(), torch.ones_like(truth), torch.ones_like(truth))
    for where in ("", "_body", "_lung"):
        assert got[f"ssim{where}"] == pytest.approx(1, abs=1e-5)
        assert got[f"psnr{where}"] == math.inf and got[f"mae_hu{where}"] == 0


def test_a_constant_offset_has_closed_form_psnr_and_mae_and_lowers_ssim():
    truth, _ = smooth_case(1)
    got = volume_metrics(truth + 100, truth)
    assert got["psnr"] == pytest.approx(20 * math.log10(2000 / 100), abs=1e-4)
    assert got["mae_hu"] == pytest.approx(100, rel=1e-5)
    assert got["ssim"] < 0.999


def test_values_beyond_the_range_are_clipped_before_comparison():
    truth, _ = smooth_case(2)
    truth = truth.clone()
    truth[..., :4] = 1000
    far = truth.clone()
    far[..., :4] = 3000
    assert volume_metrics(far, truth)["mae_hu"] == 0
    assert volume_metrics(far, truth, high=3000)["mae_hu"] > 100


def test_ssim_agrees_with_an_independent_implementation():
    truth, noisy = smooth_case(3)
    x, y = noisy[0, 0].double().numpy(), truth[0, 0].double().numpy()
    lung = torch.zeros_like(truth)
    lung[..., 4:9, 5:12, 3:10] = 0.5
    got, wanted = volume_metrics(noisy, truth, lung), reference_ssim_map(x + 1000, y + 1000, 2000)
    assert 0.3 < wanted.mean() < 0.97
    assert got["ssim"] == pytest.approx(wanted.mean(), abs=1e-4)
    assert got["ssim_lung"] == pytest.approx(np.average(wanted, weights=lung[0, 0].numpy()), abs=1e-4)


def test_psnr_and_mae_agree_with_numpy_and_the_mask_is_a_weight():
    truth, noisy = smooth_case(4)
    lung = torch.rand(truth.shape, generator=torch.Generator().manual_seed(0))
    got = volume_metrics(noisy, truth, lung)
    error, weight = (noisy - truth).double().numpy(), lung.double().numpy()
    assert got["psnr"] == pytest.approx(10 * math.log10(2000**2 / (error**2).mean()), abs=1e-4)
    assert got["psnr_lung"] == pytest.approx(10 * math.log10(2000**2 / np.average(error**2, weights=weight)), abs=1e-4)
    assert got["mae_hu_lung"] == pytest.approx(np.average(abs(error), weights=weight), rel=1e-5)


@pytest.mark.parametrize("where", ["lung", "body"])
def test_metrics_in_a_mask_ignore_errors_outside_it(where):
    truth, noisy = smooth_case(5, (24, 16, 16))
    mask = torch.zeros_like(truth)
    mask[:, :, :8] = 1
    spoiled = noisy.clone()
    spoiled[:, :, 8:] = 0
    near, same = (volume_metrics(volume, truth, **{where: mask}) for volume in (noisy, spoiled))
    assert near[f"psnr_{where}"] == same[f"psnr_{where}"] and near[f"mae_hu_{where}"] == same[f"mae_hu_{where}"]
    assert near["psnr"] > same["psnr"] + 1
    far = noisy.clone()
    far[:, :, 8 + 5:] = 0
    moved = volume_metrics(far, truth, **{where: mask})
    assert moved[f"ssim_{where}"] == pytest.approx(near[f"ssim_{where}"], abs=1e-6)


def test_masks_are_scored_apart_and_an_empty_one_counts_as_none():
    truth, noisy = smooth_case(6)
    lung = torch.rand(truth.shape, generator=torch.Generator().manual_seed(1))
    plain, none = volume_metrics(noisy, truth), torch.zeros_like(truth)
    assert volume_metrics(noisy, truth, none, none) == plain
    both = volume_metrics(noisy, truth, lung, 1 - lung)
    assert both == volume_metrics(noisy, truth, lung) | volume_metrics(noisy, truth, body=1 - lung)
    assert both["psnr_lung"] != both["psnr_body"] and both["mae_hu"] == plain["mae_hu"]


def test_scale_and_offset_of_the_range_change_no_score():
    truth, noisy = smooth_case(7)
    noisy = noisy + 60
    hu = volume_metrics(noisy, truth)
    signed = volume_metrics(noisy / 1000, truth / 1000, low=-1, high=1)
    unit = volume_metrics(noisy / 2000 + 0.5, truth / 2000 + 0.5, low=0, high=1)
    for name in ("psnr", "ssim"):
        assert signed[name] == pytest.approx(unit[name], abs=1e-3) == pytest.approx(hu[name], abs=1e-3)


@pytest.mark.parametrize("order", [(2, 3, 4), (4, 2, 3), (3, 2, 4)])
def test_axes_are_equal(order):
    truth, noisy = smooth_case(8)
    turned = volume_metrics(noisy.permute(0, 1, *order), truth.permute(0, 1, *order))
    assert turned == pytest.approx(volume_metrics(noisy, truth), rel=1e-5)


def test_each_axis_is_seen_by_the_ssim():
    """An error that varies along one axis only scores the same on whichever axis it lies."""
    wave = 300 * torch.sin(torch.arange(16.0))
    scores = []
    for axis in range(3):
        volume = wave.reshape([16 if n == axis else 1 for n in range(3)]).expand(16, 16, 16)[None, None]
        scores.append(volume_metrics(0.5 * volume, volume)["ssim"])
    assert scores[0] < 0.95
    assert scores == pytest.approx([scores[0]] * 3, abs=1e-4)


@pytest.mark.parametrize("shape", [(10, 16, 16), (8, 8, 8), (3, 4, 5), (1, 1, 1)])
def test_small_volumes_get_a_window_that_fits(shape):
    taps, _sigma = ssim_window(shape)
    assert all(t <= n and t % 2 == 1 for t, n in zip(taps, shape))
    truth, _ = smooth_case(9)
    truth = truth[..., : shape[0], : shape[1], : shape[2]]
    got = volume_metrics(truth + 50, truth)
    assert -1 <= got["ssim"] < 1 and volume_metrics(truth, truth)["ssim"] == pytest.approx(1, abs=1e-5)


def test_full_size_volumes_get_eleven_taps():
    assert ssim_window((11, 64, 256)) == ([11, 11, 11], [1.5, 1.5, 1.5])


def test_scores_do_not_depend_on_autocast():
    truth, noisy = smooth_case(10)
    with torch.autocast("cpu", torch.bfloat16):
        under = volume_metrics(noisy, truth)
    assert under == volume_metrics(noisy, truth)


def test_nan_shows():
    truth, noisy = smooth_case(11)
    noisy[0, 0, 3, 3, 3] = math.nan
    assert all(math.isnan(v) for v in volume_metrics(noisy, truth).values())


@pytest.mark.parametrize("hu, true_hu, given, sentence", [
    ((2, 1, 8, 8, 8), (2, 1, 8, 8, 8), {}, "loop over the batch"),
    ((1, 1, 8, 8, 8), (1, 1, 8, 8, 9), {}, r"\(1, 1, 8, 8, 9\)"),
    ((8, 8, 8), (8, 8, 8), {}, r"\(1, 1, X, Y, Z\)"),
    ((1, 1, 8, 8, 8), (1, 1, 8, 8, 8), {"lung": torch.ones(1, 3, 8, 8, 8)}, "lung mask"),
    ((1, 1, 8, 8, 8), (1, 1, 8, 8, 8), {"body": torch.ones(8, 8, 8)}, "body mask"),
    ((1, 1, 8, 8, 8), (1, 1, 8, 8, 8), {"low": 1000}, "low < high"),
])
def test_bad_input_is_named(hu, true_hu, given, sentence):
    with pytest.raises(ValueError, match=sentence):
        volume_metrics(torch.zeros(hu), torch.zeros(true_hu), **given)


def test_statistics_are_means_of_case_values_and_not_pooled():
    truth, good = smooth_case(12)
    bad = truth + 500
    metric = CaseMetrics(["fdk"])
    values = [volume_metrics(good, truth)["psnr"], volume_metrics(bad, truth)["psnr"]]
    for case, psnr in enumerate(values):
        metric.update(case, "fdk", {"psnr": psnr}, seconds=2.0 * case)
    got = metric.compute()
    errors = torch.cat([good - truth, bad.clamp(-1000, 1000) - truth]).double()
    pooled = 10 * math.log10(2000**2 / float((errors**2).mean()))
    assert float(got["fdk/psnr"]) == pytest.approx(np.mean(values))
    assert float(got["fdk/psnr_std"]) == pytest.approx(np.std(values, ddof=1))
    assert float(got["fdk/psnr"]) > pooled + 3
    assert float(got["fdk/seconds"]) == 1 and float(got["fdk/cases"]) == 2


def test_two_metrics_of_one_case_equal_one_metric_of_two():
    together, apart = CaseMetrics(["a", "b"]), [CaseMetrics(["a", "b"]) for _ in range(2)]
    for case in range(2):
        for method in "ab":
            for metric in (together, apart[case]):
                metric.update(case, method, {"psnr": 20.0 + case, "ssim": 0.5})
    for name in ("a/psnr", "b/psnr", "a/ssim"):
        assert float(together.compute()[name]) == np.mean([float(m.compute()[name]) for m in apart])


def test_missing_values_are_left_out_and_failures_are_kept():
    metric = CaseMetrics(["a", "b", "unused"])
    metric.update(0, "a", {"psnr": 10, "psnr_lung": 8})
    metric.update(1, "a", {"psnr": 20, "psnr_lung": None})
    metric.update(0, "b", {"psnr": math.nan})
    got = metric.compute()
    assert float(got["a/psnr"]) == 15 and float(got["a/psnr_lung"]) == 8 and math.isnan(got["a/psnr_lung_std"])
    assert math.isnan(got["b/psnr"])
    assert not {"a/mae_hu", "b/psnr_lung", "unused/psnr", "unused/cases"} & got.keys()


def test_infinite_psnr_survives_the_mean():
    metric = CaseMetrics(["a"])
    metric.update(0, "a", {"psnr": math.inf})
    metric.update(1, "a", {"psnr": 20.0})
    assert float(metric.compute()["a/psnr"]) == math.inf


def test_a_repeated_case_counts_once_and_reset_forgets():
    metric = CaseMetrics(["a"])
    for psnr in (10.0, 10.0, 10.0):
        metric.update(0, "a", {"psnr": psnr})
    metric.update(1, "a", {"psnr": 20.0})
    assert float(metric.compute()["a/psnr"]) == 15
    metric.reset()
    metric.update(2, "a", {"psnr": 1.0})
    assert float(metric.compute()["a/psnr"]) == 1


def test_unknown_methods_and_names_are_refused():
    metric = CaseMetrics(["a"])
    with pytest.raises(ValueError, match="method 'c'"):
        metric.update(0, "c", {"psnr": 1.0})
    with pytest.raises(ValueError, match="'sim'"):
        metric.update(0, "a", {"sim": 1.0})


VALUES = {(case, method): 20 + 3.7 * case + 0.1 * len(method) for case in range(5) for method in ("fdk", "gibbs")}


FEATURES = {case: {plane: torch.randn(2, 4 + case, 3, generator=torch.Generator().manual_seed(case))
                   for plane in PLANES} for case in range(5)}

SHARES = {"repeated case": ([0, 2, 4], [1, 3, 0]), "idle process": ([0, 1, 2, 3, 4], [])}


def of_process(rank: int, store: str, out: str) -> None:
    torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
    result = {}
    for name, shares in SHARES.items():
        metric = CaseMetrics(["fdk", "gibbs"])
        for case in shares[rank]:
            for method in ("fdk", "gibbs"):
                metric.update(case, method, {"psnr": VALUES[case, method]}, seconds=case)
        slices = PlaneFID(3)
        for case in shares[rank]:
            slices.update(case, FEATURES[case])
        result[name] = metric.compute() | slices.compute(), len(metric.values)
    torch.save(result, f"{out}.{rank}")
    torch.distributed.destroy_process_group()


def test_two_processes_equal_one(tmp_path):
    files = str(tmp_path / "store"), str(tmp_path / "out")
    torch.multiprocessing.start_processes(of_process, files, nprocs=2, start_method=FORKS.get_start_method())
    alone = CaseMetrics(["fdk", "gibbs"])
    for (case, method), psnr in VALUES.items():
        alone.update(case, method, {"psnr": psnr}, seconds=case)
    slices = PlaneFID(3)
    for case, features in FEATURES.items():
        slices.update(case, features)
    wanted = {name: float(value) for name, value in (alone.compute() | slices.compute()).items()}
    for rank in range(2):
        for name, (got, kept) in torch.load(tmp_path / f"out.{rank}").items():
            assert {k: float(v) for k, v in got.items()} == wanted
            assert kept == 2 * len(SHARES[name][rank])    # gathering leaves each process its own cases
