"""Tries of robustness.py: the Python API."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from prior.tiny import tiny_prior
from tries import BEAM, ORBIT, box, xrays

import phydict
from phydict import ConeBeam, Grid, HUWindow
from phydict.datasets import find_cts, load_ct, load_xrays, prepare_ct, save_xrays
from phydict.prior import load_super_resolution, save_prior
from phydict.xray import Ideal, Polychromatic
from phydict.xray.geometry_files import read_beam, write_beam


def python_api():
    """Calls from Python: what is refused is a ValueError or OSError of one line."""
    no = False
    y = xrays()
    sirt = phydict.METHODS["sirt"].__class__(iterations=2)

    def reconstruct(*args, **named):
        return lambda p: p.call(phydict.reconstruct, *args, **{"method": sirt, "grid": Grid.cube(16)} | named)

    yield "as it should be", True, "", reconstruct(y, BEAM)
    yield "numpy float64", True, "", reconstruct(y.numpy().astype("f8"), BEAM)
    yield "numpy int32", None, "", reconstruct((y.numpy() * 10).astype("i4"), BEAM)
    yield "a list of lists", None, "", reconstruct(y.tolist(), BEAM)
    yield "complex", no, "", reconstruct(y.to(torch.complex64), BEAM)
    yield "bool", no, "", reconstruct(y > 3, BEAM)
    yield "uint16", None, "", reconstruct((y.numpy() * 100).astype("u2"), BEAM)
    yield "big-endian", None, "", reconstruct(y.numpy().astype(">f4"), BEAM)
    yield "negative strides", None, "", reconstruct(y.numpy()[:, ::-1], BEAM)
    yield "requires_grad", None, "", reconstruct(y.clone().requires_grad_(), BEAM)
    yield "bfloat16", None, "", reconstruct(y.bfloat16(), BEAM)
    yield "meta", no, "", reconstruct(y.to("meta"), BEAM)
    yield "sparse", no, "", reconstruct(y.to_sparse(), BEAM)
    yield "four axes", no, "shape", reconstruct(y[None], BEAM)
    yield "no views", no, "", reconstruct(y[:0], BEAM)
    yield "None", no, "", reconstruct(None, BEAM)
    yield "a text", no, "", reconstruct("xrays", BEAM)
    yield "all zero", None, "", reconstruct(y * 0, BEAM)
    yield "all negative", None, "", reconstruct(-y, BEAM)
    yield "of 1e30", None, "", reconstruct(y * 1e30, BEAM)
    yield "of 1e-30", None, "", reconstruct(y * 1e-30, BEAM)
    yield "a beam that is a mapping", no, "ConeBeam", reconstruct(y, ORBIT)
    yield "a method that is not there", no, "magic", reconstruct(y, BEAM, method="magic")
    yield "a method that is a class", no, "method", reconstruct(y, BEAM, method=type(sirt))
    yield "a method None", True, "", reconstruct(y, BEAM, method=None)
    yield "a seed of 1.5", no, "seed", reconstruct(y, BEAM, seed=1.5)
    yield "a seed None", no, "seed", reconstruct(y, BEAM, seed=None)
    yield "a seed of numpy", None, "seed", reconstruct(y, BEAM, seed=np.int64(3))
    yield "a report of bytes", no, "report", reconstruct(y, BEAM, report=b"x")
    yield "a grid None", True, "", reconstruct(y, BEAM, grid=None)
    yield "a grid of a tuple", no, "", reconstruct(y, BEAM, grid=(16, 16, 16))
    yield "mu_water of a text", None, "TypeError", reconstruct(y, BEAM, mu_water="0.02")
    yield "mu_water nan", no, "mu_water", reconstruct(y, BEAM, mu_water=float("nan"))
    yield "display of integers", None, "", reconstruct(y, BEAM, display=3)
    yield "samples of 1.5", None, "TypeError", reconstruct(y, BEAM, method="prior_only", prior=tiny_prior(),
        samples=1.5)
    yield "guidance of a text", None, "TypeError", reconstruct(y, BEAM, method="prior_only", prior=tiny_prior(),
        guidance="1")
    yield "a prior of a number", None, "TypeError", reconstruct(y, BEAM, method="prior_only", prior=3)
    yield "precision None", no, "precision", reconstruct(y, BEAM, method="prior_only", prior=tiny_prior(),
        precision=None)
    for name, function, args, named in (
            ("ConeBeam of nothing", ConeBeam, ([], [], [], [], (1, 1)), {}), ("ConeBeam of text", ConeBeam, ("a", "b",
            "c", "d", (1, 1)), {}),
            ("ConeBeam of None", ConeBeam, (None,) * 5, {}), ("orbit of text", ConeBeam.orbit, ("3", 1020, 740, (24,
            24), 24), {}), ("orbit of text distances", ConeBeam.orbit, (3, "1020", 740, (24, 24), 24), {}),
            ("orbit of None", ConeBeam.orbit, (3, None, 740, (24, 24), 24), {}), ("orbit of nan", ConeBeam.orbit, (3,
            float("nan"), 740, (24, 24), 24), {}), ("orbit of complex", ConeBeam.orbit, (3, 1020, 740, (24, 24), 24j),
            {}),
            ("orbit start text", ConeBeam.orbit, (3, 1020, 740, (24, 24), 24), {"start_degrees": "0"}),
            ("orbit start inf", ConeBeam.orbit, (3, 1020, 740, (24, 24), 24), {"start_degrees": float("inf")}),
            ("load of a folder", ConeBeam.load, (".",), {}), ("load of None", ConeBeam.load, (None,), {}),
            ("load of a null", ConeBeam.load, ("a\0b",), {}), ("binned by 0", BEAM.binned, (0,), {}), ("binned by nan",
            BEAM.binned, (float("nan"),), {}),
            ("binned by text", BEAM.binned, ("2",), {}), ("select none", BEAM.select, ([],), {}), ("select beyond",
            BEAM.select, ([9],), {}), ("Grid of text", Grid, ("abc", 1), {}), ("Grid of 0", Grid, ((0, 1, 1), 1), {}),
            ("Grid spacing text", Grid, ((2, 2, 2), "a"), {}),
            ("Grid spacing of two", Grid, ((2, 2, 2), (1, 2)), {}), ("Grid affine ragged", Grid, ((2, 2, 2), None,
            [[1], [1, 2]]), {}), ("Grid cube of text side", Grid.cube, (4, "384"), {}), ("HUWindow of text", HUWindow,
            ("a", "b"), {}), ("HUWindow of None", HUWindow, (None, 3), {}),
            ("Ideal of text", Ideal, ("a",), {}), ("Polychromatic kvp text", Polychromatic, ("120",), {}),
            ("read_beam without ending", read_beam, ("geometry",), {}), ("read_beam of None", read_beam, (None,), {}),
            ("write_beam of another ending", write_beam, ("g.json", BEAM), {}),
            ("write_beam of a mapping", write_beam, ("g.yaml", ORBIT), {}),
            ("load_prior of None", phydict.load_prior, (None,), {}), ("load_prior of a number", phydict.load_prior, (3,
            ), {}), ("load_prior on a device that is not there", phydict.load_prior, (), {"device": "warp"}),
            ("load_super_resolution of nothing", load_super_resolution, ("",), {}),
            ("save_prior of None", phydict.save_prior, (None, "x.safetensors"), {}), ("load_xrays of nowhere",
            load_xrays, ("nowhere",), {}), ("load_xrays of None", load_xrays, (None,), {}), ("find_cts of nowhere",
            find_cts, ("nowhere",), {}), ("load_ct of a folder", load_ct, (".",), {}),
            ("prepare_ct of a short tuple (a wrong number)", prepare_ct, ((box(),),), {}),
            ("prepare_ct of 2D (a wrong number)", prepare_ct, ((box()[0], np.eye(4)),), {}), ("case_seed of None",
            phydict.case_seed, (None, None), {}), ("Projector of None", phydict.Projector, (None, None), {}),
            ("Projector of magic", phydict.Projector, (Grid.cube(16), BEAM, "magic"), {}), ("hu_to_mu of text",
            phydict.hu_to_mu, ("a",), {})):
        loose = any(word in name for word in ("None", "text", "number", "tuple", "complex", "beyond", "mapping"))
        yield name, None if loose else no, "TypeError" if loose else "", partial(
            lambda p, function, args, named: p.call(function, *args, **named), function=function, args=args,
            named=named)

    def saved(p, change):
        case = p.case()
        p.call(save_xrays, case, y, BEAM)

    yield "save_xrays over a case with a report", None, "", lambda p: saved(p, None)
    yield "save_xrays of too few", no, "", lambda p: p.call(save_xrays, p.root / "x", y[:2], BEAM)
    yield "save_xrays of nan", no, "", lambda p: p.call(save_xrays, p.root / "x", y * torch.nan, BEAM)
    yield "save_prior of nan", no, "", lambda p: (q := tiny_prior(), q.null.fill_(torch.nan), p.call(save_prior, q,
        p.root / "x.safetensors"))
    yield "write_beam over geometry.yaml", None, "", lambda p: p.call(write_beam, p.root / "g.yaml", BEAM)
