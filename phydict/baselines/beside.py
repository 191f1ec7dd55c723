"""What stands beside a volume, such as the arms or the couch of a patient wider than it, taken off the X-rays."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from phydict.baselines.tv import FISTATV
from phydict.grid import Grid
from phydict.reconstruction import Delegating, Reconstruction, Reconstructor
from phydict.runtime.profiling import Stopwatch
from phydict.runtime.warning import Remark, warn
from phydict.units import hu_to_mu
from phydict.xray.beyond import coarsened, unexplained
from phydict.xray.boxes import outside_projection, seen_by
from phydict.xray.geometry import ConeBeam
from phydict.xray.projectors.projector import Projector
from phydict.xray.residuals import misfits

LEAST_VIEWS = 4
"""Views from which on total variation tells what stands beside the volume from what is in it."""

MORE, LEAST = 0.25, 0.06
"""Shares of the volume's width that are looked at beside it, at each side: at most, and at least where the geometry
leaves so much room."""

FULL, LEAST_PIXELS = 0.3, 4
"""The line integral beyond that of a volume full of water, and how many pixels, of a detector binned to the coarse
voxels, must read as much for something to be seen beside it: of three CTs of 420 to 460 mm, from four views, 6 or more
do, of CTs that end inside 2 at most, whose X-rays scatter, wrong poses and drift do not raise."""

SUSPECT = 2.0
"""How many times what conjugate gradients leave of the X-rays in the volume is what they leave in the wider one for
something to be looked for that is not seen: 2.6 or more where arms stand there, 1.3 at most where nothing does."""

TRIES, EXPLAINED, GROSS, MUCH = 50, 1.45, 0.055, 2.5
"""Iterations of total variation that look for it; how many times its misfit in the volume must be that in the wider one
for what is seen: of the wide CTs 1.39 to 1.6 from four views and 2.1 or more from eight, of patients who fill the
volume 1.02 at most, of a tube's X-rays 1.38 from four views and 1.13 from eight; and, for what is not, how large it
must be and how many times that in the wider one: with arms 0.05 to 0.14 and 2.9 or more, of X-rays that hold half as
much scatter as signal or whose detector stands 8 mm elsewhere 0.053 and 3.3 at most."""


@dataclass(frozen=True)
class Beside(Delegating):
    """`base`, from X-rays of which what stands beside its volume was subtracted.

    Args:
        base: the method
        target: its voxels
        outside: line integrals (K, V, U) of what stands beside them
        seconds, calls: that it took to find, and applications of the wider box's operator or its adjoint
    """

    base: Reconstructor
    target: Grid
    outside: Tensor
    seconds: float = 0.0
    calls: int = 0

    @property
    def survey(self) -> Grid | None:
        return self.base.survey

    def steps(self) -> int:
        return self.base.steps()

    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        found = self.base.reconstruct(xrays - self.outside, projector, report, display, seed, on_step)
        outside = self.outside.cpu()
        y, reprojection = found.xrays + outside, found.reprojection + outside
        return replace(found, xrays=y, reprojection=reprojection, **misfits(reprojection, y),
                       seconds={"beside": self.seconds} | found.seconds,
                       projector_calls=self.calls + found.projector_calls)


@torch.no_grad()
def with_surroundings(method: Reconstructor, xrays: Tensor, projector: Projector, display: bool) -> Reconstructor:
    """The method, or, where the X-rays (K, V, U) show that something stands beside its volume, one that takes it into
    account, which is said in a remark: a coarse reconstruction by total variation of a wider box shows what stands
    there (region-of-interest tomography; Ziegler, Nielsen & Grass 2008, Medical Physics 35(4)).

    Asked of LEAST_VIEWS views or more, of line integrals, where source and detectors leave room beside the volume. It
    is seen where rays that hardly meet the volume show more than water that fills it, and else has to explain much.
    """
    beam, volume = projector.beam, method.survey or projector.grid
    coarse = coarsened(volume)
    wide = _wider(coarse, beam)
    if display or beam.views < LEAST_VIEWS or wide is None:
        return method
    y, A = seen_by(coarse, xrays, replace(beam, continued=True), False)
    full = method.mu_water * A(torch.ones(1, 1, *coarse.shape).to(y))[0]
    seen = int((y > full + FULL).sum()) >= LEAST_PIXELS
    if not seen and unexplained(xrays, beam, coarse) < SUSPECT * unexplained(xrays, beam, wide):
        return method
    watch = Stopwatch()
    with watch.stage("beside"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the method will say itself what is doubtful of the X-rays
        quick, thorough = (FISTATV(iterations=n, mu_water=method.mu_water) for n in (TRIES, FISTATV.iterations))
        alone, together = (quick.reconstruct(*seen_by(grid, xrays, beam, False)).misfit for grid in (coarse, wide))
        if not ((seen and alone > EXPLAINED * together) or alone > max(GROSS, MUCH * together)):
            return method
        found = thorough.reconstruct(*seen_by(wide, xrays, beam, False))
        box = Projector(volume, replace(beam, continued=False), projector.method, device=xrays.device,
                        full_detector=True)
        outside = outside_projection(hu_to_mu(found.volume.to(xrays), method.mu_water), wide, box, bool(beam.continued))
    width = " x ".join(f"{side:.0f}" for side in wide.extent[:2])
    warn("the X-rays show that something stands beside the volume, such as a wider patient, arms or a couch: what a "
         f"coarse reconstruction of {width} mm shows of it is subtracted from them", Remark)
    return Beside(method, projector.grid, outside, sum(watch.seconds.values()), found.projector_calls)


def _wider(grid: Grid, beam: ConeBeam) -> Grid | None:
    """The grid with columns added at its four sides, as many as have room; None where too few have."""
    across = max(grid.shape[:2])
    choices = range(round(MORE * across), max(1, math.ceil(LEAST * across)) - 1, -1)
    return next((wide for n in choices if beam.has_room_for(wide := grid.grown(n, n, 0))), None)
