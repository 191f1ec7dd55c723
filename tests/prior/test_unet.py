"""The network: space-to-depth and back loses nothing, and an untrained one can learn."""

import torch
from einops import rearrange
from laws import random_like

from phydict.prior import VolumeUNet


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
