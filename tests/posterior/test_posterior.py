"""The whole method on a tiny prior: what a result depends on, and what is refused."""

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import nibabel
import numpy as np
import pytest
import torch
from laws import random_like
from prior.tiny import REPORTS, tiny_prior

from phydict.grid import Grid
from phydict.guard import BAD_GUESS
from phydict.methods import METHODS
from phydict.posterior import GradientSteps, Posterior, PriorOnly, ProximalCG, Refined, Sampler, SplitGibbs
from phydict.prior import load_prior, save_prior
from phydict.reconstruction import describe
from phydict.units import HUWindow
from phydict.xray import Projector
from posterior.scene import BEAM, GRID, PROJECTOR, views

FAST = SplitGibbs(8, ProximalCG(4), ProximalCG(4), t_start=0.7)
SAMPLERS = {
    "fast": FAST, "noisy": SplitGibbs(6, noise_fraction=0.2), "paper": SplitGibbs(
        5, GradientSteps(), ec_delta=0.5, ec_steps=3), "prior": PriorOnly(5)}


@pytest.fixture(scope="module")
def prior():
    return tiny_prior()


@dataclass(frozen=True)
class Typed(PriorOnly):
    """A sampler of one's own that gives its states in another type."""

    kind: str = "float32"

    def sample(self, *given):
        return super().sample(*given).to(getattr(torch, self.kind))


@pytest.mark.parametrize("kind", ["float64", "float16", "bfloat16"])
def test_a_sampler_may_answer_in_another_type_and_the_volume_is_that_of_its_numbers(prior, kind):
    plain, other = (Posterior(prior, sampler).reconstruct(views(), PROJECTOR)
                    for sampler in (PriorOnly(2), Typed(2, kind=kind)))
    assert other.volume.dtype == torch.float32
    torch.testing.assert_close(other.volume, plain.volume, rtol=0, atol=8)  # of a range of 2000 HU


@pytest.mark.parametrize("name", SAMPLERS)
def test_the_same_seed_gives_the_same_result_and_another_seed_another(prior, name):
    method = Posterior(prior, SAMPLERS[name])
    one, again, other = (method.reconstruct(views(), PROJECTOR, seed=s) for s in (3, 3, 4))
    assert torch.equal(one.volume, again.volume) and torch.equal(one.masks, again.masks)
    assert not torch.allclose(one.volume, other.volume)


def test_a_result_does_not_depend_on_what_ran_before(prior):
    method = Posterior(prior, SAMPLERS["noisy"], guidance=2.0)
    first = method.reconstruct(views(), PROJECTOR, REPORTS[0], seed=5)
    torch.manual_seed(123)
    method.reconstruct(views(2), PROJECTOR, REPORTS[1], display=True, seed=6)
    Posterior(prior, SAMPLERS["paper"]).reconstruct(views(1), PROJECTOR, seed=7)
    torch.rand(1000)
    again = method.reconstruct(views(), PROJECTOR, REPORTS[0], seed=5)
    assert torch.equal(first.volume, again.volume) and first.misfit == again.misfit


def test_a_reconstruction_draws_nothing_from_the_global_generator(prior):
    torch.manual_seed(1)
    Posterior(prior, SAMPLERS["noisy"]).reconstruct(views(), PROJECTOR)
    after = torch.rand(1)
    torch.manual_seed(1)
    assert torch.equal(after, torch.rand(1))


@pytest.mark.parametrize("name", SAMPLERS)
def test_all_figures_are_finite_and_belong_to_the_volume(prior, name):
    calls = []
    method = Posterior(prior, SAMPLERS[name], name=name)
    result = method.reconstruct(views(), PROJECTOR, on_step=lambda: calls.append(1))
    assert len(calls) == method.steps()
    for values in (result.volume, result.masks, result.reprojection, torch.tensor(result.misfit_per_view)):
        assert values.dtype == torch.float32 and values.isfinite().all()
    assert result.volume.min() >= -1000 and result.volume.max() <= 600  # the prior's window
    assert result.masks.min() >= 0 and result.masks.max() <= 1
    again = PROJECTOR(prior.window.to_mu(prior.window.to_range(result.volume))[None, None])[0]
    torch.testing.assert_close(result.reprojection, again, atol=1e-4, rtol=1e-4)
    assert result.misfit == pytest.approx(float((again - views()).norm() / views().norm()), rel=1e-4)
    assert (result.method, result.seed, result.grid.same_as(GRID)) == (name, 0, True)


def test_the_memory_that_is_asked_for_holds_what_conjugate_gradients_keep(prior):
    """25 residuals; one restart of the last step of phydict_fast was measured to add 44.5 volumes."""
    few, many = (Posterior(prior, sampler) for sampler in (FAST, METHODS["phydict_fast"]))
    assert many.volumes == few.volumes + 25 >= 44.5
    fine = Grid.cube(32, GRID.extent[0])
    assert Refined(many, fine).volumes == Refined(few, fine).volumes  # the base keeps its own on coarser voxels


def test_the_x_rays_pull_the_sample_towards_them(prior):
    free = Posterior(prior, PriorOnly(8)).reconstruct(views(), PROJECTOR)
    assert Posterior(prior, FAST).reconstruct(views(), PROJECTOR).misfit < 0.5 * free.misfit


def test_more_conjugate_gradients_never_raise_the_misfit(prior):
    methods = [Posterior(prior, SplitGibbs(6, ProximalCG(n), ProximalCG(n))) for n in (1, 4, 16)]
    misfits = [method.reconstruct(views(), PROJECTOR).misfit for method in methods]
    assert misfits == sorted(misfits, reverse=True)


def test_the_prior_alone_does_not_look_at_the_x_rays(prior):
    one, other = (Posterior(prior, PriorOnly(5)).reconstruct(y, PROJECTOR).volume for y in (views(), views(3)))
    assert torch.equal(one, other)


def test_network_calls_are_counted_twice_under_guidance(prior):
    def calls(guidance, report):
        return Posterior(prior, FAST, guidance).reconstruct(views(), PROJECTOR, report).network_calls

    assert (calls(1.0, REPORTS[0]), calls(2.0, ""), calls(2.0, REPORTS[0])) == (8, 8, 16)


def test_a_report_changes_the_result(prior):
    one, other = (Posterior(prior, FAST, 3.0).reconstruct(views(), PROJECTOR, r) for r in REPORTS[:2])
    assert not torch.allclose(one.volume, other.volume)


def test_display_values_count_only_up_to_a_positive_gain_and_an_offset_per_view(prior):
    method, y = Posterior(prior, FAST, precision="float32"), views()
    shown = method.reconstruct(y, PROJECTOR, display=True)
    scaled = method.reconstruct(torch.tensor([4.0, 0.5, 2.0, 64.0]).view(4, 1, 1) * y, PROJECTOR, display=True)
    assert torch.equal(scaled.volume, shown.volume)  # powers of two are exact
    moved = method.reconstruct(3.7 * y - torch.arange(4.0).view(4, 1, 1), PROJECTOR, display=True)
    assert (moved.volume - shown.volume).square().mean().sqrt() < 1  # HU; rounding alone
    assert (method.reconstruct(3.7 * y, PROJECTOR).volume - shown.volume).square().mean().sqrt() > 50
    torch.testing.assert_close(moved.xrays, shown.xrays, atol=0.05, rtol=0.05)


def test_another_grid_is_refused_and_both_are_named(prior):
    for grid in (Grid.cube(20), Grid.cube(16, 320.0)):
        shape, spacing = str(grid.shape[0]), str(grid.spacing[0])
        with pytest.raises(ValueError, match=rf"\(16, 16, 16\).*24.0.*\({shape}, .*{spacing}"):
            Posterior(prior, FAST).reconstruct(views(), Projector(grid, BEAM))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_x_rays_that_are_not_finite_are_refused(prior, bad):
    y = views()
    y[2, 5, 5] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        Posterior(prior, FAST).reconstruct(y, PROJECTOR)


@pytest.mark.parametrize("cut", [slice(0, 1), slice(0, 3)])
def test_another_number_of_views_is_refused(prior, cut):
    with pytest.raises(ValueError, match="4 views of 14 x 14"):
        Posterior(prior, FAST).reconstruct(views()[cut], PROJECTOR)


def test_the_text_encoder_is_loaded_by_the_first_report_only(prior, tmp_path):
    save_prior(prior, tmp_path / "tiny.safetensors")
    loaded = load_prior(tmp_path / "tiny.safetensors")
    Posterior(loaded, FAST, 2.0).reconstruct(views(), PROJECTOR)
    assert loaded.text is None
    Posterior(loaded, FAST, 2.0).reconstruct(views(), PROJECTOR, REPORTS[0])
    assert loaded.text is not None


def test_the_written_file_is_the_volume_in_its_place(prior, tmp_path):
    result = Posterior(prior, FAST).reconstruct(views(), PROJECTOR)
    (tmp_path / "v.nii.gz").write_bytes(b"an older result")
    result.save_nifti(tmp_path / "v.nii.gz")
    image = nibabel.load(tmp_path / "v.nii.gz")
    np.testing.assert_array_equal(np.asarray(image.dataobj), result.volume.numpy())
    np.testing.assert_allclose(image.affine, GRID.affine)
    assert nibabel.aff2axcodes(image.affine) == ("R", "A", "S") and image.header.get_xyzt_units()[0] == "mm"
    assert [f.name for f in tmp_path.iterdir()] == ["v.nii.gz"]
    result.save_nifti(tmp_path / "v.nii.gz", -result.volume)
    np.testing.assert_array_equal(np.asarray(nibabel.load(tmp_path / "v.nii.gz").dataobj), -result.volume.numpy())
    with pytest.raises(ValueError, match="give one value for each"):
        result.save_nifti(tmp_path / "v.nii.gz", result.volume[1:])


@pytest.mark.parametrize("name", SAMPLERS)
def test_settings_are_described_in_plain_json_that_tells_methods_apart(name):
    told = {n: json.dumps(describe(s)) for n, s in SAMPLERS.items()}
    assert sum(t == told[name] for t in told.values()) == 1
    assert json.loads(told[name])["class"] in ("SplitGibbs", "PriorOnly")


def test_the_window_of_the_prior_is_the_window_of_the_result(prior):
    x = random_like((1, 1, 16, 16, 16), torch.float32, seed=9).clamp(-1, 1)
    y = PROJECTOR(HUWindow(-1000, 600).to_mu(x))[0]
    sampler = SplitGibbs(10, ProximalCG(60, noise=1e-3), ProximalCG(60, noise=1e-3))
    assert Posterior(prior, sampler).reconstruct(y, PROJECTOR).misfit < 0.01


@dataclass(frozen=True)
class Own(Sampler):
    """A sampler that gives what its `function` makes of the noise."""

    function: Callable = field(default=lambda measurement, x: x.clamp(-1, 1))

    def steps(self):
        return 1

    def sample(self, denoiser, measurement, x, generator, on_step=lambda: None):
        on_step()
        return self.function(measurement, x)


class Short(Own):
    def sample(self, denoiser, measurement, x):
        return x


@pytest.mark.parametrize("sampler, words", [
    (Own(lambda measurement, x: None), r"sample of the sampler Own must return .* of shape \(1, 4, .* gave NoneType"),
    (Own(lambda measurement, x: x[..., :-1]), r"sample of the sampler Own must return .* gave \(1, 4, 16, 16, 15\)"),
    (Own(lambda measurement, x: x[0, 0]), r"sample of the sampler Own must return .* gave \(16, 16, 16\)"),
    (Short(), r"sample of the sampler Short is called as .*on_step\), but is written as \(denoiser, measurement, x\)")])
def test_what_a_sampler_of_ones_own_gives_wrongly_is_one_sentence_that_names_its_class(prior, sampler, words):
    with pytest.raises(ValueError, match=words):
        Posterior(prior, sampler).reconstruct(views(), PROJECTOR)


def test_what_explains_no_xrays_is_told_of_every_method_but_one_that_does_not_look_at_them(prior):
    dense = torch.full((1, prior.state_channels, *GRID.shape), 1.0)
    with pytest.warns(UserWarning, match="no volume was found .* and the method does not correct"):
        Posterior(prior, Own(lambda measurement, x: dense)).reconstruct(views(), PROJECTOR)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Posterior(prior, PriorOnly(2)).reconstruct(views(), PROJECTOR).misfit > BAD_GUESS


def test_a_prior_whose_window_cannot_hold_air_is_refused():
    prior = tiny_prior()
    prior.window = HUWindow(-900, 600)
    with pytest.raises(ValueError, match="the prior's window begins at -900 HU, so that air"):
        Posterior(prior)
