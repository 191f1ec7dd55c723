"""X-rays of patients who are wider than the volume."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import pad

from phydict import ConeBeam, Projector, reconstruct
from phydict.baselines import FISTATV
from phydict.baselines.beside import Beside, with_surroundings
from phydict.datasets import phantom_case
from phydict.evaluation import volume_metrics
from phydict.grid import Grid
from phydict.methods import reconstructor
from phydict.runtime.warning import Remark
from phydict.units import HUWindow
from phydict.xray import Ideal
from phydict.xray.boxes import seen_by

TV = FISTATV(iterations=80)
CHEST, WIDE, WINDOW = Grid.cube(64), Grid.box([80, 80, 64], [480.0, 480.0, 384.0]), HUWindow()
ORBIT = replace(ConeBeam.orbit(6, 1300, 800, (112, 112), 6.4, start=0.1), continued=False)


@pytest.fixture(scope="module")
def patients() -> dict[str, torch.Tensor]:
    """A phantom of 384 mm with air beside it, and with arms."""
    alone = pad(phantom_case(3, CHEST, WINDOW)["volume"][None], (0, 0, 8, 8, 8, 8), value=-1.0)
    x, y = torch.meshgrid(torch.arange(80) - 39.5, torch.arange(80) - 39.5, indexing="ij")
    arms = (((x.abs() - 36) / 3.5) ** 2 + (y / 6) ** 2 < 1)[..., None].expand(80, 80, 64)
    return {"alone": alone, "with arms": torch.where(arms, WINDOW.to_range(torch.tensor(40.0)), alone)}


def xrays_of(volume: torch.Tensor, beam: ConeBeam = ORBIT) -> torch.Tensor:
    return Ideal()(Projector(WIDE, beam, full_detector=True), WINDOW.to_mu(volume), 0)[0]


def inside(volume: torch.Tensor) -> torch.Tensor:
    return WINDOW.to_hu(volume[..., 8:72, 8:72, :].contiguous())


@pytest.mark.filterwarnings("ignore:no volume explains")
@pytest.mark.parametrize("method", ["phydict_learned", TV])
def test_what_stands_beside_the_volume_does_not_spoil_it(patients, method, monkeypatch):
    y, truth = xrays_of(patients["with arms"]), inside(patients["with arms"])
    with pytest.warns(Remark, match="something stands beside the volume"):
        found = reconstruct(y, ORBIT, method=method, grid=CHEST)
    monkeypatch.setattr("phydict.methods.with_surroundings", lambda method, *_: method)
    spoilt = reconstruct(y, ORBIT, method=method, grid=CHEST)
    scores = [volume_metrics(each.volume[None, None], truth)["psnr"] for each in (found, spoilt)]
    assert scores[0] > scores[1] + 2
    torch.testing.assert_close(found.xrays, spoilt.xrays)
    assert found.misfit == pytest.approx(float((found.reprojection - found.xrays).norm() / found.xrays.norm()),
                                         rel=1e-4)
    assert found.misfit < spoilt.misfit and found.method == spoilt.method


def test_nothing_is_sought_where_nothing_stands_or_can_be_told(patients):
    method = reconstructor("tv")
    for beam, patient, display in (
            (ORBIT, "alone", False), (ORBIT.select([0, 1, 2]), "with arms", False), (ORBIT, "with arms", True)):
        assert with_surroundings(method, *seen_by(CHEST, xrays_of(patients[patient], beam), beam, False),
                                 display) is method
    with pytest.warns(Remark, match="480 x 480|528 x 528|552 x 552|576 x 576"):
        found = with_surroundings(method, *seen_by(CHEST, xrays_of(patients["with arms"]), ORBIT, False), False)
    assert isinstance(found, Beside) and found.with_mu_water(0.02).outside is found.outside
    narrow = ConeBeam.orbit(6, 1020, 740, (112, 112), 5.0)
    assert not narrow.has_room_for(WIDE)
    y = Ideal()(Projector(CHEST, narrow, full_detector=True), WINDOW.to_mu(patients["alone"][..., 8:72, 8:72, :]), 0)[0]
    assert with_surroundings(method, y, Projector(CHEST, narrow, full_detector=True), False) is method


@pytest.mark.filterwarnings("ignore:the X-rays show that something")
def test_a_finer_box_of_a_wider_patient_is_found_as_well(patients):
    y, box = xrays_of(patients["with arms"]), Grid.box(32, 192.0)
    truth = inside(patients["with arms"])[0, 0, 16:48, 16:48, 16:48]
    hu = reconstruct(y, ORBIT, method=TV, grid=box).volume
    whole = reconstruct(y, ORBIT, method=TV, grid=CHEST).volume[16:48, 16:48, 16:48]
    assert (hu - truth).square().mean().sqrt() < 1.1 * (whole - truth).square().mean().sqrt()
