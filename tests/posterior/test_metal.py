"""Metal carried beside a prior: found where it is, never where it is not, and given up where it does not help."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from phydict.diffusion import GaussianDenoiser
from phydict.grid import Grid
from phydict.methods import METHODS
from phydict.posterior import Measurement, Metal, Posterior, ProximalCG, Refined, metal
from phydict.posterior.metal import with_metal
from phydict.reconstruction import Reconstruction
from phydict.units import HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Ideal, Projector
from phydict.xray.boxes import in_other_voxels
from phydict.xray.carried import Carried

GRID, WINDOW = Grid.cube(24, 144.0), HUWindow()
FINE = Grid.cube(72, 144.0)
BEAM = ConeBeam.orbit(8, 1020, 740, (60, 60), 5.0)
STEP = ProximalCG(10, 3, tv_weight=5.0, tv_eps=0.003)
DENSITY = 8000.0


def body(metal: float = DENSITY) -> tuple[Tensor, Tensor]:
    """HU (1, 1, 72, 72, 72) of a trunk with a lung and a rod of 8 x 8 x 40 mm, 2.6 ml, that adds `metal`; the rod."""
    hu, rod = torch.full((1, 1, *FINE.shape), -1000.0), torch.zeros(1, 1, *FINE.shape)
    hu[..., 9:63, 15:57, 6:66] = 40
    hu[..., 15:33, 21:51, 12:60] = -800
    rod[..., 46:50, 27:31, 24:44] = metal
    return hu + rod, rod


def measured(metal: float = DENSITY, display: bool = False, beam: ConeBeam = BEAM) -> Measurement:
    """X-rays of finer voxels."""
    y = Ideal()(Projector(FINE, beam, full_detector=True), hu_to_mu(body(metal)[0]))[0]
    y = 0.3 * y + 0.1 if display else y
    return Measurement(Projector(GRID, beam, full_detector=True), y, WINDOW, display)


class Method:
    """Conjugate gradients from what a prior would say, soft tissue and lung; counts its runs."""

    def __init__(self, m: Measurement):
        self.m, self.runs = m, 0
        self.start = WINDOW.to_range(avg_pool3d(body(0)[0], 3))

    def __call__(self) -> Tensor:
        self.runs += 1
        self.m.refit(self.start)
        return STEP(self.m, self.start, 0.3)


@pytest.mark.parametrize("display", [False, True])
def test_metal_is_found_where_it_is_as_dense_as_it_is_and_the_rest_is_the_better_for_it(display):
    m = measured(display=display)
    method, (truth, rod) = Method(m), body()
    plain = method()
    z = with_metal(m, Metal(), method, method)
    found, true = m.carried, Carried(rod[0, 0], FINE)
    assert abs(found.centre - true.centre).max() < 3
    assert 0.5 < found.millilitres / true.millilitres < 1.5
    assert found.density * found.millilitres == pytest.approx(true.density * true.millilitres, rel=0.35)
    away = avg_pool3d(rod, 3) == 0
    error, before = ((WINDOW.to_hu(x) - avg_pool3d(truth, 3))[away].square().mean().sqrt() for x in (z, plain))
    assert error < 0.6 * before


def test_without_metal_nothing_is_sought_and_the_result_is_the_method_s_own():
    m = measured(0)
    method = Method(m)
    z = with_metal(m, Metal(), method, lambda: pytest.fail("it ran again"))
    assert method.runs == 1 and m.carried is None and torch.equal(z, Method(measured(0))())


def test_what_is_switched_off_or_below_bone_is_not_sought():
    m = measured()
    for settings, window in ((None, WINDOW), (Metal(), HUWindow(-1000, 600)), (Metal(least_ml=50.0), WINDOW)):
        m.window = window
        with_metal(m, settings, Method(m), lambda: pytest.fail("it ran again"))
        assert m.carried is None


@pytest.mark.parametrize("display", [False, True])
def test_two_display_images_of_unknown_gain_have_no_metal_and_two_of_line_integrals_have(display):
    m = measured(display=display, beam=BEAM.select([0, 2]))
    method = Method(m)
    with_metal(m, Metal(), method, method)
    assert (m.carried is None) == display == (method.runs == 1)


WITHOUT = {"shown_by": lambda *_: [0, 1], "DENSEST": math.inf}


@pytest.mark.parametrize("off", WITHOUT)
def test_a_bad_pixel_of_one_view_is_no_metal_as_no_other_view_shows_it_and_nothing_is_as_dense(monkeypatch, off):
    m = measured(0.0, beam=BEAM.select([0, 4]))
    m.y = m.y.clone()
    m.y[0, 1, 25, 20] = 8.0
    method = Method(m)
    plain = method()
    monkeypatch.setattr(metal, off, WITHOUT[off])  # either reason is enough
    assert torch.equal(with_metal(m, Metal(), method, method), plain) and m.carried is None
    for name, value in WITHOUT.items():
        monkeypatch.setattr(metal, name, value)
    with_metal(m, Metal(), method, method)
    assert m.carried.density > 40_000


@pytest.mark.parametrize("views", [[0], [0, 0, 0]])
def test_views_from_one_direction_cannot_say_where_metal_is_so_that_it_is_not_sought(views):
    m = measured(beam=BEAM.select(views))
    method = Method(m)
    with_metal(m, Metal(), method, lambda: pytest.fail("it ran again"))
    assert method.runs == 1 and m.carried is None


def test_metal_that_does_not_help_is_given_up_and_nothing_is_left_of_it():
    m = measured()
    method = Method(m)
    plain = method()

    def worse() -> Tensor:
        m.subgrid, m.scatter_enabled, m.y = 1.0, True, m.y + 1
        return torch.full_like(plain, -1)

    y = m.y
    assert torch.equal(with_metal(m, Metal(), method, worse), plain)
    assert m.carried is None and m.subgrid == 0 and not m.scatter_enabled and m.y is y
    assert torch.equal(m.project(plain), measured().project(plain))


def test_what_falls_far_short_of_the_density_is_given_up_before_the_method_runs_again():
    m = measured()
    plain = Method(m)()
    z = with_metal(m, Metal(least=2 * DENSITY), Method(m), lambda: pytest.fail("it ran again"))
    assert torch.equal(z, plain) and m.carried is None
    assert torch.equal(m.project(plain), measured().project(plain))


def test_metal_is_believed_from_the_density_on_that_is_said_of_it():
    found = []
    for share in (0.0, 0.99, 1.01):
        m = measured()
        z = with_metal(m, Metal(least=share * found[0] if found else 0.0), Method(m), Method(m))
        found.append(m.carried.density if m.carried else None)
    assert found == [found[0], found[0], None] and torch.equal(z, Method(measured())())


def test_carried_voxels_project_as_the_volume_that_they_are_and_keep_their_mass_on_coarser_ones():
    fine = in_other_voxels(GRID, (48, 48, 48))
    extra = torch.zeros(fine.shape)
    extra[10:15, 8:11, 12:20] = 3000.0
    carried = Carried(extra, fine, 0.025)
    projector = Projector(GRID, BEAM, full_detector=True)
    whole = Projector(fine, BEAM.divided(2), full_detector=True)(0.025 * extra[None, None] / 1000)
    assert torch.allclose(carried.projection(projector), torch.nn.functional.avg_pool2d(whole, 2)[0], atol=1e-5)
    assert torch.equal(carried.on(fine), extra)
    assert float(carried.on(GRID).sum()) * 8 == pytest.approx(float(extra.sum()))
    assert carried.density == pytest.approx(3000) and carried.millilitres == pytest.approx(120 * 0.027)
    index = torch.nonzero(extra).double().mean(0).numpy()
    assert carried.centre == pytest.approx(fine.affine[:3, :3] @ index + fine.affine[:3, 3])


def prior_of_the_body():
    """A prior that knows the trunk and nothing denser than its window."""
    class Known:
        grid, window, state_channels = GRID, WINDOW, 4

        def bind(self, *_):
            mean = WINDOW.to_range(avg_pool3d(body(0)[0], 3)).expand(-1, 4, -1, -1, -1)
            return GaussianDenoiser(mean, torch.tensor(0.1))

    return Known()


FAST = replace(METHODS["phydict_fast"], iterations=2, scatter=False, hardening=False, subgrid=None)


def reconstructed(sampler=FAST, target: Grid | None = None, **settings) -> Reconstruction:
    method, m = Posterior(prior_of_the_body(), sampler, **settings), measured()
    method = Refined(method, target) if target else method
    return method.reconstruct(m.measured[0], Projector(target or GRID, BEAM, full_detector=True))


def test_a_reconstruction_holds_the_metal_says_so_and_says_what_it_does_not_do():
    words = ("ml as dense as metal were found, about .* HU above .* as far as the volume that is kept reaches, .* beam "
             "hardening .* intervals")
    with pytest.warns(UserWarning, match=words) as said:
        result = reconstructed()
    assert not [w for w in said if "as dense as 1000 HU" in str(w.message)]
    assert result.volume.max() > 3000 and result.within.max() <= WINDOW.high + 1e-3
    assert torch.allclose(result.volume, result.within + result.carried.on(GRID))
    with pytest.warns(UserWarning, match="as dense as 1000 HU"):
        off = reconstructed(replace(FAST, metal=None))
    assert off.carried is None and off.volume.max() <= WINDOW.high
    assert result.misfit < off.misfit


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*as dense as metal")
def test_finer_voxels_and_several_samples_hold_the_metal_too():
    target = in_other_voxels(GRID, (48, 48, 48))
    coarse, fine = reconstructed(), reconstructed(target=target)
    assert torch.allclose(fine.volume - fine.within, coarse.carried.on(target), atol=0.01)
    assert fine.within.max() <= WINDOW.high + 1e-3 and fine.misfit < 1.5 * coarse.misfit
    samples = reconstructed(samples=2, batch=1)
    assert samples.volume.max() > 3000


@pytest.mark.parametrize("wrong", [{"least_ml": 0.0}, {"least_ml": 9.0, "most_ml": 8.0}, {"rounds": 0},
                                   {"least_views": 0}, {"iterations": 0}, {"least_ml": math.nan}])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="given"):
        Metal(**wrong)
