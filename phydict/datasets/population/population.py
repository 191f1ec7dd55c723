"""New patients drawn from a few: prepared CTs, registered to the one in their midst, and combinations of their shapes.

Each CT i has a stationary velocity v_i, whose flow leads from the template to it. A shape is the flow of a combination
of them, and of fields that make organs larger or smaller; it is a diffeomorphism, whatever the combination. A patient's
CT is carried into it by going back to the template and on to the patient: I_k(exp(v_k)(exp(-v)(x))).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from phydict.datasets.case import Case
from phydict.datasets.population.anatomy import Anatomy, Variation, principal_modes
from phydict.datasets.population.carry import carry, fine_flow, sources
from phydict.datasets.population.findings import put_findings
from phydict.datasets.population.organs import ORGANS, PULL, expansion, organs
from phydict.datasets.population.velocity import jacobian, resize
from phydict.datasets.prose import write_report
from phydict.grid import Grid
from phydict.units import HUWindow

LEAST_JACOBIAN = 0.15
"""Smallest Jacobian that a drawn map may have; a draw below it is taken nearer to its patient."""

CONTRAST_HU = 100.0
"""Median HU between the lungs above which a CT shows contrast agent."""


class Population:
    """What registered CTs make drawable.

    cases: N prepared Cases, as an indexed sequence. velocities: (N, 3, x, y, z), from the template to each.
    template: the index of the one whose velocity is 0.
    """

    def __init__(self, cases: Sequence[Case], velocities: Tensor, template: int, grid: Grid, window: HUWindow):
        self.cases, self.velocities, self.template = cases, velocities, template
        self.grid, self.window = grid, window
        self.flows = [fine_flow(velocity, grid.shape) for velocity in velocities]
        self._last: tuple[Anatomy, Tensor] | None = None

    @cached_property
    def modes(self):
        """Principal modes of the shapes, (M, N)."""
        return principal_modes(self.velocities)

    @cached_property
    def expansions(self) -> dict[str, Tensor]:
        """For each organ the velocity (3, x, y, z) that multiplies its volume by e."""
        case = self.cases[self.template]
        shares = organs(self.window.to_hu(case["volume"][0]), case["masks"], self.grid)
        lattice = self.velocities.shape[2:]
        return {name: expansion(resize(shares[name][None], lattice)[0], self.grid.extent, PULL[name])
                for name in ORGANS}

    def velocity(self, anatomy: Anatomy) -> Tensor:
        """(3, x, y, z), from the template to the shape of an anatomy."""
        shape = torch.tensordot(torch.tensor(anatomy.weights, dtype=torch.float32), self.velocities, dims=1)
        return shape + sum(getattr(anatomy, name) * self.expansions[name] for name in ORGANS)

    def draw(self, seed: int, variation: Variation = Variation()) -> Anatomy:
        """A random anatomy, near enough to its patient for a map without tears; the same for the same seed."""
        anatomy = Anatomy.draw(seed, self.modes, variation)
        if self.cases[anatomy.patient]["report"]:
            anatomy = replace(anatomy, findings=())
        for _ in range(8):
            if float(jacobian(self.sources(anatomy)).min()) > LEAST_JACOBIAN:
                return anatomy
            anatomy = anatomy.towards_patient(0.3)
        return anatomy.towards_patient(1.0)

    def sources(self, anatomy: Anatomy) -> Tensor:
        """Where an anatomy's voxels take their values in its patient's CT, (3, X, Y, Z) in half-widths of the box. The
        last anatomy's are kept, which drawing has looked at before its case is made."""
        if self._last is None or self._last[0] != anatomy:
            self._last = anatomy, sources(self.velocity(anatomy), self.flows[anatomy.patient], self.grid.shape)
        return self._last[1]

    def case(self, anatomy: Anatomy, seed: int = 0) -> Case:
        """The Case of an anatomy. seed: of its findings' looks and of its report's words.

        A patient's own report is kept. A report is written where findings were put in; else it is empty.
        """
        case = self.cases[anatomy.patient]
        if replace(anatomy, findings=()) != Anatomy.of(anatomy.patient, len(self.cases)):
            case = carry(case, self.sources(anatomy), self.grid, self.window, anatomy.lungs)
        if not anatomy.findings:
            return case
        hu, masks = self.window.to_hu(case["volume"]), case["masks"]
        blood = hu[0][organs(hu[0], masks, self.grid)["heart"] > 0]
        contrast = bool(len(blood)) and float(blood.median()) > CONTRAST_HU
        changed, shares, findings = put_findings(hu[0].numpy(), masks.numpy(), self.grid, anatomy.findings, contrast,
                                                 seed)
        volume = self.window.to_range(torch.from_numpy(changed).float())[None]
        return case | {"volume": volume, "masks": torch.from_numpy(shares).float(),
                       "report": write_report(findings, contrast, seed) if findings else case["report"]}
