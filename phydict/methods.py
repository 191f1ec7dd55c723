"""The named reconstruction methods, and a reconstruction in one call."""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from phydict.baselines import CGLS, FDK, FISTATV, SIRT, Baseline, DiffVox, Region
from phydict.baselines.extended import covering, extended
from phydict.datasets import format_report
from phydict.grid import Grid
from phydict.posterior import (
    DAPS,
    DDS,
    DPS,
    CascadePosterior,
    DiffPIR,
    ExactDraw,
    GradientSteps,
    Metal,
    PnPDM,
    Posterior,
    PriorOnly,
    ProximalCG,
    Refined,
    Refinement,
    Reward,
    Sampler,
    SplitGibbs,
    Unrolled,
)
from phydict.posterior.discretisation import FINER_STEP
from phydict.prior import (
    DEFAULT_CORRECTION,
    FINEST_CORRECTION,
    AnyPrior,
    Cascade,
    MedSynCheckpoint,
    MedSynSuperResolution,
    SuperResolution,
    find_prior,
    is_refiner,
    load_correction,
    load_super_resolution,
)
from phydict.prior.correction import TOLERANCE
from phydict.reconstruction import Reconstruction, Reconstructor
from phydict.runtime.memory import freed_memory_kept
from phydict.runtime.own_code import is_own
from phydict.runtime.precision import check_precision
from phydict.runtime.profiling import Stopwatch
from phydict.runtime.reading import reason
from phydict.runtime.seeds import check_seed
from phydict.runtime.warning import Remark, heard, warn
from phydict.units import HUWindow
from phydict.xray import ConeBeam
from phydict.xray.beyond import with_continuation
from phydict.xray.boxes import binned_to, covers
from phydict.xray.checks import check_fit, is_smaller_scene, with_air_at_zero
from phydict.xray.poses.uncertain import Uncertain
from phydict.xray.projectors.own import projector_kind

if TYPE_CHECKING:
    from phydict.poses import FoundPoses

RELEASED_STEPS = GradientSteps(learning_rate=0.01, prior_mean=True, reward=Reward(
    lpips=0.5, random_backbone=True, dropout=True, squared=0.1, pixel_mean=True, view_sum=True, standardise=True,
    raw_range=True, renderer="siddon"))
"""The likelihood step of the authors' release."""

METHODS: dict[str, Sampler | Reconstructor] = {
    # Conjugate gradients onto the X-rays at ten noise levels, the last counting each pixel by its noise.
    "phydict_fast": SplitGibbs(
        iterations=10, t_start=0.97, t_end=0.15, noise_fraction=0.7, momentum=0.5, sampling_noise=1.0, scatter=True,
        hardening=True, subgrid=FINER_STEP, metal=Metal(),
        likelihood=ProximalCG(iterations=12, restarts=1, tv_weight=10.0, tv_eps=0.003),
        final_likelihood=ProximalCG(iterations=25, restarts=3, noise=0.01, refit_scatter=True,
                                    weighted_least_squares=True, tv_weight=10.0, tv_eps=0.003, precondition_data=True,
                                    discrepancy=True)),
    # The default: a network trained on scenes of X-rays, four or six calls, each followed by conjugate gradients.
    "phydict_learned": Unrolled(chests_only=True),
    # The paper's text: two gradient steps of 0.1 per timestep with LPIPS, then Extra Compute from delta = 0.8.
    "phydict_paper": SplitGibbs(iterations=50, likelihood=GradientSteps(reward=Reward(lpips=1.0)), ec_delta=0.8,
                                ec_steps=40, full_detector=True),
    # What the authors' release does; its guidance scale of 10 is a setting beside the method.
    "phydict_released": SplitGibbs(
        iterations=50, likelihood=RELEASED_STEPS, final_likelihood=RELEASED_STEPS, ec_delta=0.8,
        ec_steps=40, full_detector=True, clip=False, final_denoise=True),
    # DAPS (Zhang et al. 2025), reduced for a CPU: 25 of 200 noise levels, 2 of 5 flow steps, and the exact draw for 100
    # Langevin steps; the last level is 0.02 instead of 0.1, since the exact draw leaves its whole spread in the volume;
    # prior_std is 0.5, the state's own.
    "daps": DAPS(levels=25, sigma_min=0.02, flow_steps=2, likelihood=ExactDraw(iterations=10), prior_std=0.5),
    # PnP-DM (Wu et al. 2024), reduced for a CPU: 30 of 100 iterations, whose coupling therefore falls by 0.85 instead
    # of 0.9, and 12 of 100 noise levels in the grid of the prior step; the result is the mean of the last six states.
    "pnp_dm": PnPDM(iterations=30, decay=0.85, levels=12, likelihood=ExactDraw(iterations=10), burn_in=24, thinning=1),
    # DiffPIR (Zhu et al. 2023) with its published constants; conjugate gradients for its closed forms.
    "diffpir": DiffPIR(iterations=100),
    # DDS (Chung, Lee & Ye 2024) with its published constants; its total variation, made for priors of slices, is off,
    # and so is gamma, its weight for noisy data.
    "dds": DDS(iterations=50),
    # DPS (Chung et al. 2023), reduced for a CPU: 100 of 1000 levels, so each is pushed ten times as far.
    "dps": DPS(iterations=100, scale=3.0),
    "prior_only": PriorOnly(iterations=50),
    "sirt": SIRT(),
    "fdk": FDK(),
    "cgls": CGLS(iterations=10, restarts=20, window=HUWindow()),
    "tv": FISTATV(),
    "diffvox": DiffVox(),
}
"""Settings by name, in Python as `method=`, on the command line as `--model.method`. configs/reconstruct writes out
four of them as examples."""

DEFAULT_METHOD, SAMPLING_METHOD = "phydict_learned", "phydict_fast"
"""The method where none is given, and the one where what is given needs a prior that is sampled."""


def default_method(prior: AnyPrior | MedSynCheckpoint | str | Path | None = None, samples: int = 1,
                   guidance: float = 1.0) -> str:
    """The method where none is given: DEFAULT_METHOD, but SAMPLING_METHOD for a prior that is no refiner, for several
    samples, and for guidance."""
    sampled = samples != 1 or guidance != 1 or not (prior is None or is_refiner(prior))
    return SAMPLING_METHOD if sampled else DEFAULT_METHOD


DEFAULT_GRID = Grid.cube(64)
"""The voxels of methods that have none of their own, and of the reconstruction that fills in what lies outside a
smaller box."""


UNGUIDED = ("{0}sampler is how the X-rays guide the second stage, but {0}guided was given as false, so that they do "
            "not: leave one of the two out")
"""Error where a sampler is given for a second stage without guidance; {0}: what the settings' names begin with."""


@torch.inference_mode(False)  # what a prior's weights are loaded in stays with them
def reconstructor(method: str | Sampler | Reconstructor, prior: AnyPrior | str | Path | None = None,
                  guidance: float = 1.0, name: str | None = None,
                  super_resolution: SuperResolution | MedSynSuperResolution | str | Path | None = None,
                  sr_guided: bool = True, sr_sampler: Sampler | None = None, sr_noise_augmentation: float | None = None,
                  samples: int = 1, precision: str = "auto") -> Reconstructor:
    """A method ready to reconstruct: a name of METHODS, a sampler (which needs a prior), or a Reconstructor.

    prior: what keeps PriorContract, as Prior does, for Unrolled a Refiner, or its file, or the path of its class; None
    for the shipped one. It is only loaded by methods that need it. name: what the result calls the method (None: its
    own name).
    super_resolution: the second stage of a cascade, or its file; None reconstructs on the prior's own grid. sr_guided:
    whether the X-rays guide that stage too; sr_sampler: how (None: CascadePosterior's own); sr_noise_augmentation: its
    noise (None: the stage's own). These three mean nothing without it.
    samples: how many to draw; of several, the result is the mean, with their standard deviation as a map.
    precision: of the networks, one of phydict.runtime.precision.PRECISIONS. Raises ValueError for what cannot be meant.
    """
    check_precision(precision)
    of_stage = [setting for setting, given in (
        ("sr_guided", not sr_guided), ("sr_sampler", sr_sampler is not None),
        ("sr_noise_augmentation", sr_noise_augmentation is not None)) if given]
    if of_stage and super_resolution is None:
        raise ValueError(f"without super_resolution there is no second stage, but {' and '.join(of_stage)} came for "
                         "it: leave that out, or give super_resolution as well")
    if sr_sampler is not None and not sr_guided:
        raise ValueError(UNGUIDED.format("sr_"))
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(f"there is no method '{method}': use one of {', '.join(METHODS)}")
        name, method = name or method, METHODS[method]
    if isinstance(method, Reconstructor):
        beside = [setting for setting, given in (
            ("prior", prior is not None), ("samples", samples != 1), ("guidance", guidance != 1),
            ("super_resolution", super_resolution is not None), ("precision", precision != "auto")) if given]
        _check_beside(method, beside)
        if precision != "auto":
            method = method.with_precision(precision)
        return method.with_name(name) if name else method
    if not isinstance(method, Sampler):
        given = f"the class {method.__name__}, not an object of it," if isinstance(method, type) else repr(method)
        raise ValueError(f"a method is a name ({', '.join(METHODS)}), a Sampler or a Reconstructor, but {given} was "
                         "given")
    loaded = _shipped(method.default_prior) if prior is None or prior == "" else find_prior(prior)
    name = name or type(method).__name__
    if super_resolution is None:
        otherwise = FISTATV() if method.chests_only else None
        return Posterior(loaded, method, guidance, name=name, precision=precision, samples=samples, otherwise=otherwise)
    if samples != 1:
        raise ValueError(f"samples are drawn of a prior without a second stage, but {samples} were given with "
                         "super_resolution: leave one of the two out")
    if isinstance(super_resolution, str | Path):
        super_resolution = load_super_resolution(super_resolution)
    ready = CascadePosterior(Cascade(loaded, super_resolution), method, sr_guided, noise=sr_noise_augmentation,
                             guidance=guidance, name=name, precision=precision)
    return replace(ready, sr_sampler=sr_sampler) if sr_sampler else ready


@lru_cache(maxsize=2)
def _shipped(file: Path) -> AnyPrior:
    """What a shipped file holds, read once in a process."""
    return find_prior(file)


OF_A_PRIOR = {"super_resolution": "refines what a prior gives", "samples": "are drawn from a prior",
              "guidance": "strengthens what a report tells a prior"}
"""Settings that mean nothing without a prior, and why."""


def _check_beside(method: Reconstructor, beside: Collection[str]) -> None:
    """Raises ValueError where settings beside a ready method mean nothing to it."""
    if isinstance(method, Posterior | CascadePosterior | Refined) and beside:
        raise ValueError(f"a ready {type(method).__name__} has its own settings, but {' and '.join(beside)} came "
                         "beside it: leave that out, or give its sampler and its prior in its place")
    for name in beside:
        if name in OF_A_PRIOR:
            raise ValueError(f"{name} {OF_A_PRIOR[name]}, but {type(method).__name__} has none: leave {name} out, or "
                             "use a method with a prior")


CORRECTIONS = {3.0: DEFAULT_CORRECTION, 1.5: FINEST_CORRECTION}
"""Length in mm of the voxels that they learnt on -> files of networks that correct estimates on these."""


def corrections_of(method: Sampler | Reconstructor, grid: Grid) -> list[Path]:
    """The files of the networks that correct a method's estimates on the way to a grid, its own `corrections` or, where
    it names none, those shipped, for the longest voxels first; none where the method needs no refiner or the grid's
    voxels are longer than those learnt on. Raises as `load_correction` where a file of its own cannot be read."""
    if not (isinstance(method, Sampler) and method.needs_refiner):
        return []
    learnt_on = {length: file for length, file in CORRECTIONS.items() if file.is_file()}
    if own := getattr(method, "corrections", ()):
        learnt_on = {float(min(load_correction(file).grid.spacing)): Path(file) for file in own}
    return [file for length, file in sorted(learnt_on.items(), reverse=True)
            if min(grid.spacing) < (1 + TOLERANCE) * length]


def onto_grid(method: Reconstructor, grid: Grid | None, refinement: Refinement = Refinement()) -> Reconstructor:
    """The method on the voxels of `grid`; None leaves it as it is.

    What is bound to voxels of its own, as a prior is, works there first, on more of them where the grid reaches beyond
    these, and is then refined (`Refined`), with a step also by the networks of `corrections_of`. A method without a
    prior works on `grid` itself, on a box that leaves out a part of the chest after a coarse reconstruction of the
    whole (`Region`). Raises ValueError where there is no way or not enough memory.
    """
    if grid is None or (method.grid is not None and method.grid.same_as(grid)):
        return method
    if isinstance(method, Refined):
        method = replace(method, base=covering(method.base, grid), target=grid)
    elif method.grid is not None:
        files = corrections_of(method.sampler, grid) if isinstance(method, Posterior) and refinement.step else []
        method = Refined(covering(method, grid), grid, refinement, tuple(map(load_correction, files)))
    elif isinstance(method, Baseline) and not covers(grid, outer := DEFAULT_GRID.turned_as(grid)):
        method = Region(method, grid, outer)
    method.check_voxels(grid, now=True)
    return method


@torch.inference_mode(False)  # in which no method that goes by gradients runs
def reconstruct_by(method: Reconstructor, grid: Grid, xrays: Tensor, beam: ConeBeam, report: str = "",
                   display: bool = False, seed: int = 0, on_step: Callable[[], None] = lambda: None,
                   projector: str | type = "auto", uncertain: Uncertain | None = None) -> Reconstruction:
    """What a method makes of X-rays (K, V, U) on `grid`, its own if it has one, or the voxels it refines to.

    First the poses are searched, where they are `uncertain`; then the X-rays are asked whether the patient
    continues beyond the voxels (`extended`) and binned; other arguments as those of `reconstruct`. Raises ValueError
    where X-rays, geometry and grid do not fit, and warns where the X-rays look inverted.
    """
    with heard() as warnings, torch.autocast(xrays.device.type, enabled=False), freed_memory_kept(
            method.bytes_on(grid)):
        if isinstance(method, Region) and is_smaller_scene(beam, method.outer):
            method = method.base  # of a scene that is smaller than a chest
        check_fit(xrays, beam, grid, method.survey, display)
        poses: FoundPoses | None = None
        if uncertain is not None:
            xrays, poses = calibrated(method, method.survey or grid, xrays, beam, uncertain, display, on_step)
            beam = poses.beam
        watch = Stopwatch()
        with watch.stage("fit to grid"):
            xrays = xrays.to(torch.float32, copy=True)  # of inference mode's none may be kept for gradients
            method, grid, beam = extended(method, grid, xrays, beam, display)
            xrays, A = binned_to(grid, xrays, beam, method.full_detector, projector, method.detector_grid(grid))
        if isinstance(method, Posterior) and getattr(method.sampler, "corrections", None):
            warn("corrections name networks for finer voxels than these, which are the method's own: they do nothing; "
                 "give a grid, such as 128", Remark)
        prepared, began = sum(watch.seconds.values()), time.perf_counter()
        result = method.reconstruct(xrays, A, report, display, seed, on_step)
        _check_returned(method, result)
        seconds = {"prepare": 0.0} | result.seconds
        if is_own(type(method)):  # whose stages may leave something out
            seconds["other"] = time.perf_counter() - began - sum(result.seconds.values())
        result = replace(result, seconds=seconds | {"prepare": prepared + seconds["prepare"]})
    return replace(poses.added_to(result) if poses else result, warnings=warnings)


def _check_returned(method: Reconstructor, result: object) -> None:
    """Raises ValueError unless a method returned a Reconstruction that has a value for each of its grid's voxels, and
    FloatingPointError where some are not finite."""
    name = f"reconstruct of the method {type(method).__name__} must return a Reconstruction"
    if not isinstance(result, Reconstruction):
        raise ValueError(f"{name}, but {type(result).__name__} came back: put the volume into one")
    if not isinstance(result.volume, Tensor):
        raise ValueError(f"{name} whose volume is a tensor in HU, but {type(result.volume).__name__} came back")
    if tuple(result.volume.shape) != tuple(result.grid.shape):
        raise ValueError(f"{name} whose volume has the grid's shape {tuple(result.grid.shape)}, but "
                         f"{tuple(result.volume.shape)} came back")
    if bad := int((~result.volume.isfinite()).sum()):
        raise FloatingPointError(f"{name} of finite HU, but {bad} of its {result.volume.numel()} voxels are NaN or "
                                 "infinite: correct the method")


def calibrated(method: Reconstructor, grid: Grid, xrays: Tensor, beam: ConeBeam, uncertain: Uncertain,
               display: bool, on_round: Callable[[], None] = lambda: None) -> tuple[Tensor, FoundPoses]:
    """The X-rays (K, V, U) without what was found of their gains and offsets, and the poses found (phydict.poses).

    on_round: called after each round of the search.

    Warns of what few views cannot show, and of views that were corrected by more than was stated.
    """
    from phydict.poses import find_poses  # and with it numba

    if not display:
        xrays = with_air_at_zero(xrays, beam)  # which the reconstruction would see no more once offsets are found
    stated, beam = beam.continued, with_continuation(xrays.float(), beam, grid, display)
    poses = find_poses(xrays, beam, uncertain, grid, display, method.mu_water, on_round=on_round)
    poses = replace(poses, beam=replace(poses.beam, continued=stated))
    for words in poses.warnings():
        warn(words)
    return xrays if display else poses.corrected(xrays), poses


def reconstruct(xrays: Tensor, beam: ConeBeam, prior: AnyPrior | str | Path | None = None,
                method: str | Sampler | Reconstructor | None = None, report: str | None = None,
                display: bool = False, seed: int = 0, guidance: float = 1.0, mu_water: float | None = None,
                grid: Grid | None = None, on_step=lambda: None,
                super_resolution: SuperResolution | MedSynSuperResolution | str | Path | None = None,
                sr_guided: bool = True, samples: int = 1, precision: str = "auto",
                projector: str | type = "auto", uncertain: Uncertain | None = None) -> Reconstruction:
    """A CT volume from X-rays (K, V, U) and their geometry.

    xrays: tensor or array of line integrals; with display=True, of display values with an unknown gain and offset per
    view. grid: the result's voxels, as for `onto_grid`; None for the prior's own, without a prior 64^3 of 6 mm.
    method: as for `reconstructor`; None for `default_method`'s. prior: as for `reconstructor`; report: radiology text,
    if any, which `format_report` lays out.
    mu_water: attenuation in 1/mm that water has in the X-rays (None: the method's own, near 65 keV).
    super_resolution, sr_guided: the second stage of a cascade, as for `reconstructor`; its grid counts as the prior's.
    samples: more than one gives their mean, and `deviation`, a map of how far they differ, as for `reconstructor`.
    precision: of the networks; "auto" is bfloat16 where the device computes it faster, else float32.
    projector: the `method` of the Projector, such as "siddon", or a class of one's own, which is made of a grid and a
    beam; "auto" is the fastest that suits the geometry. An object goes to `reconstructor(...).reconstruct(xrays,
    projector)`.
    on_step: is called without arguments after each of the method's steps. seed: of what is drawn. guidance: how
    strongly a report is followed.
    uncertain: what the geometry does not know exactly, which is then found first; the result holds `beam` and `poses`.
    A detector finer than the grid can use is binned. Raises ValueError when X-rays, geometry and prior do not fit.
    """
    if not isinstance(beam, ConeBeam):
        raise ValueError(f"the geometry must be a ConeBeam, but {' '.join(reprlib.repr(beam).split())} was given; "
                         "ConeBeam.load reads one")
    if not isinstance(grid, Grid | None):
        raise ValueError(f"the grid must be a Grid, but {grid!r} was given; Grid.cube makes one")
    if not isinstance(report, str | None):
        raise ValueError(f"the report must be text, but {report!r} was given")
    projector = projector_kind(projector)
    check_seed(seed)
    method = default_method(prior, samples, guidance) if method is None else method
    ready = reconstructor(method, prior, guidance, super_resolution=super_resolution, sr_guided=sr_guided,
                          samples=samples, precision=precision)
    ready = onto_grid(ready if mu_water is None else ready.with_mu_water(mu_water), grid)
    grid, xrays = ready.grid or grid or DEFAULT_GRID, _real(xrays)
    return reconstruct_by(ready, grid, xrays, beam, format_report(report), display, int(seed), on_step, projector,
                          uncertain)


def _real(xrays) -> Tensor:
    """X-rays as a dense tensor of numbers. Raises ValueError where they are none, or masked."""
    if np.ma.is_masked(xrays):
        raise ValueError(f"{np.ma.count_masked(xrays)} pixels of the X-rays are masked, and what lies under a mask "
                         "would count as measured: fill them, by `filled`, or leave those views out")
    try:
        if isinstance(xrays, np.ndarray):  # torch takes no reversed axes, other machine's bytes or read-only array
            xrays = np.require(xrays, xrays.dtype.newbyteorder("="), ["C", "W"])
        values = torch.as_tensor(xrays).detach()
    except Exception as error:  # NumPy and torch each have their own for what is no array of numbers
        raise ValueError(f"the X-rays must be an array of numbers, but {type(xrays).__name__} was given "
                         f"({reason(error)})") from error
    if values.layout != torch.strided or values.is_meta or values.is_complex() or values.dtype == torch.bool:
        raise ValueError(f"the X-rays must be a dense array of real numbers, but {values.dtype} on {values.device}, "
                         f"{values.layout}, was given")
    return values if values.is_floating_point() else values.float()
