"""Convolutions by oneDNN are torch's, forward and backward, whatever their shape."""

import pytest
import torch
from torch import nn

from phydict.prior import LocalUNet
from phydict.prior.convolution import FastConv3d, _OneDNN, speed_up
from prior.tiny import tiny_correction, tiny_prior, tiny_refiner

CASES = {"3x3x3": (dict(kernel_size=3, padding=1), (1, 8, 6, 5, 4)),
         "1x1x1": (dict(kernel_size=1), (1, 8, 4, 4, 4)),
         "strided": (dict(kernel_size=3, stride=2, padding=1), (1, 8, 8, 6, 8)),
         "within slices": (dict(kernel_size=(1, 3, 3), padding=(0, 1, 1)), (1, 8, 3, 6, 5)),
         "without bias": (dict(kernel_size=3, padding=1, bias=False), (1, 8, 6, 6, 6)),
         "several": (dict(kernel_size=3, padding=1), (2, 8, 6, 6, 6)),
         "large": (dict(kernel_size=3, padding=1), (1, 8, 52, 52, 2))}
layouts = pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last_3d], ids=["first", "last"])


def both(settings: dict, layout: torch.memory_format) -> tuple[nn.Conv3d, nn.Conv3d]:
    """A convolution, and the same sped up."""
    torch.manual_seed(0)
    plain = nn.Conv3d(8, 12, **settings)
    fast = nn.Conv3d(8, 12, **settings)
    fast.load_state_dict(plain.state_dict())
    speed_up(fast)
    assert type(fast) is FastConv3d
    return plain.to(memory_format=layout), fast.to(memory_format=layout)


@layouts
@pytest.mark.parametrize("settings, shape", CASES.values(), ids=CASES)
def test_values_and_gradients_are_those_of_torch(settings, shape, layout):
    plain, fast = both(settings, layout)
    x = torch.randn(shape).contiguous(memory_format=layout)
    found = []
    for convolution in (plain, fast):
        inputs = x.clone().requires_grad_()
        y = convolution(inputs)
        found.append([y, *torch.autograd.grad((y**2).sum(), [inputs, *convolution.parameters()])])
    for expected, value in zip(*found):
        torch.testing.assert_close(value, expected, atol=2e-4, rtol=1e-4)


@layouts
@pytest.mark.parametrize("shape", [(6, 6, 1), (6, 6, 2), (6, 6, 3), (2, 6, 6), (1, 1, 1)], ids=str)
def test_bfloat16_is_near_float32_on_thin_slabs_too(shape, layout):
    plain, fast = both(dict(kernel_size=3, stride=2, padding=1), layout)
    x = torch.randn(1, 8, *shape).contiguous(memory_format=layout)
    with torch.no_grad():
        expected = plain(x)
        with torch.autocast("cpu", torch.bfloat16):
            found = fast(x)
        cast = fast.bfloat16()(x.bfloat16())
    assert found.dtype == cast.dtype == torch.bfloat16
    for values in (found, cast):
        torch.testing.assert_close(values.float(), expected, atol=0.03, rtol=0.03)


def test_a_frozen_network_and_frozen_inputs_get_the_gradients_they_need():
    plain, fast = both({"kernel_size": 3}, torch.contiguous_format)
    x = torch.randn(1, 8, 5, 5, 5)
    for convolution in (plain, fast):
        convolution(x).sum().backward()
    torch.testing.assert_close(fast.weight.grad, plain.weight.grad)
    for convolution in (plain, fast):
        convolution.requires_grad_(False)
    inputs = [x.clone().requires_grad_() for _ in range(2)]
    plain(inputs[0]).sum().backward()
    fast(inputs[1]).sum().backward()
    torch.testing.assert_close(inputs[1].grad, inputs[0].grad)


def test_monais_swish_keeps_its_values_and_its_weight():
    from monai.networks.blocks.activation import Swish

    x = torch.linspace(-20, 20, 100)
    network = nn.Sequential(Swish(), nn.Sequential(Swish(2.0)))
    expected = network(x)
    speed_up(network)
    assert type(network[0]) is nn.SiLU and type(network[1][0]) is Swish
    torch.testing.assert_close(network(x), expected)


def test_a_small_input_goes_to_onednn_and_others_as_torch_likes(monkeypatch):
    asked = []
    monkeypatch.setattr(_OneDNN, "apply", lambda x, *_: asked.append(x.shape) or x)
    _, fast = both({"kernel_size": 3, "padding": 1}, torch.contiguous_format)
    fast(torch.zeros(1, 8, 4, 4, 4))
    assert len(asked) == 1
    fast(torch.zeros(2, 8, 4, 4, 4))
    fast.double()(torch.zeros(1, 8, 4, 4, 4, dtype=torch.float64))
    with torch.autocast("cpu", torch.bfloat16):
        fast.float()(torch.zeros(1, 8, 4, 4, 4))
    assert len(asked) == 1


@pytest.mark.parametrize("make", [
    lambda: tiny_prior(detail=True), lambda: tiny_refiner(uncertain=True), lambda: tiny_correction(uncertain=True),
    lambda: LocalUNet(channels=(8, 16))], ids=["prior", "refiner", "correction", "second stage"])
def test_every_convolution_of_a_network_is_sped_up(make):
    assert not [name for name, module in make().named_modules() if type(module) is nn.Conv3d]
