"""Protocols: the geometries and grids that were published, what they fix, and what they refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from rivals.tiny_rivals import tiny_lifted

from inference.runs import record, sirt, volume, with_prior
from phydict.cli.infer import main
from phydict.evaluation import read_csv
from phydict.evaluation.published import psnr_slices, ssim_uniform
from phydict.grid import Cube, Grid
from phydict.inference import ReconstructionData, protocols, scoring
from phydict.inference.protocols import PROTOCOLS
from phydict.inference.settings import Orbit
from phydict.inference.voxels import Voxels, placed, resampled
from phydict.prior import save_stage
from phydict.units import HUWindow
from phydict.xray import Ideal, Polychromatic


def angles(name: str, **orbit) -> list[float]:
    """Where the sources stand, in degrees from that of the first view."""
    sources = ReconstructionData(protocol=name, orbit=Orbit(**orbit)).beam.sources
    return [round(math.degrees(math.atan2(*(-s[:2]))) % 360, 6) for s in sources]


def test_views_stand_where_the_publications_put_them():
    assert angles("x2ct") == [0, 90]
    assert angles("luna16") == [0, 30, 60, 90, 120, 150] and angles("luna16", views=10)[-1] == 162
    assert angles("sparc") == [0, 90, 180, 270] and angles("sparc", views=8)[1] == 45
    assert angles("phydict") == [45 * k for k in range(8)]


@pytest.mark.parametrize("name, distances, detector_mm, grid", [
    ("x2ct", (541, 949), 500, (128, 2.5)), ("luna16", (800, 1200), 614.4, (256, 1.6)),
    ("sparc", (800, 1200), 1228.8, (256, 1.6)), ("phydict", (740, 1020), 560, None)])
def test_distances_detectors_and_voxels_are_the_published_ones(name, distances, detector_mm, grid):
    data = ReconstructionData(protocol=name)
    assert np.linalg.norm(data.beam.sources[0]) == pytest.approx(distances[0])
    assert np.linalg.norm(data.beam.sources[0] - data.beam.detectors[0]) == pytest.approx(distances[1])
    assert data.beam.shape[1] * np.linalg.norm(data.beam.u[0]) == pytest.approx(detector_mm)
    own = Voxels(Grid.cube(8), protocol=data.protocol).made
    assert (own.shape[0], own.spacing[0]) == pytest.approx(grid or (8, 48))
    assert data.simulator == Ideal(noise=0.005 if name == "phydict" else 0.0)


def test_without_a_protocol_everything_is_as_it_was():
    data = ReconstructionData()
    assert data.settings("test")["views"] == 8 and "arc" not in data.settings("test")
    assert "protocol" not in data.settings("test") and data.orbit.beam().views == 8
    assert np.array_equal(data.beam.sources, ReconstructionData(protocol="phydict").beam.sources)


@pytest.mark.parametrize("given, sentence", [
    ({"protocol": "lidc"}, "phydict, x2ct, luna16, sparc"),
    ({"protocol": "x2ct", "orbit": Orbit(views=8)}, "x2ct has 2 views, but 8 were given"),
    ({"protocol": "sparc", "orbit": Orbit(source_to_detector=1000.0)}, "source_to_detector at 1200.0, but 1000.0"),
    ({"protocol": "luna16", "orbit": Orbit(arc=360.0)}, "arc at 180.0"),
    ({"protocol": "luna16", "geometry": "paper_orbit"}, "data.geometry paper_orbit was given"),
    ({"protocol": "luna16", "simulator": Polychromatic()}, "fixes the X-rays as ideal ones with noise 0"),
    ({"protocol": "x2ct", "simulation_voxels": 192}, "X-rays of 128 voxels along .* multiple, but .* 192 was given"),
])
def test_what_clashes_with_a_protocol_is_refused(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        ReconstructionData(cts="phantom", **given)


def test_the_simulation_s_voxels_may_be_the_protocol_s():
    for voxels in (128, 256):
        assert ReconstructionData(protocol="x2ct", simulation_voxels=voxels).simulation_voxels == voxels
    assert ReconstructionData(protocol="phydict", simulation_voxels=128).simulation_voxels == 128


@pytest.mark.parametrize("given, bound, sentence", [
    (Grid.cube(64), False, "fixes 128 voxels over 320 mm, but 64 voxels over 384 mm were given"),
    (Grid.box((128, 128, 100), (320, 320, 250)), False, "but 128 x 128 x 100 voxels over 320 x 320 x 250 mm were"),
    (Grid.box(128, 320, (0, 20, 0)), False, r"but 128 voxels over 320 mm around \(0, 20, 0\) were given"),
    (Grid.cube(32, 192.0), True, "scores 128 voxels over 320 mm, but 32 voxels over 192 mm .* leave out a part"),
    (Grid.box(128, 320, (0, 20, 0)), True, "leave out a part of them: give a box that holds the chest, 384 mm, or")])
def test_voxels_that_contradict_a_protocols_are_refused(given, bound, sentence):
    with pytest.raises(ValueError, match=sentence):
        PROTOCOLS["x2ct"].check_voxels(given, bound)


def test_voxels_that_hold_a_protocols_or_the_chest_are_taken():
    for given in (None, Grid.cube(128, 320.0), Grid.cube(64, 330.0), Grid.cube(128)):
        PROTOCOLS["x2ct"].check_voxels(given, True)
    PROTOCOLS["luna16"].check_voxels(Grid.cube(128), True)  # a prior's cube is smaller than the protocol's
    PROTOCOLS["x2ct"].check_voxels(Grid.cube(128, 320.0), False)
    PROTOCOLS["phydict"].check_voxels(Grid.cube(32, 100.0), False)


def test_another_grid_and_measured_xrays_are_refused_by_the_command_line(tmp_path, capsys):
    args = sirt("test", tmp_path, "--data.cts=phantom", "--data.phantoms=1", "--data.protocol=x2ct")
    assert "fixes 128 voxels over 320 mm" in refusal(capsys, main, [*args, "--model.grid=32"])
    assert "predict takes measured ones" in refusal(capsys, main, sirt("predict", tmp_path, "--data.xrays=none",
                                                                 "--data.protocol=x2ct"))


@pytest.fixture
def small(monkeypatch):
    """A protocol of the LUNA16 kind that a test can afford."""
    made = protocols.Protocol("small", (2, 3), Orbit(None, 1200.0, 800.0, (24, 24), (25.6, 25.6), 180.0), (24, 409.6),
                              HUWindow(-1000.0, 1024.0), 0.0, ("psnr_slices", "ssim_uniform"), "a test")
    monkeypatch.setitem(PROTOCOLS, "small", made)
    return made


def test_a_protocols_scores_are_those_of_its_grid_and_range(tmp_path, small, monkeypatch):
    seen = {}

    def kept(volume, truth, scored):
        seen["volumes"] = volume, truth, scored
        return ssim_uniform(volume, truth, scored)

    monkeypatch.setitem(scoring.PUBLISHED, "ssim_uniform", kept)
    main(sirt("test", tmp_path, "--data.cts=phantom", "--data.phantoms=1", "--data.protocol=small"))
    (row,) = read_csv(tmp_path / "sirt" / "results.csv")
    volume, truth, scored = seen["volumes"]
    assert volume.shape == truth.shape == (24, 24, 24) and scored == small.hu and row["views"] == 2
    error = volume.double().clamp(-1000, 1024) - truth.double().clamp(-1000, 1024)
    assert row["psnr"] == pytest.approx(10 * math.log10(2024**2 / float(error.square().mean())), abs=1e-4)
    assert row["psnr_slices"] == pytest.approx(psnr_slices(volume, truth, scored)) and row["psnr_slices"] != row["psnr"]
    page = (tmp_path / "sirt" / "results.md").read_text()
    assert "[-1000, 1024], data range 2024" in page and "Protocol small (a test): scored on 24^3 voxels" in page
    assert record(tmp_path / "sirt" / "phantom-1000000")["settings"]["data"]["protocol"] == "small"
    assert "Protocol small (a test): scored on 24^3 voxels" in (tmp_path / "index.html").read_text()


def test_lpips_is_taken_in_a_protocols_range(tmp_path, small, monkeypatch):
    ranges = []
    monkeypatch.setattr(scoring, "load_networks", lambda: None)
    monkeypatch.setattr(scoring, "check_sides", lambda shape: None)
    monkeypatch.setattr(scoring, "lpips_scores", lambda volume, truth, device, scored: ranges.append(scored) or {})
    main(sirt("test", tmp_path, "--data.cts=phantom", "--data.phantoms=1", "--data.protocol=small",
              "--metrics=[lpips]"))
    assert ranges == [small.hu]


def test_a_volume_is_resampled_where_it_lies_and_means_are_kept():
    fine, coarse = Grid.cube(24, 240.0), Grid.cube(12, 240.0)
    hu = torch.randn(12, 12, 12, generator=torch.Generator().manual_seed(0))
    assert resampled(hu, coarse, coarse) is hu
    linear = 10 * torch.arange(12.0)[:, None, None].expand(12, 12, 12)
    assert torch.allclose(resampled(linear, coarse, fine)[2:-2, 2:-2, 2:-2], 5 * torch.arange(24.0)[
        2:-2, None, None] - 2.5, atol=1e-3)
    larger = resampled(hu, coarse, Grid.cube(16, 320.0))
    assert (larger[0] == -1000).all()
    assert float((larger + 1000).sum()) == pytest.approx(float((hu + 1000).sum()), rel=1e-4)


def test_a_method_on_other_voxels_keeps_its_place_in_the_ct():
    own, like = Cube(8, 80.0).grid(), Cube(16, 100.0).grid()
    moved = like.affine.copy()
    moved[:3, 3] += (5, -7, 11)
    assert placed(own, like, moved).centre == pytest.approx((5, -7, 11))
    assert np.array_equal(placed(like, like, moved).affine, moved)


def bound_methods(prior, folder) -> dict[str, list[str]]:
    """Options of a method with a prior, and of a rival, on 16^3 voxels of their own."""
    save_stage(tiny_lifted(), folder / "lifted.safetensors")
    return {"prior_only": with_prior("test", folder, prior),
            "lifted": ["test", "--model.method=phydict.rivals.TrainedRival", "--model.name=lifted",
                       f"--model.method.init_args.file={folder / 'lifted.safetensors'}", f"--model.out={folder}",
                       "--trainer.accelerator=cpu"]}


def test_what_has_voxels_of_its_own_is_resampled_onto_a_protocols_which_it_holds_where_it_takes_more(
        tmp_path, small, prior, monkeypatch):
    shapes = []

    def kept(volume, truth, scored):
        shapes.append((tuple(volume.shape), tuple(truth.shape)))
        return ssim_uniform(volume, truth, scored)

    monkeypatch.setitem(scoring.PUBLISHED, "ssim_uniform", kept)
    of = ["--data.cts=phantom", "--data.phantoms=1", "--data.protocol=small", "--model.sampling.with_report=false"]
    for name, arguments in bound_methods(prior, tmp_path).items():
        for more, voxels in ([], 16), (["--model.grid=32", "--model.overwrite=true"], 32):
            main([*arguments, *of, *more])
            held = 1.5 if name == "prior_only" else 1  # of 384 mm, where 409.6 are scored
            assert volume(tmp_path / name / "phantom-1000000").shape == (held * voxels,) * 3
    assert set(shapes) == {((24,) * 3, (24,) * 3)} and len(shapes) == 4


def test_a_region_is_refused_beside_a_protocol_in_which_it_would_be_scored_alone(tmp_path, small, prior, capsys):
    for arguments in bound_methods(prior, tmp_path).values():
        said = refusal(capsys, main, [*arguments, "--data.cts=phantom", "--data.phantoms=1", "--data.protocol=small",
                                      "--model.grid.voxels=32", "--model.grid.side=192"])
        assert "small scores 24 voxels over 409.6 mm, but 32 voxels over 192 mm were given" in said


def test_ablate_resamples_rivals_and_refuses_voxels_as_test_does(tmp_path, small, prior, capsys):
    bound_methods(prior, tmp_path)
    file, out = tmp_path / "spec.yaml", tmp_path / "out"
    lifted = {"of": "phydict.rivals.TrainedRival", "method.file": str(tmp_path / "lifted.safetensors")}
    file.write_text(yaml.safe_dump({"out": str(out), "phantoms": 1, "base": {"protocol": "small"}, "methods": {
        "lifted": lifted}, "axes": {"method": ["fdk", "lifted"]}}))
    main(["ablate", "-c", str(file), "--device", "cpu"])
    assert {(row["method"], row["status"], row["grid"]) for row in read_csv(out / "results.csv")} == {
        ("fdk", "ok", "24x24x24"), ("lifted", "ok", "24x24x24")}
    args = ["ablate", "-c", str(file), "--device", "cpu", "--out", str(tmp_path / "other"), "--set"]
    assert "small fixes 24 voxels over 409.6 mm, but 32 voxels over 384 mm" in refusal(
        capsys, main, [*args, "method=[fdk]", "voxels=32"])
    assert "small scores 24 voxels over 409.6 mm, but 32 voxels over 192 mm" in refusal(
        capsys, main, [*args, "method=[lifted]", "voxels=32", "side=192"])
    main([*args, "method=[lifted]", "voxels=32"])
    assert [row["grid"] for row in read_csv(tmp_path / "other" / "results.csv")] == ["24x24x24"]


def test_ablate_compares_methods_by_a_protocol(tmp_path, small):
    file = tmp_path / "spec.yaml"
    content = {"out": str(tmp_path / "out"), "phantoms": 1, "base": {"protocol": "small", "method.iterations": 2},
               "axes": {"method": ["sirt", "tv"], "views": [2, 3]}}
    file.write_text(yaml.safe_dump(content))
    main(["ablate", "-c", str(file), "--device", "cpu"])
    rows = read_csv(tmp_path / "out" / "results.csv")
    assert {(row["method"], row["views"]) for row in rows} == {(m, k) for m in ("sirt", "tv") for k in (2, 3)}
    assert {row["grid"] for row in rows} == {"24x24x24"} and all(row["ssim_uniform"] <= 1 for row in rows)
    page = (tmp_path / "out" / "tables.md").read_text()
    assert "data range 2024 HU" in page and "SSIM 7^3" in page and "Protocol small (a test): scored on 24^3" in page


def test_a_protocol_against_another_number_of_views_is_refused_by_ablate(tmp_path, small, capsys):
    file = tmp_path / "spec.yaml"
    file.write_text(yaml.safe_dump({"out": str(tmp_path / "out"), "phantoms": 1, "axes": {
        "method": ["sirt"], "protocol": ["small"], "views": [8]}}))
    said = refusal(capsys, main, ["ablate", "-c", str(file), "--device", "cpu"])
    assert "small has 2, 3 views, but 8 were given" in said
