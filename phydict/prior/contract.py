"""What a method asks of a prior: whatever keeps this contract takes the place of a trained one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol
from zlib import crc32

import torch
from torch import nn

from phydict.diffusion import Denoiser
from phydict.grid import Grid
from phydict.prior.files import load_prior
from phydict.prior.medsyn.checkpoint import MedSynCheckpoint
from phydict.runtime.own_code import check_takes, imported, is_own, own_code, words
from phydict.runtime.precision import precision_name
from phydict.runtime.reading import naming
from phydict.runtime.warning import warn
from phydict.units import HUWindow

OWN_PRECISION = "own"
"""What a prior of one's own computes in where its class does not say it."""

HARDLY_NOISY, FAR = 0.02, 0.8
"""The noise level of a state of air, and how far from it, in the prior's range, the mean of what a denoiser makes of it
may lie: noise and shares in [0, 1] lie 1 from it, HU 999."""

OF_MODULES = frozenset(vars(nn.Module()))
"""Attributes that every torch.nn.Module has."""


class PriorContract(ABC):
    """A prior of one's own: derive from it, in an importable module, and give its object to `phydict.reconstruct`, or
    the path of its class, such as my_module.MyPrior, to `--model.prior`.

    grid, window: where the volumes live, and the HU that x = -1 and 1 stand for; state_channels: channels of the state,
    the CT first, then soft masks in [-1, 1]; reads_text: whether `bind` takes a report; ends_at_zero: whether its own
    sampling ends with a call at time 0 (see PriorOnly); precision: what its network computes in, such as "float32", as
    records name it. A torch.nn.Module is moved to the device of the X-rays and set to evaluation, as by `eval()`;
    others answer on the device of x.
    """

    grid: Grid
    window: HUWindow
    state_channels: int = 1
    reads_text: bool = False
    ends_at_zero: bool = False
    precision: str = OWN_PRECISION

    def takes(self, shape: Sequence[int]) -> bool:
        """Whether its denoisers take states of this shape as well, as voxels of the same size: where the X-rays show
        that the patient continues beyond `grid`, more of them are reconstructed then."""
        return tuple(shape) == self.grid.shape

    @abstractmethod
    def bind(self, report: str, guidance: float, precision: str) -> Denoiser:
        """The denoiser of states (B, state_channels, *grid.shape) for one report, "" for none: `denoise(x, t)`, the
        estimate of the clean state of x at a time t in [0, 1], and `schedule`, such as CosineSchedule(), which says how
        noisy x is then.

        guidance: scale of classifier-free guidance; precision: see phydict.runtime.precision. States are of float32, or
        of float64 where the weights of a torch.nn.Module are; the answer may be of another type, such as bfloat16.

        The schedule of another network derives from CosineSchedule and says anew `alpha_bar(t)`, the share of the clean
        state's variance in x, a tensor that falls from nearly 1 at t = 0 to nearly 0 at t = 1 and reaches neither, and
        `time(sigma)`, the time in [0, 1] of a noise level, as a number. CosineSchedule makes of these what samplers
        ask for: `scales(t)`, the weights (sqrt(alpha_bar), sqrt(1 - alpha_bar)) of the clean state and of the noise in
        x; `sigma(t)`, the noise level, their quotient sqrt((1 - alpha_bar) / alpha_bar), of which `time` is the
        inverse; and `steps(n, start)`, pairs of times (t, s) from `start` down to 0. A whole one, of a network that
        predicts the noise, is in data/example/own_prior/noise_prior.py.
        """

    def identity(self) -> dict:
        """What decides its answers, as plain JSON values: its class, voxels, HU window and channels, and those of its
        attributes that are plain, but for what every torch.nn.Module has. A prior with weights adds their checksum, so
        that results of others are not taken for its own."""
        plain = {name: value for name, value in vars(self).items()
                 if isinstance(value, str | int | float | None) and name not in OF_MODULES}
        return {"class": f"{type(self).__module__}.{type(self).__qualname__}", "grid": self.grid.to_dict(),
                "window": [self.window.low, self.window.high], "state_channels": self.state_channels} | plain


class AnyPrior(Protocol):
    """What keeps the contract, derived from PriorContract or not: what `load_prior` returns does as well."""

    @property
    def grid(self) -> Grid: ...

    @property
    def window(self) -> HUWindow: ...

    @property
    def state_channels(self) -> int: ...

    def bind(self, report: str, guidance: float, precision: str, /) -> Denoiser: ...


def check_prior(prior: object) -> None:
    """Raises ValueError unless an object keeps the contract; it need not derive from PriorContract."""
    kinds = {"grid": Grid, "window": HUWindow, "state_channels": int}
    bad = [name for name, kind in kinds.items() if not isinstance(getattr(prior, name, None), kind)]
    bad += [] if callable(getattr(prior, "bind", None)) else ["bind"]
    if bad:
        raise ValueError("a prior has a grid (Grid), a window (HUWindow), state_channels (int) and a method bind, but "
                         f"{type(prior).__name__} lacks {', '.join(bad)}: see phydict.prior.PriorContract")


def bound(prior: AnyPrior, report: str, guidance: float, precision: str) -> Denoiser:
    """What a prior's `bind` returns. Raises ValueError, naming the class, unless that is a denoiser with a schedule,
    and warns where the schedule's time is not the inverse of its sigma."""
    name = f"the prior {type(prior).__name__}"
    check_takes(prior.bind, f"bind of {name}", "report", "guidance", "precision")
    denoiser = prior.bind(report, guidance, precision)
    schedule = getattr(denoiser, "schedule", None)
    lacking = ["denoise"] if not callable(getattr(denoiser, "denoise", None)) else []
    lacking += ["schedule"] if schedule is None else [
        f"schedule.{method}" for method in ("scales", "sigma", "time", "steps")
        if not callable(getattr(schedule, method, None))]
    if schedule is None or lacking:
        raise ValueError(f"bind of {name} must return a denoiser, which has denoise(x, t) and a schedule such as "
                         f"CosineSchedule(), but what it gave, {type(denoiser).__name__}, lacks {', '.join(lacking)}: "
                         "see phydict.prior.PriorContract.bind")
    check_takes(denoiser.denoise, f"denoise of {name}", "x", "t")
    if abs((found := float(schedule.time(float(schedule.sigma(0.5))))) - 0.5) > 0.01:
        warn(f"the schedule of {name} contradicts itself: time(sigma(0.5)) is {found:.3g} in place of 0.5, so that "
             "some samplers ask it at wrong times: write its time as the inverse of its sigma")
    return denoiser


def check_answer(prior: AnyPrior, denoiser: Denoiser, state: torch.Tensor) -> None:
    """Warns where a denoiser of one's own makes something else of hardly noisy air, in states like `state`, as one does
    that answers by the noise or in HU."""
    if not is_own(type(prior)):
        return
    t = denoiser.schedule.time(HARDLY_NOISY)
    signal, noise = map(float, denoiser.schedule.scales(t))
    drawn = torch.randn(state.shape, generator=torch.Generator().manual_seed(0)).to(state)
    found = float(denoiser.denoise(noise * drawn - signal, t)[:, :1].float().mean())
    if abs(found + 1) > FAR:
        warn(f"denoise of the prior {type(prior).__name__} makes {found:.3g} on the mean of a state of air, -1 "
             "everywhere, with hardly any noise: it is to estimate the clean state, whose values lie in [-1, 1] over "
             "the HU window, not the noise, HU or shares: see phydict.prior.PriorContract.bind")


def precision_of(prior: AnyPrior, precision: str, x: torch.Tensor) -> str:
    """The precision that results name for a prior's networks, given the one asked for and the state x; a prior of the
    user's own says it itself."""
    return str(getattr(prior, "precision", OWN_PRECISION)) if is_own(type(prior)) else precision_name(precision, x)


def is_class_path(given: object) -> bool:
    """Whether what is given as a prior is the path of a class, such as my_module.MyPrior, and no file."""
    module, _, name = given.rpartition(".") if isinstance(given, str) else ("", "", "")
    return bool(module and name[:1].isupper()) and not Path(str(given)).exists()


def own_identity(prior: AnyPrior, given: object) -> dict | None:
    """What decides the answers of a prior given as an object or by the path of its class: its own `identity`, or its
    plain attributes, its `own_code`, and the CRC-32 of its weights; None for one that is read from a file."""
    if isinstance(given, str | Path | MedSynCheckpoint) and not is_class_path(given):
        return None
    stated = getattr(prior, "identity", None)
    identity = stated() if callable(stated) else PriorContract.identity(prior)  # type: ignore[arg-type]
    identity = identity | own_code(type(prior))
    if not isinstance(prior, nn.Module) or "weights_crc32" in identity:
        return identity
    crc = 0
    for weight in prior.state_dict().values():
        crc = crc32(weight.cpu().contiguous().flatten().view(torch.uint8).numpy(), crc)
    return identity | {"weights_crc32": crc}


def find_prior(given: str | Path | MedSynCheckpoint | AnyPrior) -> AnyPrior:
    """The prior that is given: an object that keeps the contract, what `load_prior` reads, or one with its defaults by
    the path of its class.

    Raises as `load_prior`, and ValueError where the class cannot be imported or made, or keeps no contract.
    """
    if not isinstance(given, str | Path | MedSynCheckpoint):
        check_prior(given)
        return given
    if not is_class_path(given):
        return load_prior(given)
    with naming(f"the prior {given} cannot be imported"):
        kind = imported(str(given))
    try:
        prior = kind()
    except (Exception, SystemExit) as error:  # of whatever kind: another's code runs
        raise ValueError(f"the prior {given} cannot be made ({words(error)}): its settings need defaults") from error
    check_prior(prior)
    return prior
