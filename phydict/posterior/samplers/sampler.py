"""What every sampler promises, and sampling the prior alone (Eqs. 1 and 2 without X-rays)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from torch import Tensor

from phydict.diffusion import Denoiser, Generators, ddim
from phydict.prior import DEFAULT_PRIOR
from phydict.runtime.own_code import check_takes

if TYPE_CHECKING:
    from phydict.posterior.measurement import Measurement


class Sampler(ABC):
    """Settings of a sampling method; `sample` turns noise into a clean state. A sampler of one's own has
    @dataclass(frozen=True) above its class, as records tell its fields as the settings.

    full_detector, citation: as for a Reconstructor. default_prior: the file of its network where none is given;
    needs_refiner: whether that is a Refiner. sees_xrays: whether results depend on the X-rays. chests_only: whether one
    material in air is left to a method without a network (`Posterior.otherwise`). batches: whether the states of a
    batch do not influence each other, so that several samples may be drawn at once, with one generator for each.
    """

    settings_are_fields = True
    full_detector = False
    default_prior = DEFAULT_PRIOR
    needs_refiner = False
    sees_xrays = True
    chests_only = False
    citation = ""
    batches = False

    @abstractmethod
    def sample(self, denoiser: Denoiser, measurement: Measurement, x: Tensor, generator: Generators,
               on_step: Callable[[], None] = lambda: None) -> Tensor:
        """Noise x (B, C, X, Y, Z) at time 1 -> clean states, which are returned as a tensor of the same shape;
        `generator` is the source of any further noise."""

    @abstractmethod
    def steps(self) -> int:
        """How often `sample` calls on_step."""

    def suited(self, prior: object) -> Sampler:
        """These settings, with what they leave to a prior decided; these, unless overridden."""
        return self

    def for_sampling(self) -> Sampler:
        """The settings of which independent runs differ as far as the posterior is wide; these, unless overridden."""
        return self


def check_sampler(sampler: Sampler) -> None:
    """Raises ValueError, naming the class, unless `sample` takes what it is given."""
    check_takes(sampler.sample, f"sample of the sampler {type(sampler).__name__}", "denoiser", "measurement", "x",
                "generator", "on_step")


def check_drawn(sampler: Sampler, drawn: Any, x: Tensor) -> Tensor:
    """What `sample` gave of the noise x, of whatever type, in that of x. Raises ValueError, naming the class, unless
    these are states like x."""
    if not isinstance(drawn, Tensor) or drawn.shape != x.shape:
        found = tuple(drawn.shape) if isinstance(drawn, Tensor) else type(drawn).__name__
        raise ValueError(f"sample of the sampler {type(sampler).__name__} must return clean states, a tensor of shape "
                         f"{tuple(x.shape)} like the noise that it is given, but gave {found}")
    return drawn.to(x)


def ddim_sample(denoiser: Denoiser, x: Tensor, iterations: int, start: float = 1.0,
            on_step: Callable[[], None] = lambda: None, final_denoise: bool = False) -> Tensor:
    """Deterministic descent of the state x from time `start` to its clean end, clipped to the prior's range.

    final_denoise: denoise once more at time 0.
    """
    for t, s in [*denoiser.schedule.steps(iterations, start), *[(0.0, 0.0)] * final_denoise]:
        x0 = denoiser.denoise(x, t).clamp(-1, 1)
        x = ddim(denoiser.schedule, x0, x, t, s)
        on_step()
    return x0
