"""The network: space-to-depth and back loses nothing, an untrained one can learn, and how it runs changes nothing."""

from copy import deepcopy

import pytest
import torch
from einops import rearrange
from laws import random_like

from phydict.prior import VolumeUNet
from prior.tiny import REPORTS, tiny_prior


def network(**settings):
    torch.manual_seed(0)
    return VolumeUNet(**{"state_channels": 2, "channels": (8, 8), "attention": (False, True), "head_channels": 8,
                         "context_dim": 16} | settings)


def test_an_untrained_network_is_silent_and_yet_its_gradient_is_not():
    net, x = network(), random_like((1, 2, 8, 8, 8), torch.float32)
    y = net(x, torch.tensor([0.5]), torch.zeros(1, 1, 16))
    assert (y == 0).all()
    (y - 1).square().sum().backward()
    assert net.unfold.weight.grad.abs().max() > 0


def test_each_voxel_comes_back_to_its_place():
    net = network(channels=(16, 16))
    net.unet = torch.nn.Module()
    net.unet.forward = lambda h, t, context: h
    net.fold = net.unfold = torch.nn.Identity()
    x = random_like((2, 2, 8, 12, 16), torch.float32)
    assert torch.equal(net(x, torch.zeros(2), torch.zeros(2, 1, 16)), x)  # the untrained hint of the text is zero


def test_a_block_holds_neighbours():
    net, seen = network(), {}
    net.fold.register_forward_hook(lambda _, inputs, __: seen.update(folded=inputs[0]))
    x = random_like((1, 2, 8, 8, 8), torch.float32)
    net(x, torch.tensor([0.5]), torch.zeros(1, 1, 16))
    blocks = rearrange(seen["folded"], "1 (c n) x y z -> c n x y z", c=2)
    torch.testing.assert_close(blocks.mean(1)[None], torch.nn.functional.avg_pool3d(x, 2))


def test_settings_build_the_same_network_again():
    net = network(block=4)
    again = VolumeUNet(**net.settings)
    again.load_state_dict(net.state_dict())
    x = random_like((1, 2, 16, 16, 16), torch.float32)
    torch.nn.init.ones_(net.unfold.weight), torch.nn.init.ones_(again.unfold.weight)
    arguments = (x, torch.tensor([0.3]), torch.zeros(1, 1, 16))
    assert net(*arguments).any() and torch.equal(net(*arguments), again(*arguments))
    assert net.divisor == again.divisor == 8


def gradients(net: VolumeUNet) -> list[torch.Tensor]:
    x, context = random_like((2, 2, 8, 8, 8)), random_like((2, 3, 16), seed=1)
    net(x, torch.tensor([0.2, 0.7]), context).square().mean().backward()
    return [weight.grad for weight in net.parameters() if weight.grad is not None]


def awake(**flags) -> VolumeUNet:
    """A network in float64 whose layers that start at zero do not."""
    net = network().double()
    for weight in net.parameters():
        if weight.ndim > 1 and not weight.any():
            torch.nn.init.normal_(weight, std=0.1, generator=torch.Generator().manual_seed(1))
    return net.run_with(**flags)


@pytest.mark.parametrize("flags, tolerance", [
    ({"gradient_checkpointing": True}, 1e-12), ({"channels_last": False}, 1e-12),
    pytest.param({"compiled": True}, 1e-6, marks=pytest.mark.slow),
], ids=["checkpointing", "layout", "compiled"])
def test_how_it_runs_changes_neither_gradients_nor_names(flags, tolerance, monkeypatch):
    compile_module = torch.nn.Module.compile
    monkeypatch.setattr("torch.nn.Module.compile",  # the whole path but the C++ compiler, which takes minutes
                        lambda net, **settings: compile_module(net, backend="aot_eager", **settings))
    plain, other = awake(), awake(**flags)
    largest = max(float(gradient.abs().max()) for gradient in gradients(awake()))
    for expected, gradient in zip(gradients(plain), gradients(other), strict=True):
        torch.testing.assert_close(gradient, expected, rtol=0, atol=tolerance * largest)
    assert list(plain.state_dict()) == list(other.state_dict()) and plain.settings == other.settings
    assert list(dict(plain.named_parameters())) == list(dict(other.named_parameters()))


def test_checkpointed_blocks_are_computed_again_for_the_gradient_and_only_then():
    calls = {}
    for checkpointing in (False, True):
        net, seen = awake(gradient_checkpointing=checkpointing), []
        net.blocks()[0].norm1.register_forward_hook(lambda *_: seen.append(1))
        with torch.no_grad():
            net(random_like((1, 2, 8, 8, 8)), torch.tensor([0.5]), random_like((1, 3, 16)))
        evaluated = len(seen)
        gradients(net)
        calls[checkpointing] = (evaluated, len(seen) - evaluated)
    assert calls == {False: (1, 1), True: (1, 2)}


def test_a_checkpointed_copy_computes_with_its_own_weights():
    net = awake(gradient_checkpointing=True)
    copy = deepcopy(net)  # as weight averaging makes one
    with torch.no_grad():
        net.blocks()[0].conv1.conv.weight.zero_()
    arguments = random_like((1, 2, 8, 8, 8)), torch.tensor([0.5]), random_like((1, 3, 16))
    assert torch.equal(copy(*arguments), awake()(*arguments)) and not torch.equal(net(*arguments), copy(*arguments))


@torch.no_grad()
def test_the_map_of_a_report_stays_where_it_is_in_more_voxels():
    prior = tiny_prior()
    network, context = prior.network, prior.context([REPORTS[0]])
    own = network.hint_over(context, (8, 8, 8))
    assert own.std((2, 3, 4)).max() > 0
    grown = network.hint_over(context, (8, 10, 12))
    assert torch.equal(grown[..., 1:9, 2:10], own)
    assert torch.equal(grown[..., 1:9, :2], own[..., :1].expand(-1, -1, -1, -1, 2))
    assert torch.equal(grown[:, :, :, -1], grown[:, :, :, -2])


@pytest.mark.parametrize("settings, words", [
    ({"attention": (True,)}, r"attention \[True\] and channels \[8, 8\]"),
    ({"head_channels": 16}, r"attend not below head_channels, but \[8, 8\] and head_channels 16"),
    ({"channels": (8, 16), "attention": (True, True), "head_channels": 16}, r"but \[8, 16\] and head_channels 16"),
    ({"channels": (8, 12)}, r"multiples of 8, .* but \[8, 12\]")])
def test_a_network_that_cannot_be_built_is_refused_by_its_settings(settings, words):
    with pytest.raises(ValueError, match=words):
        network(**settings)
