"""Refinement on finer voxels: what it keeps, what it gains, and regions of interest."""

import os
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from fitting import fit_to_grid
from laws import random_like
from prior.tiny import tiny_prior, tiny_refiner, tiny_super_resolution

from phydict.baselines import CGLS, FDK, FISTATV, SIRT, Region
from phydict.grid import Grid
from phydict.methods import onto_grid, reconstruct, reconstructor
from phydict.posterior import Measurement, Posterior, PriorOnly, ProximalCG, Refined, Refinement, Unrolled
from phydict.prior import CorrectionNetwork
from phydict.prior.uncertainty import LEVELS
from phydict.runtime.memory import check_memory, free_memory
from phydict.units import HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.calibration import without_hardening

BEAM = replace(ConeBeam.orbit(6, 1020, 740, (56, 56), 10.0), continued=False)
COARSE, FINE, WINDOW = Grid.cube(16), Grid.cube(64), HUWindow(-1000, 600)


def chest() -> torch.Tensor:
    """HU (64, 64, 64) of an ellipse with two lungs and a small dense rod."""
    x, y, z = torch.meshgrid(*[torch.linspace(-190, 190, 64)] * 3, indexing="ij")
    hu = torch.full(FINE.shape, -1000.0)
    hu[((x / 150) ** 2 + (y / 105) ** 2 < 1) & (z.abs() < 170)] = 30.0
    hu[(((x.abs() - 70) / 50) ** 2 + (y / 75) ** 2 < 1) & (z.abs() < 130)] = -800.0
    hu[((x - 70) ** 2 + (y - 10) ** 2 < 14**2) & (z.abs() < 60)] = 60.0
    return hu


@pytest.fixture(scope="module")
def xrays() -> torch.Tensor:
    return Projector(FINE, BEAM, full_detector=True)(hu_to_mu(chest())[None, None])[0]


class Known:
    """A method that is bound to voxels and knows the chest there by its means."""

    full_detector, citation, mu_water, name, window, survey = False, "known", 0.02, "known", WINDOW, None
    precision, volumes = "float32", 20

    def __init__(self, voxels: int = 16):
        self.grid = Grid.cube(voxels)

    def steps(self):
        return 1

    def with_mu_water(self, mu_water):
        return self

    def reconstruct(self, xrays, projector, report="", display=False, seed=0, on_step=lambda: None):
        found = reconstructor(PriorOnly(1), tiny_prior(False)).reconstruct(
            *fit_to_grid(self, Grid.cube(16), xrays, projector.beam), display=display)
        factor = 64 // self.grid.shape[0]
        on_step()
        return replace(found, volume=torch.nn.functional.avg_pool3d(chest()[None], factor)[0], grid=self.grid,
                       masks=torch.rand(2, *self.grid.shape), deviation=torch.ones(self.grid.shape))


def refined(grid: Grid, xrays: torch.Tensor, refinement: Refinement = Refinement(), voxels: int = 16, **settings):
    ready = Refined(Known(voxels), grid, refinement)
    return ready.reconstruct(*fit_to_grid(ready, grid, xrays, BEAM), **settings)


def error(volume: torch.Tensor, truth: torch.Tensor) -> float:
    return float((volume - truth).square().mean().sqrt())


def test_a_network_on_finer_voxels_computes_as_the_base_does(xrays):
    asked = []

    class Asked(Watched):
        def __init__(self):
            pass

        def corrected(self, z, evidence, precision):
            asked.append(precision)
            return z

    ready = Refined(Known(), Grid.cube(32), networks=(Asked(),))
    ready.reconstruct(*fit_to_grid(ready, ready.grid, xrays, BEAM))
    assert asked == ["float32"] * 2


@pytest.mark.parametrize("sign", [1, -1])
def test_a_network_that_leads_away_from_the_x_rays_is_told_of(xrays, sign):
    class Fitting(Known):
        def reconstruct(self, *given, **settings):
            found = super().reconstruct(*given, **settings)
            return replace(found, reprojection=found.xrays)

    class Turns(Watched):
        def __init__(self):
            pass

        def corrected(self, z, evidence, precision):
            return sign * z

    ready = Refined(Fitting(), FINE, networks=(Turns(),))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = ready.reconstruct(*fit_to_grid(ready, FINE, xrays, BEAM))
    told = [str(warning.message) for warning in caught if "does not explain the X-rays" in str(warning.message)]
    assert (len(told), found.misfit > 0.5) == ((0, False) if sign == 1 else (1, True))


@pytest.mark.parametrize("learnt, correcting", [
    ([32, 64], [32, 32, 64, 64]), ([32], [32, 32, 32, 32]), ([64], [64, 64])])
def test_voxels_are_corrected_by_the_network_that_learnt_on_them_or_on_twice_as_long_ones(xrays, learnt, correcting):
    asked = []

    class Noted(CorrectionNetwork):
        def corrected(self, z, evidence, precision="auto"):
            asked.append(self.grid.shape[0])
            return z

    networks = tuple(Noted((4, 8), 4, Grid.cube(voxels), WINDOW) for voxels in learnt)
    ready = Refined(Known(), FINE, networks=networks)
    ready.reconstruct(*fit_to_grid(ready, FINE, xrays, BEAM))
    assert asked == correcting


def test_a_method_in_a_box_holds_as_many_volumes_as_without():
    region = Grid.box(24, 144.0, (48.0, 0.0, 0.0))
    assert onto_grid(FISTATV(), region).volumes == FISTATV().volumes > Refined(Known(), region).volumes


def test_the_own_grid_is_no_refinement_and_changes_nothing(xrays):
    prior = tiny_prior(False)
    own, same = (reconstruct(xrays, BEAM, prior, PriorOnly(2), grid=grid) for grid in (None, Grid.cube(16)))
    assert own.volume.equal(same.volume) and same.coarse is None


@pytest.mark.parametrize("grid, factor", [(Grid.cube(8), 2), (Grid((16, 16, 4), (24.0, 24.0, 96.0)), (1, 1, 4))])
def test_on_voxels_no_finer_than_the_base_s_the_result_is_its_averages_with_its_misfit(xrays, grid, factor):
    found, base = refined(grid, xrays), Known()
    coarse = found.coarse
    assert found.grid is grid and found.misfit == coarse.misfit and Refined(base, grid).steps() == base.steps()
    for of_target, of_base in ((found.volume, coarse.volume), (found.deviation, coarse.deviation),
                               (found.masks, coarse.masks)):
        torch.testing.assert_close(of_target, torch.nn.functional.avg_pool3d(
            of_base.view(-1, 1, *COARSE.shape), factor).view_as(of_target))


def test_on_coarser_voxels_a_method_sees_as_many_pixels_as_on_its_own(xrays):
    method = Unrolled((0.2,), (0.5, 0.3))
    own, few = (reconstruct(xrays, BEAM, tiny_refiner(), method, precision="float32", grid=grid)
                for grid in (None, Grid.cube(8)))
    assert few.coarse.volume.equal(own.volume) and few.xrays.shape == own.xrays.shape
    torch.testing.assert_close(few.volume, torch.nn.functional.avg_pool3d(own.volume[None], 2)[0])


def test_refining_leaves_what_explains_the_xrays_to_the_solvers_tolerance():
    x = WINDOW.to_range(chest())[None, None].double()
    projector = Projector(FINE, BEAM, full_detector=True)
    y = projector(WINDOW.to_mu(x))[0]
    noise = 1e-4 * y.max() * random_like(y.shape)
    for observed, tolerance in ((y, 1e-9), (y + noise, 2e-3)):
        z = ProximalCG(10, 3)(Measurement(projector, observed, WINDOW), x, 0.2)
        assert error(z, x) < tolerance


def test_meeting_the_xrays_on_fine_voxels_beats_interpolation(xrays):
    interpolated, met = (refined(FINE, xrays, refinement) for refinement in (Refinement(None), Refinement()))
    assert met.misfit < 0.3 * interpolated.misfit
    assert error(met.volume, chest()) < 0.8 * error(interpolated.volume, chest())
    assert met.volume.shape == met.masks.shape[1:] == met.deviation.shape == FINE.shape and met.grid is FINE
    assert met.coarse.volume.shape == (16,) * 3 and met.projector_calls > interpolated.projector_calls


def test_what_was_refined_before_is_met_as_after_a_correction():
    projector, refinement = Projector(FINE, BEAM, full_detector=True), Refinement()
    x = WINDOW.to_range(chest())[None, None]
    y = 1.1 * projector(WINDOW.to_mu(x))[0]
    first, later = (refinement(Measurement(projector, y, WINDOW), x, None, refined=known) for known in (False, True))
    assert later.equal(refinement.call_step(Measurement(projector, y, WINDOW), x, refinement.call_std))
    assert first.equal(refinement.step(Measurement(projector, y, WINDOW), x, refinement.x0_std))


class Watched:
    """Corrects nothing on any voxels, and keeps what noise it is told of and what there is."""

    def __init__(self, measurement: Measurement):
        self.measurement, self.told = measurement, []

    def suits(self, grid, window):
        return True

    def corrected(self, z, evidence, precision):
        noise = self.measurement.noise_variance.mean().sqrt() / self.measurement.y.max()
        self.told.append((10 ** (float(evidence[0, 4].mean()) - 2), float(noise)))
        return z


def test_a_correction_makes_the_back_projection_of_ones_once_and_is_told_of_the_noise_as_it_is():
    projector, x = Projector(COARSE, BEAM), WINDOW.to_range(torch.nn.functional.avg_pool3d(chest()[None], 4))[None]
    y = projector(WINDOW.to_mu(x))[0]
    y = 5 + 3 * (y + 0.05 * random_like(y.shape))

    def used(calls: int) -> tuple[int, list]:
        measurement = Measurement(projector, y, WINDOW, display=True)
        network = Watched(measurement)
        refinement = Refinement(ProximalCG(1, 1), calls=calls, call_step=None, mirrored=False)
        refinement(measurement, x.clamp(-1, 0.5), network)
        return measurement.calls, network.told

    (none, _), (once, _), (thrice, told) = (used(calls) for calls in (0, 1, 3))
    assert once - none == 4 and thrice - once == 2 * 3  # evidence takes two, a refit one, and A' 1 is the first's
    assert all(seen == pytest.approx(noise, rel=1e-4) for seen, noise in told)
    assert told[0] != pytest.approx(told[1], rel=1e-2)


class Sure(Known):
    """The same with intervals of 10 HU at levels of its own."""

    def __init__(self, *levels: float):
        super().__init__()
        self.levels = levels

    def reconstruct(self, *args, **settings):
        wide = torch.full(self.grid.shape, 10.0)
        return replace(super().reconstruct(*args, **settings), intervals=dict.fromkeys(self.levels, wide))


def test_intervals_of_any_levels_are_made_on_finer_voxels_by_shares_between_those_of_the_known_ones(xrays):
    ready = Refined(Sure(0.3, 0.5, 0.68, 0.8, 0.93, 0.95, 0.99), Grid.cube(32))
    found = ready.reconstruct(*fit_to_grid(ready, ready.grid, xrays, BEAM)).intervals
    assert list(found) == list(ready.base.levels)
    torch.testing.assert_close(found[0.68], 0.4 * found[0.5] + 0.6 * found[0.8])
    assert found[0.3].equal(found[0.5]) and found[0.99].equal(found[0.95])
    assert (found[0.93] <= found[0.95]).all() and found[0.93].mean() < found[0.95].mean()


def test_a_network_that_knows_intervals_of_the_usual_levels_leaves_others_alone(xrays):
    class Knowing(Watched):
        def __init__(self):
            pass

        def corrected(self, z, evidence, precision):
            return z

        def half_widths(self, level, seen, precision):
            return torch.zeros(1, len(LEVELS), *level.shape)

    for levels, known in ((LEVELS, True), ((0.68,), False), ((0.68, 0.9), False)):
        ready = Refined(Sure(*levels), Grid.cube(32), networks=(Knowing(),))
        found = ready.reconstruct(*fit_to_grid(ready, ready.grid, xrays, BEAM)).intervals
        assert tuple(found) == levels and all((width == 0).all() == known for width in found.values())


def test_what_contradicts_counts_as_noise_on_finer_voxels_too(xrays):
    class Doubting(Known):
        def reconstruct(self, *args, **settings):
            return replace(super().reconstruct(*args, **settings), model_variance=doubt)

    def fits(doubted: torch.Tensor) -> list[float]:
        nonlocal doubt
        doubt, ready = doubted, Refined(Doubting(), FINE)
        return ready.reconstruct(*fit_to_grid(ready, FINE, xrays, BEAM)).misfit_per_view

    doubt = torch.zeros(6, 1, 1)
    plain, second = fits(doubt), fits(torch.tensor([0.0, 1, 0, 0, 0, 0])[:, None, None])
    assert second[1] > 1.5 * plain[1] and second[0] < 1.1 * plain[0]


def test_line_integrals_that_the_base_straightened_are_straight_on_finer_voxels(xrays):
    class Hardened(Known):
        def reconstruct(self, *args, **settings):
            return replace(super().reconstruct(*args, **settings), hardened=True)

    plain, straight = (Refined(known(), Grid.cube(32)).reconstruct(*fit_to_grid(Known(32), Grid.cube(32), xrays, BEAM))
                       for known in (Known, Hardened))
    torch.testing.assert_close(straight.xrays, without_hardening(plain.xrays, Known.mu_water))


def test_a_refined_method_is_refined_to_other_voxels_from_its_base(xrays):
    ready = onto_grid(reconstructor("phydict_fast", tiny_prior(False)), Grid.cube(32))
    again = onto_grid(ready, Grid.cube(48))
    assert again.base == ready.base and again.target.same_as(Grid.cube(48)) and again.refinement == ready.refinement
    assert onto_grid(ready, Grid.cube(32)) is ready


def test_x_rays_in_double_precision_are_refined_by_networks_in_single(xrays):
    ready = onto_grid(Posterior(tiny_refiner(False), Unrolled(), precision="float32"), Grid.cube(32))
    y, projector = fit_to_grid(ready, Grid.cube(32), xrays, BEAM)
    assert torch.equal(ready.reconstruct(y.double(), projector).volume, ready.reconstruct(y, projector).volume)


@pytest.mark.filterwarnings("ignore:samples are drawn on the prior")
def test_every_level_is_one_step_and_figures_belong_to_the_volume(xrays):
    steps, target = [], Grid.box((31, 40, 27), (384, 390, 390))
    ready = Refined(Known(), target)
    y, projector = fit_to_grid(ready, target, xrays, BEAM)
    found = ready.reconstruct(y, projector, on_step=lambda: steps.append(1))
    assert len(steps) == ready.steps() == 2 and set(found.seconds) == {"base", "refine", "score"}
    again = projector(hu_to_mu(found.volume)[None, None])[0]
    torch.testing.assert_close(found.reprojection, again, rtol=1e-5, atol=1e-4)
    assert found.misfit == pytest.approx(float((found.reprojection - y).norm() / y.norm()), rel=1e-4)


class Bare(Known):
    """The same without masks and deviation."""

    def reconstruct(self, *args, **settings):
        return replace(super().reconstruct(*args, **settings), masks=torch.zeros(0, 16, 16, 16), deviation=None)


def test_what_has_no_masks_is_refined_too(xrays):
    ready = Refined(Bare(), Grid.cube(24))
    found = ready.reconstruct(*fit_to_grid(ready, ready.target, xrays, BEAM))
    assert found.masks.shape == (0, 24, 24, 24) and found.deviation is None


def test_a_region_is_the_full_reconstruction_inside_its_box(xrays):
    """To 60 HU in the root mean square where the coarse volume outside is right to its voxels' 24 mm, and 4 times
    better than where nothing is known of the outside."""
    inner = (slice(24, 56), slice(16, 48), slice(20, 44))  # of a lung and the rod, cut laterally
    region = Grid.box((32, 32, 24), (192.0, 192.0, 144.0), (48.0, 0.0, 0.0))
    np.testing.assert_allclose(region.affine[:3, 3], FINE.affine[:3, :3] @ [24, 16, 20] + FINE.affine[:3, 3])
    full, part = refined(FINE, xrays, voxels=32).volume[inner], refined(region, xrays, voxels=32)
    assert error(part.volume, full) < 60
    alone = FISTATV(60).reconstruct(*fit_to_grid(FISTATV(), region, xrays, BEAM))
    assert error(part.volume, full) < 0.25 * error(alone.volume, full)
    assert part.misfit < 0.05 and part.xrays.max() == pytest.approx(float(xrays.max()), rel=0.05)


@pytest.mark.parametrize("method", [SIRT(40), CGLS(10, 3, HUWindow()), FISTATV(30)],
                         ids=lambda method: method.name)
def test_a_method_without_a_prior_accounts_for_what_lies_outside_its_box(xrays, method):
    region = Grid.box((24, 32, 24), (144.0, 192.0, 144.0), (48.0, 0.0, 0.0))
    truth = chest()[28:52, 16:48, 20:44]
    ready = onto_grid(method, region)
    assert isinstance(ready, Region) and ready.steps() == 2 * method.steps()
    y, projector = fit_to_grid(ready, region, xrays, BEAM)
    part, alone = (way.reconstruct(y, projector) for way in (ready, method))
    assert error(part.volume, truth) < 0.8 * error(alone.volume, truth)
    assert part.coarse.grid.shape == (64, 64, 64) and part.grid is region


@pytest.mark.parametrize("method", [SIRT(40), FISTATV(15)], ids=lambda method: method.name)
def test_a_box_means_the_same_in_whatever_directions_its_voxels_are_stacked(xrays, method):
    box = Grid.box((24, 32, 20), (144.0, 192.0, 120.0), (48.0, 0.0, 0.0))
    flipped, permuted = box.affine.copy(), box.affine[:, [2, 0, 1, 3]]
    flipped[:3, :2] *= -1
    flipped[:3, 3] += box.affine[:3, :3] @ (23, 31, 0)
    usual, lps, turned = (reconstruct(xrays, BEAM, method=method, grid=grid)
                          for grid in (box, Grid(box.shape, affine=flipped), Grid((20, 24, 32), affine=permuted)))
    assert error(lps.volume.flip(0, 1), usual.volume) < 15
    truth = chest()[28:52, 16:48, 22:42]  # another projector suits the last one
    assert error(turned.volume.permute(1, 2, 0), truth) < 1.25 * error(usual.volume, truth)
    assert lps.misfit == pytest.approx(usual.misfit, rel=1e-3)
    with pytest.raises(ValueError, match="give voxels whose third axis is superior, or leave out `continued`"):
        reconstruct(xrays, replace(BEAM, continued=True), method=method, grid=turned.grid)


def test_a_local_method_gives_in_a_box_what_it_gives_there_in_the_whole(xrays):
    region = Grid.box((24, 32, 24), (144.0, 192.0, 144.0), (48.0, 0.0, 0.0))
    whole, part = (reconstruct(xrays, BEAM, method="fdk", grid=grid) for grid in (None, region))
    torch.testing.assert_close(part.volume, whole.volume[28:52, 16:48, 20:44], atol=0.1, rtol=1e-4)
    assert part.misfit == pytest.approx(whole.misfit, rel=0.3)


def test_display_values_are_matched_by_what_the_coarse_volume_shows(xrays):
    region = Grid.box(24, 144.0, (48.0, 0.0, 0.0))
    for ready in (onto_grid(CGLS(10, 3, HUWindow()), region), Refined(Known(), region)):
        y, projector = fit_to_grid(ready, region, 7 + 3 * xrays, BEAM)
        found = ready.reconstruct(y, projector, display=True)
        assert (found.xrays - fit_to_grid(ready, region, xrays, BEAM)[0]).norm() < 0.2 * xrays.norm()


def test_a_trained_stage_comes_before_the_refinement(xrays):
    ready = onto_grid(reconstructor(PriorOnly(2), tiny_prior(False), super_resolution=tiny_super_resolution()),
                      Grid.cube(64))
    assert [level.shape[0] for level in ready.levels] == [64] and ready.base.grid.shape[0] == 32
    assert onto_grid(ready.base, Grid.cube(32)) is ready.base
    found = ready.reconstruct(*fit_to_grid(ready, FINE, xrays, BEAM))
    assert found.coarse.volume.shape == (32,) * 3 and found.misfit < found.coarse.misfit


@pytest.mark.parametrize("ready", [
    Region(FDK(name="mine"), Grid.cube(24), FINE), Refined(reconstructor(PriorOnly(2), tiny_prior(False)), FINE)],
    ids=lambda ready: type(ready).__name__)
def test_a_method_that_works_by_another_one_is_asked_what_that_is_asked(ready):
    told, base = ready.with_mu_water(0.016), ready.base
    assert told == replace(ready, base=base.with_mu_water(0.016)) and told.mu_water == 0.016 != ready.mu_water
    assert (told.name, told.citation, told.full_detector) == (base.name, base.citation, base.full_detector)
    assert told.grid is ready.target and base.citation
    assert ready.with_name("other") == replace(ready, base=base.with_name("other"))
    assert ready.with_name("other").name == "other" != ready.name
    assert ready.with_precision("bfloat16").base.precision == ready.with_precision("bfloat16").precision == "bfloat16"


def test_the_attenuation_of_water_reaches_every_level(xrays):
    way = {"prior": tiny_prior(False), "method": PriorOnly(2), "grid": Grid.cube(32)}
    usual = reconstruct(xrays, BEAM, **way).volume
    told, untold = (reconstruct(0.8 * xrays, BEAM, **way, **more).volume for more in ({"mu_water": 0.016}, {}))
    assert error(told, usual) < 0.2 * error(untold, usual)


@pytest.mark.parametrize("height, words", [(480.0, "384 x 384 x 384 mm alone.* deviation is 0"), (384.0, "")])
def test_a_deviation_that_ends_with_the_priors_box_is_told_of(xrays, height, words):
    target = Grid.box(32, (384.0, 384.0, height))
    ready = Refined(reconstructor(PriorOnly(2), tiny_prior(False), samples=2), target)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = ready.reconstruct(*fit_to_grid(ready, target, xrays, BEAM))
    told = " ".join(str(warning.message) for warning in said)
    assert bool(result.deviation[0, 0, 0] == 0) == ("deviation is 0" in told) == bool(words)
    assert re.search(words, told)


@pytest.mark.parametrize("method", [PriorOnly(2), SIRT(2)], ids=["prior", "sirt"])
def test_more_voxels_than_memory_are_refused_with_their_gib_before_work_starts(xrays, monkeypatch, method):
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**18}.__getitem__)  # 1 GiB
    steps, grid = [], Grid.cube(300)
    with pytest.raises(ValueError, match=r"300 x 300 x 300 voxels.* would take [\d,.]+ GiB of memory.* has 1\.0"):
        reconstruct(xrays, BEAM, tiny_prior(False), method, grid=grid, on_step=lambda: steps.append(1))
    assert not steps


@pytest.mark.parametrize("limit", [f"{2**30}\n", "max\n"])
def test_a_container_has_the_memory_that_it_may_use(tmp_path, monkeypatch, limit):
    (tmp_path / "memory.max").write_text(limit)
    monkeypatch.setattr("phydict.runtime.memory.CONTROL_GROUPS", (tmp_path / "memory.max", tmp_path / "not there"))
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**19}.__getitem__)  # 2 GiB
    has = "2.0" if limit == "max\n" else "1.0"
    check_memory(2**30 - 1, "it", "take less")
    with pytest.raises(ValueError, match=f"3.0 GiB of memory, but this machine has {has}; take less"):
        check_memory(3 * 2**30, "it", "take less")


def meminfo(folder, monkeypatch, gib: float) -> None:
    """The system says that so much memory is free, and that this process holds 1 GiB."""
    (folder / "meminfo").write_text(f"MemTotal: 8388608 kB\nMemAvailable: {gib * 2**20:.0f} kB\nSwapFree: 1024 kB\n")
    (folder / "statm").write_text(f"1 {2**30 // os.sysconf('SC_PAGE_SIZE')} 0\n")
    for name in ("MEMINFO", "STATM"):
        monkeypatch.setattr(f"phydict.runtime.memory.{name}", folder / name.lower())


def test_voxels_for_which_other_programs_leave_too_little_memory_are_refused_before_work_starts(
        xrays, tmp_path, monkeypatch):
    steps, way = [], {"prior": tiny_prior(False), "method": PriorOnly(2), "grid": Grid.cube(32)}
    meminfo(tmp_path, monkeypatch, 0.1)
    with pytest.raises(ValueError, match=r"32 x 32 x 32 voxels.* would take 1\.2 GiB of memory, but of the [\d.]+ that "
                       r"this machine has other programs leave 1\.1 at present; end some of them, or give fewer"):
        reconstruct(xrays, BEAM, **way, on_step=lambda: steps.append(1))
    assert not steps
    meminfo(tmp_path, monkeypatch, 0.5)
    reconstruct(xrays, BEAM, **way)


@pytest.mark.parametrize("limit, usage, files", [("memory.max", "memory.current", "{}active_file"),
                                                 ("memory.limit_in_bytes", "memory.usage_in_bytes",
                                                  "total_{}active_file")])
def test_of_a_containers_memory_what_it_uses_is_not_free_but_files_that_give_way(
        tmp_path, monkeypatch, limit, usage, files):
    meminfo(tmp_path, monkeypatch, 6.0)
    monkeypatch.setattr("phydict.runtime.memory.CONTROL_GROUPS", (tmp_path / limit,))
    for name, text in ((limit, 4 * 2**30), (usage, 3 * 2**30),
                       ("memory.stat", f"anon 5\n{files.format('in')} {2**28}\n{files.format('')} {2**28}")):
        (tmp_path / name).write_text(f"{text}\n")
    assert free_memory() == 2**30 + 2**29 + 2**30
    (tmp_path / usage).unlink()
    assert free_memory() is None
