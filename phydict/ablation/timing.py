"""Where the time of a reconstruction goes: a prior and a projector that keep a stopwatch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from phydict.diffusion import Denoiser
from phydict.runtime.profiling import Stopwatch
from phydict.xray import Projector


class TimedPrior:
    """A prior whose denoisers count their time as the stage "network". Backward passes through it are not in it."""

    def __init__(self, prior, watch: Stopwatch):
        self.grid, self.window, self.state_channels = prior.grid, prior.window, prior.state_channels
        self.ends_at_zero = getattr(prior, "ends_at_zero", False)
        self._prior, self._watch = prior, watch

    def bind(self, report: str, guidance: float, precision: str) -> Denoiser:
        return TimedDenoiser(self._prior.bind(report, guidance, precision), self._watch)


class TimedDenoiser:
    """A denoiser whose calls are the stage "network"."""

    def __init__(self, denoiser: Denoiser, watch: Stopwatch):
        self.schedule, self._denoiser, self._watch = denoiser.schedule, denoiser, watch

    def denoise(self, x: Tensor, t: float) -> Tensor:
        with _stage(self._watch, "network", x):
            return self._denoiser.denoise(x, t)


class TimedProjector:
    """A projector whose applications, those of its adjoint by autograd too, are the stage "projector"."""

    def __init__(self, projector: Projector, watch: Stopwatch):
        self.grid, self.beam = projector.grid, projector.beam
        self._projector, self._watch = projector, watch

    def __call__(self, mu: Tensor) -> Tensor:
        return _Timed.apply(mu, self._projector, self._projector.T, self._watch)

    def T(self, xrays: Tensor) -> Tensor:
        return _Timed.apply(xrays, self._projector.T, self._projector, self._watch)

    def norm(self) -> float:
        return self._projector.norm()


class _Timed(torch.autograd.Function):
    """y = there(x), linear, whose gradient is back(y)."""

    @staticmethod
    def forward(ctx, x, there, back, watch):
        ctx.there, ctx.back, ctx.watch = there, back, watch
        with _stage(watch, "projector", x):
            return there(x)

    @staticmethod
    def backward(ctx, gradient):
        return _Timed.apply(gradient, ctx.back, ctx.there, ctx.watch), None, None, None


@contextmanager
def _stage(watch: Stopwatch, name: str, x: Tensor) -> Iterator[None]:
    with watch.stage(name):
        if x.is_cuda:
            torch.cuda.synchronize(x.device)
        yield
        if x.is_cuda:
            torch.cuda.synchronize(x.device)


class WarmUp:
    """An on_step that ends a reconstruction, by raising Warm, after its second step."""

    class Warm(Exception):
        """The reconstruction has seen all of its code."""

    def __init__(self, on_step: Callable[[], None] = lambda: None):
        self.steps, self.on_step = 0, on_step

    def __call__(self) -> None:
        self.steps += 1
        self.on_step()
        if self.steps == 2:
            raise self.Warm
