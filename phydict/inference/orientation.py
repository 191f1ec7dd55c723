"""Whether X-rays and geometry agree on where up and right are: X-rays beside those of a standard thorax."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, conv2d

from phydict.datasets import Thorax, build
from phydict.datasets.radiographs.xray_description import Orientation
from phydict.grid import Grid
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector
from phydict.xray.binning import binned, binning
from phydict.xray.boxes import in_other_voxels
from phydict.xray.poses.gauge import moved_as_a_whole

FLIPS = {"as it is": (1, 1), "flip_rows": (-1, 1), "flip_columns": (1, -1), "flip_rows and flip_columns": (-1, -1)}
CLEAR, LEAST = {"flip_rows": 0.06, "flip_columns": 0.03, "flip_rows and flip_columns": 0.06}, 0.6
"""By how much a flip must agree better with the standard thorax, and how well at least, before it is worth a word."""

TURNS = [Orientation(degrees, flip_columns=flip) for flip in (False, True) for degrees in (90, 270)]

TURNED = 0.1
"""By how much turned images must agree better than any flip of them, wherever patient and detector are."""

MIRRORED = 0.003
"""By how much the frontal views' mean agreement must be better with the patient mirrored. Of nine chest CTs in the
right geometry it was up to 0.024 worse, but for one, 0.001 better."""

SIDE = 32
"""Voxels along each side of the volume that `orientation_doubts` compares with."""

LOOKS = 0.005
"""By how much flipped views must agree better than as they are, both moved to where they agree best: a patient beside
the middle and a wrong detector shift make flips agree better where they stand."""

REACH = 100.0
"""How far, in mm on the detector, views are moved along rows and columns until they agree best."""

PLACED, READ, MOVED, SURE, ALIKE = 30.0, 8.0, 20.0, 2.0, 0.7
"""Standard deviations in mm of where a patient lies, and of how far a view, if its pixels are not larger, seems moved
along its columns; how many mm all views must be moved alike, and how many standard deviations, and how well they must
agree then, before it is worth a word. Of nine training CTs in seven geometries of three views or more it was 12 mm at
most, and 17 mm where these lie 12 to 30 mm beside the middle in three directions."""

ONE_SIDED = 1 / 6
"""What is added to MOVED for each mm of the stated shift: a half-fan detector sees one side of the patient, and a wider
patient than the standard one then looks moved, at 120 mm by up to 12 mm in nine training CTs and 31 mm in one of four
others."""

ABOUT, ROTATED, ALL_ROUND = (45, 90, 135, 225, 270, 315), 0.06, 61.0
"""By how many degrees sources and detectors are turned about the patient, and by how much the views must agree better
there than flipped or as stated, both where the geometry puts them and wherever patient and detector are. Of five CTs in
right orbits they agreed worse by 0.01 or more. Between the lines of neighbouring views lie ALL_ROUND degrees at most: a
lateral view alone may agree better as an oblique one. Half a turn looks like flipped columns, and is
named in their place where it agrees best: of nine training CTs and four phantoms, wherever views were all round."""

PIXELS = 64
"""Pixels along each side of a view, at most."""


def standard_thorax(grid: Grid) -> np.ndarray:
    """HU (X, Y, Z) of the standard thorax in the middle of a grid, built once for all cases on its voxels."""
    return _built(grid.shape, tuple(grid.affine.flatten()))


@lru_cache(2)
def _built(shape: tuple[int, int, int], affine: tuple[float, ...]) -> np.ndarray:
    return build(Thorax.standard(), Grid(shape, affine=np.reshape(affine, (4, 4))))[0]


def thorax_views(grid: Grid, beam: ConeBeam) -> np.ndarray:
    """X-rays (K, V, U) of the standard thorax."""
    mu = hu_to_mu(torch.from_numpy(standard_thorax(grid)))
    return Projector(grid, beam, full_detector=True)(mu[None, None])[0].numpy()


def in_other_sense(beam: ConeBeam, grid: Grid) -> ConeBeam:
    """The beam whose angles run the other way, its detectors shifted along their columns as before: sources and
    detectors mirrored left to right about the grid's centre, and then the shifts."""
    across = np.array([-1.0, 1.0, 1.0])
    move = (1 - across) * grid.centre
    u = -beam.u * across
    back = 2 * column_shifts(beam, grid)[:, None] * u / np.linalg.norm(u, axis=1, keepdims=True)
    return replace(beam, sources=beam.sources * across + move, detectors=beam.detectors * across + move + back, u=u,
                   v=beam.v * across)


def rotated(beam: ConeBeam, grid: Grid, degrees: float) -> ConeBeam:
    """The beam with its sources and detectors turned about the grid's upright axis, as by `degrees` more of an orbit's
    start_degrees."""
    turn = np.array([0.0, 0.0, -degrees])
    move = grid.centre - Rotation.from_rotvec(turn, degrees=True).apply(grid.centre)
    return moved_as_a_whole(beam, np.concatenate([move, turn]))


def column_shifts(beam: ConeBeam, grid: Grid) -> np.ndarray:
    """How far (K,) in mm along the columns each detector's centre lies from the shadow of the grid's."""
    return -beam.shadows(grid.centre[None])[:, 0, 0]


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, in [-1, 1], of two images of one shape; 0 where one is constant."""
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def moved_agreements(images: Tensor, wide: Tensor) -> Tensor:
    """Correlations (K, R, C) of images (K, V, U) with every part of their size of images (K, V + R - 1, U + C - 1)."""
    size = images.shape[1:]
    centred = images - images.mean((1, 2), keepdim=True)
    products = conv2d(wide[None], centred[:, None], groups=len(images))[0]
    variance = avg_pool2d(wide.square(), size, 1) - avg_pool2d(wide, size, 1).square()
    norms = centred.square().sum((1, 2), keepdim=True) * variance.clamp(min=1e-6) * size.numel()
    return products / norms.clamp(min=1e-12).sqrt()


def clear_flip(scores: dict[str, float]) -> str:
    """The flip that clearly agrees better than the view "as it is", which is the answer where none does; scores:
    agreements of all of FLIPS."""
    clear = [name for name, more in CLEAR.items() if scores[name] > max(scores["as it is"] + more, LEAST)]
    return max(clear, key=scores.__getitem__, default="as it is")


def better_flip(xray: np.ndarray, thorax: np.ndarray) -> tuple[str, float]:
    """The flip of a view (V, U) that clearly agrees better with the standard thorax's, and how well; "as it is" where
    none does."""
    scores = {name: correlation(xray[::rows, ::columns], thorax) for name, (rows, columns) in FLIPS.items()}
    best = clear_flip(scores)
    return best, scores[best]


class Comparison:
    """X-rays (K, V, U) beside those of a standard thorax in the middle of a grid, on coarse voxels and pixels.

    maps: correlations (K, R, C), as `moved_agreements`, of the views in the stated beam after each of FLIPS and, in the
    other "sense" of the angles, as they are and with "both" that and flip_columns.
    """

    def __init__(self, xrays: Tensor, beam: ConeBeam, grid: Grid):
        self.grid, self.stated_shape = in_other_voxels(grid, (SIDE,) * 3), beam.shape
        factor = binning(self.grid, beam)
        self.images, beam = binned(xrays.float().cpu(), factor), beam.binned(factor)
        rows, columns = (min(n, PIXELS) for n in beam.shape)
        self.images = adaptive_avg_pool2d(self.images, (rows, columns))
        self.beam = replace(beam, v=beam.v * beam.shape[0] / rows, u=beam.u * beam.shape[1] / columns,
                            shape=(rows, columns))
        self.pixel = self.beam.pixel.mean(0)
        self.margin = tuple(math.ceil(REACH / side) for side in self.pixel)
        thorax, opposite = self.thorax(self.beam), self.thorax(in_other_sense(self.beam, self.grid))
        flipped = {name: self.images.flip([axis for axis, way in enumerate(ways, 1) if way < 0])
                   for name, ways in FLIPS.items()}
        self.maps = {name: moved_agreements(images, thorax) for name, images in flipped.items()} | {
            "sense": moved_agreements(self.images, opposite),
            "both": moved_agreements(flipped["flip_columns"], opposite)}

    def thorax(self, beam: ConeBeam) -> Tensor:
        rows, columns = (n + 2 * more for n, more in zip(beam.shape, self.margin))
        return torch.from_numpy(thorax_views(self.grid, replace(beam, shape=(rows, columns))))

    def stated(self, name: str) -> np.ndarray:
        """Agreements (K,) where the geometry puts the views."""
        return self.maps[name][:, self.margin[0], self.margin[1]].numpy()

    def anywhere(self, name: str) -> np.ndarray:
        """Agreements (K,) of each view where it agrees best, wherever patient and detector are."""
        return self.maps[name].amax((1, 2)).numpy()

    @property
    def all_round(self) -> bool:
        """Whether the views' lines leave no large angle about the patient unseen."""
        x, y, _ = (self.beam.sources - self.grid.centre).T
        lines = np.sort(np.degrees(np.arctan2(y, x)) % 180)
        return bool(np.diff(lines, append=lines[0] + 180).max() <= ALL_ROUND)

    def turned(self, degrees: float) -> float:
        """The mean agreement where sources and detectors are turned about the patient."""
        thorax = thorax_views(self.grid, rotated(self.beam, self.grid, degrees))
        return float(np.mean([*map(correlation, self.images.numpy(), thorax)]))

    def looks(self, names: Collection[str], views=slice(None)) -> bool:
        """Whether the views, each where it agrees best, agree better by one of these maps than as they are."""
        best = max(self.anywhere(name)[views].mean() for name in names)
        return best > LOOKS + self.anywhere("as it is")[views].mean()


def orientation_doubts(xrays: Tensor, beam: ConeBeam, grid: Grid) -> list[str]:
    """Sentences on X-rays (K, V, U) of a chest that agree clearly better with a standard thorax in the middle of the
    grid where they are turned, moved or flipped, the angles run in the other sense, or the patient is mirrored."""
    compared = Comparison(xrays, beam, grid)
    return whole_doubts(compared) or flip_doubts(compared)


def whole_doubts(compared: Comparison) -> list[str]:
    """A sentence on views that all are to be turned by a quarter, moved alike or put elsewhere about the patient,
    before flips can be told."""
    return _turned(compared) or _moved(compared) or _rotated(compared)


def _turned(compared: Comparison) -> list[str]:
    beam = compared.beam
    height, width = compared.pixel
    thorax = thorax_views(compared.grid, replace(beam, u=beam.u * height / width, v=beam.v * width / height,
                                                 shape=beam.shape[::-1]))
    scores = {turn: np.mean([*map(correlation, turn.apply(compared.images.numpy()), thorax)]) for turn in TURNS}
    best = max(scores, key=scores.__getitem__)
    if scores[best] <= max(LEAST, TURNED + max(compared.anywhere(name).mean() for name in compared.maps)):
        return []
    keys = f"rotate_degrees: {best.rotate_degrees}" + ", flip_columns: true" * best.flip_columns
    return [f"all views agree better with a standard thorax when turned by a quarter (mean agreement "
            f"{scores[best]:.3f}, as stated {compared.stated('as it is').mean():.3f}): give `orientation: {{{keys}}}` "
            f"and, of the turned images, shape {list(compared.stated_shape[::-1])} and pixel, and look again"]


def _moved(compared: Comparison) -> list[str]:
    if compared.looks([*CLEAR, "sense"]):
        return []
    alike, stated = float(compared.maps["as it is"].mean(0).max()), compared.stated("as it is").mean()
    now, (shift, deviation) = column_shifts(compared.beam, compared.grid).mean(), common_shift(compared)
    least = max(MOVED + ONE_SIDED * abs(now), SURE * deviation)
    if abs(shift) <= least or alike <= max(ALIKE, stated + CLEAR["flip_columns"]):
        return []
    return [f"all views agree better with a standard thorax when moved alike, along the columns by about {shift:+.0f} "
            f"mm (mean agreement {alike:.3f}, as stated {stated:.3f}): check whether detector_shift is missing or has "
            f"the wrong sign; its columns are {round(now):+} mm as stated, and about {round(now + shift):+} mm would "
            "fit"]


def _rotated(compared: Comparison) -> list[str]:
    if not compared.all_round:
        return []
    scores = {degrees: compared.turned(degrees) for degrees in ABOUT}
    best = max(scores, key=scores.__getitem__)
    if scores[best] <= max(LEAST, ROTATED + max(compared.stated(name).mean() for name in compared.maps)):
        return []
    thorax = compared.thorax(rotated(compared.beam, compared.grid, best))
    there = float(moved_agreements(compared.images, thorax).amax((1, 2)).mean())
    if there <= ROTATED + max(compared.anywhere(name).mean() for name in compared.maps):
        return []
    return [f"all views agree better with a standard thorax when sources and detectors are turned about the patient, "
            f"by {best} degrees more of start_degrees (mean agreement {scores[best]:.3f}, as stated "
            f"{compared.stated('as it is').mean():.3f}): check the angle of the first view, which is 0 for PA and 90 "
            "where the source stands at the patient's left, the order of the views, and the axes of the geometry's "
            "world"]


def common_shift(compared: Comparison) -> tuple[float, float]:
    """How far in mm along the columns all detectors alike lie beside where the beam puts them, and the standard
    deviation of that, which is large where a patient beside the middle would explain as much."""
    grid, beam = compared.grid, compared.beam
    columns = compared.maps["as it is"].amax(1).argmax(1).numpy() - compared.margin[1]
    shadows = beam.shadows(grid.centre + np.concatenate([np.zeros((1, 3)), np.eye(3)]))[..., 0]
    design = np.column_stack([shadows[:, 1:] - shadows[:, :1], np.ones(beam.views)])
    pixel = compared.pixel[1]
    weight = max(READ, pixel) ** -2
    covariance = np.linalg.inv(weight * design.T @ design + np.diag([PLACED**-2] * 3 + [REACH**-2]))
    found = covariance @ design.T @ (columns * pixel) * weight
    return float(found[3]), float(np.sqrt(covariance[3, 3]))


def flip_doubts(compared: Comparison) -> list[str]:
    """Sentences on flipped views, the sense of the angles and a mirrored patient."""
    named = _flipped_views(compared)
    doubts = [f"view {named[flip]} agrees better with a standard thorax when {how}: row 0 is superior, "
              f"{_change(compared, flip)}"
              for flip, how in (("flip_rows", "upside down"), ("flip_rows and flip_columns", "turned by 180 degrees"))
              if flip in named]
    doubts += _mirrored_views(compared, named.get("flip_columns"))
    return doubts or _mirrored_patient(compared)


def _flipped_views(compared: Comparison) -> dict[str, str]:
    """Flip -> the views that it clearly improves, unless to move them as they are improves them as much."""
    stated = {name: compared.stated(name) for name in FLIPS}
    flips = np.array([clear_flip({name: stated[name][k] for name in FLIPS}) for k in range(compared.beam.views)])
    views = {flip: np.flatnonzero(flips == flip) for flip in CLEAR}
    return {flip: ", ".join(map(str, where)) for flip, where in views.items() if len(where) and (
        compared.looks([flip, "sense"] if flip == "flip_columns" else [flip], where))}


def _of_single_views(compared: Comparison, ways: Collection[str]) -> bool:
    """Whether all views together agree better as stated than changed in any of these ways."""
    return bool(compared.stated("as it is").mean() >= max(compared.stated(way).mean() for way in ways))


def _change(compared: Comparison, flip: str) -> str:
    """How to flip the named views: by `orientation:` or, where the other views are right as stated, one by one."""
    if not _of_single_views(compared, [flip]):
        return f"change {flip}"
    return f"flip {flip.replace('flip_', '')} in the image of each such view, as `orientation:` turns all views alike"


def _mirrored_views(compared: Comparison, views: str | None) -> list[str]:
    """A sentence where these views agree better mirrored, or all of them in the other sense of the angles."""
    stated, flipped, turned = (compared.stated(name).mean() for name in ("as it is", "flip_columns", "sense"))
    opposite = turned > max(stated + CLEAR["flip_columns"], LEAST) and compared.looks(["sense"])
    if views is None and not opposite:
        return []
    if not opposite and _of_single_views(compared, ["flip_columns", "sense"]):
        return [f"view {views} agrees better with a standard thorax when mirrored, the others as stated: "
                f"{_change(compared, 'flip_columns')}; or else put the source of each such view on the other side, for "
                "a left lateral (LL) view the patient's right, 270 degrees of an orbit"]
    half = compared.turned(180) if compared.all_round else -1.0
    if half > max(flipped, turned + MIRRORED):
        return ["all views agree better with a standard thorax when sources and detectors are turned by half about "
                f"the patient (mean agreement {half:.3f}, as stated {stated:.3f}): give 180 degrees more of "
                "start_degrees or, where the geometry's axes lead to left and posterior, change the signs of x and y; "
                f"or else change flip_columns ({flipped:.3f}), or negate the angles ({turned:.3f})"]
    columns = f"change flip_columns (mean agreement of all views {flipped:.3f})"
    sense = (f"negate the angles, which seem to run in the other sense ({turned:.3f}), or put a single view's source "
             "on the other side, for a left lateral (LL) view the patient's right, 270 degrees of an orbit")
    first, second = (columns, sense) if flipped > turned + MIRRORED else (sense, columns)
    return [f"{'all views together agree' if views is None else f'view {views} agrees'} better with a standard thorax "
            f"when mirrored (as stated {stated:.3f}): {first}; or else {second}; the wrong one of the two mirrors the "
            "patient"]


def _mirrored_patient(compared: Comparison) -> list[str]:
    """A sentence where the frontal views show the heart on the right."""
    frontal = np.abs(compared.beam.normals[:, 1]) > np.abs(compared.beam.normals[:, 0])
    if not frontal.any() or not compared.looks(["both"], frontal):
        return []
    seen, upside_down, other = (compared.stated(name)[frontal].mean() for name in ("as it is", "flip_rows", "both"))
    if other <= max(MIRRORED + max(seen, upside_down), LEAST):
        return []
    ways = {"flip_columns": "change flip_columns alone", "sense": "negate the angles alone",
            "both": "change flip_columns and negate the angles"}
    means = {name: compared.stated(name).mean() for name in ways}
    best, *others = (f"{ways[name]} ({means[name]:.3f})" for name in sorted(ways, key=lambda name: -means[name]))
    return [f"the patient looks mirrored, with the heart on the right (agreement with a standard thorax {seen:.3f}, "
            f"mirrored {other:.3f}): {best} agrees best over all views, before {' and '.join(others)}; one of the "
            "three is right"]
