"""The unrolled reconstruction: its prior's own where nothing is learnt, and what its evidence says."""

import warnings
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from prior.tiny import tiny_prior, tiny_refiner, tiny_super_resolution
from scenes import WINDOW, block
from torch.nn.functional import avg_pool3d, interpolate, max_pool3d

from phydict.datasets import Thorax, build, load_xrays
from phydict.diffusion import CosineSchedule, renoise
from phydict.grid import Grid
from phydict.guard import one_material
from phydict.methods import METHODS, reconstruct, reconstructor
from phydict.posterior import Measurement, Posterior, PriorOnly, ProximalCG, SplitGibbs, Unrolled, discretisation
from phydict.posterior.discretisation import subgrid_projection
from phydict.posterior.hardening import with_hardening
from phydict.prior import BoundRefiner, Prior, Refiner, load_prior, save_prior, save_refiner
from phydict.runtime.precision import computes_bfloat16
from phydict.units import HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Ideal, Polychromatic, Projector
from phydict.xray.finer import FinerProjector
from posterior.hollow import GRID, ORBIT, fine_scene, measured

OTHERS = {
    "one view": ConeBeam.orbit(1, 1020, 740, (28, 28), 20.0),
    "33 views": ConeBeam.orbit(33, 1020, 740, (28, 28), 20.0),
    "an arc of 60 degrees": ConeBeam.orbit(5, 1020, 740, (28, 28), 20.0, arc_degrees=60),
    "a detector that cuts the body": ConeBeam.orbit(4, 1020, 740, (10, 12), 20.0),
    "64 views": ConeBeam.orbit(64, 1020, 740, (28, 28), 20.0),
    "a tilted detector": ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0).tilted(15),
    "a tomosynthesis": ConeBeam.orbit(9, 1020, 740, (28, 28), 20.0, arc_degrees=40),
    "half a fan": ConeBeam(ORBIT.sources, ORBIT.detectors + 10 * ORBIT.u, ORBIT.u, ORBIT.v, ORBIT.shape)}


COARSE = Unrolled(contradiction=None)
"""On voxels as coarse as GRID's, what the first step leaves unexplained contradicts nothing."""


def test_an_untrained_refiner_is_its_prior_to_the_last_digit():
    refiner = tiny_refiner(untrained=True)
    x, t = torch.randn(1, 4, *GRID.shape), torch.tensor([0.3])
    context, evidence = refiner.prior.null, torch.randn(1, 5, *GRID.shape)
    assert torch.equal(refiner(x, t, context, evidence), refiner.prior(x, t, context))
    assert not torch.equal(tiny_refiner()(x, t, context, evidence), refiner.prior(x, t, context))


@torch.no_grad()
def test_an_untrained_refiner_reconstructs_as_split_gibbs_without_noise_does():
    """From the state that the first likelihood step leaves, at the same times with the same steps."""
    refiner, m = tiny_refiner(untrained=True), measured()
    step = ProximalCG(4, 2)  # without total variation, which model error would raise
    method = Unrolled((0.4, 0.2), (0.5, 0.3, 0.3), step, step, step, subgrid=None, contradiction=None)
    *_, result = method.estimates(refiner.bind(precision="float32"), m)

    class Levels(SplitGibbs):
        def times(self, denoiser):
            return [(0.4, 0.2), (0.2, 0.0)]

        def x0_std(self, denoiser, t):
            return 0.3

    mean = refiner.mean[None]
    z = torch.cat([step(m, mean[:, :1], 0.5).clamp(-1, 1), mean[:, 1:]], 1)
    sampler = Levels(iterations=2, likelihood=step, final_likelihood=step, noise_fraction=0.0)
    x = renoise(refiner.schedule, z, 0.4, torch.zeros_like(z))
    again = sampler.sample(refiner.prior.bind(precision="float32"), m, x, torch.Generator())
    torch.testing.assert_close(result, again, atol=1e-5, rtol=0)


@torch.no_grad()
def test_finer_voxels_explain_what_the_means_of_the_truth_do_not():
    m, truth = fine_scene(noise=1e-3)
    without = m.normalised_residual(truth)
    m.subgrid = subgrid_projection(m, truth, ProximalCG(20, 2), 0.5)
    assert without > 3 and m.normalised_residual(truth) < 0.8 * without


@torch.no_grad()
def test_finer_voxels_are_asked_only_where_the_grid_misses_the_x_rays():
    refiner = tiny_refiner().bind(precision="float32")
    for name, m in {"grid": measured(noise=0.02), "finer": fine_scene(noise=1e-3)[0]}.items():
        *_, z = Unrolled().estimates(refiner, m)
        assert isinstance(m.subgrid, torch.Tensor) == (name == "finer")
        *_, other = Unrolled(subgrid=None).estimates(refiner, m)
        assert not isinstance(m.subgrid, torch.Tensor) and torch.equal(z, other) == (name == "grid")


@torch.no_grad()
def test_what_finer_voxels_add_is_left_out_of_a_view_that_misses_more_with_it(monkeypatch):
    def spoilt(m: Measurement, *given) -> torch.Tensor:
        found = subgrid_projection(m, *given)
        found[:, 1] += m.y.max()
        return found

    m, m_spoilt = (fine_scene(noise=1e-3)[0] for _ in range(2))
    refiner = tiny_refiner().bind(precision="float32")
    for measurement, step in ((m, subgrid_projection), (m_spoilt, spoilt)):
        monkeypatch.setattr(discretisation, "subgrid_projection", step)
        list(Unrolled().estimates(refiner, measurement))
    assert m.subgrid.abs().amax((2, 3)).min() > 0 and not m_spoilt.subgrid[:, 1].any()
    assert torch.equal(m_spoilt.subgrid[:, ::2], m.subgrid[:, ::2])


EIGHT = ConeBeam.orbit(8, 1020, 740, (28, 28), 20.0)


def contradicted(amount: float) -> Measurement:
    """Eight views of the block, of which view 3 reads `amount` too much over half of its pixels."""
    m = measured(EIGHT, noise=0.005)
    m.y[:, 3, :14] += amount
    return m


class Knowing:
    """A refiner that always answers with the block, and begins half-way to it."""

    schedule, mean, begins = CosineSchedule(), 0.5 * block(), False

    def refine(self, *_):
        return block()


@torch.no_grad()
def test_a_view_that_contradicts_the_others_counts_less_and_x_rays_that_agree_count_as_ever():
    error = {}
    for amount in (0.0, 0.5, 2.0):
        for method in (Unrolled(), Unrolled(contradiction=None)):
            m = contradicted(amount)
            *_, z = method.estimates(Knowing(), m)
            error[amount, method.contradiction] = float((z - block()).norm())
            if amount and method.contradiction:
                variance = m.model_variance.flatten()
                assert variance.argmax() == 3 and variance[3] > 10 * variance.sort().values[-2]
            else:
                assert m.model_variance == 0.0
    assert error[0.0, Unrolled.contradiction] == error[0.0, None]
    for amount in (0.5, 2.0):
        assert error[amount, Unrolled.contradiction] < 0.5 * error[amount, None]


@torch.no_grad()
def test_a_thin_sheet_that_views_see_along_its_face_contradicts_nothing():
    """A couch's, half a voxel thick, which only finer voxels can hold."""
    fine = interpolate(block(), scale_factor=2)
    fine[:, :, 4:28, 7, 4:28] = 1
    projector = Projector(GRID, ConeBeam.orbit(32, 1020, 740, (28, 28), 20.0), full_detector=True)
    y, refiner = FinerProjector(projector)(WINDOW.to_mu(fine)), Knowing()
    y = y + 0.002 * y.max() * torch.randn(y.shape, generator=torch.Generator().manual_seed(0))
    counted = {}
    for asked, method in {True: Unrolled(), False: Unrolled(subgrid=None)}.items():
        m = Measurement(projector, y[0], WINDOW, noise=0.002)
        list(method.estimates(refiner, m))
        counted[asked] = m.model_variance
    assert counted[True] == 0.0 and set(counted[False].flatten().nonzero().flatten().tolist()) == {7, 25}


@torch.no_grad()
def test_what_is_known_of_finer_voxels_counts_once_where_views_are_compared():
    fine = interpolate(block(), scale_factor=2)
    fine[:, :, 4:28, 7, 4:28] = 1
    projector = Projector(GRID, ConeBeam.orbit(8, 1020, 740, (28, 28), 20.0), full_detector=True)
    y = FinerProjector(projector)(WINDOW.to_mu(fine))
    y[:, 3] = y[:, 3].flip(-1)
    z, found = avg_pool3d(fine, 2), []
    for known in (False, True):
        m = Measurement(projector, y[0], WINDOW, noise=0.002)
        if known:
            m.subgrid = subgrid_projection(m, z, Unrolled.subgrid, 0.5)
        before = m.subgrid
        Unrolled()._check_views_fit(m, z, m.project(z), Unrolled.contradiction)
        assert m.subgrid is before
        found.append(m.model_variance)
    assert found[0].max() > 0
    torch.testing.assert_close(found[1], found[0], rtol=0.35, atol=1e-4)


def test_scatter_that_the_first_step_knows_little_of_contradicts_nothing():
    grid, simulator, beam = Grid.cube(64), Polychromatic(scatter=0.06), ConeBeam.orbit(4, 1020, 740, (56, 56), 10.0)
    mu = hu_to_mu(torch.from_numpy(build(Thorax.standard(), grid)[0]).float())
    xrays = simulator(Projector(grid, beam, full_detector=True), mu[None, None], 1)[0]
    two_calls = Unrolled((0.35, 0.25), (0.5, 0.3, 0.3))
    found = reconstruct(xrays, beam, method=two_calls, mu_water=simulator.effective_mu_water)
    assert found.scatter > 0.1 and found.model_variance == 0.0


@pytest.mark.parametrize("simulator", [Polychromatic(), Ideal()], ids=lambda simulator: type(simulator).__name__)
def test_a_tubes_hardening_is_taken_out_and_not_of_what_has_none(simulator):
    grid, window = Grid.cube(64), HUWindow()
    projector = Projector(grid, ConeBeam.orbit(4, 1020, 740, (112, 112), 5.0), full_detector=True)
    hu = torch.from_numpy(build(Thorax.standard(), grid)[0]).float()[None, None].clamp(-1000, 1000)
    m = Measurement(projector, simulator(projector, hu_to_mu(hu), 1)[0], window, mu_water=simulator.effective_mu_water)
    bent, truth, runs = float(m.normalised_residual(window.to_range(hu))), window.to_range(hu), []
    with_hardening(m, lambda: truth, lambda: (runs.append(m.hardened), truth)[1])
    assert m.hardened == isinstance(simulator, Polychromatic) and runs == [True] * m.hardened
    assert float(m.normalised_residual(truth)) < 0.7 * bent or not m.hardened


@pytest.mark.slow
def test_what_was_straightened_stands_in_the_record():
    grid, beam = Grid.cube(64), ConeBeam.orbit(4, 1020, 740, (112, 112), 5.0)
    mu = hu_to_mu(torch.from_numpy(build(Thorax.standard(), grid)[0]).float())
    for simulator in (Polychromatic(), Ideal()):
        xrays = simulator(Projector(grid, beam, full_detector=True), mu[None, None], 1)[0]
        found = reconstruct(xrays, beam, mu_water=simulator.effective_mu_water)
        assert found.hardened == isinstance(simulator, Polychromatic) and found.scatter == 0


def test_what_no_volume_explains_is_said_and_not_where_nothing_counts_as_such():
    xrays, refiner = contradicted(2.0).y[0], tiny_refiner(untrained=True)
    with pytest.warns(UserWarning, match="no volume explains .*: as much of it as contradicts the rest"):
        reconstruct(xrays, EIGHT, refiner, Unrolled(), precision="float32")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "no volume explains")
        reconstruct(xrays, EIGHT, refiner, Unrolled(contradiction=None), precision="float32")


def test_air_and_one_material_in_it_are_no_chest_and_a_body_with_a_hollow_is_another_thing():
    hu, draw = WINDOW.to_hu(block())[0, 0].clone(), torch.Generator().manual_seed(0)
    grain = 20 * torch.randn(hu.shape, generator=draw)
    for air, material in ((hu < 1000, -1000.0), (hu < -900, 0.0), (hu > 1000, 600.0)):
        assert one_material(torch.where(air, -1000.0, material) + grain)
    hu[3:13, 4:8, 2:14] = -800  # an eighth of all
    assert not one_material(hu + grain) and not one_material(1000 * torch.randn(hu.shape, generator=draw))


@pytest.mark.parametrize("share", [1.0, 0.6, 0.5, 0.42])
def test_a_small_chest_is_a_chest_and_a_body_of_its_shape_of_one_material_is_none(share):
    hu = torch.from_numpy(build(Thorax.standard(), Grid.cube(64))[0]).float()[None, None].clamp(-1000, 1000)
    small = interpolate(hu, scale_factor=share, mode="trilinear")
    size = 64 - small.shape[2]
    chest = torch.nn.functional.pad(small, 3 * [size // 2, size - size // 2], value=-1000.0)[0, 0]
    shape = max_pool3d((chest > -900).float()[None], 3, 1, 1)[0]
    blurred = 1000 * avg_pool3d(shape[None], 3, 1, 1)[0] - 1000  # edges as the network's own
    assert not one_material(chest) and one_material(blurred)


def test_what_is_no_chest_is_reconstructed_without_a_network_and_that_is_said():
    projector = Projector(GRID, EIGHT, full_detector=True)
    xrays = projector(torch.full((1, 1, *GRID.shape), 0.02))[0]
    with pytest.warns(UserWarning, match="one material in air and no chest.* reconstructed instead"):
        found = reconstruct(xrays, EIGHT, tiny_refiner(uncertain=True), "phydict_learned", precision="float32")
    assert torch.equal(found.volume, reconstruct(xrays, EIGHT, method="tv", grid=GRID).volume)
    assert found.method == "phydict_learned" and found.network_calls and found.intervals == {}


@pytest.mark.parametrize("subgrid", [None, Unrolled.subgrid], ids=["own voxels", "finer voxels"])
def test_views_in_another_order_give_the_same_volume(subgrid):
    """In double precision: bounds that act or not on single voxels carry the rounding of single precision on."""
    own, order, bound = measured(noise=0.01, dtype=torch.float64), [2, 0, 1], tiny_refiner().double().bind()
    other = Measurement(Projector(GRID, ORBIT.select(order), full_detector=True), own.y[0][order], WINDOW)
    for volume, again in zip(*(Unrolled(subgrid=subgrid).estimates(bound, m) for m in (own, other))):
        torch.testing.assert_close(again, volume, rtol=0, atol=1e-8)


@dataclass(frozen=True)
class Mirrored(BoundRefiner):
    """What a refiner is to a patient whose left is right."""

    @property
    def mean(self) -> torch.Tensor:
        return super().mean.flip(2)

    def refine(self, x: torch.Tensor, t: float, evidence: torch.Tensor) -> torch.Tensor:
        return super().refine(x.flip(2), t, evidence.flip(2)).flip(2)


def of_kind(kind: type[BoundRefiner], bound: BoundRefiner) -> BoundRefiner:
    return kind(*(getattr(bound, field.name) for field in fields(bound)))


def test_mirrored_views_and_a_mirrored_network_give_the_mirrored_volume():
    """Without total variation, whose forward differences know left from right."""
    own, mirror = measured(noise=0.01, dtype=torch.float64), np.array([-1.0, 1.0, 1.0])
    beam = ConeBeam(ORBIT.sources * mirror, ORBIT.detectors * mirror, ORBIT.u * mirror, ORBIT.v * mirror, ORBIT.shape)
    other = Measurement(Projector(GRID, beam, full_detector=True), own.y[0], WINDOW)
    bound = tiny_refiner().double().bind(precision="float32")
    plain = replace(Unrolled(subgrid=None), **{name: replace(getattr(Unrolled, name), tv_weight=0.0)
                                               for name in ("start", "likelihood", "final_likelihood")})
    for volume, mirrored in zip(plain.estimates(bound, own), plain.estimates(of_kind(Mirrored, bound), other)):
        torch.testing.assert_close(mirrored.flip(2), volume, rtol=0, atol=1e-10)
        assert (mirrored - volume).abs().mean() > 0.1


@dataclass(frozen=True)
class Oracle(BoundRefiner):
    """Knows the truth."""

    def refine(self, x: torch.Tensor, t: float, evidence: torch.Tensor) -> torch.Tensor:
        return torch.cat([block().to(x), x[:, 1:]], 1)


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.03])
def test_the_truth_is_kept_and_x_rays_are_met_to_their_noise(noise):
    m = measured(noise=noise)
    *_, found = COARSE.estimates(of_kind(Oracle, tiny_refiner().bind()), m)
    residual = (m.project(found[:, :1]) - m.y).square().mean().sqrt() / (noise * measured().y.max())
    assert 0.7 < residual < 1.1
    assert WINDOW.half_width * (found[:, :1] - block()).square().mean().sqrt() < 3e3 * noise + 5


@pytest.mark.skipif(not computes_bfloat16(torch.device("cpu")), reason="this processor does not compute bfloat16")
def test_bfloat16_changes_the_reconstruction_of_the_example_by_less_than_2_hu():
    case = load_xrays(Path(__file__).parents[2] / "data" / "example" / "xrays")
    xrays, beam = case["xrays"][::4], case["beam"].select(slice(None, None, 4))
    full, half = (reconstruct(xrays, beam, precision=kind).volume for kind in ("float32", "bfloat16"))
    assert 0 < (full - half).square().mean().sqrt() < 2


@pytest.mark.parametrize("beam", OTHERS.values(), ids=OTHERS)
def test_any_number_of_views_and_any_geometry_is_reconstructed_within_the_bounds(beam):
    found = reconstruct(measured(beam, noise=0.02).y[0], beam, tiny_refiner(), COARSE, precision="float32")
    assert found.volume.isfinite().all() and found.volume.min() >= -1000 and found.volume.max() <= 600
    calls = 6 if beam.views > 12 else 4
    assert found.network_calls in (calls, 2 * calls)  # twice where a misfit of so coarse a grid looks like scatter
    assert found.misfit < 0.1  # an untrained network's estimates are met by the likelihood steps all the same


def test_from_twelve_views_on_two_more_calls_follow_that_a_progress_bar_does_not_count():
    for views, calls in ((11, 4), (12, 6)):
        m, steps, refiner = measured(ConeBeam.orbit(views, 1020, 740, (28, 28), 20.0)), [], tiny_refiner()
        answers = list(COARSE.estimates(refiner.bind(precision="float32"), m, lambda: steps.append(1)))
        assert len(answers) == calls + 1 and len(steps) == COARSE.steps() == 5


@pytest.mark.parametrize("views", [23, 24])
def test_from_24_views_on_the_last_step_is_another(views):
    m, refiner = measured(ConeBeam.orbit(views, 1020, 740, (28, 28), 20.0)), tiny_refiner().bind(precision="float32")
    method = replace(COARSE, times=(0.2,), x0_stds=(0.5, 0.3), more_times=(), subgrid=None)
    few = replace(method, many_views=25)
    many = replace(few, final_likelihood=method.last_step(24))
    own, of_few, of_many = (list(sampler.estimates(refiner, m))[-1] for sampler in (method, few, many))
    assert torch.equal(own, of_few) == (views < 24) and torch.equal(own, of_many) == (views >= 24)


def test_the_result_does_not_depend_on_the_seed():
    y = measured().y[0]
    volumes = [reconstruct(y, ORBIT, tiny_refiner(), "phydict_learned", seed=seed).volume for seed in (0, 1)]
    assert torch.equal(*volumes)


def test_a_refiners_file_gives_it_back(tmp_path):
    refiner = tiny_refiner()
    save_refiner(refiner, tmp_path / "refiner.safetensors", dtype=torch.float32)
    again = load_prior(tmp_path / "refiner.safetensors")
    assert isinstance(again, Refiner) and isinstance(again.prior, Prior)
    x, t, evidence = torch.randn(1, 4, *GRID.shape), torch.tensor([0.3]), torch.randn(1, 5, *GRID.shape)
    for report in ("", "Small nodule in the left upper lobe."):
        contexts = [r.bind(report).context for r in (refiner, again)]
        assert torch.equal(refiner(x, t, contexts[0], evidence), again(x, t, contexts[1], evidence))


def test_a_report_reaches_the_refiner():
    y = measured().y[0]
    volumes = [reconstruct(y, ORBIT, tiny_refiner(), "phydict_learned", report=report, precision="float32").volume
               for report in (None, "Small nodule in the left upper lobe.")]
    assert not torch.equal(*volumes)


def test_display_values_are_reconstructed_whatever_their_gain():
    y = measured().y[0]
    volumes = [reconstruct(gain * y + 0.1, ORBIT, tiny_refiner(), COARSE, display=True,
                           precision="float32").volume for gain in (0.5, 2.0)]
    assert (volumes[0] - volumes[1]).abs().mean() < 2


def test_a_second_stage_refines_what_it_gives():
    fine = tiny_super_resolution()
    found = reconstruct(measured(noise=0.01).y[0], ORBIT, tiny_refiner(), "phydict_learned", super_resolution=fine,
                        precision="float32")
    assert found.grid.same_as(fine.grid) and found.volume.isfinite().all() and found.misfit < 0.1


def test_what_does_not_fit_is_refused_in_a_sentence(tmp_path):
    y = measured().y[0]
    with pytest.raises(ValueError, match="Unrolled needs a refiner, but the file is a prior"):
        reconstruct(y, ORBIT, tiny_prior(), "phydict_learned")
    with pytest.raises(ValueError, match="PriorOnly needs a prior, but the file is a refiner"):
        Posterior(tiny_refiner(), PriorOnly())
    with pytest.raises(ValueError, match="leave samples at 1"):
        reconstruct(y, ORBIT, tiny_refiner(), "phydict_learned", samples=2)
    with pytest.raises(ValueError, match="guided by the X-rays alone"):
        reconstruct(y, ORBIT, tiny_refiner(), "phydict_learned", guidance=2.0)
    with pytest.raises(ValueError, match="needs a prior with a detail network"):
        Refiner(tiny_prior(), torch.zeros(4, *GRID.shape))
    for change, words in (({"times": ()}, "one or more"), ({"times": (0.0,), "x0_stds": (1, 1)}, "between 0 and 1"),
                          ({"more_times": (1.0,)}, "between 0 and 1"),
                          ({"x0_stds": (0.1,)}, "5 numbers, one more"), ({"x0_stds": (0, 1, 1, 1, 1)}, "x0_stds lies"),
                          ({"x0_stds": (1e200, 1, 1, 1, 1)}, "x0_stds lies"),
                          ({"contradiction": -1.0}, "contradiction lies")):
        with pytest.raises(ValueError, match=words):
            replace(METHODS["phydict_learned"], **change)
    save_prior(tiny_prior(), tmp_path / "prior.safetensors")
    with pytest.raises(ValueError, match="needs a refiner"):
        reconstructor("phydict_learned", tmp_path / "prior.safetensors")
