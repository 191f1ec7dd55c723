"""The named methods, and a reconstruction in one call."""

import time
import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from prior.tiny import tiny_for, tiny_prior, tiny_refiner, tiny_super_resolution
from scenes import ball

from phydict.baselines import CGLS, SIRT, Baseline, Region
from phydict.diffusion import GaussianDenoiser
from phydict.grid import Grid
from phydict.inference.settings import CascadeSettings
from phydict.methods import METHODS, default_method, onto_grid, reconstruct, reconstructor
from phydict.posterior import CascadePosterior, Posterior, PriorOnly, ProximalCG, Sampler, SplitGibbs
from phydict.prior import MedSynCheckpoint, save_prior, save_refiner, save_stage
from phydict.reconstruction import Reconstruction, Reconstructor
from phydict.units import MU_WATER, HUWindow, hu_to_mu
from phydict.xray import ConeBeam, Projector, binned, binning
from phydict.xray.residuals import misfits

GRID = Grid.cube(64)
DEFAULT = ConeBeam.orbit(8, 1020, 740, (448, 448), 1.25)


def test_sirt_in_one_call_finds_the_ball_in_its_exact_line_integrals():
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    result = reconstruct(ball(beam, 90.0), beam, method=SIRT(60))
    assert result.misfit < 0.04
    assert result.volume.shape == GRID.shape and result.grid.same_as(GRID)
    mass = float(hu_to_mu(result.volume).sum()) * 6**3
    assert mass == pytest.approx(MU_WATER * 4 / 3 * np.pi * 90**3, rel=0.1)
    assert result.volume[26:38, 26:38, 26:38].mean() == pytest.approx(0, abs=100)


@pytest.mark.parametrize("method, prior", [("sirt", None), (PriorOnly(2), tiny_prior(False))])
def test_a_box_that_no_view_sees_is_refused_and_one_that_is_seen_in_part_is_not(method, prior):
    beam = ConeBeam.orbit(2, 1020, 740, (28, 28), 20.0, arc_degrees=180)
    xrays = ball(beam, 90.0)
    with pytest.raises(ValueError, match=r"no ray of any view meets the box .*centre at \(0, 0, 900\) mm: give a cent"):
        reconstruct(xrays, beam, prior, method, grid=Grid.box(8, 96.0, (0, 0, 900.0)))
    part = reconstruct(xrays, beam, prior, method, grid=Grid.box(8, 96.0, (0, 0, 190.0)))
    assert part.volume.shape == (8, 8, 8)


def test_a_strangers_method_is_named_and_scaled_though_it_declares_neither():
    @dataclass(frozen=True)
    class Water(Reconstructor):
        hu: float = 0.0

        def reconstruct(self, xrays, projector, report="", display=False, seed=0, on_step=lambda: None):
            density = torch.full(projector.grid.shape, 1 + self.hu / 1000)
            reprojection = projector(self.mu_water * density[None, None])[0]
            return Reconstruction(1000 * (density - 1), projector.grid, self.name, seed, **misfits(reprojection, xrays),
                                  seconds={}, xrays=xrays, reprojection=reprojection)

        def steps(self) -> int:
            return 0

    beam = ConeBeam.orbit(2, 1020, 740, (14, 14), 40.0)
    named = reconstructor(Water(-500), name="half water")
    assert (named.name, named.hu, Water().name) == ("half water", -500, "")
    plain, scaled = (reconstruct(ball(beam, 90.0), beam, method=named, mu_water=mu) for mu in (None, 2 * MU_WATER))
    assert plain.method == "half water"
    torch.testing.assert_close(scaled.reprojection, 2 * plain.reprojection)


def test_hu_do_not_depend_on_the_beams_attenuation_of_water_once_it_is_stated():
    beam = ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0)
    soft = reconstruct(ball(beam, 90.0), beam, method=SIRT(5)).volume
    hard = reconstruct(0.85 * ball(beam, 90.0), beam, method=SIRT(5), mu_water=0.85 * MU_WATER).volume
    torch.testing.assert_close(hard, soft, rtol=1e-4, atol=0.05)


def test_a_detector_finer_than_the_grid_can_use_is_binned():
    beam = ConeBeam.orbit(3, 1020, 740, (112, 112), 4.0)
    result = reconstruct(ball(beam, 90.0), beam, method=SIRT(2))
    coarse = reconstruct(binned(ball(beam, 90.0), 1), beam, method=SIRT(2))
    assert result.xrays.shape == (3, 112, 112) and torch.equal(result.volume, coarse.volume)
    fine = ConeBeam.orbit(3, 1020, 740, (224, 224), 2.0)
    assert binning(GRID, fine) == 2
    assert reconstruct(ball(fine, 90.0), fine, method=SIRT(2)).xrays.shape == (3, 112, 112)


def test_no_warning_of_a_fine_detector_where_the_method_decides():
    fine = ConeBeam.orbit(2, 1020, 740, (56, 56), 10.0)
    full = SplitGibbs(2, ProximalCG(2), ProximalCG(2), full_detector=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="the detector's pixels")
        assert reconstruct(ball(fine, 90.0), fine, tiny_prior(), full).xrays.shape == (2, 56, 56)
        assert reconstruct(ball(fine, 90.0), fine, tiny_prior(), PriorOnly(2)).xrays.shape == (2, 28, 28)


def test_an_unknown_method_names_the_known_ones():
    with pytest.raises(ValueError) as error:
        reconstructor("phydict_fats")
    assert "phydict_fats" in str(error.value) and all(name in str(error.value) for name in METHODS)
    assert "\n" not in str(error.value)


def test_a_class_in_place_of_a_method_is_told_apart_from_its_object():
    with pytest.raises(ValueError, match="but the class SIRT, not an object of it, was given"):
        reconstructor(SIRT)


def test_sirt_needs_no_prior_and_a_sampler_says_which_one_is_missing(tmp_path):
    assert reconstructor("sirt", tmp_path / "nowhere.safetensors") == METHODS["sirt"]
    assert reconstructor("sirt", name="mine").name == "mine"
    with pytest.raises(FileNotFoundError, match="nowhere.safetensors"):
        reconstructor("phydict_fast", tmp_path / "nowhere.safetensors")


def test_priors_samplers_and_projectors_of_ones_own_fit_in():
    """The README's contract, by the smallest objects that keep it."""
    grid, beam = Grid.cube(16), ConeBeam.orbit(3, 1020, 740, (24, 24), 23.0)

    class OwnPrior:
        window, state_channels = HUWindow(), 1

        def bind(self, report, guidance, precision):
            return GaussianDenoiser(torch.full((1, 1, 16, 16, 16), -0.5), torch.tensor(0.01))

    OwnPrior.grid = grid

    @dataclass(frozen=True)
    class Mean(Sampler):
        def steps(self):
            return 1

        def sample(self, denoiser, measurement, x, draw, on_step):
            on_step()
            return denoiser.denoise(x, 1.0)

    class Doubled:
        def __init__(self, grid=grid):
            self.grid, self.beam, self._A = grid, beam, Projector(grid, beam, full_detector=True)

        def __call__(self, mu):
            return 2 * self._A(mu)

        def T(self, y):
            return 2 * self._A.T(y)

    y = Projector(grid, beam)(hu_to_mu(torch.full((1, 1, 16, 16, 16), -500.0)))[0]
    mean = reconstruct(y, beam, OwnPrior(), Mean())
    assert mean.volume.mean() == pytest.approx(-500, abs=20) and mean.misfit < 0.1 and mean.method == "Mean"
    doubled = Posterior(OwnPrior(), METHODS["phydict_fast"]).reconstruct(2 * y, Doubled())
    assert doubled.misfit < 0.02 and doubled.volume.mean() == pytest.approx(-500, abs=20)
    own = Posterior(OwnPrior(), METHODS["dds"])
    for elsewhere in (onto_grid(own, Grid.cube(32)), onto_grid(own, Grid.box(24, 180.0)),
                      Region(CGLS(2), Grid.box(8, 90.0), grid)):
        with pytest.warns(UserWarning, match="Doubled projects its own voxels alone"):
            assert elsewhere.reconstruct(2 * y, Doubled(elsewhere.target)).volume.isfinite().all()


@pytest.mark.parametrize("change, sentence", [
    ({"beam": "geometry.yaml"}, "ConeBeam.load"), ({"report": 5}, "report must be text"),
    ({"method": 123}, "a Sampler or"), ({"method": SIRT}, "a Sampler or"),
    ({"method": "fbp"}, "phydict_fast, phydict_learned"), ({"projector": object()}, "give it to reconstructor"),
    ({"xrays": np.full((8, 448, 448), np.nan)}, "NaN"), ({"xrays": np.zeros((7, 448, 448))}, "8 views"),
    ({"seed": -1}, "a seed is a whole number"), ({"seed": 2**70}, "a seed is a whole number"),
    *(({"mu_water": value}, "mu_water") for value in (-0.02, 0, "water", float("nan"))),
    ({"method": "dds", "prior": tiny_prior(False), "guidance": float("nan")}, "scale lies between 0 and 1,000,000"),
    ({"method": "tv", "guidance": 3.0}, "FISTATV has none: leave guidance out"),
    ({"method": "dds", "prior": tiny_prior(False), "samples": 10**9}, "would take .* GiB of memory")],
    ids=lambda value: str(value)[:30] if isinstance(value, dict) else "")
def test_bad_arguments_are_one_sentence(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        reconstruct(**{"xrays": np.zeros((8, 448, 448)), "beam": DEFAULT, "method": "sirt"} | change)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_names_its_publication(name):
    ready = reconstructor(name, tiny_for(name, text=False))
    year = [word for word in ready.citation.replace(",", " ").split() if word.isdigit() and 1900 < int(word) < 2030]
    assert year and ready.citation.split(",")[0]


def test_a_method_may_be_a_name_a_sampler_or_a_reconstructor(tmp_path):
    prior = tiny_prior()
    save_prior(prior, tmp_path / "tiny.safetensors")
    named, made = reconstructor("phydict_fast", prior), reconstructor(METHODS["phydict_fast"], prior)
    assert isinstance(named, Posterior) and named.sampler == made.sampler and named.prior is prior
    assert (named.name, made.name) == ("phydict_fast", "SplitGibbs")
    assert reconstructor("prior_only", tmp_path / "tiny.safetensors").prior.grid.same_as(prior.grid)
    assert reconstructor(made) is made


@pytest.mark.filterwarnings("ignore:the X-rays show one material")
def test_the_default_is_the_learned_method_unless_a_prior_must_be_sampled(tmp_path):
    save_prior(tiny_prior(), tmp_path / "prior.safetensors")
    save_refiner(tiny_refiner(), tmp_path / "refiner.safetensors")
    for given in (None, tiny_refiner(), tmp_path / "refiner.safetensors", str(tmp_path / "refiner.safetensors")):
        assert default_method(given) == "phydict_learned"
        assert default_method(given, samples=2) == default_method(given, guidance=3.0) == "phydict_fast"
    for given in (tiny_prior(), tmp_path / "prior.safetensors", tmp_path / "nowhere.safetensors", "my_module.MyPrior",
                  MedSynCheckpoint(str(tmp_path))):
        assert default_method(given) == "phydict_fast"
    beam = ConeBeam.orbit(2, 1020, 740, (28, 28), 20.0)
    methods = [reconstruct(ball(beam, 90.0), beam, prior).method for prior in (tiny_prior(), tiny_refiner())]
    assert methods == ["phydict_fast", "phydict_learned"]


def test_a_checkpoint_of_medsyns_is_read_as_a_path_is(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        reconstructor("phydict_fast", MedSynCheckpoint(str(tmp_path / "nowhere")))


def test_a_ready_method_takes_double_precision_for_what_its_numbers_say():
    beam = ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0)
    ready = reconstructor("phydict_fast", tiny_prior())
    A = Projector(ready.grid, beam)
    single, double = (ready.reconstruct(xrays, A).volume for xrays in (ball(beam, 120.0), ball(beam, 120.0).double()))
    assert torch.equal(single, double)


def test_one_call_takes_the_priors_grid_and_fits_the_views():
    beam = ConeBeam.orbit(4, 1020, 740, (28, 28), 20.0)
    method = SplitGibbs(6, ProximalCG(20), ProximalCG(20))
    result = reconstruct(ball(beam, 120.0), beam, tiny_prior(), method, seed=2)
    assert result.grid.same_as(Grid.cube(16)) and result.seed == 2
    assert result.misfit < 0.5 * reconstruct(ball(beam, 120.0), beam, tiny_prior(), PriorOnly(6), seed=2).misfit


def test_x_rays_and_geometry_that_do_not_match_are_refused_with_both_sizes():
    with pytest.raises(ValueError, match=r"8 views of 448 x 448.*\(7, 448, 448\)"):
        reconstruct(torch.zeros(7, 448, 448), DEFAULT, method="sirt")


def test_a_source_inside_the_volume_is_refused():
    beam = ConeBeam.orbit(2, 500, 150, (28, 28), 10.0)
    with pytest.raises(ValueError, match="inside the volume"):
        reconstruct(torch.zeros(2, 28, 28), beam, method="sirt")


@dataclass(frozen=True)
class Slow(Baseline):
    mu_water: float = MU_WATER
    name: str = "Slow"

    def steps(self):
        return 1

    def solve(self, A, y, on_step):
        return torch.ones(1, 1, *A.grid.shape).to(y)

    def reconstruct(self, *args, **settings):
        time.sleep(0.2)
        return replace(super().reconstruct(*args, **settings), seconds={})


@pytest.mark.filterwarnings("ignore")  # of water that explains nothing
def test_the_seconds_of_a_method_of_ones_own_are_measured():
    beam = ConeBeam.orbit(2, 1020, 740, (28, 28), 20.0)
    result = reconstruct(ball(beam, 90.0), beam, method=Slow(), grid=Grid.cube(16))
    assert sum(result.seconds.values()) >= 0.2


def test_the_shipped_network_is_read_once_and_another_file_each_time(tmp_path):
    assert reconstructor("phydict_fast").prior is reconstructor("dds").prior
    save_prior(tiny_prior(), file := tmp_path / "prior.safetensors")
    assert reconstructor("dds", file).prior is not reconstructor("dds", file).prior


def test_a_super_resolution_stage_makes_it_a_cascade_on_the_fine_grid(tmp_path):
    save_stage(tiny_super_resolution(), tmp_path / "fine.safetensors")
    beam = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)
    views = ball(beam, 90.0)
    results = [reconstruct(views, beam, tiny_prior(False), PriorOnly(2), super_resolution=tmp_path / "fine.safetensors",
                           sr_guided=guide) for guide in (True, False)]
    assert all(result.grid.same_as(Grid.cube(32)) for result in results)
    assert results[0].misfit < 0.5 * results[1].misfit
    ready = reconstructor(PriorOnly(2), tiny_prior(False), 1.0, "two", tiny_super_resolution(), True, PriorOnly(3), 0.1)
    assert isinstance(ready, CascadePosterior) and ready.sr_sampler == PriorOnly(3) and ready.noise == 0.1
    assert ready.name == "two" and ready.with_mu_water(0.018).mu_water == 0.018


@pytest.mark.parametrize("beside", [{"samples": 3}, {"guidance": 2.0}, {"super_resolution": tiny_super_resolution()},
                                    {"prior": tiny_prior()}, {"precision": "float32"}])
def test_a_method_that_is_made_takes_no_settings_of_its_making(beside):
    ready = Posterior(tiny_prior(), PriorOnly(2))
    for method, kind in ((ready, "Posterior"), (onto_grid(ready, Grid.cube(24)), "Refined")):
        with pytest.raises(ValueError, match=f"a ready {kind} has its own settings, but {next(iter(beside))} came"):
            reconstructor(method, **beside)


def test_what_lies_beside_a_small_box_is_accounted_for_wherever_the_sources_clear_the_chest():
    beam = replace(ConeBeam.orbit(4, 700, 320, (48, 48), 16.0), continued=False)
    chest = hu_to_mu(torch.full((1, 1, 16, 16, 16), -700.0))
    views = Projector(Grid.cube(16), beam, full_detector=True)(chest)[0]
    result = reconstruct(views, beam, method=CGLS(5), grid=Grid.box(16, 150.0))
    assert result.misfit < 0.1 and result.volume.mean() == pytest.approx(-700, abs=60)


@pytest.mark.filterwarnings("ignore:the largest line integral is")
@pytest.mark.parametrize("method", ["cgls", "tv"])
def test_what_is_far_smaller_than_a_chest_is_reconstructed_alone(method):
    grid, beam = Grid.cube(16, 60.0), ConeBeam.orbit(4, 300, 200, (24, 24), 5.0)
    mu = torch.zeros(1, 1, *grid.shape)
    mu[..., 4:12, 4:12, 4:12] = 0.02
    found = reconstruct(Projector(grid, beam, full_detector=True)(mu)[0], beam, method=method, grid=grid)
    assert found.coarse is None and found.misfit < 0.01 and found.grid.same_as(grid)


def test_a_method_without_a_prior_takes_no_second_stage():
    with pytest.raises(ValueError, match="SIRT has none"):
        reconstructor("sirt", super_resolution=tiny_super_resolution())
    with pytest.raises(ValueError, match=r"in \[0, 1\]"):
        reconstructor(PriorOnly(2), tiny_prior(False), super_resolution=tiny_super_resolution(),
                      sr_noise_augmentation=1.5)


@pytest.mark.parametrize("method", ["sirt", PriorOnly(2)], ids=["sirt", "prior"])
@pytest.mark.parametrize("setting", [{"sr_guided": False}, {"sr_sampler": PriorOnly(3)},
                                     {"sr_noise_augmentation": 0.0}], ids=lambda setting: next(iter(setting)))
def test_settings_of_a_second_stage_are_refused_without_one(method, setting):
    with pytest.raises(ValueError, match=f"no second stage, but {next(iter(setting))} came for it: leave that out"):
        reconstructor(method, tiny_prior(False), **setting)


def test_a_sampler_of_a_second_stage_that_is_not_guided_is_refused():
    with pytest.raises(ValueError, match="sr_sampler is how .* but sr_guided was given as false.*leave one of the two"):
        reconstructor(PriorOnly(2), tiny_prior(False), super_resolution=tiny_super_resolution(), sr_guided=False,
                      sr_sampler=PriorOnly(3))
    with pytest.raises(ValueError, match=r"model.super_resolution.sampler is how .* model.super_resolution.guided"):
        CascadeSettings("fine.safetensors", guided=False, sampler=PriorOnly(3))


@pytest.mark.parametrize("method", ["cgls", "phydict_fast"])
def test_a_warning_points_at_the_line_that_called(method):
    beam = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)
    with pytest.warns(UserWarning, match="line integral") as found:
        reconstruct(100 * ball(beam, 90.0), beam, tiny_prior(), method, grid=Grid.cube(16))
    assert {warning.filename for warning in found} == {__file__}


@pytest.mark.parametrize("spoil", [
    lambda y: y.to(torch.complex64), lambda y: y > 1, lambda y: y.to("meta"), lambda y: y.to_sparse(), lambda y: None,
    lambda y: "xrays", lambda y: [[1], [1, 2]]], ids=["complex", "bool", "meta", "sparse", "None", "text", "ragged"])
def test_xrays_that_are_no_array_of_numbers_are_refused(spoil):
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    with pytest.raises(ValueError, match="the X-rays must be a"):
        reconstruct(spoil(ball(beam, 90.0)), beam, method=SIRT(2))


def test_xrays_of_unsigned_integers_are_what_their_numbers_say():
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    counts = (100 * ball(beam, 90.0).numpy()).astype(np.uint16)
    pair = [reconstruct(xrays, beam, method=SIRT(2)).volume for xrays in (counts, counts.astype(np.float32))]
    assert torch.equal(*pair)


def test_xrays_and_seeds_of_numpy_are_what_their_numbers_say():
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    y = ball(beam, 90.0).numpy()
    plain, other, turned = (reconstruct(xrays, beam, method=SIRT(2), seed=np.int64(3))
                            for xrays in (y, y.astype(">f4"), y[:, ::-1].copy()[:, ::-1]))
    assert torch.equal(plain.volume, other.volume) and torch.equal(plain.volume, turned.volume) and plain.seed == 3


def test_xrays_that_are_read_only_or_follow_gradients_are_what_their_numbers_say():
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    y = ball(beam, 90.0)
    plain, frozen = reconstruct(y, beam, method=SIRT(2)), y.numpy().copy()
    frozen.setflags(write=False)
    for xrays in (frozen, y.clone().requires_grad_()):  # without a word: warnings are errors
        other = reconstruct(xrays, beam, method=SIRT(2))
        assert torch.equal(plain.volume, other.volume) and not other.xrays.requires_grad


def test_masked_xrays_are_refused_and_those_with_nothing_masked_are_not():
    beam = ConeBeam.orbit(6, 1020, 740, (56, 56), 8.0)
    y = ball(beam, 90.0).numpy()
    spoilt = np.ma.masked_array(y, np.broadcast_to(np.arange(56) < 2, y.shape))
    with pytest.raises(ValueError, match=f"{6 * 56 * 2} pixels of the X-rays are masked"):
        reconstruct(spoilt, beam, method=SIRT(2))
    whole = reconstruct(np.ma.masked_array(y), beam, method=SIRT(2))
    assert torch.equal(whole.volume, reconstruct(y, beam, method=SIRT(2)).volume)


@pytest.mark.parametrize("guidance", [-1.0, float("nan"), 1e7, 1e308])
def test_a_guidance_that_overflows_is_refused(guidance):
    with pytest.raises(ValueError, match="the guidance scale lies between 0 and 1,000,000"):
        reconstructor("prior_only", tiny_prior(), guidance)
