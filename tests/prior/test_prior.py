"""The prior's preconditioning, its contexts and its guidance."""

import pytest
import torch
from laws import random_like

from phydict.diffusion import GaussianDenoiser
from phydict.grid import Grid
from phydict.prior import DetailNetwork, Prior, VolumeUNet
from phydict.units import HUWindow
from prior.tiny import REPORTS, tiny_prior

SHAPE = (1, 4, 16, 16, 16)
X = random_like(SHAPE, seed=1)


@pytest.fixture(scope="module", params=[False, True], ids=["blocks alone", "with detail"])
def prior(request):
    return tiny_prior(detail=request.param).double()


def untrained(detail=None):
    return Prior(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8, 16), Grid.cube(16), HUWindow(), sigma_data=0.4,
                 detail=detail).double()


@pytest.mark.parametrize("detail", [None, DetailNetwork()], ids=["blocks alone", "with detail"])
@pytest.mark.parametrize("t", [0.0, 0.2, 0.6, 1.0])
def test_an_untrained_prior_is_the_exact_denoiser_of_gaussian_detail_of_its_skip_std(t, detail):
    expected = GaussianDenoiser(torch.zeros(()).double(), torch.tensor(0.1**2).double()).denoise(X, t)
    torch.testing.assert_close(untrained(detail).bind().denoise(X, t), expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("t", [0.05, 0.2])
def test_detail_is_added_where_it_can_be_seen_and_stays_of_its_size(t):
    told, silent = tiny_prior(detail=True).double(), tiny_prior(detail=True).double()
    torch.nn.init.zeros_(silent.detail.leave.weight)
    torch.nn.init.zeros_(silent.detail.leave.bias)
    sigma = float(told.schedule.sigma(torch.tensor(t).double()))
    size = sigma * told.skip_std / (sigma**2 + told.skip_std**2) ** 0.5
    answers = []
    told.detail.register_forward_hook(lambda *call: answers.append(call[2]))
    added = told.bind().denoise(X, t) - silent.bind().denoise(X, t)
    torch.testing.assert_close(added, size * answers[0])
    assert answers[0].abs().mean() > 0.01


def test_a_detail_network_is_not_asked_where_noise_hides_all_detail():
    prior, asked = tiny_prior(detail=True), []
    prior.detail.register_forward_hook(lambda *call: asked.append(call[1][2]))
    for t in (0.1, 0.3, 0.6, 1.0):
        prior.bind().denoise(X.float(), t)
    assert torch.cat(asked).tolist() == pytest.approx([0.1, 0.3])


def test_in_training_a_detail_network_is_asked_at_any_noise_and_adds_nothing_beyond_its_reach():
    prior, asked = tiny_prior(detail=True), []
    still = prior.bind().denoise(X.float(), 0.8)
    prior.detail.register_forward_hook(lambda *call: asked.append(call[2]))
    torch.testing.assert_close(prior.train().bind().denoise(X.float(), 0.8), still)
    assert asked[0].abs().mean() > 0.01


def test_without_noise_the_state_is_returned_whatever_the_network_says(prior):
    for t, closeness in ((0.0, 0.05), (0.7, None)):
        change = float((prior.bind().denoise(X, t) - X).square().mean().sqrt())
        assert change < closeness if closeness else change > 0.3


def test_the_network_answers_to_state_time_and_text(prior):
    def answer(x=X, t=0.5, report=""):
        return prior.network(x, torch.tensor([t]), prior.context([report]))

    for other in (answer(x=X.flip(2)).flip(2), answer(t=0.4), answer(report=REPORTS[0])):
        assert (other - answer()).square().mean().sqrt() > 0.01 * answer().std()
    reports = [answer(report=r) for r in REPORTS[:2]]
    assert (reports[0] - reports[1]).square().mean().sqrt() > 1e-3 * answer().std()


def test_each_case_of_a_batch_is_denoised_alone(prior):
    x, t = random_like((2, *SHAPE[1:]), seed=2), torch.tensor([0.3, 0.8])
    context = prior.context([REPORTS[0], ""])
    alone = torch.cat([prior(x[i:i + 1], t[i:i + 1], context[i:i + 1]) for i in range(2)])
    torch.testing.assert_close(prior(x, t, context), alone)


def test_a_network_that_does_not_divide_the_grid_is_refused_with_both_numbers():
    with pytest.raises(ValueError, match=r"divisible by 4.*\(18, 18, 18\)"):
        Prior(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8, 16), Grid.cube(18), HUWindow())


def test_an_empty_report_and_padding_are_the_null_token(prior):
    assert torch.equal(prior.context(["", ""]), prior.null.expand(2, 1, -1))
    context, (states, mask) = prior.context([REPORTS[0], ""]), prior.text([REPORTS[0], ""])
    assert (context[1] == prior.null).all()
    assert 0 < mask[0].sum() < mask.shape[1]
    assert (context[0][~mask[0]] == prior.null[0, 0]).all()
    assert torch.equal(context[0][mask[0]], states[0][mask[0]])


def test_a_reports_context_does_not_depend_on_its_batch(prior):
    together = prior.context([*REPORTS, ""])
    for report, context in zip(REPORTS, together):
        torch.testing.assert_close(prior.context([report])[0], context)


def test_one_null_token_says_as_much_as_many(prior):
    t = torch.tensor([0.5])
    many = prior.null.expand(1, 24, -1)
    torch.testing.assert_close(prior(X, t, prior.context([""])), prior(X, t, many))


@pytest.mark.parametrize("scale", [0.0, 1.0, 3.0])
def test_guidance_is_linear_between_no_report_and_report(prior, scale):
    without, report = prior.bind().denoise(X, 0.5), prior.bind(REPORTS[1]).denoise(X, 0.5)
    torch.testing.assert_close(prior.bind(REPORTS[1], scale).denoise(X, 0.5), without + scale * (report - without))


def test_without_a_report_there_is_nothing_to_guide(prior):
    assert torch.equal(prior.bind("", 4.0).denoise(X, 0.5), prior.bind().denoise(X, 0.5))


def test_half_precision_changes_little_and_double_is_kept():
    prior = tiny_prior()
    x = X.float()
    full, low = (prior.bind(precision=p).denoise(x, 0.5) for p in ("float32", "bfloat16"))
    assert low.dtype == torch.float32 and 0 < (low - full).square().mean().sqrt() < 0.03 * full.std()
    assert prior.double().bind().denoise(X, 0.5).dtype == torch.float64


def test_bad_requests_are_refused(prior):
    with pytest.raises(ValueError, match="at least 0"):
        prior.bind(REPORTS[0], -1.0)
    with pytest.raises(ValueError, match="leave the report out"):
        tiny_prior(text=False).bind(REPORTS[0])
    assert tiny_prior(text=False).bind("").denoise(X.float(), 0.5).isfinite().all()
