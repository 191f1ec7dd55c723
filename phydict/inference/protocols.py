"""Published evaluations by name: what geometry, voxels, HU range, noise and scores their figures were taken with.

A method that is bound to no voxels works on the protocol's; one with a prior, or a trained rival, works on its own, and
its volume is resampled onto the protocol's, on which the X-rays are made and the scores are taken. CTs are centred on
the lungs, where the publications crop the middle of the scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phydict.evaluation import RANGE
from phydict.grid import Grid
from phydict.inference.settings import PAPER, Orbit
from phydict.methods import DEFAULT_GRID
from phydict.units import HUWindow
from phydict.xray import Ideal, Simulator
from phydict.xray.boxes import covers


@dataclass(frozen=True)
class Protocol:
    """A published evaluation.

    views: the numbers of views of its tables, the first where none is given; orbit: without views; cube: voxels along
    each side and the side in mm, None for the method's own; hu: the range that truth and scores are clipped to, None
    for the method's window and `RANGE`; noise: as Ideal's; scores: further ones, of evaluation.published; source.
    """

    name: str
    views: tuple[int, ...]
    orbit: Orbit
    cube: tuple[int, float] | None
    hu: HUWindow | None
    noise: float
    scores: tuple[str, ...]
    source: str

    @property
    def grid(self) -> Grid | None:
        return Grid.cube(*self.cube) if self.cube else None

    @property
    def window(self) -> HUWindow:
        """The range of the scores."""
        return self.hu or RANGE

    @property
    def note(self) -> str:
        """What a table taken by it rests on."""
        where = f"scored on {self.cube[0]}^3 voxels over {self.cube[1]:g} mm" if self.cube else "on the method's voxels"
        return f"Protocol {self.name} ({self.source}): {where}."

    def fixed_orbit(self, given: Orbit) -> Orbit:
        """The protocol's orbit with a number of views that it has. Raises ValueError where another one is given."""
        fixed = given.filled(Orbit(self.views[0]).filled(self.orbit))
        if fixed.views not in self.views:
            raise ValueError(f"data.protocol {self.name} has {', '.join(map(str, self.views))} views, but "
                             f"{fixed.views} were given: give one of these, or leave the protocol out")
        for name, value in vars(self.orbit).items():
            if name != "views" and getattr(fixed, name) != value:
                raise ValueError(f"data.protocol {self.name} fixes the orbit's {name} at {value}, but "
                                 f"{getattr(fixed, name)} was given: leave one of the two out")
        return fixed

    def fixed_simulator(self, given: Simulator) -> Simulator:
        """The protocol's simulator. Raises ValueError where another one than the default is given."""
        fixed = Ideal(noise=self.noise)
        if given not in (fixed, Ideal()):
            raise ValueError(f"data.protocol {self.name} fixes the X-rays as ideal ones with noise {self.noise:g}, but "
                             f"{given} was given: leave one of the two out")
        return fixed

    def check_simulation(self, voxels: int | None) -> None:
        """Raises ValueError where X-rays are to be made of other voxels, along each side, than as many as the protocol
        has, or a multiple."""
        if self.cube and voxels and voxels % self.cube[0]:
            raise ValueError(f"data.protocol {self.name} makes X-rays of {self.cube[0]} voxels along each side, or a "
                             f"multiple, but data.simulation_voxels {voxels} was given: give such a one, or leave one "
                             "of the two out")

    def check_voxels(self, given: Grid | None, bound: bool) -> None:
        """Raises ValueError where a method is given voxels for its result that contradict the protocol's: others than
        these, or, where it is bound to voxels of its own, a box that leaves out a part both of these and of the
        chest."""
        fixed = self.grid
        if fixed is None or given is None or given.same_as(fixed):
            return
        if not bound:
            raise ValueError(f"data.protocol {self.name} fixes {_grid_text(fixed)}, but {_grid_text(given)} were given"
                             ": leave one of the two out")
        if not any(covers(given, box) for box in (fixed, DEFAULT_GRID)):
            raise ValueError(f"data.protocol {self.name} scores {_grid_text(fixed)}, but {_grid_text(given)} were "
                             "given, which leave out a part of them: give a box that holds the chest, "
                             f"{DEFAULT_GRID.extent[0]:g} mm, or leave one of the two out")


def _grid_text(grid: Grid) -> str:
    """The number of voxels of a box along its sides, these in mm, and where its centre is unless at the isocentre."""
    sizes, sides = (values[:1] if len(set(values)) == 1 else values
                    for values in (grid.shape, (*grid.extent.round(3),)))
    place = "" if np.allclose(grid.centre, 0) else f" around ({', '.join(f'{x:g}' for x in grid.centre)})"
    return f"{' x '.join(map(str, sizes))} voxels over {' x '.join(f'{side:g}' for side in sides)} mm{place}"


PROTOCOLS = {protocol.name: protocol for protocol in (
    Protocol("phydict", (8,), replace(PAPER, views=None), None, None, Ideal().noise, (),
             "Dai, Ghosh and Batmanghelich, MICCAI 2026"),
    Protocol("x2ct", (2,), Orbit(None, 949.0, 541.0, (320, 320), (1.5625, 1.5625), 180.0), (128, 320.0),
             HUWindow(-1000.0, 1500.0), 0.0, ("psnr_slices", "ssim_slices"),
             "X2CT-GAN, Ying et al., CVPR 2019, arXiv:1905.06902"),
    Protocol("luna16", (6, 8, 10), Orbit(None, 1200.0, 800.0, (256, 256), (2.4, 2.4), 180.0), (256, 409.6),
             HUWindow(-1000.0, 1024.0), 0.0, ("ssim_uniform",), "C2RV, Lin et al., CVPR 2024, arXiv:2406.03902"),
    Protocol("sparc", (4, 8), Orbit(None, 1200.0, 800.0, (512, 512), (2.4, 2.4), 360.0), (256, 409.6),
             HUWindow(-1024.0, 1024.0), 0.0, ("ssim_uniform",), "SPARC, HORIZONHealthcare/SPARC, 2026"))}


def protocol_of(name: str) -> Protocol:
    """A protocol by its name. Raises ValueError, naming them all, where there is none."""
    if name not in PROTOCOLS:
        raise ValueError(f"data.protocol is one of {', '.join(PROTOCOLS)}, but {name!r} was given")
    return PROTOCOLS[name]
