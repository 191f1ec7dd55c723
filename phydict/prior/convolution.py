"""Layers of networks that a CPU computes faster: 3D convolutions by oneDNN wherever torch would take its slow road, and
Swish in one pass over memory for MONAI's three.

For float32 batches of one, torch sends a convolution whose input has few channels times slices times rows to
`slow_conv3d`, forward and backward, which takes two to four times as long as oneDNN's. In bfloat16 oneDNN is wrong, by
more than half and otherwise each time, where a stride leaves a single voxel along the last axis.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

SLOW_UP_TO = 20480
"""Channels times slices times rows of a single float32 input up to which torch does not ask oneDNN."""

THIN = 2
"""Voxels along an axis of an input up to which bfloat16 gives way to float32 on a CPU."""


class FastConv3d(nn.Conv3d):
    """nn.Conv3d, with the same weights, names and results, by oneDNN where that is faster, and right on thin slabs."""

    def _conv_forward(self, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        if self._taken_wrongly(x):
            with torch.autocast("cpu", enabled=False):
                exact = (None if values is None else values.float() for values in (x, weight, bias))
                return self._conv_forward(*exact).bfloat16()  # type: ignore[arg-type]
        if not self._taken_slowly(x, weight):
            return super()._conv_forward(x, weight, bias)
        return _OneDNN.apply(x, weight, bias, self.stride, self.padding, self.dilation)

    @staticmethod
    def _taken_wrongly(x: Tensor) -> bool:
        autocast = torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu") == torch.bfloat16
        return x.device.type == "cpu" and min(x.shape[2:]) <= THIN and (autocast or x.dtype == torch.bfloat16)

    def _taken_slowly(self, x: Tensor, weight: Tensor) -> bool:
        return (x.device.type == "cpu" and x.dtype == weight.dtype == torch.float32 and len(x) == 1 and self.groups == 1
                and x.shape[1] * x.shape[2] * x.shape[3] <= SLOW_UP_TO and self.padding_mode == "zeros"
                and not isinstance(self.padding, str) and not torch.is_autocast_enabled("cpu")
                and torch.backends.mkldnn.is_available() and not torch.compiler.is_compiling())


class _OneDNN(torch.autograd.Function):
    """A convolution and its gradients, both by oneDNN."""

    @staticmethod
    def forward(ctx, x, weight, bias, stride, padding, dilation):
        ctx.save_for_backward(x, weight)
        ctx.settings = stride, padding, dilation
        ctx.bias_shape = None if bias is None else list(bias.shape)
        return torch.ops.aten.mkldnn_convolution(x, weight, bias, padding, stride, dilation, 1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        x, weight = ctx.saved_tensors
        wanted = [*ctx.needs_input_grad[:2], ctx.needs_input_grad[2] and ctx.bias_shape is not None]
        # Only inputs in oneDNN's own layout keep torch from its slow road here.
        parts = torch.ops.aten.convolution_backward(
            gradient.to_mkldnn(), x.to_mkldnn(), weight, ctx.bias_shape, *ctx.settings, False, [0] * 3, 1, wanted)
        return *(part.to_dense() if part is not None and part.is_mkldnn else part for part in parts), None, None, None


def channels_last(network: nn.Module) -> None:
    """Lays the channels of every nn.Conv3d of a network side by side in memory, in place: faster where they are few."""
    for module in network.modules():
        if isinstance(module, nn.Conv3d):
            lay_out(module)


def lay_out(network: nn.Module, memory_format: torch.memory_format = torch.channels_last_3d) -> None:
    """Lays out a network's weights of five axes in memory, in place."""
    network.to(memory_format=memory_format)  # type: ignore[call-overload]  # which torch's stub lacks


def silence(layer: nn.Module) -> None:
    """Makes a layer answer with zeros, in place."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


def speed_up(network: nn.Module) -> None:
    """Makes every nn.Conv3d of a network a FastConv3d and every Swish of MONAI's a SiLU, in place; weights and their
    names stay."""
    from monai.networks.blocks.activation import Swish

    for module in list(network.modules()):
        if type(module) is nn.Conv3d:
            module.__class__ = FastConv3d
        for name, child in module.named_children():
            if isinstance(child, Swish) and child.alpha == 1:
                setattr(module, name, nn.SiLU())
