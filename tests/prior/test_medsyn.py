"""MedSyn's networks: exactly its parameters, what each part may and may not see, and where voxels go."""

import csv
import hashlib
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from laws import random_like
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.functional import interpolate

from phydict import reconstruct
from phydict.diffusion import guided
from phydict.grid import Grid
from phydict.methods import reconstructor
from phydict.posterior import PriorOnly, ProximalCG, SplitGibbs
from phydict.prior import MedSynPrior, MedSynSuperResolution, TextEncoder, learn_vocabulary
from phydict.prior.medsyn.networks import (
    ChannelNorm,
    SelfAttention,
    Sinusoid,
    SuperResolutionUNet,
    TextUNet,
    from_slices,
    to_slices,
)
from phydict.prior.medsyn.prior import atlas_grid
from phydict.xray import ConeBeam
from prior.medsyn_files import super_resolution_unet, text_unet
from prior.peak import Peak
from prior.tiny import tiny_prior

GRID = Grid((8, 4, 6), (40.0, 80.0, 48.0))
X = random_like((1, 4, 8, 4, 6), torch.float32, seed=1)
SLICES = random_like((1, 4, 6, 4, 8), torch.float32, seed=2)
CONTEXT = random_like((1, 6, 16), torch.float32, seed=3)
TIME = torch.tensor([0.4])


class Words(nn.Module):
    """Reports -> contexts by their length alone."""

    def forward(self, reports):
        states = torch.stack([random_like((6, 16), torch.float32, seed=len(report)) for report in reports])
        return states, torch.ones(states.shape[:2], dtype=torch.bool)


def prior(**settings) -> MedSynPrior:
    return MedSynPrior(text_unet(**settings), Words(), grid=GRID)


@pytest.mark.parametrize("kind, parameters, count, digest", [
    (TextUNet, 716_215_684, 377, "5b8d204876778dbd3ba83e3a842b89b542079cf1cd4319928eff602add8eaf33"),
    (SuperResolutionUNet, 54_307_908, 317, "cd2d69f28d4c1bf2319f015a969cd13fe0860930f501e5d8bbe351dd1da1a244")])
def test_the_full_size_networks_have_exactly_medsyns_names_and_shapes(kind, parameters, count, digest):
    """The digest is of "name<tab>shape" lines of MedSyn's checkpoints, sorted, without the prefix denoise_fn."""
    with torch.device("meta"):
        network = kind()
    assert sum(weight.numel() for weight in network.parameters()) == parameters
    lines = sorted(f"{name}\t{tuple(weight.shape)}" for name, weight in network.state_dict().items())
    assert len(lines) == count and hashlib.sha256("\n".join(lines).encode()).hexdigest() == digest


@pytest.mark.parametrize("network, condition", [(text_unet, CONTEXT), (super_resolution_unet, SLICES)])
def test_the_order_of_the_way_up_changes_the_result_but_no_name(network, condition):
    early, late = network(upsample_first=True), network(upsample_first=False)
    early.load_state_dict(late.state_dict())
    difference = early(SLICES, TIME, condition) - late(SLICES, TIME, condition)
    assert difference.std() > 0.01 * late(SLICES, TIME, condition).std()


def test_everything_given_reaches_the_estimate():
    network, fine = text_unet(), super_resolution_unet()
    for one, other in (((SLICES, TIME, CONTEXT), (SLICES, TIME, -CONTEXT)),
                       ((SLICES, TIME, CONTEXT), (SLICES, TIME + 0.1, CONTEXT)),
                       ((SLICES, TIME, CONTEXT), (-SLICES, TIME, CONTEXT))):
        assert not torch.allclose(network(*one), network(*other), rtol=1e-3)
    assert not torch.allclose(fine(SLICES, TIME, SLICES), fine(SLICES, TIME, -SLICES), rtol=1e-3)
    assert not torch.allclose(fine(SLICES, TIME, 0 * SLICES), fine(0 * SLICES, TIME, SLICES), rtol=1e-3)


def test_slices_are_never_downsampled_and_rows_and_columns_are():
    shapes = []
    network = text_unet(multipliers=(1, 2, 4))
    network.mid_block1.register_forward_hook(lambda _, inputs, __: shapes.append(tuple(inputs[0].shape[2:])))
    network(random_like((1, 4, 5, 8, 12), torch.float32), TIME, CONTEXT)
    assert shapes == [(5, 2, 3)]


def test_the_self_attentions_of_stage_1_are_one_and_its_norms_are_four():
    network = text_unet()
    assert len({id(network.get_submodule(f"mid_spatial_attn{n}").fn.fn.fn) for n in (1, 2, 3, 4)}) == 1
    assert len({id(network.get_submodule(f"mid_spatial_attn{n}").fn.norm) for n in (1, 2, 3, 4)}) == 4


def test_self_attention_is_softmax_of_scaled_products_by_head():
    attention = SelfAttention(16, 2)
    x = random_like((3, 5, 16), torch.float32)
    q, k, v = attention.to_qkv(x).chunk(3, dim=2)
    heads = [(q[..., h] @ k[..., h].mT / 32**0.5).softmax(-1) @ v[..., h] for h in (slice(0, 32), slice(32, 64))]
    torch.testing.assert_close(attention(x), attention.to_out(torch.cat(heads, 2)))


def test_self_attention_stays_in_its_slice_and_knows_no_order_within_it():
    attend = text_unet().mid_spatial_attn1
    x = random_like((1, 16, 3, 2, 2), torch.float32)
    changed = x.clone()
    changed[:, :, 0] += 1 + random_like((1, 16, 2, 2), torch.float32, seed=9)
    assert torch.allclose(attend(x)[:, :, 1:], attend(changed)[:, :, 1:], atol=1e-6)
    assert not torch.allclose(attend(x)[:, :, 0], attend(changed)[:, :, 0], atol=1e-2)
    torch.testing.assert_close(attend(x.flip(4)), attend(x).flip(4))


def test_cross_attention_knows_no_order_of_tokens_and_attends_to_every_one():
    attend = text_unet().mid_cross_attn1
    x = random_like((1, 16, 3, 2, 2), torch.float32)
    torch.testing.assert_close(attend(x, CONTEXT), attend(x, CONTEXT.flip(1)))
    for token in range(6):
        without = torch.cat([CONTEXT[:, :token], CONTEXT[:, token + 1:]], 1)
        assert not torch.allclose(attend(x, CONTEXT), attend(x, without), atol=1e-5)


def test_channels_are_normed_voxel_by_voxel():
    norm = ChannelNorm(16)
    x = 3 + 5 * random_like((2, 16, 2, 3, 4), torch.float32)
    torch.testing.assert_close(norm(x).mean(1), torch.zeros(2, 2, 3, 4), atol=1e-5, rtol=0)
    torch.testing.assert_close(norm(x).square().mean(1), torch.ones(2, 2, 3, 4), atol=1e-4, rtol=0)


def test_times_are_sines_then_cosines_of_frequencies_from_one_to_a_ten_thousandth():
    angle = 250.0 * torch.tensor([1.0, 10000 ** -(1 / 3), 10000 ** -(2 / 3), 1e-4])
    torch.testing.assert_close(Sinusoid(8)(torch.tensor([250.0])), torch.cat([angle.sin(), angle.cos()])[None],
                               atol=1e-4, rtol=0)


def test_a_voxel_goes_where_medsyn_has_it_and_comes_back():
    volume = torch.zeros(1, 1, 5, 6, 7)
    volume[0, 0, 4, 1, 2] = 1  # far right, second from posterior, third from inferior
    assert to_slices(volume).shape == (1, 1, 7, 6, 5)
    assert to_slices(volume)[0, 0, 2, 1, 0] == 1  # third from inferior, second from posterior, first from the right
    assert torch.equal(from_slices(to_slices(volume)), volume)


def test_a_prior_shows_its_network_medsyns_axes_and_returns_ours():
    one, seen = prior(), {}
    one.network.forward = lambda x, t, context: seen.update(x=x) or x
    assert torch.equal(one.bind(precision="float32").denoise(X, 0.5), X)
    assert seen["x"][0, 2, 5, 1, 0] == X[0, 2, 7, 1, 5]
    fine, coarse = MedSynSuperResolution(super_resolution_unet(), GRID), random_like((1, 4, 2, 1, 3), torch.float32)
    fine.network.forward = lambda x, t, coarse: coarse
    x = torch.zeros(1, 4, 8, 4, 12)
    assert torch.equal(fine.bind(coarse, precision="float32").denoise(x, 0.5), interpolate(coarse, x.shape[2:]))


def test_the_atlas_is_316_by_316_by_292_mm_at_both_stages():
    for voxels in (64, 256):
        assert atlas_grid(voxels).extent == pytest.approx([316, 316, 292])
        assert atlas_grid(voxels).centre == pytest.approx([0, 0, 0])
    with torch.device("meta"):
        base, fine = MedSynPrior(TextUNet()), MedSynSuperResolution(SuperResolutionUNet())
    assert base.grid.same_as(atlas_grid(64)) and fine.grid.same_as(atlas_grid(256))
    assert (base.window.to_hu(-1.0), base.window.to_hu(1.0)) == (-1024, 600) and base.window == fine.window
    assert tuple(fine.factor * n for n in base.grid.shape) == fine.grid.shape


def test_no_report_is_the_learned_context_and_a_report_is_the_encoders():
    one = prior()
    both = one.context(["a report", ""])
    assert torch.equal(both[0], Words()(["a report"])[0][0]) and torch.equal(both[1], one.null[0])
    assert torch.equal(one.context(["", ""]), one.null.expand(2, -1, -1))
    bare = MedSynPrior(one.network, lambda reports: Words()(reports)[0], grid=GRID)
    assert torch.equal(bare.context(["a report"]), one.context(["a report"]))


def test_a_report_that_is_cut_or_foreign_is_warned_of_and_another_is_not():
    words = learn_vocabulary(["No effusion. Clear lungs."])
    one = MedSynPrior(text_unet(), TextEncoder.small(words, 16, length=6), grid=GRID)
    for report, said in (("Clear lungs. No effusion. Clear lungs.", "longer than the 6 tokens"),
                         ("肺 結節", "words that the text encoder does not know")):
        with pytest.warns(match=said):
            one.bind(report)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one.bind("Clear lungs.")
        one.bind()


def test_guidance_leads_away_from_the_estimate_without_a_report():
    one = prior()
    with_report, without = (one.bind(report, precision="float32").denoise(X, 0.5) for report in ("a report", ""))
    assert not torch.equal(with_report, without)
    torch.testing.assert_close(one.bind("a report", 3.0, precision="float32").denoise(X, 0.5),
                               guided(with_report, without, 3.0))
    assert torch.equal(one.bind("", 3.0, precision="float32").denoise(X, 0.5), without)


@pytest.mark.parametrize("stage", [lambda precision: prior().bind("a report", precision=precision),
                                   lambda precision: MedSynSuperResolution(super_resolution_unet(), GRID).bind(
                                       X[:, :, :2, :1, :2], precision=precision)])
def test_half_precision_changes_the_estimate_slightly(stage):
    x = random_like((1, 4, 8, 4, 8), torch.float32, seed=4)
    full, low = stage("float32").denoise(x, 0.5), stage("bfloat16").denoise(x, 0.5)
    assert low.dtype == torch.float32
    assert 0 < (low - full).square().mean().sqrt() < 0.05 * full.std()


def test_a_batch_is_denoised_as_its_members_are():
    x = random_like((2, 4, 8, 4, 6), torch.float32, seed=5)
    together = prior().bind("a report", precision="float32").denoise(x, 0.7)
    alone = torch.cat([prior().bind("a report", precision="float32").denoise(part, 0.7) for part in x.split(1)])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)


def test_a_network_can_be_differentiated():
    x = X.clone().requires_grad_()
    estimate = prior()(x, TIME, CONTEXT)
    direction, step = random_like(X.shape, torch.float32, seed=7), 1e-2
    slope = torch.autograd.grad((estimate * direction).sum(), x)[0]
    with torch.no_grad():
        moved = [(prior()(X + s * step * slope, TIME, CONTEXT) * direction).sum() for s in (-1, 1)]
    assert (moved[1] - moved[0]) / (2 * step) == pytest.approx(float(slope.square().sum()), rel=0.02)


BEAM = replace(ConeBeam.orbit(2, 1020.0, 740.0, (12, 12), 48.0), continued=False)
XRAYS = torch.linspace(1.5, 2.5, 288).view(2, 12, 12)


@pytest.mark.parametrize("sampler", [PriorOnly(2), SplitGibbs(2), SplitGibbs(
    2, t_start=0.3, t_end=0.2, noise_fraction=0.0, final_likelihood=ProximalCG(2))], ids=["prior", "ddim", "fast"])
def test_every_sampler_works_with_it(sampler):
    result = reconstruct(XRAYS, BEAM, prior(), sampler, report="a report", seed=3)
    assert result.volume.shape == (8, 4, 6) and -1024 <= result.volume.min() < result.volume.max() <= 600
    assert result.masks.shape == (3, 8, 4, 6)
    assert result.network_calls == (3 if isinstance(sampler, PriorOnly) else 2)
    again = reconstruct(XRAYS, BEAM, prior(), sampler, report="a report", seed=3)
    assert torch.equal(result.volume, again.volume)


def times_of(network) -> list[float]:
    """A list that grows by the time of every call of a network of MedSyn's."""
    times = []
    network.register_forward_pre_hook(lambda _, inputs: times.append(float(inputs[1])))
    return times


def test_sampled_alone_it_ends_as_medsyns_inference_does():
    """Stage 1 in 51 calls, 1000, 980, ..., 0; stage 2 in 21, 1000, 950, ..., 0."""
    one, fine, steps = prior(), MedSynSuperResolution(super_resolution_unet(), GRID), []
    times, fine_times = times_of(one.network), times_of(fine.network)
    found = reconstruct(XRAYS, BEAM, one, PriorOnly(50), on_step=lambda: steps.append(1))
    assert times == pytest.approx([(50 - i) / 50 for i in range(51)])
    assert found.network_calls == len(steps) == reconstructor(PriorOnly(50), one).steps() == 51
    PriorOnly(20).suited(fine).sample(fine.bind(X[:, :, :2, :1, :2]), None, torch.zeros(1, 4, 8, 4, 8), None)
    assert fine_times == pytest.approx([(20 - i) / 20 for i in range(21)])


def test_the_last_call_can_be_left_out_and_other_priors_make_none():
    assert reconstructor(PriorOnly(5, final_denoise=False), prior()).steps() == 5
    assert reconstructor(PriorOnly(5), tiny_prior(False)).steps() == 5
    assert reconstructor(PriorOnly(5, final_denoise=True), tiny_prior(False)).steps() == 6


def test_the_second_stages_noise_takes_its_share_of_the_coarse_state_on_fine_voxels():
    fine, coarse = MedSynSuperResolution(super_resolution_unet(), GRID), random_like((1, 4, 2, 1, 3), torch.float32)
    noise = torch.randn(1, 4, 8, 4, 12, generator=torch.Generator().manual_seed(5))
    for share in (0.0, 0.1, 1.0):
        given = fine.bind(coarse, share, generator=torch.Generator().manual_seed(5)).coarse
        torch.testing.assert_close(given, (1 - share) * fine.upsample(coarse) + share * noise)
    assert torch.equal(fine.bind(coarse, 0.1).coarse, fine.upsample(coarse))  # it carries its noise already


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_second_stage_states_the_memory_of_a_call(dtype):
    with FakeTensorMode():  # full size, nothing computed
        fine = MedSynSuperResolution(SuperResolutionUNet()).requires_grad_(False)
        denoiser = fine.bind(torch.zeros(1, 4, 64, 64, 64), precision=str(dtype).removeprefix("torch."))
        x = torch.zeros(1, 4, 256, 256, 256)
        with Peak() as peak:
            denoiser.denoise(x, 0.5)
    assert 0.7 < peak.most / (256**3 * fine.network.bytes_per_voxel(dtype)) < 1


def test_the_stated_memory_is_that_of_a_measured_call():
    """tests/benchmark/medsyn.csv, on 128^3 voxels in bfloat16."""
    rows = csv.DictReader((Path(__file__).parents[1] / "benchmark" / "medsyn.csv").open())
    row = next(row for row in rows if row["stage"] == "2")
    taken = 2**20 * (int(row["peak_mib"]) - int(row["peak_mib_before_the_call"]))
    with torch.device("meta"):
        network = SuperResolutionUNet()
    assert row["precision"] == "bfloat16"
    assert taken == pytest.approx(int(row["voxels"]) * network.bytes_per_voxel(torch.bfloat16), rel=0.1)


def test_a_second_stage_that_needs_more_memory_than_it_may_take_says_how_much_it_needs():
    with torch.device("meta"):
        fine = MedSynSuperResolution(SuperResolutionUNet())
    with pytest.raises(ValueError, match=r"256.* about 36 GiB in float32, but 4 GiB .*resolution.memory 36") as error:
        fine.check_memory(torch.float32)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="about 18.5 GiB in bfloat16"):
        fine.check_memory(torch.bfloat16)
    fine.memory = 36 * 2**30
    fine.check_memory(torch.float32)


def test_the_second_stage_samples_on_the_fine_voxels_of_a_part():
    fine = MedSynSuperResolution(super_resolution_unet())
    denoiser = fine.bind(random_like((1, 4, 2, 1, 2), torch.float32), 0.1, precision="float32")
    state = PriorOnly(2).sample(denoiser, None, random_like((1, 4, 8, 4, 8), torch.float32, seed=8), None)
    assert state.shape == (1, 4, 8, 4, 8) and state.isfinite().all() and denoiser.schedule == fine.schedule


@pytest.mark.parametrize("wrong, words", [
    (lambda: MedSynPrior(text_unet(), grid=Grid((8, 5, 6), 1.0)), "divisible by 2, but the grid is"),
    (lambda: prior().bind(guidance=-1.0), "guidance scale is at least 0"),
    (lambda: MedSynPrior(text_unet(), grid=GRID).bind("a report"), "no text encoder, but a report was given"),
    (lambda: MedSynPrior(text_unet(tokens=9), Words(), grid=GRID).bind("a report"), "9 tokens of 16 .* gave .6, 16."),
    (lambda: MedSynSuperResolution(super_resolution_unet()).bind(X[:, :1]), "whole state"),
    (lambda: MedSynSuperResolution(super_resolution_unet()).bind(X, noise=1.5), "noise level of the coarse state"),
    (lambda: MedSynSuperResolution(super_resolution_unet()).bind(X).denoise(X, 0.5), "the same region")])
def test_what_does_not_fit_is_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        wrong()
