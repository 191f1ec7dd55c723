"""SIRT: simultaneous iterative reconstruction with positivity, the classical yardstick without a prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from phydict.reconstructor import Reconstruction, Reconstructor, Stopwatch, check_xrays, misfits
from phydict.units import MU_WATER, mu_to_hu
from phydict.xray import Projector
from phydict.xray.calibration import match_views


@dataclass(frozen=True)
class SIRT(Reconstructor):
    """mu <- max(0, mu + C A.T R (y - A mu)), R and C the inverse row and column sums of A (Gregor & Benson 2008,
    doi:10.1109/TMI.2008.923696), from zero.

    iterations: more fit the views better and, on noisy data, the noise too. Display values need a scale to start
    from: they are first matched to a water ellipse of a typical chest.
    """

    citation = ("Gregor & Benson, Computational Analysis and Improvement of SIRT, IEEE Transactions on Medical Imaging "
                "27(7), 2008, doi:10.1109/TMI.2008.923696")

    iterations: int = 300
    mu_water: float = MU_WATER
    name: str = "sirt"

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"SIRT needs at least 1 iteration, but {self.iterations} was given")

    def steps(self) -> int:
        return self.iterations

    @torch.no_grad()
    def reconstruct(self, xrays: Tensor, projector: Projector, report: str = "", display: bool = False,
                    seed: int = 0, on_step: Callable[[], None] = lambda: None) -> Reconstruction:
        watch, A = Stopwatch(), projector
        check_xrays(xrays, A.beam)
        with watch.stage("prepare"):
            y = xrays[None]
            ones = torch.ones(1, 1, *A.grid.shape).to(xrays)
            if display:
                y = match_views(y, A(typical_chest(A).to(xrays) * self.mu_water))
            rows, columns = (1 / w.clamp(min=1e-6 * float(w.max())) for w in (A(ones), A.T(torch.ones_like(y))))
            mu = torch.zeros_like(ones)
        with watch.stage("sample"):
            for _ in range(self.iterations):
                mu = (mu + columns * A.T(rows * (y - A(mu)))).clamp(min=0)
                on_step()
        with watch.stage("score"):
            reprojection = A(mu)[0].cpu()
        return Reconstruction(
            volume=mu_to_hu(mu[0, 0], self.mu_water).cpu(), grid=A.grid, method=self.name, seed=seed,
            **misfits(reprojection, y[0].cpu()), seconds=watch.seconds, xrays=y[0].cpu(), reprojection=reprojection,
            projector_calls=2 * self.iterations + 3)


def typical_chest(projector: Projector) -> Tensor:
    """Density relative to water (1, 1, X, Y, Z) of an upright elliptic cylinder, 320 x 220 mm, with two lungs."""
    grid = projector.grid
    index = torch.stack(torch.meshgrid(*[torch.arange(n) for n in grid.shape], indexing="ij"), -1).double()
    affine = torch.tensor(grid.affine)
    x, y, _ = (index @ affine[:3, :3].T + affine[:3, 3] - torch.tensor(grid.centre)).unbind(-1)
    body = (x / 160) ** 2 + (y / 110) ** 2 < 1
    lungs = ((x.abs() - 75) / 55) ** 2 + (y / 80) ** 2 < 1
    return (body.float() - 0.75 * (body & lungs).float())[None, None]
