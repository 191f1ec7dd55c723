"""What an unrolled reconstruction from few views and a report starts from: what an untouched prior makes of both."""

import itertools
import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from prior.tiny import REPORTS, tiny_prior, tiny_refiner
from safetensors import safe_open
from safetensors.torch import save_file

from phydict.grid import Grid
from phydict.methods import reconstruct
from phydict.posterior import Measurement, Unrolled
from phydict.prior import Refiner, load_prior, save_refiner
from phydict.reconstruction import Reconstruction
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

GRID, WINDOW = Grid.cube(16), HUWindow(-1000, 600)
METHOD = Unrolled((0.35, 0.15), (0.5, 0.3, 0.3), contradiction=None, metal=None, subgrid=None)
FEW, MANY = (ConeBeam.orbit(views, 1020, 740, (28, 28), 20.0) for views in (2, METHOD.first_views + 1))


def xrays(beam: ConeBeam) -> torch.Tensor:
    hu = torch.full((1, 1, *GRID.shape), -1000.0)
    hu[:, :, 3:13, 4:12, 2:14] = 40
    return Projector(GRID, beam, full_detector=True)(WINDOW.to_mu(WINDOW.to_range(hu)))[0]


def measured(beam: ConeBeam) -> Measurement:
    return Measurement(Projector(GRID, beam, full_detector=True), xrays(beam), WINDOW)


def found(refiner: Refiner, beam: ConeBeam, report: str | None = None) -> Reconstruction:
    return reconstruct(xrays(beam), beam, refiner, METHOD, report=report, precision="float32")


@torch.no_grad()
def test_few_views_with_a_report_start_from_what_the_prior_makes_of_both_and_others_from_the_mean():
    begins, told = tiny_refiner(begins=True), tiny_refiner(begins=True)
    start = METHOD.start_state(begins.bind(REPORTS[0], precision="float32"), measured(FEW))[0]
    told.first = None
    for beam, report, mean in ((FEW, REPORTS[0], start), (FEW, "", begins.mean), (MANY, REPORTS[0], begins.mean)):
        told.mean = mean
        both = [list(METHOD.estimates(bound, measured(beam))) for bound in (
            begins.bind(report, precision="float32"), told.bind(precision="float32"))]
        assert all(torch.equal(*pair) for pair in zip(*both))
    assert (start - begins.mean).abs().mean() > 0.01


def test_the_calls_of_what_it_starts_with_are_counted_and_a_report_that_is_not_used_is_told():
    for beam, report, first in ((FEW, REPORTS[0], METHOD.first.iterations), (FEW, None, 0), (MANY, REPORTS[0], 0)):
        unused = pytest.warns(UserWarning, match="and 4 were given") if beam is MANY else nullcontext()
        with unused:
            calls = found(tiny_refiner(begins=True), beam, report).network_calls
        assert calls % (first + len(METHOD.times)) == 0 and calls > 0


def test_each_report_starts_elsewhere():
    refiner = tiny_refiner(begins=True)
    starts = [METHOD.start_state(refiner.bind(report, precision="float32"), measured(FEW)) for report in REPORTS]
    assert min(float((one - other).abs().max()) for one, other in itertools.pairwise(starts)) > 1e-3


@pytest.mark.parametrize("probability, heard", [(0.4, False), (0.6, True)])
def test_a_report_that_states_no_finding_counts_as_none(probability, heard):
    refiner = tiny_refiner(begins=True)
    refiner.first.network.draw_kinds(["effusion", "nodule"])
    score = refiner.first.network.text_map.score
    torch.nn.init.zeros_(score.weight)
    score.bias.data = torch.logit(torch.tensor([0.1, probability]))
    told, untold = (refiner.bind(report, precision="float32") for report in (REPORTS[0], ""))
    assert told.begins == heard and not untold.begins
    starts = [METHOD.start_state(bound, measured(FEW)) for bound in (told, untold)]
    assert torch.equal(*starts) != heard


@torch.no_grad()
def test_where_more_slices_are_reconstructed_it_starts_from_what_the_prior_makes_on_its_own():
    refiner = tiny_refiner(begins=True).bind(REPORTS[0], precision="float32")
    tall = replace(FEW, continued=True)
    own, grown = (
        METHOD.start_state(refiner, Measurement(Projector(grid, tall, full_detector=True), xrays(FEW), WINDOW))
        for grid in (GRID, GRID.grown(0, 0, 4)))
    assert torch.equal(grown[..., 4:-4], own)
    assert torch.equal(grown[..., :4], own[..., :1].expand(-1, -1, -1, -1, 4))
    assert torch.equal(grown[..., -4:], own[..., -1:].expand(-1, -1, -1, -1, 4))


@torch.no_grad()
def test_what_projects_on_fewer_slices_is_counted(monkeypatch):
    refiner = tiny_refiner(begins=True).bind(REPORTS[0], precision="float32")
    measurement = Measurement(
        Projector(GRID.grown(0, 0, 4), replace(FEW, continued=True), full_detector=True), xrays(FEW), WINDOW)
    ran, known = [], measurement.calls
    for name in ("__call__", "T"):
        original = getattr(Projector, name)
        monkeypatch.setattr(Projector, name, lambda self, x, of=original: ran.append(len(x)) or of(self, x))
    METHOD.start_state(refiner, measurement)
    assert measurement.calls - known == sum(ran) > 0


def test_neither_the_seed_nor_the_order_of_the_views_counts():
    refiner, y = tiny_refiner(begins=True), xrays(FEW)
    settings = {"report": REPORTS[0], "precision": "float32"}
    one, other = (reconstruct(y, FEW, refiner, METHOD, seed=seed, **settings).volume for seed in (0, 1))
    assert torch.equal(one, other)
    turned = reconstruct(y[[1, 0]], FEW.select([1, 0]), refiner, METHOD, **settings).volume
    assert (one - turned).abs().mean() < 1


def test_a_refiners_file_keeps_what_it_begins_with(tmp_path):
    refiner = tiny_refiner(begins=True)
    save_refiner(refiner, tmp_path / "refiner.safetensors", dtype=torch.float32)
    again = load_prior(tmp_path / "refiner.safetensors")
    for report in (None, REPORTS[0]):
        assert torch.equal(found(refiner, FEW, report=report).volume, found(again, FEW, report=report).volume)


@pytest.mark.parametrize("changed", [3, {}, {"network": {"block": 10**9}}])
def test_a_file_whose_prior_to_begin_with_is_none_is_refused(tmp_path, changed):
    file = tmp_path / "refiner.safetensors"
    save_refiner(tiny_refiner(begins=True), file)
    with safe_open(file, "pt") as opened:
        header = json.loads(opened.metadata()["phydict"])
        weights = {name: opened.get_tensor(name) for name in opened.keys()}
    header["first"] = changed
    save_file(weights, file, {"phydict": json.dumps(header)})
    with pytest.raises(ValueError, match=str(file)):
        load_prior(file)


def test_a_prior_that_it_cannot_begin_with_is_refused():
    with pytest.raises(ValueError, match="own grid, HU window, state and noise schedule"):
        tiny_refiner().begin_with(tiny_prior(voxels=32))
