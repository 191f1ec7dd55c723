"""RTK's FDK (package itk-rtk) of phydict's views, for comparison."""

from __future__ import annotations

import tempfile
from pathlib import Path

import itk
import numpy as np
import torch
from itk import RTK
from torch import Tensor

from phydict.grid import Grid
from phydict.xray import ConeBeam
from phydict.xray.rtk import FIXED_TO_RAS, write_rtk


def rtk_fdk(xrays: Tensor, grid: Grid, beam: ConeBeam, hann: bool) -> Tensor:
    """The volume (X, Y, Z) that RTK reconstructs from float32 line integrals (K, V, U)."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "geometry.xml"
        write_rtk(file, beam)
        reader = RTK.ThreeDCircularProjectionGeometryXMLFileReader.New(Filename=str(file))
        reader.GenerateOutputInformation()
    width, height = (np.linalg.norm(step[0]) for step in (beam.u, beam.v))
    corner = [-width * (beam.shape[1] - 1) / 2, -height * (beam.shape[0] - 1) / 2, 0]
    axes = FIXED_TO_RAS.T @ (grid.affine[:3, :3] / grid.spacing)[:, ::-1]  # ITK counts axes from the last
    image = itk.Image[itk.F, 3]
    fdk = RTK.FDKConeBeamReconstructionFilter[image].New(Geometry=reader.GetOutputObject())
    empty = np.zeros(grid.shape, np.float32)
    fdk.SetInput(0, _image(empty, grid.spacing[::-1], FIXED_TO_RAS.T @ grid.affine[:3, 3], axes))
    fdk.SetInput(1, _image(xrays.numpy(), [width, height, 1], corner, np.eye(3)))
    fdk.GetRampFilter().SetTruncationCorrection(0)
    fdk.GetRampFilter().SetHannCutFrequency(1.0 if hann else 0.0)
    fdk.Update()
    return torch.from_numpy(itk.array_from_image(fdk.GetOutput()))


def _image(values: np.ndarray, spacing, origin, direction):
    image = itk.image_from_array(values)
    image.SetSpacing([float(s) for s in spacing])
    image.SetOrigin([float(o) for o in origin])
    image.SetDirection(itk.matrix_from_array(np.ascontiguousarray(direction)))
    return image
