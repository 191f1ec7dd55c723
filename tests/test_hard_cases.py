"""Data and settings at the limits: every run ends finite or with one sentence, and tells where it went astray."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from prior.tiny import REPORTS, tiny_prior, tiny_refiner
from scenes import voxel_centres

from phydict import METHODS, ConeBeam, Grid, HUWindow, Projector, reconstruct
from phydict.baselines import CGLS, FISTATV, SIRT, DiffVox
from phydict.diffusion import CosineSchedule, GaussianDenoiser
from phydict.guard import check_ceiling, half_mass_density, risen_from
from phydict.methods import reconstructor
from phydict.posterior import (
    DAPS,
    DDS,
    DPS,
    DiffPIR,
    ExactDraw,
    GradientSteps,
    Langevin,
    PnPDM,
    Posterior,
    PriorOnly,
    ProximalCG,
    SplitGibbs,
)
from phydict.runtime.warning import heard
from phydict.xray import Ideal, Polychromatic
from phydict.xray.checks import (
    check_clipped,
    check_flat,
    check_line_integrals,
    check_offset,
    check_repeated,
    prepared_xrays,
    with_air_at_zero,
)
from phydict.xray.residuals import misfits

pytestmark = [pytest.mark.filterwarnings(f"ignore:{said}") for said in
              ("no volume was found", "the largest line integral", "the misfit rose")]
GRID = Grid.cube(16)
BEAM = ConeBeam.orbit(8, 1020, 740, (24, 24), 24.0)
FULL = METHODS["phydict_fast"]
FAST = replace(FULL, iterations=5, likelihood=replace(FULL.likelihood, iterations=4),
               final_likelihood=replace(FULL.final_likelihood, iterations=8, restarts=2))
PLAIN = replace(FULL, iterations=5, scatter=False, hardening=False, metal=None)  # in one pass
SAMPLERS = {
    "fast": FAST, "paper": SplitGibbs(4, GradientSteps(), ec_delta=0.3, ec_steps=2),
    "released": replace(METHODS["phydict_released"], iterations=1, ec_steps=1),
    "daps": DAPS(levels=3, flow_steps=1, likelihood=ExactDraw(3), prior_std=0.5),
    "daps langevin": DAPS(levels=3, flow_steps=1, likelihood=Langevin(5)),
    "pnp_dm": PnPDM(iterations=4, decay=0.5, levels=3, likelihood=ExactDraw(3), burn_in=2, thinning=1),
    "diffpir": DiffPIR(4), "dds": DDS(4), "dps": DPS(4, 3.0), "prior": PriorOnly(2)}
BASELINES = {"sirt": SIRT(50), "cgls": CGLS(5, 4, HUWindow()), "tv": FISTATV(30), "diffvox": DiffVox(20),
             "fdk": METHODS["fdk"]}
METHOD = pytest.mark.parametrize("name", [*SAMPLERS, *BASELINES])


def body(grid: Grid = GRID) -> torch.Tensor:
    """Attenuation (1, 1, X, Y, Z) in 1/mm of an ellipse with two lungs and a heart, fainter towards the top."""
    x, y, z = np.moveaxis((voxel_centres(grid) - grid.centre) / grid.extent * 2, -1, 0)
    trunk = (x / 0.8) ** 2 + (y / 0.55) ** 2 < 1
    lungs = ((abs(x) - 0.4) / 0.27) ** 2 + (y / 0.4) ** 2 + (z / 0.8) ** 2 < 1
    heart = ((x + 0.15) / 0.3) ** 2 + ((y - 0.2) / 0.25) ** 2 + ((z + 0.3) / 0.4) ** 2 < 1
    mu = 0.02 * trunk - 0.015 * (lungs & ~heart) - 0.002 * z * trunk
    return torch.as_tensor(mu, dtype=torch.float32)[None, None]


def views(mu: torch.Tensor | None = None, beam: ConeBeam = BEAM, simulator: Ideal = Ideal()) -> torch.Tensor:
    return simulator(Projector(GRID, beam, full_detector=True), body() if mu is None else mu, 0)[0]


CLEAN = views()


def changed(change, view: int = 3) -> torch.Tensor:
    """The views, of which one is changed."""
    xrays = CLEAN.clone()
    xrays[view] = change(xrays[view])
    return xrays


def metal() -> torch.Tensor:
    mu = body()
    mu[..., 8, 5, 6:9] = 0.5
    return mu


def water(level: float) -> torch.Tensor:
    return torch.full((1, 1, *GRID.shape), level)


def orbit(views: int, degrees: float = 360.0, shape: tuple[int, int] = (24, 24)) -> ConeBeam:
    return ConeBeam.orbit(views, 1020, 740, shape, 24.0, arc=np.radians(degrees))


OTHERS = [0, 1, 2, 4, 5, 6, 7]
CASES = {
    "one view": (lambda: views(beam=orbit(1)), orbit(1)),
    "arc of 60 degrees": (lambda: views(beam=orbit(8, 60)), orbit(8, 60)),
    "a view flipped": (lambda: changed(lambda v: v.flip(-1)), BEAM),
    "a view shifted": (lambda: changed(lambda v: v.roll(5, -1)), BEAM),
    "a view missing": (lambda: CLEAN[OTHERS], BEAM.select(OTHERS)),
    "a view twice": (lambda: CLEAN[[*range(8), 3]], BEAM.select([*range(8), 3])),
    "no noise": (lambda: views(simulator=Ideal(0)), BEAM),
    "ten photons": (lambda: views(simulator=Ideal(0, 10)), BEAM),
    "only noise": (lambda: torch.randn(CLEAN.shape, generator=torch.Generator().manual_seed(0)), BEAM),
    "metal": (lambda: views(metal()), BEAM),
    "narrow detector": (lambda: views(beam=orbit(8, shape=(24, 10))), orbit(8, shape=(24, 10))),
    "a thousand times too large": (lambda: 1000 * CLEAN, BEAM),
    "negative": (lambda: -CLEAN, BEAM),
    "tiny": (lambda: 1e-20 * CLEAN, BEAM),
    "all air": (lambda: views(water(0.0)), BEAM),
    "all water": (lambda: views(water(0.02)), BEAM),
}


@pytest.fixture(scope="module")
def prior():
    return tiny_prior()


def run(name: str, prior, xrays=CLEAN, beam=BEAM, **settings):
    method = (SAMPLERS | BASELINES | {"one pass": PLAIN})[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reconstruct(xrays, beam, None if name in BASELINES else prior, method, grid=GRID, **settings)


def assert_finite(result) -> None:
    for values in (result.volume, result.reprojection, torch.tensor([result.misfit, *result.misfit_per_view])):
        assert values.isfinite().all()


# Data

@METHOD
@pytest.mark.parametrize("case", CASES)
def test_every_method_ends_finite_whatever_the_x_rays(prior, name, case):
    make, beam = CASES[case]
    try:
        assert_finite(run(name, prior, make(), beam))
    except ValueError as refused:  # a method may refuse what it cannot do, in one sentence
        allowed = {"fdk": ("one view", "a view twice"), "released": ("narrow detector",)}
        assert case in allowed[name] and "\n" not in str(refused)


@METHOD
@pytest.mark.parametrize("case", ["ten photons", "a thousand times too large"])
def test_display_values_end_finite_too(prior, name, case):
    assert_finite(run(name, prior, CASES[case][0](), display=True))


@METHOD
def test_a_missing_view_that_the_geometry_has_and_one_that_is_not_finite_are_refused(prior, name):
    with pytest.raises(ValueError, match="8 views.*7, 24, 24"):
        run(name, prior, CLEAN[OTHERS])
    with pytest.raises(ValueError, match="NaN"):
        run(name, prior, changed(lambda v: v * float("nan")))


@pytest.mark.parametrize("blank", [0.0, 5.0])
def test_a_blank_view_among_others_is_refused_by_its_number(prior, blank):
    with pytest.raises(ValueError, match="view 3 .*same value"):
        run("sirt", prior, changed(lambda v: torch.full_like(v, blank)))


def test_blank_views_are_refused_unless_nothing_was_in_the_beam(prior):
    for blank in (torch.full_like(CLEAN, 5.0), CLEAN.amax((1, 2), True).expand_as(CLEAN)):
        with pytest.raises(ValueError, match="every view .*same value.* saturated"):
            run("sirt", prior, blank)
    assert_finite(run("sirt", prior, torch.zeros_like(CLEAN)))
    for name in ("sirt", "fast"):
        with pytest.raises(ValueError, match="every view .*same value"):
            run(name, prior, torch.zeros_like(CLEAN), display=True)


@pytest.mark.parametrize("name", ["diffpir", "sirt"])
def test_inverted_images_are_warned_of_and_others_are_not_however_narrow(prior, name):
    method, own = SAMPLERS.get(name) or BASELINES[name], prior if name in SAMPLERS else None
    for display in (False, True):
        with pytest.warns(UserWarning, match="as inverted images are"):
            reconstruct(CLEAN.max() - CLEAN, BEAM, own, method, grid=GRID, display=display)
    for columns in (24, 16, 10, 6):
        first = (24 - columns) // 2
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "the X-rays are densest")
            reconstruct(CLEAN[..., first:first + columns], orbit(8, shape=(24, columns)), own, method, grid=GRID)


@pytest.fixture(scope="module")
def told_of_good_views(prior):
    """Of a method, what it finds of good views and how many steps it tells of, once."""
    @cache
    def told(name):
        steps = []
        return run(name, prior, on_step=lambda: steps.append(1)), len(steps)
    return told


@pytest.fixture(scope="module")
def of_good_views(told_of_good_views):
    """Of a method, what it finds of good views, once."""
    return lambda name: told_of_good_views(name)[0]


@pytest.mark.parametrize("change, fast", [
    (lambda v: v.flip(-1), "fast"), (lambda v: v.roll(5, -1), "fast"),
    (lambda v: v.max() - v, "one pass")  # scatter and metal, where they are sought, share out what it contradicts
], ids=["flipped", "shifted", "negated"])
@pytest.mark.parametrize("name", ["fast", "sirt", "cgls", "tv"])
def test_one_bad_view_fits_worst_and_raises_the_misfit(prior, of_good_views, name, change, fast):
    name = fast if name == "fast" else name
    good, bad = of_good_views(name), run(name, prior, changed(change))
    assert int(np.argmax(bad.misfit_per_view)) == 3
    assert bad.misfit > 1.2 * good.misfit and bad.misfit_per_view[3] > 1.5 * good.misfit_per_view[3]


def test_one_bad_view_is_named_in_a_warning_and_good_ones_are_not(prior):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reconstruct(CLEAN, BEAM, prior, FAST).warnings == []
    with pytest.warns(UserWarning, match=r"view 3 .* times worse than the median") as given:
        shown = reconstruct(changed(lambda v: v.roll(8, -1)), BEAM, prior, FAST)
    assert shown.warnings == [str(each.message) for each in given]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert reconstruct(changed(lambda v: v.roll(8, -1)), BEAM, prior, FAST).warnings == shown.warnings


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_line_integrals_of_no_chest_are_warned_of_and_display_values_of_any_size_are_not(prior, scale):
    with pytest.warns(UserWarning, match="largest line integral .* of a chest.*intensity: {kind: display"):
        reconstruct(scale * CLEAN, BEAM, method=SIRT(2), grid=GRID)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reconstruct(scale * CLEAN, BEAM, prior, FAST, display=True)


@pytest.mark.parametrize("name, grid", [("fast", Grid.cube(32)), ("sirt", Grid.cube(8, 96.0))])
def test_what_is_doubtful_in_the_x_rays_is_said_once_however_often_they_are_binned(prior, name, grid):
    beam = orbit(8, shape=(48, 48))
    drifted = 5 * views(beam=beam, simulator=Ideal(0)) + torch.linspace(0, 0.3, 8)[:, None, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = reconstruct(drifted, beam, prior if name == "fast" else None, SAMPLERS.get(name) or SIRT(2), grid=grid)
    for words in ("the largest line integral is", "air beside the patient reads"):
        assert sum(said.startswith(words) for said in found.warnings) == 1, found.warnings


def test_views_that_cut_the_patient_off_at_both_sides_are_warned_of_where_they_are_most_of_them():
    narrow = CLEAN[..., 9:15]
    with pytest.warns(UserWarning, match="8 of 8 views cut the patient off at the left and right side"):
        check_line_integrals(narrow)
    half_fan = torch.cat([CLEAN[:4, :, 9:], CLEAN[4:, :, :15]])
    mostly_whole = torch.where(torch.arange(8)[:, None, None] < 4, 5.0, CLEAN)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for xrays in (CLEAN, half_fan, mostly_whole):
            check_line_integrals(xrays)


def test_a_gain_that_drifts_is_taken_out_by_the_air_and_where_none_is_seen_nothing_is():
    exact = views(simulator=Ideal(0))
    drifted = exact - torch.linspace(1, 0.8, len(exact)).log()[:, None, None]
    with pytest.warns(UserWarning, match="air beside the patient reads from -?0.0. to 0.2.*own value of air is sub"):
        found = reconstruct(drifted, BEAM, method=SIRT(2), grid=GRID)
    assert (found.volume - reconstruct(exact, BEAM, method=SIRT(2), grid=GRID).volume).abs().max() < 0.1
    for xrays, beam, settings in ((exact, BEAM, {}), (drifted, BEAM, {"display": True}), (drifted + 0.2, BEAM, {}),
                                  (drifted[..., 7:17], orbit(8, shape=(24, 10)), {})):
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "air beside the patient")
            warnings.filterwarnings("ignore", "in air beside the patient")
            reconstruct(xrays, beam, method=SIRT(2), grid=GRID, **settings)


def test_a_detector_turned_onto_its_side_is_looked_at_beside_the_patient_too():
    lying = replace(BEAM, u=BEAM.v, v=BEAM.u)
    drifted = CLEAN - torch.linspace(1, 0.8, len(CLEAN)).log()[:, None, None]
    for xrays in (CLEAN, drifted, CLEAN + 0.3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with heard() as told:
                as_it_stands = prepared_xrays(xrays, BEAM, False)
            with heard() as told_lying:
                on_its_side = prepared_xrays(xrays.mT, lying, False)
        assert torch.equal(on_its_side.mT, as_it_stands) and told_lying == told


def test_air_is_the_thinner_side_of_a_view_and_views_without_it_keep_their_values():
    exact = views(simulator=Ideal(0))
    drifted = exact - torch.linspace(1, 0.8, len(exact)).log()[:, None, None]
    drifted[1, :, -1] += 0.3  # a couch seen edge-on
    drifted[2] += 0.02 * torch.arange(24)[:, None]  # what differs from row to row is not air
    with pytest.warns(UserWarning, match="is subtracted, but not of the 1 views that show no air"):
        found = with_air_at_zero(drifted, BEAM)
    assert torch.equal(found[2], drifted[2])
    for view in (0, 1, 3, 7):
        assert (found[view, :, :-1] - exact[view, :, :-1]).abs().max() < 1e-5


def test_air_that_differs_across_the_detector_alike_in_all_views_is_that_of_a_missing_flat_image():
    exact = views(simulator=Ideal(0))
    rows = torch.linspace(0, 0.2, 24)[:, None]
    for uneven in (rows, 0.2 * (torch.arange(24) > 12)):
        with pytest.warns(UserWarning, match="air is not the same across the detector.* give `flat:`"):
            check_flat(exact + uneven)
    scattered = -0.2 * torch.linspace(0, 1, 24)[:, None]
    drifted = exact - torch.linspace(1, 0.8, len(exact)).log()[:, None, None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for xrays in (exact, exact + 0.3, exact + scattered, drifted, (exact + rows)[:2], exact[..., 7:17] + rows):
            check_flat(xrays)
        check_flat(Polychromatic(scatter=1.0)(Projector(GRID, BEAM, full_detector=True), body(), 0)[0])


def test_air_that_reads_alike_in_all_views_but_not_0_is_that_of_a_wrong_value_of_air():
    exact = views(simulator=Ideal(0))
    for air in (0.2, 0.4):
        with pytest.warns(UserWarning, match=f"in air beside the patient, which 8 of 8 views show.* read {air:.2f} or"):
            reconstruct(exact + air, BEAM, method=SIRT(2), grid=GRID)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for xrays in (exact, exact + 0.05, exact - 0.2, (exact + 0.2)[:1], exact[..., 7:17] + 0.2):
            check_offset(xrays)


def test_line_integrals_on_another_scale_than_a_chests_are_told_from_many_views_alone():
    chest = torch.where(body()[0, 0] > 0.012, 30.0, torch.where(body()[0, 0] > 0.002, -800.0, -1000.0))
    xrays = views(HUWindow().to_mu(HUWindow().to_range(chest))[None, None])
    of = replace(BASELINES["cgls"], iterations=30)
    for scale in (1 / np.log(10), 2.0):
        with pytest.warns(UserWarning, match="too (light|dense) for a chest.* scale of the line integrals"):
            reconstruct(scale * xrays, BEAM, method=of, grid=GRID)
    with pytest.warns(UserWarning, match="too light for a chest: half.* below 0.4. times.* mu_water"):
        reconstruct(xrays, BEAM, method=of, grid=GRID, mu_water=0.05)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reconstruct(xrays, BEAM, method=of, grid=GRID)
        reconstruct(2 * xrays[:4], orbit(8).select(range(4)), method=of, grid=GRID)
        reconstruct(2 * xrays, BEAM, method=of, grid=GRID, display=True)


def test_half_of_the_mass_lies_below_a_density_that_scales_with_the_volume():
    chest = torch.tensor([-1000.0] * 50 + [-800.0] * 20 + [0.0] * 10 + [300.0] * 2).reshape(82, 1, 1)
    assert half_mass_density(chest) == 1.0  # 4 of 16.6 are lung, 10 water, 2.6 bone
    assert half_mass_density(0.4 * (chest + 1000) - 1000) == pytest.approx(0.4)
    assert half_mass_density(torch.cat([chest, torch.full((500, 1, 1), -1500.0)])) == 1.0


def test_views_of_which_many_pixels_hold_their_densest_value_are_told_to_be_cut_off():
    most = CLEAN.flatten(1).quantile(0.95, 1)[:, None, None]
    windowed, covered = CLEAN.clone(), CLEAN.clone()
    windowed[2:4], covered[:, :, :1] = torch.minimum(CLEAN, most)[2:4], 11.5
    for display in (False, True):
        with pytest.warns(UserWarning, match="2 of 8 views hold exactly their densest value in up to 5% of their"):
            reconstruct(windowed, BEAM, method=SIRT(2), grid=GRID, display=display)
    with pytest.warns(UserWarning, match="8 of 8 views hold .*4% of their pixels.* a collimator covers it"):
        check_clipped(covered)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for xrays in (CLEAN, (CLEAN * 255 / CLEAN.max()).round(), CLEAN.clamp(min=1), torch.zeros_like(CLEAN),
                      views(water(0.02), simulator=Ideal(0)), CLEAN[:, :3, :5], windowed[:, :3, :5]):
            check_clipped(xrays)


def test_an_image_given_for_two_directions_is_told_and_one_given_twice_for_its_own_is_not():
    twice = CLEAN[[0, 0]]
    for display in (False, True):
        with pytest.warns(UserWarning, match=r"view 1 \(counted from 0\) holds exactly the same image as view 0"):
            reconstruct(twice, BEAM.select([0, 2]), method=SIRT(2), grid=GRID, display=display)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_repeated(CLEAN, BEAM)
        check_repeated(twice, BEAM.select([0, 0]))
        check_repeated(torch.zeros_like(CLEAN), BEAM)
        check_repeated(views(water(0.02), simulator=Ideal(0)), BEAM)


def test_what_is_denser_than_the_prior_knows_is_said_with_its_place_and_size():
    x = torch.full(GRID.shape, -0.5)
    x[8, 5, 6:9] = 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_ceiling(torch.full(GRID.shape, 0.97), GRID, HUWindow())
        check_ceiling(x, Grid.cube(16, 96.0), HUWindow())  # 0.6 ml
    with pytest.warns(UserWarning, match=r"41.5 ml are as dense as 1000 HU.*\(12, -60, -12\) mm.*metal"):
        check_ceiling(x, GRID, HUWindow())


def test_x_rays_that_no_volume_can_explain_have_a_misfit_near_one(prior, of_good_views):
    assert of_good_views("fast").misfit < 0.1
    assert run("fast", prior, 10 * CLEAN).misfit > 0.5


def test_the_misfit_of_x_rays_that_read_nothing_is_finite_and_grows_with_what_is_seen_instead():
    nothing = torch.zeros(2, 5, 5)
    assert misfits(nothing, nothing)["misfit"] == 0
    assert misfits(nothing + 1e-3, nothing) == {"misfit": pytest.approx(1), "misfit_per_view": pytest.approx([1, 1])}


def test_pixels_far_brighter_than_air_are_told_with_their_view_and_the_network_ends_finite_with_them():
    for reading, of, own in ((-20.0, SIRT(2), None), (-1e6, METHODS["phydict_learned"], tiny_refiner())):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            bright = changed(lambda v: v.index_fill(0, torch.tensor(11), reading))
            result = reconstruct(bright, BEAM, own, of, grid=GRID)
        assert_finite(result)
        assert any(f"the smallest line integral is {reading:.3g}, in view 3 " in said for said in result.warnings)


# Settings

@pytest.mark.parametrize("make, words", [
    (lambda prior: reconstructor("phydict_fast", prior, samples=2.5), "samples is a whole number, but 2.5"),
    (lambda prior: reconstructor("phydict_fast", prior, guidance="2"), "guidance scale is a number, but '2'"),
    (lambda prior: replace(METHODS["tv"], iterations=2.5), "iterations is a whole number, but 2.5"),
    (lambda prior: DPS(scale="1"), "DPS.scale is a number, but '1'")])
def test_settings_of_another_kind_are_refused_in_a_sentence(prior, make, words):
    with pytest.raises(ValueError, match=words):
        make(prior)


@pytest.mark.parametrize("guidance", [1, 3, 10])
def test_a_contradictory_report_at_any_guidance_ends_finite_and_x_rays_are_met_as_well(prior, of_good_views, guidance):
    alone, told = of_good_views("fast"), run("fast", prior, report=REPORTS[2], guidance=guidance)
    assert_finite(told)
    assert told.misfit < 2 * alone.misfit


@pytest.mark.parametrize("delta", [0.0, 0.01, 0.99])
def test_extra_compute_from_any_delta_ends_finite_in_the_priors_range(prior, delta):
    volume = reconstruct(CLEAN, BEAM, prior, replace(FAST, ec_delta=delta, ec_steps=2)).volume
    assert volume.isfinite().all() and volume.min() >= -1000 and volume.max() <= 600


@pytest.mark.parametrize("make", [
    lambda n: replace(FAST, iterations=n, t_start=1.0, t_end=None), lambda n: PriorOnly(n), lambda n: DPS(n, 1.0),
    lambda n: DDS(n), lambda n: DiffPIR(n), lambda n: DAPS(n, flow_steps=1, likelihood=ExactDraw(3), prior_std=0.5),
    lambda n: PnPDM(n, levels=2, likelihood=ExactDraw(3), burn_in=n - 1, thinning=1)],
    ids=["fast", "prior", "dps", "dds", "diffpir", "daps", "pnp_dm"])
@pytest.mark.parametrize("steps", [1, 2, 20])
def test_few_and_many_steps_end_finite(prior, make, steps):
    result = reconstruct(CLEAN, BEAM, prior, make(steps))
    assert_finite(result)


def test_ten_times_as_many_noise_levels_change_little():
    prior = FixedPrior(GaussianDenoiser(torch.full((1, 4, *GRID.shape), -0.5), torch.tensor(0.1)))
    few, many = (reconstruct(CLEAN, BEAM, prior, replace(PLAIN, iterations=n, likelihood=ProximalCG(2, 1))).volume
                 for n in (20, 200))
    assert float((few - many).square().mean().sqrt()) < 20


def test_denoisers_in_bf16_fp32_and_fp64_agree(prior):
    projector, sampler = Projector(GRID, BEAM, full_detector=True), replace(FAST, iterations=4)

    def volume(kind: torch.dtype, precision: str) -> torch.Tensor:
        method = Posterior(tiny_prior().to(kind), sampler, precision=precision)
        return method.reconstruct(CLEAN.to(kind), projector).volume

    exact = volume(torch.float64, "float32")
    difference = [float((volume(torch.float32, precision) - exact).square().mean().sqrt()) 
                  for precision in ("float32", "bfloat16")]
    assert exact.dtype == torch.float64 and difference[0] < 0.5 and difference[1] < 30


def test_seeds_differ_less_where_the_x_rays_say_more(prior):
    method = replace(PLAIN, sampling_noise=1.0)

    def spread(beam: ConeBeam) -> float:
        return float(reconstruct(views(beam=beam), beam, prior, method, samples=4).deviation.mean())

    assert 0 < spread(orbit(8)) < spread(orbit(1))


# What else is set in the process

@pytest.mark.parametrize("name", ["paper", "dps", "diffvox"])
def test_neither_inference_mode_nor_autocast_around_a_reconstruction_changes_it(prior, of_good_views, name):
    with torch.inference_mode():
        inside = run(name, prior, CLEAN.clone()).volume
    with torch.autocast("cpu", torch.bfloat16):
        cast = run(name, prior).volume
    assert torch.equal(inside, of_good_views(name).volume) and torch.equal(cast, inside)


@pytest.mark.parametrize("name", ["prior", "diffpir", "daps", "sirt"])
def test_the_noise_of_a_seed_is_the_same_whatever_type_torch_makes_by_default(prior, of_good_views, name):
    torch.set_default_dtype(torch.float64)
    try:
        double = run(name, prior).volume
    finally:
        torch.set_default_dtype(torch.float32)
    assert double.dtype == torch.float32
    assert float((double - of_good_views(name).volume).square().mean().sqrt()) < 0.1


# Divergence

class Broken:
    """A denoiser whose estimates are `value` from its call number `at` on."""

    schedule = CosineSchedule()

    def __init__(self, at: int, value: float):
        self.at, self.value, self.calls = at, value, 0

    def denoise(self, x: torch.Tensor, t: float) -> torch.Tensor:
        self.calls += 1
        return torch.full_like(x, self.value if self.calls >= self.at else -0.5) + 0 * x


class FixedPrior:
    """A prior whose denoiser is given."""

    grid, window, state_channels = GRID, HUWindow(), 4

    def __init__(self, denoiser):
        self.denoiser = denoiser

    def bind(self, *_):
        return self.denoiser


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("sampler", [PriorOnly(5), SplitGibbs(5), SplitGibbs(5, GradientSteps()), DDS(5), DiffPIR(5),
                                     DPS(5), DAPS(5, flow_steps=1)], ids=lambda s: type(s).__name__)
def test_an_estimate_that_is_not_finite_stops_the_run_and_the_step_is_told(sampler, value):
    steps = []
    with pytest.raises(FloatingPointError, match="from step 3 of 5 on"):
        reconstruct(CLEAN, BEAM, FixedPrior(Broken(3, value)), sampler, on_step=lambda: steps.append(1))
    assert len(steps) == 2


def test_a_baseline_that_overflows_stops_and_the_step_is_told():
    with pytest.raises(FloatingPointError, match="from step 1 of 5 on"):
        reconstruct(1e37 * CLEAN, BEAM, method=CGLS(5), grid=GRID)


def test_descent_that_is_too_fast_is_told_with_the_step_from_which_the_misfit_rose():
    prior = FixedPrior(GaussianDenoiser(torch.full((1, 4, *GRID.shape), -0.5), torch.tensor(0.1)))
    far, near = (SplitGibbs(6, GradientSteps(2, rate, adam=False), GradientSteps(2, rate, adam=False))
                 for rate in (10.0, 1e-5))
    with pytest.warns(UserWarning, match=r"the misfit rose from .* to .*, from step \d of 6 on"):
        result = reconstruct(CLEAN, BEAM, prior, far)
    assert 1 <= result.diverged_at <= 6 and result.volume.isfinite().all()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the misfit rose")
        assert reconstruct(CLEAN, BEAM, prior, near).diverged_at is None


def test_the_step_at_which_a_rise_began_is_told_where_the_last_steps_forget_the_x_rays(prior):
    sampler = SplitGibbs(4, ProximalCG(10), ProximalCG(10), t_start=0.3, t_end=0.15, ec_delta=0.99,
                         ec_steps=3)
    with pytest.warns(UserWarning, match="from step 5 of 7 on"):
        result = reconstruct(CLEAN, BEAM, prior, sampler)
    assert result.diverged_at == 5 and result.misfit > 0.1


@pytest.mark.parametrize("name", ["fast", "daps", "pnp_dm", "diffpir", "dds", "dps", "sirt", "cgls", "tv", "diffvox"])
def test_runs_that_converge_are_not_called_divergent(of_good_views, name):
    assert of_good_views(name).diverged_at is None


@pytest.mark.parametrize("misfits, step", [
    ({}, None), ({1: 0.5}, None), ({1: 0.5, 2: 0.2, 3: 0.1}, None), ({1: 0.1, 2: 0.3, 3: 0.15}, None),
    ({1: 0.1, 2: 0.3, 3: 0.4}, 2), ({1: 1.9}, None), ({1: 9.0, 2: 0.4}, None), ({1: 9.0, 2: 2.1}, 1),
    ({1: 0.5, 4: 0.2, 5: 0.45, 8: 3.0}, 5), ({1: 1e-4, 2: 1e-2}, None)])
def test_a_rise_counts_from_where_the_misfit_stays_above_what_was_reached(misfits, step):
    assert risen_from(misfits) == step


def test_watching_takes_no_projection_of_its_own(prior):
    for sampler, calls in ((PriorOnly(5), 2), (SplitGibbs(3, ProximalCG(1, 1)), 2 + 2 * 4)):
        assert reconstruct(CLEAN, BEAM, prior, sampler).projector_calls == calls


@METHOD
def test_a_step_is_called_once_by_every_method(prior, told_of_good_views, name):
    assert told_of_good_views(name)[1] == reconstructor(SAMPLERS.get(name) or BASELINES[name], prior).steps()
