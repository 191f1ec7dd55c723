"""The scripted tries of robustness.py: what strangers and attackers may give, group by group."""

from __future__ import annotations

import gzip
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import nibabel
import numpy as np
import torch
import yaml
from dicom_files import orbit_tags, write_ct_series, write_dicom
from PIL import Image
from prior.tiny import tiny_prior, tiny_super_resolution
from robustness import Try, state
from safetensors.torch import save_file

import phydict
from phydict import ConeBeam, Grid, HUWindow
from phydict.cli.infer import main as infer
from phydict.cli.train import main as train
from phydict.datasets import find_cts, load_ct, load_xrays, phantom_case, prepare_ct, save_xrays
from phydict.page import CASE_FILES
from phydict.prior import load_super_resolution, save_prior, save_super_resolution
from phydict.prior.files import describe
from phydict.xray import Ideal, Polychromatic
from phydict.xray.geometry_files import read_beam, write_beam

ROOT = Path(__file__).parents[2]
ORBIT = {"views": 3, "source_to_detector": 1020.0, "source_to_isocentre": 740.0, "shape": [24, 24],
         "pixel": [24.0, 24.0]}
BEAM = ConeBeam.orbit(**ORBIT)
PICKLE = b"cos\nsystem\n(S'touch pwned'\ntR."
"""Runs a command where it is unpickled."""

SIRT = ["-c", "sirt", "--model.method.init_args.iterations=2", "--model.cube.voxels=16", "--trainer.accelerator=cpu"]


@cache
def xrays() -> torch.Tensor:
    """Three views of a phantom."""
    volume = phantom_case(1, Grid.cube(32), HUWindow())["volume"]
    return phydict.Projector(Grid.cube(32), BEAM, full_detector=True)(HUWindow().to_mu(volume)[None])[0]


@cache
def box(n: int = 20) -> np.ndarray:
    """HU (X, Y, Z) of a box of tissue in air."""
    hu = np.full((n, n, n), -1000, np.float32)
    hu[4:-4, 6:-5] = 40 + 10 * np.random.default_rng(0).standard_normal((n - 8, n - 11, n))
    return hu


@cache
def tiny() -> tuple:
    """Header, weights and metadata of a prior of 16^3 voxels."""
    prior = tiny_prior()
    return describe(prior) | {"training": {}}, {k: w.half().contiguous() for k, w in prior.state_dict().items()}


class Place:
    """The folder of one try, what it is given there, and the ways to run it."""

    def __init__(self, root: Path):
        self.root, self.given, self.out = root, root / "in", root / "out"
        self.api, self.before, self.said = False, None, ""

    def begin(self) -> None:
        self.given.mkdir(parents=True)
        os.chdir(self.root)

    def harm(self) -> str:
        """What a try did to its input or left half-written."""
        if self.before is not None and self.before != (after := state(self.given)):
            changed = {k for k in self.before.keys() | after.keys() if self.before.get(k) != after.get(k)}
            return f"loss: {sorted(changed)[:4]} changed"
        left = [str(p) for p in self.root.rglob(".*") if ".part" in p.name or "set-aside" in p.name]
        return f"half: {left[:4]} left" if left else ""

    # what is given

    def case(self, name: str = "case", text: str | bytes | None = None, orbit: dict | None = None, **blocks) -> Path:
        """A folder of three NPY X-rays whose geometry.yaml is `text`, or has `orbit` and `blocks` changed."""
        folder = self.given / name
        save_xrays(folder, xrays(), BEAM, "No effusion.")
        content = {"beam": {"orbit": ORBIT | (orbit or {})}, "intensity": {"kind": "line_integrals"}} | blocks
        content = {k: v for k, v in content.items() if v is not None}
        self.write(folder / "geometry.yaml", yaml.safe_dump(content) if text is None else text)
        return folder

    def view(self, write, name: str = "view_1.npy", case: Path | None = None) -> Path:
        """A case whose view `name` is what `write(path)` makes of it."""
        folder = case or self.case()
        (folder / "view_1.npy").unlink(missing_ok=True)
        write(folder / name)
        return folder

    def pictures(self, change=lambda pixels: pixels, **intensity) -> Path:
        """A case of 16-bit PNG, after `change` of the pixels (K, V, U)."""
        folder = self.case(intensity={"kind": "line_integrals", "scale": 1e-4} | intensity)
        for k, view in enumerate(change((xrays().numpy() * 1e4).astype(np.uint16))):
            (folder / f"view_{k}.npy").unlink(missing_ok=True)
            Image.fromarray(view).save(folder / f"view_{k}.png")
        return folder

    def run_of(self, **tags) -> Path:
        """An XA run in DICOM."""
        stored = (xrays().numpy() * 1e4).astype(np.uint16)
        folder = self.given / "run"
        tags = {**orbit_tags(3, 1020.0, 740.0, (24.0, 24.0)), **tags}
        write_dicom(folder / "run.dcm", stored, **{k: v for k, v in tags.items() if v is not None or k == "Modality"})
        self.write(folder / "geometry.yaml", "intensity: {kind: line_integrals, scale: 1.0e-4}\n")
        return folder

    def ct(self, name: str = "ct.nii.gz", hu: np.ndarray | None = None, affine=None, header: dict | None = None,
           change=None) -> Path:
        """A NIfTI CT of 20^3 voxels of 10 mm; header: fields to set; change: of the file's bytes before gzip."""
        affine = np.diag([10.0, 10, 10, 1]) if affine is None else np.asarray(affine, float)
        image = nibabel.Nifti1Image(box() if hu is None else hu, affine)
        image.set_sform(affine, 1)
        raw = bytearray(image.to_bytes())
        for field, value in (header or {}).items():
            kind, offset = nibabel.Nifti1Header.template_dtype.fields[field]
            size = kind.itemsize
            raw[offset:offset + size] = np.array(value, kind.base).tobytes().ljust(size, b"\0")[:size]
        raw = change(raw) if change else raw
        path = self.given / "cts" / name
        self.write(path, gzip.compress(bytes(raw), 1) if name.endswith(".gz") else bytes(raw))
        return path

    def prior(self, header: dict | None = None, weights: dict | None = None, text: str | None = None,
              name: str = "tiny.safetensors") -> Path:
        """A prior's file with parts of header and weights changed (None: left out), or another header `text`."""
        mine, tensors = tiny()
        merged = {k: v for k, v in (mine | (header or {})).items() if v is not ...}
        tensors = {k: v for k, v in (tensors | (weights or {})).items() if v is not ...}
        path = self.given / name
        save_file(tensors, path, {"phydict": json.dumps(merged) if text is None else text})
        return path

    def write(self, path: Path | str, content: str | bytes) -> Path:
        path = self.given / path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode(errors="surrogateescape") if isinstance(content, str) else content)
        return path

    # ways to run

    def started(self) -> None:
        self.before = state(self.given)

    def infer(self, *args) -> None:
        self.started()
        infer([str(arg) for arg in args])

    def predict(self, folder, *more, out=None) -> None:
        self.infer("predict", *SIRT, f"--data.xrays={folder}", f"--model.out={out or self.out}", *more)

    def dry(self, folder, *more) -> None:
        self.predict(folder, "--dry_run", *more)

    def test(self, cts, *more, out=None) -> None:
        self.infer("test", *SIRT, f"--data.cts={cts}", f"--model.out={out or self.out}", "--data.orbit.views=3",
                   "--data.orbit.detector=[24,24]", "--data.orbit.pixel=[24,24]", *more)

    def sampled(self, prior, *more) -> None:
        """predict with a prior, two steps of it."""
        self.infer("predict", "-c", "prior_only", "--model.method.init_args.iterations=2", f"--model.prior={prior}",
                   f"--data.xrays={self.case()}", f"--model.out={self.out}", "--trainer.accelerator=cpu", *more)

    def settings(self, content, command: str = "predict") -> None:
        """predict with a configuration file that holds `content`."""
        file = self.write("mine.yaml", content if isinstance(content, str | bytes) else yaml.safe_dump(content))
        self.infer(command, "-c", "sirt", "-c", file, "--model.method.init_args.iterations=2", "--model.cube.voxels=16",
                   f"--data.xrays={self.case()}", f"--model.out={self.out}", "--trainer.accelerator=cpu")

    def ablate(self, content, *more) -> None:
        base = {"phantoms": 1, "out": str(self.out), "base": {
            "voxels": 16, "views": 2, "detector": 24, "method.iterations": 2}, "axes": {"method": ["sirt"]}}
        if isinstance(content, dict):
            content = yaml.safe_dump({k: v for k, v in (base | content).items() if v is not ...})
        file = self.write("spec.yaml", content)
        self.infer("ablate", "-c", file, "--device", "cpu", *more)

    def train(self, *args) -> None:
        self.started()
        train([str(arg) for arg in args])

    def fit(self, *more) -> None:
        self.train("fit", "-c", "phantom", f"--out={self.out}", f"--data.cache={self.root / 'cache'}",
                   "--data.phantoms=2", "--data.holdout.phantoms=1", "--data.loading.epoch_size=2",
                   "--data.loading.batch_size=1", "--trainer.max_steps=1", "--trainer.accelerator=cpu",
                   "--model.cube.voxels=16",
                   "--model.network.class_path=phydict.prior.VolumeUNet",
                   "--model.network.init_args.channels=[8,8]", "--model.network.init_args.attention=[false,true]",
                   "--model.network.init_args.head_channels=8", "--model.text.pretrain_steps=2", *more)

    def prepare(self, cts, *more, out=None) -> None:
        import runpy
        self.started()
        main = runpy.run_path(str(ROOT / "data" / "prepare_cts.py"))["main"]
        main([str(cts), str(out or self.out), "--voxels=16", *map(str, more)])

    def call(self, function, *args, **named):
        """A call of the Python API."""
        self.api = True
        self.started()
        return function(*args, **named)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, depth: int = 8, colour: int = 0, data: bytes | None = None,
    more: bytes = b"") -> bytes:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return (b"\x89PNG\r\n\x1a\n" + header + more + png_chunk(b"IDAT", zlib.compress(data or b"\0" * 600))
            + png_chunk(b"IEND", b""))


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode("latin1") + b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def tries() -> Iterator[Try]:
    """All tries, in groups."""
    from stranger_tries import GROUPS  # which takes its places from here

    for group in (command_lines, geometries, geometry_files, images, dicoms, nifti_images, reports, cts, series, tables,
                  priors, configurations, outputs, ablations, trainings, preparations, names, python_api,
                  interruptions, *GROUPS):
        for name, good, words, work in group():
            words = (words,) if isinstance(words, str) else tuple(words)
            yield Try(group.__name__.replace("_", " "), name, good, words, work)


def command_lines():
    no = False
    yield "no words at all", no, "predict", lambda p: p.infer()
    yield "an empty word", no, "predict", lambda p: p.infer("")
    yield "a command in capitals", no, "PREDICT", lambda p: p.infer("PREDICT")
    yield "a command twice", no, "", lambda p: p.infer("predict", "predict", *SIRT, "--data.xrays", p.case())
    yield "two commands", no, "", lambda p: p.infer("predict", *SIRT, "test")
    yield "an option before the command", no, "", lambda p: p.infer("--data.xrays=x", "predict", *SIRT)
    yield "an option without its value", no, "xrays", lambda p: p.infer("predict", *SIRT, "--data.xrays")
    yield "config without its value", no, "", lambda p: p.infer("predict", "-c")
    yield "config joined to its option", None, "", lambda p: p.infer("predict", "-csirt", f"--data.xrays={p.case()}")
    yield "config is a folder", no, "configuration", lambda p: p.infer("predict", "-c", p.given)
    yield "config is the X-rays' geometry", no, "", lambda p: p.infer("predict", "-c", p.case() / "geometry.yaml")
    yield "config is a PNG", no, ".png", lambda p: p.infer("predict", "-c", ROOT / "data/example/xrays/view_0.png")
    yield "config is a list inline", no, "", lambda p: p.infer("predict", "-c", "[a: 1]", f"--data.xrays={p.case()}")
    yield "anchors inline", None, "", lambda p: p.infer(
        "predict", "-c", "a: &a [x,x,x,x,x,x,x,x,x]\n" + "\n".join(
            f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]" for i in range(8)))
    yield "an ablation's config for predict", no, "", lambda p: p.infer("predict", "-c", "pareto")
    yield "a config of train for predict", no, "phantom", lambda p: p.infer("predict", "-c", "phantom")
    yield "an option that is not there", no, "colour", lambda p: p.predict(p.case(), "--model.colour=red")
    yield "a section that is not there", no, "", lambda p: p.predict(p.case(), "--modell.seed=1")
    yield "a stray word at the end", no, "", lambda p: p.predict(p.case(), "stray")
    yield "a seed with a decimal", no, "seed", lambda p: p.predict(p.case(), "--model.seed=1.5")
    yield "a seed of 2^63", no, "seed", lambda p: p.predict(p.case(), f"--model.seed={2**63}")
    yield "a seed of 400 digits", no, "", lambda p: p.predict(p.case(), "--model.seed=" + "9" * 400)
    yield "a seed in hexadecimal", None, "seed", lambda p: p.predict(p.case(), "--model.seed=0x10")
    yield "seed_everything in words", no, "seed", lambda p: p.predict(p.case(), "--seed_everything=often")
    yield "seed_everything below 0", None, "", lambda p: p.predict(p.case(), "--seed_everything=-5")
    yield "seed_everything too large", None, "", lambda p: p.predict(p.case(), "--seed_everything=99999999999999")
    yield "voxels nan", no, "voxels", lambda p: p.predict(p.case(), "--model.cube.voxels=nan")
    yield "voxels -4", no, "", lambda p: p.predict(p.case(), "--model.cube.voxels=-4")
    yield "voxels 1", None, "", lambda p: p.predict(p.case(), "--model.cube.voxels=1")
    yield "voxels 3", None, "", lambda p: p.predict(p.case(), "--model.cube.voxels=3")
    yield "side of 1 mm", None, "", lambda p: p.predict(p.case(), "--model.cube.side=1")
    yield "side inf", no, "", lambda p: p.predict(p.case(), "--model.cube.side=inf")
    yield "iterations 10^12 dry", True, "", lambda p: p.dry(p.case(),
        "--model.method.init_args.iterations=1000000000000")
    yield "mu_water nan", no, "mu_water", lambda p: p.predict(p.case(), "--model.method.init_args.mu_water=nan")
    yield "mu_water 1e-300", None, "", lambda p: p.predict(p.case(), "--model.method.init_args.mu_water=1e-300")
    yield "mu_water 1e300", None, "", lambda p: p.predict(p.case(), "--model.method.init_args.mu_water=1e300")
    yield "samples of a method without prior", no, "samples", lambda p: p.predict(
        p.case(), "--model.sampling.samples=2")
    yield "samples 0 with a prior", no, "samples", lambda p: p.sampled(p.prior(), "--model.sampling.samples=0")
    yield "guidance inf with a prior", no, "guidance", lambda p: p.sampled(p.prior(), "--model.sampling.guidance=inf")
    yield "guidance 1e308 with a prior", None, "", lambda p: p.sampled(p.prior(), "--model.sampling.guidance=1e308")
    yield "precision float16", no, "precision", lambda p: p.sampled(p.prior(), "--model.sampling.precision=float16")
    yield "precision float64 without prior", no, "precision", lambda p: p.predict(
        p.case(), "--model.sampling.precision=float64")
    yield "memory nan", no, "memory", lambda p: p.sampled(
        p.prior(), "--model.super_resolution.memory=nan",
        f"--model.super_resolution.file={p.prior(name='f.safetensors')}")
    yield "a base prior as second stage", no, "super-resolution", lambda p: p.sampled(
        p.prior(), f"--model.super_resolution.file={p.prior(name='f.safetensors')}")
    yield "accelerator that is not there", no, "accelerator", lambda p: p.predict(p.case(), "--trainer.accelerator=tpx")
    yield "gpu where there is none", no, "", lambda p: p.predict(p.case(), "--trainer.accelerator=gpu")
    yield "devices 0", no, "devices", lambda p: p.predict(p.case(), "--trainer.devices=0")
    yield "devices in words", no, "devices", lambda p: p.predict(p.case(), "--trainer.devices=many")
    yield "trainer.precision 12", no, "precision", lambda p: p.predict(p.case(), "--trainer.precision=12")
    yield "no batch is allowed", None, "", lambda p: p.predict(p.case(), "--trainer.limit_predict_batches=0")
    yield "a callback that is no callback", no, "callbacks", lambda p: p.predict(
        p.case(), "--trainer.callbacks=collections.OrderedDict")
    yield "a logger that is a shell", no, "logger", lambda p: p.predict(
        p.case(), '--trainer.logger={"class_path": "os.system", "init_args": {"command": "touch pwned"}}')
    yield "a method that is a shell", no, "method", lambda p: p.predict(
        p.case(), '--model.method={"class_path": "subprocess.Popen", "init_args": {"args": ["touch", "pwned"]}}')
    yield "a method without module", no, "method", lambda p: p.predict(p.case(), "--model.method=Nothing")
    yield "a method that is a prior", no, "", lambda p: p.predict(p.case(), "--model.method=phydict.prior.Prior")
    yield "a method that is abstract", no, "", lambda p: p.predict(p.case(), "--model.method=phydict.posterior.Sampler")
    yield "a method by its name", True, "", lambda p: p.predict(p.case(), "--model.method=sirt")
    yield "an init_arg too many", no, "speed", lambda p: p.predict(p.case(), "--model.method.init_args.speed=9")
    yield "overwrite maybe", no, "overwrite", lambda p: p.predict(p.case(), "--model.overwrite=maybe")
    yield "dry_run with a value", None, "", lambda p: p.predict(p.case(), "--dry_run=7")
    yield "profile", True, "", lambda p: p.predict(p.case(), "--profile")
    yield "test without cts", no, "data.cts", lambda p: p.infer("test", *SIRT, f"--model.out={p.out}")
    yield "predict without xrays", no, "data.xrays", lambda p: p.infer("predict", *SIRT, f"--model.out={p.out}")
    yield "phantoms 0", no, "phantoms", lambda p: p.test("phantom", "--data.phantoms=0")
    yield "views 0 of test", no, "view", lambda p: p.test("phantom", "--data.orbit.views=0")
    yield "detector of one number", no, "detector", lambda p: p.test("phantom", "--data.orbit.detector=24")
    yield "detector of three numbers", no, "detector", lambda p: p.test("phantom", "--data.orbit.detector=[24,24,24]")
    yield "pixel 0", no, "pixel", lambda p: p.test("phantom", "--data.orbit.pixel=[0,0]")
    yield "detector 10^6 squared", no, "GiB", lambda p: p.test("phantom", "--data.orbit.detector=[1000000,1000000]")
    yield "simulation_voxels 17", no, "simulation_voxels", lambda p: p.test("phantom", "--data.simulation_voxels=17")
    yield "simulation_voxels 160000", no, "GiB", lambda p: p.test("phantom", "--data.simulation_voxels=160000")
    yield "simulator noise nan", no, "noise", lambda p: p.test(
        "phantom", "--data.simulator=phydict.xray.Ideal", "--data.simulator.init_args.noise=nan")
    yield "simulator noise 1e30", None, "", lambda p: p.test(
        "phantom", "--data.phantoms=1", "--data.simulator=phydict.xray.Ideal", "--data.simulator.init_args.noise=1e30")
    yield "simulator null", None, "simulator", lambda p: p.test("phantom", "--data.phantoms=1", "--data.simulator=null")
    yield "simulator kvp 90", no, "kvp", lambda p: p.test(
        "phantom", "--data.simulator=phydict.xray.Polychromatic", "--data.simulator.init_args.kvp=90")
    yield "simulator photons 1e-300", None, "", lambda p: p.test(
        "phantom", "--data.phantoms=1", "--data.simulator=phydict.xray.Ideal",
        "--data.simulator.init_args.photons=1e-300")
    yield "only is a folder", no, "data.only", lambda p: p.test(p.ct().parent, f"--data.only={p.given}")
    yield "only is empty", no, "data.only", lambda p: p.test(p.ct().parent, f"--data.only={p.write('ids', '')}")
    yield "only names another", no, "data.only", lambda p: p.test(p.ct().parent, f"--data.only={p.write('ids', 'zz')}")
    yield "only is binary", no, "ids", lambda p: p.test(p.ct().parent,
        f"--data.only={p.write('ids', bytes(range(256)))}")
    yield "everything is excluded", no, "excluded", lambda p: p.test(
        p.ct().parent, f"--data.source.exclude={p.write('ids', 'ct.nii.gz')}")
    yield "exclude is not there", no, "exclude", lambda p: p.test(p.ct().parent, "--data.source.exclude=nowhere.txt")
    yield "help", True, "", lambda p: p.infer("--help")
    yield "help of predict", True, "", lambda p: p.infer("predict", "--help")
    yield "help of a method", True, "", lambda p: p.infer("predict", "--model.method.help=phydict.baselines.SIRT")
    yield "print_config", True, "", lambda p: p.infer("predict", *SIRT, "--print_config")
    yield "train without words", no, "fit", lambda p: p.train()
    yield "train with another command", no, "fit", lambda p: p.train("predict")
    yield "export of nothing", no, "checkpoint", lambda p: p.train("export")
    yield "inspect of nothing", no, "path", lambda p: p.train("inspect-prior")
    yield "inspect of what is not there", no, "nowhere", lambda p: p.train("inspect-prior", "nowhere")
    yield "inspect of an empty name", None, "", lambda p: p.train("inspect-prior", "")


def geometries():
    """geometry.yaml."""
    no = False

    def orbit(**changes):
        return lambda p: p.predict(p.case(orbit=changes))

    def text(content):
        return lambda p: p.predict(p.case(text=content))

    good = yaml.safe_dump({"beam": {"orbit": ORBIT}, "intensity": {"kind": "line_integrals"}})
    for key, value in (("views", "3"), ("views", 2.5), ("views", True), ("views", None), ("views", -3), ("views", []),
                       ("views", {"n": 3}), ("views", 10**30), ("pixel", "24"), ("pixel", [24, 24, 24]),
                       ("pixel", [[24, 24]]), ("pixel", [24, "24"]), ("pixel", -24), ("pixel", [24, 0]),
                       ("pixel", {"row": 24}), ("pixel", 1e300), ("pixel", 1e-300), ("shape", [24]), ("shape", "24x24"),
                       ("shape", [24, 24, 1]), ("shape", [0, 24]), ("shape", [24, -24]), ("shape", [24, 1e18]),
                       ("shape", [[24, 24], [24, 24]]), ("shape", 24), ("source_to_detector", "1020 mm"),
                       ("source_to_detector", 102.0), ("source_to_detector", [1020]), ("source_to_isocentre", 0),
                       ("source_to_isocentre", -740), ("source_to_isocentre", 1e-320), ("source_to_isocentre", 100),
                       ("start", 90), ("start", "0"), ("arc", 360), ("arc", float("nan")),
                       ("start_degrees", [0, 90, 180]), ("radius", 740), ("", 1), (None, 1), (3, 1)):
        named = str(key) if isinstance(key, str) and key else ""
        yield f"orbit.{key} {str(value)[:20]}", no, ("" if value in (1e-320, 100, 102.0) else "geometry.yaml",
            "" if named in ("source_to_isocentre", "shape", "pixel") else named), \
            orbit(**{key: value}) if isinstance(key, str) else partial(
                lambda p, key, value: p.predict(p.case(beam={"orbit": ORBIT | {key: value}})), key=key, value=value)
    yield "arc_degrees 0", None, "", orbit(arc_degrees=0)
    yield "arc_degrees 1e300", None, "", orbit(arc_degrees=1e300)
    yield "start_degrees -1e17", None, "", orbit(start_degrees=-1e17)
    yield "start_degrees and start", no, "start", orbit(start=0, start_degrees=0)
    yield "orbit is null", no, "geometry.yaml", text("beam: {orbit: null}")
    yield "orbit is a list", no, "geometry.yaml", text("beam: {orbit: [3, 1020, 740]}")
    yield "beam twice", no, "beam", text(good + good)
    yield "orbit and vectors", no, "geometry.yaml", text("beam: {orbit: {views: 3}, sources: []}")
    yield "an empty file", no, "geometry.yaml", text("")
    yield "only comments", no, "geometry.yaml", text("# nothing\n# here\n")
    yield "only a number", no, "geometry.yaml", text("42")
    yield "JSON", None, "", text(json.dumps({"beam": {"orbit": ORBIT}, "intensity": {"kind": "line_integrals"}}))
    yield "with a byte order mark", True, "", text("\ufeff" + good)
    yield "with Windows' line ends", True, "", text(good.replace("\n", "\r\n"))
    yield "in UTF-16", no, "UTF-8", text(good.encode("utf-16"))
    yield "in Latin-1", no, "UTF-8", text(("# Größe\n" + good).encode("latin1"))
    yield "with tabs", no, "geometry.yaml", text(good.replace("  ", "\t"))
    yield "a null byte", no, "geometry.yaml", text(good + "x: \0\n")
    yield "a control character", no, "geometry.yaml", text(good + "x: \x07\n")
    yield "two documents", no, "documents", text(good + "---\n" + good)
    yield "a document end and rubbish", no, "geometry.yaml", text(good + "...\n]]]]\n")
    yield "a python tag", no, "geometry.yaml", text("beam: !!python/object/apply:os.system ['touch pwned']")
    yield "a python tag on a number", no, "geometry.yaml", text(good.replace("views: 3", "views: !!python/int 3"))
    yield "a tag of one's own", no, "geometry.yaml", text(good.replace("views: 3", "views: !three 3"))
    yield "a set", no, "geometry.yaml", text("beam: !!set {a, b}")
    yield "binary", no, "geometry.yaml", text("beam: !!binary aGVsbG8=")
    yield "an alias before its anchor", no, "geometry.yaml", text("beam: *later\nx: &later 1")
    yield "an alias of itself", no, "geometry.yaml", text("beam: &b {orbit: *b}")
    yield "a merge of a list", no, "geometry.yaml", text("beam: {<<: [1, 2]}")
    yield "a merge of an orbit", True, "", text(
        "beam: {orbit: {<<: &o " + json.dumps(ORBIT) + "}}\nintensity: {kind: line_integrals}")
    yield "a key of 10^6 letters", no, "geometry.yaml", text("x" * 10**6 + ": 1\n")
    yield "a text of 16 MB", no, "", text("# " + "x" * (2**24 - 10) + "\nbeam: 1")
    yield "a text of 17 MB", no, "geometry.yaml", text("#" * (17 * 2**20))
    yield "10^5 keys", no, "geometry.yaml", text("".join(f"k{i}: 1\n" for i in range(10**5)))
    yield "octal and sexagesimal numbers", None, "", orbit(start_degrees=0) if False else text(
        good.replace("views: 3", "views: 0o3"))
    yield "sexagesimal", no, "geometry.yaml", text(good.replace("views: 3", "views: 3:00"))
    yield "1_0 with underscores", no, "geometry.yaml", text(good.replace("views: 3", "views: 3_0"))
    yield "yes for a flag", None, "", lambda p: p.predict(p.case(text=good + "orientation: {flip_rows: yes}\n"))
    yield "a flag in quotes", no, "flip_rows", lambda p: p.predict(p.case(orientation={"flip_rows": "true"}))
    yield "rotate 45", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": 45}))
    yield "rotate 90.0", None, "", lambda p: p.predict(p.case(orientation={"rotate_degrees": 90.0}))
    yield "rotate nan", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": float("nan")}))
    yield "rotate a list", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": [90]}))
    yield "orientation a word", no, "orientation", lambda p: p.predict(p.case(orientation="upright"))
    yield "orientation a list", no, "orientation", lambda p: p.predict(p.case(orientation=["flip_rows"]))
    yield "an orientation with a number as key", no, "orientation", lambda p: p.predict(p.case(orientation={1: True}))
    yield "an intensity with a number as key", no, "intensity", lambda p: p.predict(p.case(intensity={1: True}))
    for name, block, word in (
            ("kind a list", {"kind": ["counts"]}, "kind"), ("kind a mapping", {"kind": {"a": 1}}, "kind"),
            ("kind 1", {"kind": 1}, "kind"), ("scale in words", {"kind": "line_integrals", "scale": "big"}, "scale"),
            ("scale nan", {"kind": "line_integrals", "scale": float("nan")}, "scale"),
            ("scale 1e29", {"kind": "line_integrals", "scale": 1e29}, "scale"),
            ("scale true", {"kind": "line_integrals", "scale": True}, "scale"),
            ("offset a list", {"kind": "line_integrals", "offset": [0]}, "offset"),
            ("air 0", {"kind": "counts", "air": 0}, "air"), ("air -1", {"kind": "counts", "air": -1}, "air"),
            ("air and flat", {"kind": "counts", "air": 1, "flat": "f.npy"}, "air"),
            ("flat a number", {"kind": "counts", "flat": 3}, "flat"), ("flat empty", {"kind": "counts", "flat": []},
            ""),
            ("flat empty text", {"kind": "counts", "flat": ""}, ""),
            ("flat a folder", {"kind": "counts", "flat": "."}, ""), ("flat missing", {"kind": "counts",
            "flat": "no.npy"}, "no.npy"),
            ("flat far away", {"kind": "counts", "flat": "/etc/passwd"}, "passwd"),
            ("flat with a null", {"kind": "counts", "flat": "a\0b"}, "flat"),
            ("flat a device", {"kind": "counts", "flat": "/dev/zero"}, "zero"),
            ("flat is a view", {"kind": "counts", "flat": "view_0.npy"}, ""),
            ("flat of 300 letters", {"kind": "counts", "flat": "f" * 300}, "flat"),
            ("dark above air", {"kind": "counts", "air": 5, "dark": 9}, "dark"),
            ("floor 0", {"kind": "counts", "air": 99, "floor": 0}, "floor"),
            ("floor above air", {"kind": "counts", "air": 99, "floor": 1e20}, ""),
            ("display without polarity", {"kind": "display"}, "bright_is_dense"),
            ("polarity 1", {"kind": "display", "bright_is_dense": 1}, "bright_is_dense"),
            ("polarity of counts", {"kind": "counts", "bright_is_dense": True, "air": "1"}, "air")):
        yield f"intensity {name}", no, word, lambda p, block=block: p.predict(p.case(intensity=block))
    vectors = BEAM.to_dict()
    for name, change, word in (
            ("of text", {"sources": "here"}, "sources"), ("one short", {"sources": vectors["sources"][:2]}, ""),
            ("flat lists", {"u": [1, 0, 0]}, "u"), ("ragged", {"u": [[1, 0, 0], [1, 0], [1]]}, "u"),
            ("4 columns", {"v": [[1, 0, 0, 0]] * 3}, "v"), ("tiny steps", {
                "u": [[1e-160, 0, 0]] * 3, "v": [[0, 1e-160, 0]] * 3}, "u"),
            ("steps along each other", {"v": vectors["u"]}, "perpendicular"),
            ("infinite", {"detectors": [[float("inf"), 0, 0]] * 3}, "detectors"),
            ("as text numbers", {"detectors": [["0", "0", "0"]] * 3}, "detectors"),
            ("true", {"detectors": [[True, False, False]] * 3}, "detectors"),
            ("nested deep", {"sources": [[[0, 0, 0]]]}, ""), ("no shape", {"shape": None}, "shape"),
            ("empty", {"sources": [], "detectors": [], "u": [], "v": []}, ""),
            ("null", {"sources": None}, "sources"), ("source at the detector", {"detectors": vectors["sources"]},
            "view"),
            ("far away", {"detectors": [[1e8, 1e8, 1e8]] * 3}, "view"),
            ("a million views", {"sources": [[0, 0, 0]] * 100_000}, "")):
        yield f"vectors {name}", no, ("" if name in ("a million views", "far away") else "geometry.yaml", word), \
            lambda p, change=change: p.predict(p.case(beam=vectors | change))
    yield "vectors as they should be", True, "", lambda p: p.predict(p.case(beam=vectors))
    yield "a beam in a file that is not there", no, "b.csv", lambda p: p.predict(p.case(beam={"file": "b.csv"}))
    yield "a beam in the folder", no, "", lambda p: p.predict(p.case(beam={"file": "."}))
    yield "a beam in itself", no, "", lambda p: p.predict(p.case(beam={"file": "geometry.yaml"}))
    yield "a beam in a number", no, "file", lambda p: p.predict(p.case(beam={"file": 7}))
    yield "a beam by tags of images without", no, "DICOM", lambda p: p.predict(p.case(beam={"dicom": {"pixel": 1}}))
    yield "dicom a list", no, "dicom", lambda p: p.predict(p.case(beam={"dicom": [1]}))
    yield "geometry.yaml is a folder", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), f.mkdir(), p.predict(f.parent))
    yield "geometry.yaml is a dangling link", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), f.symlink_to("nowhere"), p.predict(f.parent))
    yield "geometry.yaml is a pipe", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), os.mkfifo(f), infer(
            ["predict", *SIRT, f"--data.xrays={f.parent}", f"--model.out={p.out}"]))
    yield "a geometry without ending", no, "", lambda p: p.predict(p.case(), f"--data.geometry={p.write('g', good)}")
    yield "an empty geometry option", None, "", lambda p: p.predict(p.case(), "--data.geometry=")
    yield "a geometry option to a folder", no, "", lambda p: p.predict(p.case(), f"--data.geometry={p.given}")


def geometry_files():
    """RTK's XML, ASTRA's vectors and tables."""
    no = False

    def given(name, content):
        def work(p):
            folder = p.case(beam={"file": name, "pixel": [24, 24]})
            p.write(folder / name, content if isinstance(content, str | bytes) else content())
            # images must not take the geometry for a view
            p.predict(folder)
        return work

    def rtk(change=lambda text: text, version="3"):
        rows = "".join(f"<Projection><SourceToIsocenterDistance>740</SourceToIsocenterDistance>"
                       f"<SourceToDetectorDistance>1020</SourceToDetectorDistance><GantryAngle>{a}</GantryAngle>"
                       "</Projection>" for a in (0, 120, 240))
        return change(f'<?xml version="1.0"?><RTKThreeDCircularGeometry version="{version}">{rows}'
                      "</RTKThreeDCircularGeometry>")

    laughs = '<!DOCTYPE l [<!ENTITY a "ha">' + "".join(
        f'<!ENTITY {chr(98 + i)} "{("&" + chr(97 + i) + ";") * 12}">' for i in range(9)) + "]>"
    yield "xml as it should be", True, "", given("g.xml", rtk())
    yield "xml of version 1", no, "version", given("g.xml", rtk(version="1"))
    yield "xml, a billion laughs", no, "g.xml", given("g.xml",
        laughs + "<RTKThreeDCircularGeometry version='3'>&j;</RTKThreeDCircularGeometry>")
    yield "xml that reads files", no, "g.xml", given("g.xml",
        '<!DOCTYPE f [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + rtk(
        lambda t: t.partition("?>")[2].replace(">740<", ">&x;<")))
    yield "xml 5000 deep", no, "g.xml", given("g.xml", "<a>" * 5000)
    yield "xml 200000 deep and closed", no, "g.xml", given("g.xml", "<a>" * 200000 + "</a>" * 200000)
    yield "xml of an unknown encoding", no, "g.xml", given("g.xml", '<?xml version="1.0" encoding="ebcdic-xx"?><a/>')
    yield "xml, an angle of words", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace(">120<", ">right<")))
    yield "xml, an angle of inf", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace(">120<", ">inf<")))
    yield "xml, an angle of 10^4 digits", None, "", given("g.xml", rtk(lambda t: t.replace(">120<",
        ">" + "9" * 10**4 + "<")))
    yield "xml, a distance of 1e200", no, "g.xml", given("g.xml", rtk(lambda t: t.replace(">740<", ">1e200<")))
    yield "xml, without angles", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace("GantryAngle", "Angle")))
    yield "xml without projections", no, "Projection", given("g.xml", rtk(lambda t: t.replace("Projection", "View")))
    yield "xml, empty", no, "g.xml", given("g.xml", "")
    yield "xml, HTML", no, "g.xml", given("g.xml", "<!doctype html><html><br></html>")
    vectors = np.concatenate([BEAM.sources, BEAM.detectors, BEAM.u, BEAM.v], 1)
    csv = "\n".join(",".join(map(str, row)) for row in vectors)
    yield "csv as it should be", True, "", given("g.csv", csv)
    yield "csv with semicolons and BOM", True, "", given("g.csv", "\ufeff" + csv.replace(",", ";"))
    yield "csv with decimal commas", no, "g.csv", given("g.csv", csv.replace(",", ";").replace(".", ","))
    yield "csv with a short row", no, "g.csv", given("g.csv", csv + "\n1,2,3")
    yield "csv with words", no, "g.csv", given("g.csv", csv.replace("740.0", "seven"))
    yield "csv with nan", no, "g.csv", given("g.csv", csv.replace("740.0", "nan"))
    yield "csv with 1e999", no, "g.csv", given("g.csv", csv.replace("740.0", "1e999"))
    yield "csv with a column twice", None, "", given("g.csv", ",".join(
        f"{v}_{a}" for v in ("source", "detector", "u", "v") for a in "xyz") + ",source_x\n" + csv.replace("\n",
        ",1\n") + ",1")
    yield "csv with half a header", no, "column", given("g.csv", "source_x,source_y\n" + csv)
    yield "csv, empty", no, "g.csv", given("g.csv", "")
    yield "csv, only newlines", no, "g.csv", given("g.csv", "\n\n\n")
    yield "csv, binary", no, "g.csv", given("g.csv", bytes(range(256)) * 10)
    yield "csv of 16 MB in one line", no, "g.csv", given("g.csv", "1," * (2**23 - 1))
    yield "csv of 10^6 lines", no, "", given("g.csv", "0,0,0,0,0,0,0\n" * 10**6)

    def with_npy(content):
        def work(p):
            folder = p.case(beam={"file": "../g.npy"})
            p.write("g.npy", content)
            p.predict(folder)
        return work

    good = vectors.astype("<f8").tobytes()
    yield "npy as it should be", True, "", with_npy(npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3, 12), }",
        good))
    yield "npy of objects", no, "g.npy", with_npy(npy("{'descr': '|O', 'fortran_order': False, 'shape': (3, 12), }",
        PICKLE))
    yield "npy with a shape below 0", no, "g.npy", with_npy(npy(
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 12), }", good))
    yield "npy with code in its header", no, "g.npy", with_npy(npy(
        "{'descr': __import__('os').system('touch pwned'), 'fortran_order': False, 'shape': (3, 12), }", good))
    yield "npy with 10^5 brackets", no, "g.npy", with_npy(npy("(" * 60000, good))
    yield "npy of type 1e9 letters", no, "g.npy", with_npy(npy(
        "{'descr': '<U1000000000', 'fortran_order': False, 'shape': (), }"))
    yield "npy of version 9", no, "g.npy", with_npy(b"\x93NUMPY\x09\x00" + good)
    yield "npy, 5 bytes", no, "g.npy", with_npy(b"\x93NUMP")
    yield "npy of complex numbers", no, "g.npy", with_npy(npy(
        "{'descr': '<c16', 'fortran_order': False, 'shape': (3, 6), }", good))
    yield "npy with no numbers of 10^18 rows", no, "g.npy", with_npy(npy(
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000000, 0), }"))
    yield "npy of records", no, "g.npy", with_npy(npy(
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (36,), }", good))


def images():
    """PNG, TIFF and NPY views."""
    no = False

    def bytes_of(content, name="view_1.png"):
        return lambda p: p.predict(p.view(lambda f: f.write_bytes(content), name))

    array = xrays()[1].numpy()
    yield "npy in Fortran's order", True, "", lambda p: p.predict(p.view(lambda f: np.save(f,
        np.asfortranarray(array))))
    yield "npy big-endian", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype(">f4"))))
    yield "npy float16", no, "type", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype("f2"))))
    yield "npy of dates", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f,
        array.astype("i8").astype("M8[s]"))))
    yield "npy of texts", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype("U9"))))
    yield "npy of true and false", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, array > 1)))
    yield "npy of records", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((24, 24), [("a",
        "f4")]))))
    yield "npy without pixels", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((0, 24),
        "f4"))))
    yield "npy of one number", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.float32(3)))) 
    yield "npy with 32 axes", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((1,) * 32,
        "f4"))))
    yield "npy three views at once", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f,
        xrays().numpy())))
    yield "npy longdouble", no, "type", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype(np.longdouble))))
    yield "npy with -inf", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.where(array > 5,
        -np.inf, array))))
    yield "npy of 1e38", no, "", lambda p: p.predict(p.view(lambda f: np.save(f, array * np.float32(1e37))))
    yield "npy of -1e38", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, np.where(array > 3,
        np.float32(-1e38), array))))
    yield "npy of denormals", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, array * np.float32(1e-42))))
    yield "npy integers of 64 bit", no, "intensity", lambda p: p.predict(p.view(
        lambda f: [np.save(f.with_name(f"view_{k}.npy"), (xrays()[k].numpy() * 2**40).astype("u8")) for k in range(3)],
        case=p.case(intensity=None)))
    yield "a view is a link to another", True, "", lambda p: p.predict(p.view(lambda f: f.symlink_to("view_0.npy")))
    yield "a view is a link to itself", no, "", lambda p: p.predict(p.view(lambda f: f.symlink_to(f.name)))
    yield "a view is a pipe", no, "", lambda p: (folder := p.view(lambda f: os.mkfifo(f)), infer(
        ["predict", *SIRT, f"--data.xrays={folder}", f"--model.out={p.out}"]))
    yield "a view is a folder", no, "", lambda p: p.predict(p.view(lambda f: f.mkdir()))
    yield "a view is empty", no, "view_1.png", bytes_of(b"")
    yield "PNG, signature alone", no, "view_1.png", bytes_of(b"\x89PNG\r\n\x1a\n")
    yield "PNG, 0 x 0", no, "view_1.png", bytes_of(png(0, 0))
    yield "PNG, 2^31 wide", no, "view_1.png", bytes_of(png(2**31 - 1, 1))
    yield "PNG, 13000 x 13000 of nothing", no, "", bytes_of(png(13000, 13000, data=b"\0" * (13001 * 13000)))
    yield "PNG, depth 3", no, "view_1.png", bytes_of(png(24, 24, depth=3))
    yield "PNG, broken checksum", no, "view_1.png", bytes_of(png(24, 24).replace(b"IDAT", b"IDAT\1"))
    yield "PNG, text of 100 MB squeezed", None, "", bytes_of(png(24, 24, more=png_chunk(
        b"zTXt", b"a\0\0" + zlib.compress(b"\0" * 10**8))))
    yield "PNG, colour profile of 100 MB", None, "", bytes_of(png(24, 24, more=png_chunk(
        b"iCCP", b"a\0\0" + zlib.compress(b"\0" * 10**8))))
    yield "PNG, transparent", no, "view_1.png", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.zeros((24, 24, 4), np.uint8)).save(f), "view_1.png"))
    yield "PNG with a palette", no, "", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.arange(576, dtype=np.uint8).reshape(24, 24)).convert("P").save(f), "view_1.png"))
    yield "PNG of one bit", no, "", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.eye(24, dtype=bool)).save(f), "view_1.png"))
    yield "animated PNG", no, "view_1.png", lambda p: p.predict(p.view(lambda f: Image.new("L", (24, 24)).save(
        f, save_all=True, append_images=[Image.new("L", (24, 24), 9)]), "view_1.png"))
    yield "GIF named PNG", no, "", lambda p: p.predict(p.view(lambda f: Image.new("L", (24, 24)).save(f, "GIF"),
        "view_1.png"))
    yield "PostScript named PNG", no, "view_1.png", bytes_of(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n(touch pwned) system\n")
    yield "XBM named PNG", no, "", bytes_of(
        b"#define x_width 24\n#define x_height 24\nstatic char x_bits[] = {0x00};\n")
    yield "PPM of 10^9 pixels named PNG", no, "view_1.png", bytes_of(b"P5 30000 30000 255 ")
    yield "TIFF float64 pages 2", no, "view_1.tif", lambda p: p.predict(p.view(lambda f: Image.new("F", (24, 24)).save(
        f, save_all=True, append_images=[Image.new("F", (24, 24))]), "view_1.tif"))
    yield "TIFF, LZW cut off", no, "view_1.tif", lambda p: p.predict(p.view(lambda f: (Image.fromarray(
        np.random.default_rng(0).integers(0, 255, (24, 24), np.uint8)).save(f, compression="tiff_lzw"),
        f.write_bytes(f.read_bytes()[:200])), "view_1.tif"))
    yield "TIFF whose pages lead to each other", no, "view_1.tif", bytes_of(
        b"II*\0\x08\0\0\0\x01\0\0\x01\x03\0\x01\0\0\0\x18\0\0\0\x08\0\0\0", "view_1.tif")
    yield "TIFF CMYK", no, "", lambda p: p.predict(p.view(lambda f: Image.new("CMYK", (24, 24)).save(f), "view_1.tif"))
    yield "PNG all equal", no, "nothing", lambda p: p.predict(p.pictures(lambda a: a * 0 + 7))
    yield "PNG one view inverted", None, "", lambda p: p.predict(p.pictures(lambda a: np.stack([a[0], 60000 - a[1],
        a[2]])))
    yield "PNG with one hot pixel", None, "", lambda p: p.predict(p.pictures(lambda a: np.where(np.arange(
        24) + 0 * a == 3, 65535, a).astype(np.uint16)))
    yield "PNG of other sizes", no, "pixels", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.zeros((24, 25), np.uint16)).save(f), "view_1.png", p.pictures()))
    yield "PNG among NPY", no, "types", lambda p: p.predict(p.view(lambda f: Image.fromarray(
        (array * 1000).astype(np.uint16)).save(f), "view_1.png"))
    yield "images and their thumbnails", no, "images", lambda p: p.predict(p.view(lambda f: [shutil.copy(
        f.with_name("view_0.npy"), f.with_name(n)) for n in ("view_1.npy", "view_0 (copy).npy")], "x", p.case()))
    yield "Thumbs.db and .DS_Store beside", True, "", lambda p: (f := p.case(), p.write(f / "Thumbs.db", b"\xd0\xcf"),
        p.write(
        f / ".DS_Store", b"x"), p.write(f / "notes.docx", b"x"), p.predict(f))
    yield "a hidden image beside", True, "", lambda p: (f := p.case(), p.write(f / "._view_0.npy", b"x"), p.predict(f))
    yield "capital endings", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "VIEW_1.NPY"))
    yield "digits that are no numbers in a name", True, "", lambda p: p.predict(p.view(
        lambda f: np.save(open(f, "wb"), array), "view_1²3.npy"))
    yield "Arabic digits in a name", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "view_٣.npy"))
    yield "a name of 250 digits", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "9" * 250 + ".npy"))
    yield "a name that is no UTF-8", True, "", lambda p: p.predict(p.view(
        lambda f: np.save(open(os.fsencode(f.parent) + b"/view_\xe9.npy", "wb"), array)))
    yield "a name with a line break", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "view\n1.npy"))
    yield "a truncated view with a line break in its name", no, "", bytes_of(b"\x89PNG", "view\n1.png")
    yield "one bad case of two", no, "bad", lambda p: (p.case("good"), p.view(
        lambda f: f.write_bytes(b"x"), case=p.case("bad")), p.predict(p.given))


def dicoms():
    """DICOM views."""
    no = False

    def tags(good, word, **given):
        return good, word, lambda p: p.predict(p.run_of(**given))

    yield "a run as it should be", *tags(True, "")
    yield "distance 0", *tags(no, "DistanceSourceToDetector", DistanceSourceToDetector=0)
    yield "distance below 0", *tags(no, "source_to_detector", DistanceSourceToDetector=-1020)
    yield "isocentre behind the detector", *tags(no, "source_to_isocentre", DistanceSourceToPatient=2000)
    yield "spacing of three", *tags(no, "ImagerPixelSpacing", ImagerPixelSpacing=[1, 1, 1])
    yield "spacing 0", *tags(no, "pixel", ImagerPixelSpacing=[0, 24])
    yield "no spacing", *tags(no, "ImagerPixelSpacing", ImagerPixelSpacing=None)
    yield "increments one short", *tags(no, "Increment", PositionerPrimaryAngleIncrement=[0, 1])
    yield "an angle of 1e300", *tags(None, "", PositionerPrimaryAngle="1e300")
    yield "a slope of 0", *tags(no, "", RescaleSlope=0, RescaleIntercept=0)
    yield "a slope of 1e300", *tags(no, "", RescaleSlope="1e300", RescaleIntercept=0)
    yield "16 bits in 12", *tags(None, "", BitsStored=12, HighBit=11)
    yield "bits stored above allocated", *tags(None, "", BitsStored=33)
    yield "bits allocated 7", *tags(no, "run.dcm", BitsAllocated=7)
    yield "bits allocated 64", *tags(no, "run.dcm", BitsAllocated=64)
    yield "rows 65535", *tags(no, "run.dcm", Rows=65535, Columns=65535)
    yield "rows 0", *tags(no, "run.dcm", Rows=0)
    yield "frames 0", *tags(None, "run.dcm", NumberOfFrames=0)
    yield "frames -3", *tags(None, "run.dcm", NumberOfFrames=-3)
    yield "frames 2^31", *tags(no, "run.dcm", NumberOfFrames=2**31 - 1)
    yield "three colours", *tags(no, "colour", SamplesPerPixel=3)
    yield "palette colour", *tags(None, "", PhotometricInterpretation="PALETTE COLOR")
    yield "MONOCHROME1 line integrals", *tags(None, "", PhotometricInterpretation="MONOCHROME1")
    yield "an unknown photometry", *tags(None, "", PhotometricInterpretation="MONOCHROME9")
    yield "an orientation of nonsense", *tags(no, "PatientOrientation", PatientOrientation=["X", "Y"])
    yield "an orientation along the ray", *tags(no, "PatientOrientation", PatientOrientation=["A", "F"])
    yield "modality CT", *tags(None, "", Modality="CT")
    yield "modality missing", *tags(None, "", Modality=None)

    def raw(change):
        def work(p):
            folder = p.run_of()
            file = folder / "run.dcm"
            file.write_bytes(bytes(change(bytearray(file.read_bytes()))))
            p.predict(folder)
        return work

    yield "cut in the pixels", no, "run.dcm", raw(lambda b: b[:-500])
    yield "cut in the tags", no, "run.dcm", raw(lambda b: b[:600])
    yield "preamble alone", no, "run.dcm", raw(lambda b: b[:132])
    yield "another transfer syntax", no, "run.dcm", raw(lambda b: b.replace(b"1.2.840.10008.1.2.1\0",
        b"1.2.840.10008.1.2.4\0"))
    yield "a deflated syntax without deflate", no, "run.dcm", raw(lambda b: b.replace(
        b"1.2.840.10008.1.2.1\0", b"1.2.840.10008.1.2.1.99"))
    yield "JPEG that is none", no, "run.dcm", raw(lambda b: b.replace(b"1.2.840.10008.1.2.1\0",
        b"1.2.840.10008.1.2.5\0"))
    yield "a sequence without end", no, "run.dcm", raw(lambda b: b + b"\xfe\xff\x00\xe0\xff\xff\xff\xff")
    yield "a length of 2 GB", None, "", raw(lambda b: b[:(n := b.index(
        b"\xe0\x7f\x10\x00OW") + 8)] + b"\xff\xff\xff\x7f" + b[n + 4:])

    def bomb(p):
        folder = p.run_of()
        raw = (folder / "run.dcm").read_bytes()
        start = raw.index(b"\x08\x00\x16\x00UI")
        head = raw[:start].replace(b"\x10\x00UI\x14\x00" + b"1.2.840.10008.1.2.1\0",
        b"\x10\x00UI\x16\x00" + b"1.2.840.10008.1.2.1.99")
        pack = zlib.compressobj(9, wbits=-15)
        body = pack.compress(raw[start:])
        for _ in range(60):
            body += pack.compress(b"\x09\x00\x10\x10UN\0\0" + struct.pack("<I", 10**7) + bytes(10**7))
        (folder / "run.dcm").write_bytes(head + body + pack.flush())
        p.predict(folder)

    yield "a deflated bomb of 600 MB", no, "run.dcm", bomb
    yield "DICOM named PNG", None, "", lambda p: (f := p.run_of(), (f / "run.dcm").rename(f / "run.png"), p.predict(f))
    yield "PNG named DICOM", no, "run2.dcm", lambda p: (f := p.run_of(), Image.new("L", (24, 24)).save(
        p.given / "x.png"), shutil.copy(p.given / "x.png", f / "run2.dcm"), p.predict(f))
    yield "a DICOMDIR beside", True, "", lambda p: (f := p.run_of(), p.write(f / "DICOMDIR", bytes(128) + b"DICM"),
        p.predict(f))
    yield "DICOM and NPY", no, "kind", lambda p: (f := p.run_of(), np.save(f / "v.npy", xrays()[0]), p.predict(f))
    yield "overrides of too many", no, "pixel", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {pixel: [[1,1],[1,1]]}}\nintensity: {kind: line_integrals}"), p.predict(f))
    yield "an override of nan", no, "source_to_isocentre", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {source_to_isocentre: .nan}}\nintensity: {kind: line_integrals}"),
        p.predict(f))
    yield "an override of an orientation that is a list", no, "patient_orientation", lambda p: (f := p.run_of(),
        p.write(
        f / "geometry.yaml", "beam: {dicom: {patient_orientation: [[L, F]]}}\nintensity: {kind: line_integrals}"),
        p.predict(f))
    yield "an empty override of orientation", no, "PatientOrientation", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {patient_orientation: ''}}\nintensity: {kind: line_integrals}"),
        p.predict(f))


def nifti_images():
    """NIfTI views."""
    no = False

    def view(array=None, change=lambda raw: raw, name="view_1.nii"):
        def write(f):
            image = nibabel.Nifti1Image(xrays()[1].numpy().T if array is None else array, np.eye(4))
            raw = bytes(change(bytearray(image.to_bytes())))
            f.write_bytes(gzip.compress(raw) if name.endswith(".gz") else raw)
        return lambda p: p.predict(p.view(write, name))

    def at(offset, data):
        return lambda raw: raw[:offset] + data + raw[offset + len(data):]

    yield "as it should be", True, "", view()
    yield "squeezed", True, "", view(name="view_1.nii.gz")
    yield "of three views", no, "view_1.nii", view(np.zeros((24, 24, 3), "f4"))
    yield "of 7 axes", None, "", view(xrays()[1].numpy().T.reshape(24, 24, 1, 1, 1, 1, 1))
    yield "voxels begin at nan", no, "view_1.nii", view(change=at(108, struct.pack("<f", float("nan"))))
    yield "voxels begin at inf", no, "view_1.nii", view(change=at(108, struct.pack("<f", float("inf"))))
    yield "voxels begin at -1000", no, "view_1.nii", view(change=at(108, struct.pack("<f", -1000.0)))
    yield "voxels begin at 1e30", no, "view_1.nii", view(change=at(108, struct.pack("<f", 1e30)))
    yield "voxels begin in the header", None, "", view(change=at(108, struct.pack("<f", 10.0)))
    yield "slope nan", None, "", view(change=at(112, struct.pack("<f", float("nan"))))
    yield "slope 1e38", no, "", view(change=at(112, struct.pack("<f", 1e38)))
    yield "type 0", no, "view_1.nii", view(change=at(70, struct.pack("<h", 0)))
    yield "type of one bit", no, "view_1.nii", view(change=at(70, struct.pack("<h", 1)))
    yield "type 128 bit", no, "view_1.nii", view(change=at(70, struct.pack("<h", 1536)))
    yield "8 axes", no, "view_1.nii", view(change=at(40, struct.pack("<h", 8)))
    yield "-1 axes", no, "view_1.nii", view(change=at(40, struct.pack("<h", -1)))
    yield "an axis below 0", no, "view_1.nii", view(change=at(42, struct.pack("<h", -24)))
    yield "an extension of 0 bytes", None, "", view(change=lambda raw: raw[:348] + b"\1\0\0\0" + struct.pack("<ii", 0,
        4) + raw[352:])
    yield "an extension of -16 bytes", no, "view_1.nii", view(change=lambda raw: at(108, struct.pack("<f", 400.0))(
        raw[:348] + b"\1\0\0\0" + struct.pack("<ii", -16, 4) + bytes(40) + raw[352:]))
    yield "an extension of 2 GB", no, "view_1.nii", view(change=lambda raw: at(108, struct.pack("<f", 400.0))(
        raw[:348] + b"\1\0\0\0" + struct.pack("<ii", 2**31 - 16, 4) + bytes(40) + raw[352:]))
    yield "two magic words", None, "", view(change=at(344, b"ni1\0"))
    yield "no magic word", no, "view_1.nii", view(change=at(344, b"abcd"))
    yield "cut in the header", no, "view_1.nii", view(change=lambda raw: raw[:200])
    yield "squeezed and cut", no, "view_1.nii.gz", lambda p: p.predict(p.view(lambda f: f.write_bytes(
        gzip.compress(nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes())[:-700]), "view_1.nii.gz"))
    yield "gz that is none", no, "view_1.nii.gz", lambda p: p.predict(p.view(lambda f: f.write_bytes(
        nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes()), "view_1.nii.gz"))
    yield "nii that is gz", no, "view_1.nii", lambda p: p.predict(p.view(lambda f: f.write_bytes(gzip.compress(
        nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes())), "view_1.nii"))
    yield "NIfTI 2", True, "", lambda p: p.predict(p.view(lambda f: nibabel.save(
        nibabel.Nifti2Image(xrays()[1].numpy().T, np.eye(4)), f), "view_1.nii"))


def reports():
    """report.txt."""
    def report(content):
        return lambda p: p.sampled(p.prior(), "--model.sampling.with_report=true") if content is None else (
            folder := p.case("other"), p.write(folder / "report.txt", content), p.infer(
                "predict", "-c", "prior_only", "--model.method.init_args.iterations=2", f"--model.prior={p.prior()}",
                f"--data.xrays={folder}", f"--model.out={p.out}", "--trainer.accelerator=cpu",
                "--model.sampling.guidance=2"))

    yield "as it should be", True, "", report(None)
    yield "empty", True, "", report("")
    yield "white space", True, "", report(" \n\t\r\n ")
    yield "a null byte", True, "", report("nodule\0nodule")
    yield "UTF-16", False, "report.txt", report("nodule".encode("utf-16"))
    yield "Latin-1", False, "report.txt", report("Größe".encode("latin1"))
    yield "one word of a million letters", False, "report.txt", report("x" * 10**6)
    yield "a million words", False, "report.txt", report("nodule " * 10**6)
    yield "a million headings", False, "report.txt", report("Findings: a\n" * 10**6)
    yield "16 MB of spaces", False, "report.txt", report(" " * (2**24 - 1))
    yield "17 MB", False, "report.txt", report("x" * (17 * 2**20))
    yield "40000 words", True, "", report("nodule " * 37000)
    yield "20000 headings", True, "", report("Findings: a\n" * 20000)
    yield "256 KB of spaces", True, "", report(" " * 2**18)
    yield "emoji and combining marks", True, "", report("🫁" * 1000 + "e\u0301" * 1000)
    yield "right-to-left and surrogates' neighbours", True, "", report("\u202e\ud7ff\ue000 nodule \U0010ffff")
    yield "special tokens", True, "", report("[CLS] [SEP] [MASK] [PAD] [UNK]")
    yield "rich markup", True, "", report("[/bold] [red]nodule")
    yield "a report that is a folder", True, "", lambda p: (f := p.case("other") / "report.txt").unlink() or f.mkdir(
        ) or p.predict(f.parent)


def cts():
    """NIfTI CTs in test."""
    no = False
    box_ = box()

    def header(good, word, **fields):
        return good, word, lambda p: p.test(p.ct("ct.nii", header=fields))

    yield "as it should be", True, "", lambda p: p.test(p.ct())
    yield "without orientation", no, "sform", lambda p: p.test(p.ct(header={"sform_code": 0, "qform_code": 0}))
    yield "qform of nan", *header(None, "", sform_code=0, qform_code=1, quatern_b=float("nan"))
    yield "qform of 5", *header(None, "ct.nii", sform_code=0, qform_code=1, quatern_b=5.0)
    yield "sform of inf", *header(no, "ct.nii", srow_x=[float("inf"), 0, 0, 0])
    yield "sform of 0", *header(no, "ct.nii", srow_x=[0, 0, 0, 0])
    yield "sform far away", *header(no, "ct.nii", srow_x=[10, 0, 0, 1e9])
    yield "sform with shear", *header(None, "ct.nii", srow_x=[10, 8, 0, 0])
    yield "voxels of 99 mm", *header(None, "ct.nii", srow_x=[99, 0, 0, 0], srow_y=[0, 99, 0, 0], srow_z=[0, 0, 99, 0])
    yield "voxels of 60 mm", *header(None, "ct.nii", srow_x=[60, 0, 0, 0], srow_y=[0, 60, 0, 0], srow_z=[0, 0, 60, 0])
    yield "voxels of 0.02 mm", *header(None, "ct.nii", srow_x=[.02, 0, 0, 0], srow_y=[0, .02, 0, 0], srow_z=[0, 0, .02,
        0])
    yield "code 9", *header(None, "", sform_code=9)
    yield "units unknown", *header(None, "", xyzt_units=255)
    yield "slope 0", *header(None, "", scl_slope=0.0)
    yield "slope nan and intercept inf", *header(None, "", scl_slope=float("nan"), scl_inter=float("inf"))
    yield "slope inf", *header(None, "ct.nii", scl_slope=float("inf"))
    yield "slope 1e30", *header(None, "", scl_slope=1e30)
    yield "dim 0 of 0", *header(no, "ct.nii", dim=[0, 20, 20, 20, 1, 1, 1, 1])
    yield "dim with 0", *header(no, "ct.nii", dim=[3, 20, 0, 20, 1, 1, 1, 1])
    yield "dim of 32767^3", *header(no, "ct.nii", dim=[3, 32767, 32767, 32767, 1, 1, 1, 1])
    yield "four axes of 1", *header(True, "", dim=[4, 20, 20, 20, 1, 1, 1, 1])
    yield "four axes", *header(no, "ct.nii", dim=[4, 20, 20, 10, 2, 1, 1, 1])
    yield "a vector of 7 axes", *header(no, "ct.nii", dim=[7, 10, 10, 10, 1, 1, 2, 4])
    yield "type complex", *header(no, "ct.nii", datatype=32, bitpix=64)
    yield "type RGBA", *header(no, "ct.nii", datatype=2304, bitpix=32)
    yield "type 9999", *header(no, "ct.nii", datatype=9999)
    yield "bitpix that lies", *header(None, "", bitpix=8)
    yield "sizeof_hdr 349", *header(None, "", sizeof_hdr=349)
    yield "pixdim of nan", *header(None, "", pixdim=[float("nan")] * 8)
    for name, hu in (("all nan", box_ * np.nan), ("all one value", box_ * 0), ("all air", box_ * 0 - 1000), ("huge",
        box_ * 1e30),
                     ("of uint8", (box_ / 10 + 110).astype("u1")), ("inverted", -box_),
                     ("7 slices", box_[:, :, :7]), ("8 slices", box_[:, :, :8]), ("one slice", box_[:, :, :1]),
                     ("a line", box_[:, :1, :1]), ("noise", np.random.default_rng(0).normal(0, 5000,
                     box_.shape).astype("f4"))):
        yield f"voxels {name}", None, "ct", lambda p, hu=hu: p.test(p.ct("ct.nii", hu=hu))
    yield "cut", no, "ct.nii", lambda p: p.test(p.ct("ct.nii", change=lambda raw: raw[:9000]))
    yield "gz cut", no, "ct.nii.gz", lambda p: (f := p.ct(), f.write_bytes(f.read_bytes()[:-900]), p.test(f))
    yield "gz with a damaged middle", no, "ct.nii.gz", lambda p: (f := p.ct(), (b := bytearray(f.read_bytes())),
        b.__setitem__(
        slice(3000, 3100), bytes(100)), f.write_bytes(b), p.test(f))
    yield "gz twice", no, "ct.nii.gz", lambda p: (f := p.ct(), f.write_bytes(gzip.compress(f.read_bytes())), p.test(f))
    yield "gz with rubbish behind", None, "", lambda p: (f := p.ct(), f.write_bytes(f.read_bytes() + b"rubbish" * 99),
        p.test(f))
    yield "a gzip bomb of 4 GB behind the voxels", None, "", lambda p: (f := p.ct(change=lambda raw: raw[:352]),
        f.write_bytes(
        gzip.compress(gzip.decompress(f.read_bytes())) + gzip.compress(bytes(10**7), 9) * 400), p.test(f))
    yield "an empty file", no, "ct.nii.gz", lambda p: p.test(p.write("ct.nii.gz", b""))
    yield "a text", no, "ct.nii", lambda p: p.test(p.write("ct.nii", "hello"))
    yield "a pair's header", no, "", lambda p: p.test(p.write("ct.hdr", "hello"))
    yield "a folder without CTs", no, "", lambda p: p.test(p.case())
    yield "a folder that is not there", no, "nowhere", lambda p: p.test(p.given / "nowhere")
    yield "one bad of two", no, "bad", lambda p: (p.ct(), p.write("cts/bad.nii.gz", b"x"), p.test(p.given / "cts"))
    yield "a CT in two folders", None, "", lambda p: (p.ct("a/x.nii.gz"), p.ct("b/x.nii.gz"), p.test(p.given / "cts"))
    yield "a CT with two endings", no, "rename", lambda p: (p.ct("x.nii"), p.ct("x.nii.gz"), p.test(p.given / "cts"))
    yield "a link to its own folder", None, "", lambda p: (f := p.ct(), (f.parent / "loop").symlink_to(f.parent),
        p.test(f.parent))
    yield "a CT called results.csv", None, "", lambda p: p.test(p.ct("results.csv.nii.gz"))
    yield "a CT called results.md", None, "", lambda p: p.test(p.ct("results.md.nii.gz"))
    yield "a CT called phantom", True, "", lambda p: p.test(p.ct("phantom.nii.gz"))

    def damaged(content):
        def work(p):
            f = p.ct()
            p.test(f)
            p.write(p.out / "sirt/ct/reconstruction.json", content(
                (p.out / "sirt/ct/reconstruction.json").read_text()))
            p.test(f)
        return work

    def without(name):
        return lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != name})

    def with_(name, value):
        return lambda text: json.dumps(json.loads(text) | {name: value})

    yield "done twice", True, "", damaged(lambda text: text)
    for name in ("views", "grid", "scores", "seconds", "method", "files", "settings", "warnings", "network_calls"):
        yield f"a record without {name}", None if name in ("files",
            "warnings") else no, "reconstruction.json" if name not in ("files",
            "warnings") else "", damaged(without(name))
    yield "a record whose scores are words", no, "reconstruction.json", damaged(with_("scores", "good"))
    yield "a record whose scores hold words", None, "", damaged(with_("scores", {"psnr": "good"}))
    yield "a record whose seconds are a number", no, "reconstruction.json", damaged(with_("seconds", 3))
    yield "a record 10^5 deep", no, "reconstruction.json", damaged(lambda text: "[" * 10**5)
    yield "a record that is a list", no, "reconstruction.json", damaged(lambda text: "[]")
    yield "a record in UTF-16", no, "reconstruction.json", damaged(lambda text: text.encode("utf-16"))
    yield "a record of 5000 digits", no, "reconstruction.json", damaged(lambda text: "9" * 5000)
    yield "a table of binary", no, "results.csv", lambda p: (f := p.ct(), p.write(p.out / "sirt/results.csv",
        bytes(256)), p.test(f))


def series():
    """DICOM CT series, prepared."""
    no = False

    def ct(change=lambda folder, paths: None, **tags):
        def work(p):
            affine = np.diag([10.0, 10, 10, 1])
            paths = write_ct_series(p.given / "dicom" / "series", box(), affine, **tags)
            change(p.given / "dicom" / "series", paths)
            p.prepare(p.given / "dicom")
        return work

    yield "without lungs", no, "lungs", ct()
    yield "slices twice", no, "", ct(lambda d, f: shutil.copy(f[3], d / "again.dcm"))
    yield "a slice missing", no, "missing", ct(lambda d, f: f[7].unlink())
    yield "two slices", no, "slices", ct(lambda d, f: [x.unlink() for x in f[2:]])
    yield "modality MR", no, "MR", ct(Modality="MR")
    yield "no position", no, "ImagePositionPatient", ct(ImagePositionPatient=[])
    yield "position of words", no, "", ct(lambda d, f: f[0].write_bytes(f[0].read_bytes().replace(b"1.2.1", b"1.2.9")))
    yield "spacing 0", no, "PixelSpacing", ct(PixelSpacing=[0, 0])
    yield "spacing 1e30", no, "", ct(PixelSpacing=["1e30", "1e30"])
    yield "spacing of one", no, "PixelSpacing", ct(PixelSpacing=[1])
    yield "slope missing", no, "RescaleSlope", ct(RescaleSlope="")
    yield "slope 0", no, "", ct(RescaleSlope=0)
    yield "orientation of 0", no, "ImageOrientationPatient", ct(ImageOrientationPatient=[0] * 6)
    yield "rows larger in one slice", no, "slices", ct(lambda d, f: write_dicom(f[5], np.zeros((30, 20), np.uint16),
        "CT"))
    yield "a slice cut", no, "slice004", ct(lambda d, f: f[4].write_bytes(f[4].read_bytes()[:-300]))
    yield "a slice cut in its header", no, "", ct(lambda d, f: f[4].write_bytes(f[4].read_bytes()[:200]))
    yield "a slice empty", no, "", ct(lambda d, f: f[4].write_bytes(b""))
    yield "rubbish beside", no, "lungs", ct(lambda d, f: (d / "readme.txt").write_text("hello"))
    yield "a localizer", no, "localizer", ct(ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    yield "10 frames in a slice", no, "multi-frame", ct(NumberOfFrames=10)
    yield "a series called ..", no, "lungs", ct(SeriesNumber=0)


def tables():
    """CSV tables of reports and metadata."""
    no = False
    head = "VolumeName,Findings_EN,Impressions_EN\n"

    def report(content, good=True, word=""):
        return good, word, lambda p: p.test(p.ct(), f"--data.source.reports={p.write('r.csv', content)}")

    yield "as it should be", *report(head + "ct.nii.gz,Nodule.,Nodule.\n")
    yield "empty", *report("", no, "r.csv")
    yield "header alone", *report(head)
    yield "one field of 200000 letters", *report(head + f"ct.nii.gz,{'x' * 200000},y\n", None, "r.csv")
    yield "a quote that never ends", *report(head + 'ct.nii.gz,"Nodule', None, "")
    yield "a null byte", *report(head + "ct.nii.gz,a\0b,c\n", None, "r.csv")
    yield "more fields than columns", *report(head + "ct.nii.gz,a,b,c,d\n")
    yield "fewer fields", *report(head + "ct.nii.gz\n")
    yield "only commas", *report(head + ",,\n", no, "VolumeName")
    yield "a row twice", *report(head + "ct.nii.gz,a,b\nct,a,b\n", no, "two rows")
    yield "other columns", *report("name,text\nct,a\n", no, "columns")
    yield "semicolons", *report(head.replace(",", ";"), no, "columns")
    yield "UTF-16", *report(head.encode("utf-16"), no, "UTF-8")
    yield "a folder without tables", no, "CSV", lambda p: p.test(p.ct(), f"--data.source.reports={p.given}")
    yield "a table that is not there", no, "none.csv", lambda p: p.test(p.ct(), "--data.source.reports=none.csv")
    yield "an Excel file", no, "r.csv", lambda p: p.test(p.ct(),
        f"--data.source.reports={p.write('r.csv', b'PK' + bytes(range(128, 256)))}")
    meta = "VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n"

    def calibrated(row, good=no, word="", columns=meta):
        return good, word, lambda p: p.test(p.ct(), f"--data.source.metadata={p.write('m.csv', columns + row)}",
            "--data.source.fixed=false")

    yield "metadata as they should be", *calibrated('ct.nii.gz,1,0,"[10, 10]",10\n', True)
    yield "metadata missing", *calibrated("", no, "ct")
    yield "metadata spacing below 0", *calibrated('ct.nii.gz,1,0,"[-10, 10]",10\n', no, "Spacing")
    yield "metadata spacing of words", *calibrated('ct.nii.gz,1,0,"[a, b]",10\n', no, "XYSpacing")
    yield "metadata slope nan", *calibrated('ct.nii.gz,nan,0,"[10, 10]",10\n', no, "RescaleSlope")
    yield "metadata slope 1e300", *calibrated('ct.nii.gz,1e300,0,"[10, 10]",10\n', no)
    yield "metadata spacing 1e30", *calibrated('ct.nii.gz,1,0,"[1e30, 1e30]",1e30\n', no)
    yield "metadata spacing 500", *calibrated('ct.nii.gz,1,0,"[500, 500]",500\n', None)
    yield "metadata orientation of 0", *calibrated('ct.nii.gz,1,0,"[10, 10]",10,"[0,0,0,0,0,0]"\n', no, "",
        meta.strip() + ",ImageOrientationPatient\n")
    yield "metadata orientation of 5", *calibrated('ct.nii.gz,1,0,"[10, 10]",10,"[1,0,0,0,1]"\n', no,
        "ImageOrientationPatient", meta.strip() + ",ImageOrientationPatient\n")
    yield "metadata short row", *calibrated("ct.nii.gz,1\n", no, "")


def priors():
    """safetensors files."""
    no, name = False, "tiny.safetensors"

    def header(good, word, **changes):
        return good, (name, word) if good is no else word, lambda p: p.sampled(p.prior(changes))

    def network(good, word, **changes):
        return header(good, word, network=tiny()[0]["network"] | changes)

    yield "as it should be", *header(True, "")
    for key in ("format", "grid", "hu_window", "sigma_data", "skip_std", "schedule", "network", "text"):
        yield f"{key} left out", *header(no, "", **{key: ...})
        for value in ([], {}, "x", -1, 1e308, True):
            if (key, value) not in (("format", True),):
                yield f"{key} {value!r}", *header(None if (key, value) in (("schedule", {}), ("text", {})) else no, "",
                    **{key: value})
    yield "stage left out", *header(True, "", stage=...)
    yield "stage base twice", *header(no, "", stage=["base"])
    yield "unknown keys", *header(None, "", colour="red")
    yield "window upside down", *header(no, "", hu_window=[600, -1000])
    yield "window of texts", *header(no, "", hu_window=["-1000", "600"])
    yield "window of true", *header(no, "", hu_window=[False, True])
    yield "window of 1e300", *header(no, "", hu_window=[-1000, 1e300])
    yield "window below air", *header(None, "", hu_window=[-5000, 600])
    yield "window so narrow", *header(None, "", hu_window=[0, 1e-30])
    grid = tiny()[0]["grid"]
    yield "grid of other voxels", *header(None, "", grid=grid | {"shape": [18, 16, 16]})
    yield "grid of one voxel", *header(None, "", grid=grid | {"shape": [1, 1, 1]})
    yield "grid of 15 voxels", *header(None, "", grid=grid | {"shape": [15, 15, 15]})
    yield "grid of 10^6 voxels", *header(no, "", grid=grid | {"shape": [10**6] * 3})
    yield "grid of 600^3 voxels", *header(None, "", grid=grid | {"shape": [600] * 3})
    yield "grid of text", *header(no, "", grid=grid | {"shape": "16"})
    yield "grid with an affine of nan", *header(no, "", grid=grid | {"affine": [[float("nan")] * 4] * 4})
    yield "grid with an affine of words", *header(no, "", grid=grid | {"affine": [["a"] * 4] * 4})
    yield "grid with a key too many", *header(no, "", grid=grid | {"colour": 1})
    yield "grid mirrored", *header(None, "", grid=grid | {"affine": np.diag([-24.0, 24, 24, 1]).tolist()})
    yield "grid far away", *header(None, "", grid=grid | {"affine": (np.diag([24.0, 24, 24, 0]) + [[0, 0, 0,
        1e8]] * 3 + [[0, 0, 0, 1]] if False else [[24, 0, 0, 1e8], [0, 24, 0, 0], [0, 0, 24, 0], [0, 0, 0, 1]])})
    yield "grid in nanometres", *header(None, "", grid=grid | {"affine": np.diag([1e-9, 1e-9, 1e-9, 1]).tolist()})
    yield "blocks 0", *network(no, "", block=0)
    yield "blocks 4", *network(no, "", block=4)
    yield "channels empty", *network(no, "", channels=[])
    yield "channels with null", *network(no, "", channels=[16, None])
    yield "channels nested", *network(no, "", channels=[[16], [16]])
    yield "channels a text", *network(no, "", channels="1616")
    yield "channels a mapping", *network(no, "", channels={"0": 16})
    yield "attention of numbers", *network(None, "", attention=[0, 1])
    yield "attention of another length", *network(no, "", attention=[True])
    yield "res_blocks a list", *network(no, "", res_blocks=[1, 1])
    yield "res_blocks of another length", *network(no, "", res_blocks=[1] * 16)
    yield "head_channels 0", *network(no, "", head_channels=0)
    yield "head_channels 3", *network(None, "", head_channels=3)
    yield "state_channels 1", *network(no, "", state_channels=1)
    yield "a setting too many", *network(no, "", speed=1)
    yield "100000 blocks beside an empty tensor", no, name, lambda p: p.sampled(p.prior(
        {"network": tiny()[0]["network"] | {"res_blocks": 10**5}}, {"x": torch.zeros(10**9, 0)}))
    yield "100000 blocks beside a long tensor", no, name, lambda p: p.sampled(p.prior(
        {"network": tiny()[0]["network"] | {"res_blocks": 10**5}}, {"x": torch.zeros(10**6, dtype=torch.bool)}))
    yield "10^6 details beside a long tensor", no, name, lambda p: p.sampled(p.prior(
        {"detail": {"state_channels": 4, "width": 8, "layers": 10**6}}, {"x": torch.zeros(10**6, dtype=torch.bool)}))
    yield "an unexpected tensor", no, name, lambda p: p.sampled(p.prior(weights={"extra": torch.zeros(3)}))
    first = next(iter(tiny()[1]))
    yield "a tensor missing", no, name, lambda p: p.sampled(p.prior(weights={first: ...}))
    yield "a tensor of integers", None, name, lambda p: p.sampled(p.prior(weights={first: tiny()[1][first].int()}))
    yield "a tensor of true", None, name, lambda p: p.sampled(p.prior(weights={first: tiny()[1][first] > 0}))
    yield "a tensor of complex numbers", None, name, lambda p: p.sampled(p.prior(weights={first: tiny()[1][first].to(
        torch.complex64)}))
    yield "a tensor of float8", None, name, lambda p: p.sampled(p.prior(weights={first: tiny()[1][first].to(
        torch.float8_e4m3fn)}))
    yield "a tensor of 6e4", None, "", lambda p: p.sampled(p.prior(weights={first: torch.full_like(tiny()[1][first],
        6e4)}))
    yield "all tensors 6e4", None, "", lambda p: p.sampled(p.prior(weights={
        k: torch.full_like(w, 6e4) for k, w in tiny()[1].items()}))
    yield "a tensor of inf", no, name, lambda p: p.sampled(p.prior(weights={first: tiny()[1][first] * torch.inf}))
    text = tiny()[0]["text"]
    for key, value in (("vocabulary", []), ("vocabulary", ["a"] * 3), ("vocabulary", [1]), ("vocabulary", "abc"),
        ("length", 0),
                       ("length", 10**5), ("width", 7), ("layers", 0), ("layers", 10**9), ("layers", "1"),
                       ("padded_to", 1),
                       ("source", "/nowhere"), ("source", "../../etc"), ("source", 3), ("source", "")):
        yield f"text.{key} {str(value)[:20]}", None, "" if key == "source" else name, \
            lambda p, key=key, value=value: p.sampled(p.prior({"text": text | {key: value}}))
    for content, what in (("", "nothing"), ("{", "a bracket"), ("1", "a number"), ('"x"', "a text"), ("nan", "nan"),
                          ("{}" * 2, "two objects"), ("\ud800".encode("utf-8", "surrogatepass").decode("utf-8",
                          "replace"), "a surrogate"),
                          ('{"format": 1, "format": 2}', "a key twice"), ("9" * 5000, "5000 digits"), ("[" * 10**6,
                          "10^6 brackets")):
        yield f"a header of {what}", no, name, lambda p, content=content: p.sampled(p.prior(text=content))

    def raw(content):
        return lambda p: p.sampled(p.write(name, content))

    yield "empty", no, name, raw(b"")
    yield "8 bytes of ones", no, name, raw(b"\xff" * 8)
    yield "a length of 2^63", no, name, raw(struct.pack("<Q", 2**63) + b"{}")
    yield "a length of 100 MB", no, name, raw(struct.pack("<Q", 10**8) + b"{}")
    yield "an empty header", no, name, raw(struct.pack("<Q", 2) + b"{}")
    yield "tensors over each other", no, name, raw(struct.pack("<Q", 117) + json.dumps({
        "a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, "b": {"dtype": "F32", "shape": [1],
        "data_offsets": [0, 4]}}).encode().ljust(117) + bytes(4))
    yield "a zip", no, name, raw(b"PK\x05\x06" + bytes(18))
    yield "a pickle", no, "", lambda p: p.sampled(p.write("evil.pt", PICKLE))
    yield "a pickle named safetensors", no, "", raw(PICKLE)
    yield "a folder", no, "", lambda p: p.sampled(p.given)
    yield "a device", no, "", lambda p: p.sampled("/dev/zero")
    yield "an empty name", None, "", lambda p: p.sampled("")
    yield "a hub's name", no, "", lambda p: p.sampled("microsoft/BiomedVLP-CXR-BERT-specialized")
    yield "a URL", no, "", lambda p: p.sampled("https://example.org/prior.safetensors")
    yield "inspect of a header list", None, "", lambda p: p.train("inspect-prior", p.prior(text="[]"))
    yield "inspect of a header with odd parts", None, "", lambda p: p.train("inspect-prior", p.prior({"grid": [],
        "hu_window": "ab", "text": [1]}))
    yield "inspect of the prior", True, "", lambda p: p.train("inspect-prior", p.prior())
    yield "a second stage of another size", no, "", lambda p: (save_super_resolution(
        tiny_super_resolution(48, 2), p.given / "f.safetensors"), p.sampled(p.prior(),
        f"--model.super_resolution.file={p.given / 'f.safetensors'}"))
    yield "a second stage as it should be", True, "", lambda p: (save_super_resolution(
        tiny_super_resolution(32, 2), p.given / "f.safetensors"), p.sampled(p.prior(),
        f"--model.super_resolution.file={p.given / 'f.safetensors'}"))


def configurations():
    """YAML configurations."""
    no = False
    for name, content, good, word in (
            ("model null", {"model": None}, None, ""), ("data null", {"data": None}, None, ""), ("trainer null",
            {"trainer": None}, None, ""),
            ("a number as key", {3: 4}, no, "3"), ("null as key", {None: 4}, no, ""), ("true as key", {True: 4}, no,
            ""),
            ("a number as key of model", {"model": {3: 4}}, no, "3"), ("null as key of data", {"data": {None: 1}}, no,
            ""),
            ("a nested number as key", {"model": {"method": {"class_path": "phydict.baselines.SIRT",
            "init_args": {7: 1}}}}, no, "7"),
            ("dotted keys", {"model.seed": 3}, None, ""), ("an empty key", {"": 3}, no, ""), ("a key of dots",
            {"...": 3}, no, ""),
            ("a key with dashes", {"--model.seed": 3}, no, ""), ("a key with a space", {"model seed": 3}, no, ""),
            ("seed a list", {"model": {"seed": [1]}}, no, "seed"), ("seed true", {"model": {"seed": True}}, None,
            "seed"),
            ("seed a text", {"model": {"seed": "one"}}, no, "seed"), ("seed null", {"model": {"seed": None}}, no,
            "seed"),
            ("seed 1e3", {"model": {"seed": 1e3}}, None, "seed"), ("name null", {"model": {"name": None}}, None, ""),
            ("name a list", {"model": {"name": ["a"]}}, no, "name"), ("name a number", {"model": {"name": 3}}, None,
            "name"),
            ("name of dots", {"model": {"name": "..."}}, None, ""), ("name of a space", {"model": {"name": " "}}, None,
            ""),
            ("name with a null byte", {"model": {"name": "a\0b"}}, no, "name"), ("name with a line break",
            {"model": {"name": "a\nb"}}, None, ""),
            ("name of 300 letters", {"model": {"name": "a" * 300}}, no, ""), ("name with markup",
            {"model": {"name": "[/b]"}}, None, ""),
            ("name of a record", {"model": {"name": ".hidden"}}, None, ""), ("name with dollars",
            {"model": {"name": "$a$b$"}}, None, ""),
            ("name dry_run", {"model": {"name": "dry_run"}}, None, ""),
            ("out a list", {"model": {"out": [1]}}, None, "out"),
            ("method null", {"model": {"method": None}}, no, "method"), ("method a number", {"model": {"method": 3}},
            no, "method"),
            ("method without class_path", {"model": {"method": {"init_args": {"iterations": 2}}}}, None, ""),
            ("class_path a list", {"model": {"method": {"class_path": ["a"]}}}, no, "method"),
            ("class_path of dots", {"model": {"method": {"class_path": "a..b"}}}, no, "method"),
            ("class_path of a module", {"model": {"method": {"class_path": "phydict.baselines"}}}, no, "method"),
            ("class_path with code", {"model": {"method": {"class_path": "__import__('os').system('touch pwned')"}}},
            no, "method"),
            ("class_path eval", {"model": {"method": {"class_path": "builtins.eval", "init_args": {"source": "1"}}}},
            no, "method"),
            ("init_args a list", {"model": {"method": {"class_path": "phydict.baselines.SIRT", "init_args": [1]}}}, no,
            ""),
            ("init_args null", {"model": {"method": {"class_path": "phydict.baselines.SIRT", "init_args": None}}},
            None, ""),
            ("init_args twice nested", {"model": {"method": {"class_path": "phydict.baselines.SIRT",
            "init_args": {"init_args": {"iterations": 1}}}}}, no, ""),
            ("a method in the method", {"model": {"method": {"class_path": "phydict.posterior.SplitGibbs",
            "init_args": {"likelihood": {"class_path": "phydict.baselines.SIRT"}}}}}, no, "likelihood"),
            ("prior a mapping", {"model": {"prior": {"path": 3}}}, None, ""), ("prior a list",
            {"model": {"prior": ["a"]}}, None, ""),
            ("views a text", {"data": {"orbit": {"views": "8"}}}, None, ""),
            ("detector a text", {"data": {"orbit": {"detector": "24,24"}}}, no, "detector"),
            ("detector nested", {"data": {"orbit": {"detector": [[24], [24]]}}}, no, "detector"), ("pixel null",
            {"data": {"orbit": {"pixel": None}}}, None, ""),
            ("simulator a word", {"data": {"simulator": "ideal"}}, no, "simulator"), ("simulator null",
            {"data": {"simulator": None}}, None, ""),
            ("trainer.devices a mapping", {"trainer": {"devices": {"n": 1}}}, no, "devices"),
            ("trainer.callbacks of open", {"trainer": {"callbacks": [{"class_path": "builtins.open",
            "init_args": {"file": "pwned", "mode": "w"}}]}}, no, "callbacks"),
            ("trainer.strategy of words", {"trainer": {"strategy": "fast"}}, no, "strategy"),
            ("trainer.plugins of a shell", {"trainer": {"plugins": [{"class_path": "os.system"}]}}, no, "plugins"),
            ("subcommand", {"subcommand": "test"}, None, ""), ("predict nested", {"predict": {"model": {"seed": 1}}},
            no, ""),
            ("config in config", {"config": "other.yaml"}, None, ""), ("seed_everything", {"seed_everything": "x"}, no,
            "seed_everything"),
            ("help as key", {"help": True}, no, ""), ("print_config as key", {"print_config": True}, no, ""),
            ("dry_run as text", {"dry_run": "often"}, no, "dry_run"), ("return_predictions",
            {"return_predictions": True}, no, ""),
            ("class as key", {"__class__": "x"}, no, ""), ("path as key", {"__path__": "x"}, None, "")):
        yield name, good, word, lambda p, content=content: p.settings(content)
    for name, content, good, word in (
            ("empty", "", no, ""), ("a list", "- a\n- b\n", no, "mine.yaml"), ("a text", "hello", no, "mine.yaml"),
            ("rubbish", "{]", no, "mine.yaml"),
            ("binary", bytes(range(256)), no, "mine.yaml"), ("a python tag", "model: !!python/name:os.system", no,
            "mine.yaml"),
            ("an include", "model: !include /etc/passwd", no, "mine.yaml"), ("environment", "model: {name: ${HOME}}",
            None, ""),
            ("3 anchors", "a: &a {seed: 3}\nmodel: *a\n", None, ""), ("a date", "model: {name: 2020-01-01}", None, ""),
            ("a float with 1000 digits", "model: {cube: {side: 1." + "0" * 1000 + "}}", no, "side"), ("a key twice",
            "model: {seed: 1, seed: 2}", no, "seed"),
            ("40 levels", "model: " + "{a: " * 40 + "1" + "}" * 40, no, "mine.yaml"), ("a colon in text",
            "model: {name: 'a: b'}", None, ""),
            ("emoji", "model: {name: 🫁}", True, ""), ("a lone surrogate", 'model: {name: "\\ud800"}', None, ""),
            ("an escape beyond Unicode", 'model: {name: "\\U00110000"}', no, "mine.yaml"), ("omegaconf",
            "model: {seed: ${oc.env:HOME}}", no, "")):
        yield f"text {name}", good, word, lambda p, content=content: p.settings(content)
    yield "a name with a colon", None, "", lambda p: (f := p.write("a:b.yaml", "model: {seed: 1}"), p.predict(p.case(),
        "-c", f))
    yield "a name with anchors and a colon", no, "", lambda p: (f := p.write("a:b.yaml",
        "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 10)}]\n" for i in range(8))),
        p.predict(p.case(), "-c", f))
    yield "a name with a space", None, "", lambda p: (f := p.write("a b.yaml", "model: {seed: 1}"), p.predict(p.case(),
        "-c", f))
    yield "a pipe", no, "", lambda p: (f := p.given / "pipe.yaml", os.mkfifo(f), infer(["predict", "-c", str(f),
        "--data.xrays=x"]))


def outputs():
    """Where results go."""
    no = False
    yield "in the X-rays", no, "model.out", lambda p: (c := p.case(), p.predict(c, out=c / "out"))
    yield "around the X-rays", no, "", lambda p: (c := p.case("sirt/case"), p.predict(c, out=p.given))
    yield "through a link", no, "model.out", lambda p: (c := p.case(), (p.root / "l").symlink_to(c), p.predict(c,
        out=p.root / "l" / "out"))
    yield "X-rays through a link", no, "model.out", lambda p: (c := p.case(), (p.root / "l").symlink_to(c),
        p.predict(p.root / "l", out=c))
    yield "through ..", no, "model.out", lambda p: (c := p.case(), p.predict(c, out=p.given / "x" / ".." / "case"))
    yield "the pages in the X-rays", no, "model.out", lambda p: (c := p.case("dry_run"), p.predict(c, "--dry_run",
        out=p.given))
    yield "a file", no, "model.out", lambda p: p.predict(p.case(), out=p.write("file", "x"))
    yield "below a file", no, "model.out", lambda p: p.predict(p.case(), out=p.write("file", "x") / "y")
    yield "a dangling link", None, "", lambda p: ((p.root / "out").symlink_to("nowhere/there"), p.predict(p.case()))
    yield "a link to itself", no, "model.out", lambda p: ((p.root / "out").symlink_to("out"), p.predict(p.case()))
    yield "/dev/null", no, "model.out", lambda p: p.predict(p.case(), out="/dev/null")
    yield "/proc", no, "model.out", lambda p: p.predict(p.case(), out="/proc/out")
    yield "/sys", no, "model.out", lambda p: p.predict(p.case(), out="/sys/out")
    yield "an empty name", None, "", lambda p: p.predict(p.case(), "--model.out=")
    yield "300 letters", no, "model.out", lambda p: p.predict(p.case(), out="x" * 300)
    yield "5000 letters deep", no, "model.out", lambda p: p.predict(p.case(), out="/".join(["x" * 100] * 50))
    yield "spaces, quotes and line breaks", True, "", lambda p: p.predict(p.case(),
        out=p.root / "a b'c\"d\n$(touch pwned)`e`;f")
    yield "emoji", True, "", lambda p: p.predict(p.case(), out=p.root / "🫁é")
    yield "no UTF-8", True, "", lambda p: p.predict(p.case(), out=os.fsdecode(os.fsencode(p.root) + b"/\xe9"))
    yield "markup", True, "", lambda p: p.predict(p.case(), out=p.root / "[" / "b]")
    yield "a case's place is a file", no, "case", lambda p: (p.write(p.out / "sirt/case", "mine"), p.predict(p.case()))
    yield "a case's place is an empty folder", no, "case", lambda p: ((p.out / "sirt/case").mkdir(parents=True),
        p.predict(p.case()))
    yield "a case's place is a dangling link", no, "case", lambda p: ((p.out / "sirt").mkdir(parents=True),
        (p.out / "sirt/case").symlink_to("x"), p.predict(p.case()))
    yield "a case's place, overwritten", no, "case", lambda p: (p.write(p.out / "sirt/case/mine.txt", "mine"),
        p.predict(p.case(), "--model.overwrite=true"))

    def twice(*more, between=lambda p: None, good_first=()):
        def work(p):
            c = p.case()
            p.predict(c, *good_first)
            between(p)
            p.predict(c, *more)
        return work

    yield "twice", True, "", twice()
    yield "twice, overwritten", True, "", twice("--model.overwrite=true")
    yield "twice with another seed", no, "overwrite", twice("--model.seed=3")
    yield "twice, one's own file among them", no, "mine.txt", twice(
        "--model.overwrite=true", between=lambda p: p.write(p.out / "sirt/case/mine.txt", "mine"))
    yield "twice, a folder among them", no, "", twice(
        "--model.overwrite=true", between=lambda p: p.write(p.out / "sirt/case/volume/mine.txt", "mine"))
    yield "twice, the record lists a file of one's own", None, "", twice("--model.overwrite=true",
        between=lambda p: p.write(
        p.out / "sirt/case/reconstruction.json", (p.out / "sirt/case/reconstruction.json").read_text().replace(
        '"files": [', '"files": ["../../..", "mine.txt",')))
    yield "twice, the volume gone", None, "", twice(between=lambda p: (p.out / "sirt/case/volume.nii.gz").unlink())
    yield "leftovers of a killed run", True, "", lambda p: ((
        p.out / f"sirt/.case.{os.uname().nodename}.999999.partial").mkdir(parents=True), p.predict(p.case()))
    yield "set aside by a killed run", True, "", twice(between=lambda p: (p.out / "sirt/case").rename(
        p.out / "sirt/.case.set-aside-by-phydict"))
    yield "X-rays below a folder called as the output", None, "", lambda p: p.predict(p.case("runs/sirt"),
        out=p.root / "runs")
    yield "the demo's folder as X-rays and output", no, "", lambda p: p.predict("data/example/xrays",
        out=ROOT / "data/example/xrays")
    yield "a stranger's page", None, "", lambda p: (p.write(p.out / "dry_run/case.png", "mine"), p.predict(p.case(),
        "--dry_run"), (_ for _ in ()).throw(
        AssertionError("the file was replaced")) if (p.out / "dry_run/case.png").read_bytes() != b"mine" else None)
    yield "ablate into the CTs", no, "", lambda p: (c := p.ct().parent, p.ablate({"phantoms": ..., "cts": str(c),
        "out": str(c)}))
    yield "ablate into a folder in the CTs", no, "", lambda p: (c := p.ct().parent, p.ablate({"phantoms": ...,
        "cts": str(c), "out": str(c / "x")}))
    yield "fit into the CTs", no, "", lambda p: (c := p.ct().parent, p.fit(f"--data.cts={c}", "--data.phantoms=0",
        f"--out={c}"))
    yield "export onto a link", None, "", lambda p: p.train("export", "--checkpoint=x.ckpt",
        f"--out={p.out}/x.safetensors")


def ablations():
    """Specifications of ablate."""
    no = False
    for name, content, good, word in (
            ("as it should be", {}, True, ""), ("no cases", {"phantoms": ...}, no, "cts"), ("phantoms a text",
            {"phantoms": "1"}, no, "phantoms"),
            ("phantoms -1", {"phantoms": -1}, no, "phantoms"), ("phantoms true", {"phantoms": True}, no, "phantoms"),
            ("out a number", {"out": 3}, no, "out"),
            ("out null", {"out": None}, no, "out"), ("axes a list", {"axes": [1]}, no, "axes"), ("axes null",
            {"axes": None}, no, "method"),
            ("an axis empty", {"axes": {"method": []}}, no, "method"), ("an axis a number",
            {"axes": {"method": ["sirt"], "views": 3}}, no, "views"),
            ("an axis of mappings", {"axes": {"method": ["sirt"], "views": [{"a": 1}]}}, no, "views"), ("views nan",
            {"axes": {"method": ["sirt"], "views": [float("nan")]}}, no, "views"),
            ("views 0", {"axes": {"method": ["sirt"], "views": [0]}}, no, "view"), ("views 10^9",
            {"axes": {"method": ["sirt"], "views": [10**9]}}, no, "views"),
            ("detector 0", {"axes": {"method": ["sirt"], "detector": [0]}}, no, "detector"), ("pixel -1",
            {"axes": {"method": ["sirt"], "pixel": [-1.0]}}, no, "pixel"),
            ("seed -1", {"axes": {"method": ["sirt"], "seed": [-1]}}, no, "seed"), ("seed a text",
            {"axes": {"method": ["sirt"], "seed": ["a"]}}, no, "seed"),
            ("a method that is not there", {"axes": {"method": ["magic"]}}, no, "magic"), ("a method that is a list",
            {"axes": {"method": [["sirt"]]}}, no, "method"),
            ("a field that is not there", {"axes": {"method": ["sirt"], "method.speed": [1]}}, no, "speed"),
            ("method.", {"base": {"method.": 1}}, no, "method."),
            ("a field of a field", {"axes": {"method": ["sirt"], "method.iterations.x": [1]}}, no, "iterations"),
            ("dots", {"base": {"..": 1}}, no, ".."),
            ("a number as setting", {"base": {3: 1}}, no, "3"), ("null as setting", {"base": {None: 1}}, no, "None"),
            ("iterations 0", {"axes": {"method": ["sirt"], "method.iterations": [0]}}, no, "iteration"),
            ("iterations a text", {"axes": {"method": ["sirt"], "method.iterations": ["many"]}}, no, "iterations"),
            ("methods a list", {"methods": ["sirt"]}, no, "methods"), ("a method of nothing",
            {"methods": {"mine": {"of": "magic"}}}, no, "magic"),
            ("a method named by a number", {"methods": {3: {"of": "sirt"}}}, None, ""), ("a method of a list",
            {"methods": {"mine": {"of": ["sirt"]}}}, no, "mine"),
            ("a method with markup and bars", {"methods": {"[/b]|$a$b": {"of": "sirt"}},
            "axes": {"method": ["[/b]|$a$b"]}}, True, ""),
            ("a method with one dollar and a backslash", {"methods": {"a$b\\frac$": {"of": "sirt"}},
            "axes": {"method": ["a$b\\frac$", "sirt"]}}, True, ""),
            ("products and axes", {"products": [{}]}, no, "products"), ("products empty", {"axes": ...,
            "products": []}, no, "products"),
            ("products of numbers", {"axes": ..., "products": [3]}, no, "product"), ("10^6 combinations",
            {"axes": {"method": ["sirt"], "seed": list(range(1000)), "views": list(range(1, 1000))}}, no,
            "combinations"),
            ("9000 combinations", {"axes": {"method": ["sirt"], "seed": list(range(90)), "views": list(range(1,
            101))}}, None, ""),
            ("30 products of 9000", {"axes": ..., "products": [{"axes": {"method": ["sirt"], "seed": list(range(90)),
            "views": list(range(1, 101))}}] * 30}, None, ""),
            ("voxels 0", {"base": {"voxels": 0}}, no, "voxels"), ("voxels 10^5", {"base": {"voxels": 10**5}}, no,
            "GiB"), ("side nan", {"base": {"voxels": 16, "side": float("nan")}}, no, "side"),
            ("simulator magic", {"base": {"simulator": "magic"}}, no, "magic"), ("simulator.noise below 0",
            {"base": {"voxels": 16, "simulator.noise": -1.0}}, no, "noise"),
            ("a prior that is not there", {"axes": {"method": ["prior_only"], "prior": ["nowhere.safetensors"]},
            "base": {"views": 2}}, no, "nowhere"),
            ("guidance nan", {"axes": {"method": ["prior_only"], "guidance": [float("nan")]}, "base": {"views": 2}},
            no, "guidance"),
            ("delta 2", {"axes": {"method": ["phydict_paper"], "delta": [2.0]}, "base": {"views": 2}}, None, ""),
            ("a report of words", {"base": {"report": "maybe"}}, no, "report"), ("an unknown key", {"colour": 1}, no,
            "colour"), ("only of phantoms", {"only": "x.txt"}, None, "")):
        yield name, good, word, lambda p, content=content: p.ablate(content)
    for name, content in (("empty", ""), ("a list", "[]"), ("a number", "3"), ("null", "null"), ("rubbish", "{"),
        ("binary", bytes(range(256)))):
        yield f"text {name}", no, "spec.yaml", lambda p, content=content: p.ablate(content)
    yield "a device that is not there", no, "device", lambda p: p.ablate({}, "--device=warp")
    yield "cuda where there is none", None if torch.cuda.is_available() else no, "cuda", lambda p: p.ablate({},
        "--device=cuda")
    yield "an option that is not there", no, "colour", lambda p: p.ablate({}, "--colour=red")

    def edited(change, good, word):
        def work(p):
            p.ablate({})
            file = p.out / "results.csv"
            file.write_bytes(change(file.read_bytes()))
            p.ablate({})
        return good, word, work

    yield "a table of another's", *edited(lambda b: b"a,b\n1,2\n", no, "results.csv")
    yield "a table cut", *edited(lambda b: b[:-20], None, "results.csv")
    yield "a table with a line more", *edited(lambda b: b + b"x\n", no, "results.csv")
    yield "a table with a huge field", *edited(lambda b: b + b"x" * 200000 + b"\n", no, "results.csv")
    yield "a table of binary", *edited(lambda b: bytes(range(256)), no, "results.csv")
    yield "a table empty", *edited(lambda b: b"", None, "results.csv")
    yield "a table with null bytes", *edited(lambda b: b + b"\0" * 500, None, "results.csv")
    yield "a table in UTF-16", *edited(lambda b: b.decode().encode("utf-16"), no, "results.csv")
    yield "a table with words for numbers", *edited(lambda b: b.replace(b",ok,", b",ok,", 1).replace(b"cpu", b"cpu"),
        True, "")

    def psnr(b, value):
        import csv
        import io
        rows = list(csv.reader(io.StringIO(b.decode())))
        rows[1][rows[0].index("psnr")] = value
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        return text.getvalue().encode()

    for value in ("good", "nan", "inf", "", "1e999"):
        yield f"a table with a PSNR of {value or 'nothing'}", *edited(lambda b, value=value: psnr(b, value), None,
            "results.csv")
    yield "a stranger's picture in the folder", no, "", lambda p: (p.write(p.out / "cat.png", "mine"), p.ablate({}))
    yield "a stranger's table in the folder", no, "", lambda p: (p.write(p.out / "tables.md", "mine"), p.ablate({}))


def trainings():
    """train.py."""
    no = False
    for option, good, word in (
            ("--trainer.max_steps=0", None, ""), ("--trainer.max_steps=-5", None, ""),
            ("--data.loading.batch_size=0", no, "batch_size"), ("--data.loading.batch_size=100", no, "batch_size"),
            ("--data.loading.epoch_size=-1", no, "epoch_size"), ("--data.loading.workers=-1", no, "workers"),
            ("--data.loading.workers=1000000", no, "workers"), ("--data.phantoms=-2", no, "phantoms"),
            ("--data.phantoms=0", no, "phantoms"), ("--data.loading.ct_fraction=2", no, "ct_fraction"),
            ("--data.loading.ct_fraction=nan", no, "ct_fraction"), ("--data.holdout.fraction=7", no, "fraction"),
            ("--data.seed=-1", no, "seed"), ("--model.optimisation.learning_rate=nan", None, "learning_rate"),
            ("--model.optimisation.learning_rate=-1", no, "learning"),
            ("--model.optimisation.learning_rate=1e30", None, ""),
            ("--model.cube.voxels=7", no, ""), ("--model.cube.voxels=0", no, "voxels"),
            ("--model.cube.voxels=100000", no, "GiB"),
            ("--model.cube.side=-1", no, "side"), ("--model.window=[600,-1000]", no, "window"),
            ("--model.window=[0]", no, "window"), ("--model.optimisation.warmup=-3", None, "warmup"),
            ("--model.optimisation.decay_steps=-3", None, "decay"), ("--model.network.init_args.channels=[]", no, ""),
            ("--model.network.init_args.channels=[7,7]", no, ""), ("--model.network.init_args.block=0", no, ""),
            ("--model.initial=nowhere.safetensors", no, "nowhere"),
            ("--ckpt_path=nowhere.ckpt", no, "nowhere"), ("--ckpt_path=hpc", None, ""), ("--precision=half", no,
            "precision"), ("--stage=third", no, "stage"), ("--data.cache=/dev/null", no, "cache"),
            ("--data.cache=", None, ""), ("--out=", None, ""), ("--data.cts=nowhere", no, "nowhere"),
            ("--data.holdout.ids=[x]", no, "holdout"), ("--data.holdout.phantoms=-1", None, "phantoms"),
            ("--data.holdout.phantoms=1000000000", no, "phantoms"), ("--data.augmentation.shift=nan",
            None, ""), ("--data.augmentation.shift=-5", None, ""), ("--trainer.max_epochs=-3", None, ""),
            ("--model.text.encoder=nowhere", no, "nowhere"), ("--model.text.length=0", None, ""),
            ("--trainer.gradient_clip_val=-1", None, ""), ("--checkpoint.every_n_epochs=-1", None, ""),
            ("--progress.interval=x", no, "interval"), ("--trainer.devices=99", no, "devices")):
        yield option, good, word, lambda p, option=option: p.fit(option)
    yield "export of a PNG", no, "png", lambda p: p.train("export",
        f"--checkpoint={ROOT / 'data/example/xrays/view_0.png'}", f"--out={p.out}.safetensors")
    yield "export of a pickle", no, "refused", lambda p: p.train("export",
        f"--checkpoint={p.write('e.ckpt', PICKLE)}", f"--out={p.out}.safetensors")

    def checkpoint(content):
        def work(p):
            torch.save(content, p.given / "c.ckpt")
            p.train("export", f"--checkpoint={p.given / 'c.ckpt'}", f"--out={p.root / 'x.safetensors'}")
        return work

    head = tiny()[0]
    yield "a checkpoint that is a list", no, "c.ckpt", checkpoint([1])
    yield "a checkpoint with header null", no, "c.ckpt", checkpoint({"phydict": None})
    yield "a checkpoint with weights null", no, "c.ckpt", checkpoint({"phydict": head, "state_dict": None})
    yield "a checkpoint without weights", no, "", checkpoint({"phydict": head, "state_dict": {}})
    yield "a checkpoint with a weight of text", no, "c.ckpt", checkpoint({"phydict": head,
        "state_dict": {"prior.x": "y"}})
    yield "a checkpoint with numbers as names", no, "c.ckpt", checkpoint({"phydict": head,
        "state_dict": {1: torch.zeros(1)}})
    yield "a checkpoint with an empty header", no, "", checkpoint({"phydict": {}, "state_dict": {}})
    yield "a checkpoint of sparse weights", no, "", checkpoint({"phydict": head,
        "state_dict": {"prior.x": torch.eye(3).to_sparse()}})
    full = {"phydict": head, "state_dict": {"prior." + k: w for k, w in tiny()[1].items()}}
    yield "a checkpoint as it should be", True, "", checkpoint(full)
    yield "a checkpoint whose training is odd", None, "", checkpoint(full | {"phydict": head | {"training": {1: (2,
        3)}}})
    yield "a checkpoint of meta weights", no, "", checkpoint({"phydict": head,
        "state_dict": {"prior." + k: w.to("meta") for k, w in tiny()[1].items()}})
    yield "a checkpoint to go on from that lacks parts", no, "lacks", lambda p: (torch.save(full, p.given / "c.ckpt"),
        p.fit(f"--ckpt_path={p.given / 'c.ckpt'}"))
    yield "a checkpoint whose parts are odd", no, "", lambda p: (torch.save(full | dict.fromkeys(
        ("epoch", "global_step", "loops", "optimizer_states", "lr_schedulers", "callbacks"),
        3) | {"pytorch-lightning_version": "2.6.6"}, p.given / "c.ckpt"), p.fit(f"--ckpt_path={p.given / 'c.ckpt'}"))
    yield "export over another's file", no, "replaced", lambda p: (f := p.write("x.safetensors", b"mine"),
        torch.save(full, p.root / "c.ckpt"), p.train("export", f"--checkpoint={p.root / 'c.ckpt'}", f"--out={f}",
        "--overwrite=true"))
    yield "export into what is not there", None, "", lambda p: (torch.save(full, p.given / "c.ckpt"), p.train("export",
        f"--checkpoint={p.given / 'c.ckpt'}", f"--out={p.root / 'a/b/c.safetensors'}"))
    yield "inspect of a checkpoint with an odd header", None, "", lambda p: (torch.save({"phydict": 3},
        p.given / "c.ckpt"), p.train("inspect-prior", p.given / "c.ckpt"))


def preparations():
    """data/prepare_cts.py."""
    no = False
    yield "without lungs", no, "lungs", lambda p: p.prepare(p.ct().parent)
    yield "voxels 0", no, "voxels", lambda p: p.prepare(p.ct().parent, "--voxels=0")
    yield "voxels 10^6", no, "", lambda p: p.prepare(p.ct().parent, "--voxels=1000000")
    yield "side nan", no, "side", lambda p: p.prepare(p.ct().parent, "--side=nan")
    yield "side inf", no, "side", lambda p: p.prepare(p.ct().parent, "--side=inf")
    yield "window nan", no, "window", lambda p: p.prepare(p.ct().parent, "--window=[nan,nan]")
    yield "space mars", no, "space", lambda p: p.prepare(p.ct().parent, "--space=mars")
    yield "segmenter eye", no, "segmenter", lambda p: p.prepare(p.ct().parent, "--segmenter=eye")
    yield "workers 0", no, "workers", lambda p: p.prepare(p.ct().parent, "--workers=0")
    yield "atlas a CT", no, "atlas", lambda p: p.prepare(p.ct().parent, f"--atlas={p.ct()}")
    yield "atlas not there", no, "nowhere", lambda p: p.prepare(p.ct().parent, "--atlas=nowhere.nii.gz")
    yield "out in the CTs", no, "", lambda p: (c := p.ct().parent, p.prepare(c, out=c / "x"))
    yield "out is a file", no, "", lambda p: p.prepare(p.ct().parent, out=p.write("f", "x"))
    yield "an empty folder", no, "", lambda p: p.prepare(p.given)
    yield "a file that is no CT", no, "", lambda p: p.prepare(p.write("x.txt", "x"))
    yield "an option that is not there", no, "colour", lambda p: p.prepare(p.ct().parent, "--colour=red")
    yield "an abbreviated option", no, "", lambda p: p.prepare(p.ct().parent, "--work=2")

    def prepared(content):
        def work(p):
            p.write("prepared/a/case.json", content)
            shutil.copy(p.ct(), p.given / "prepared/a/ct.nii.gz")
            p.test(p.given / "prepared")
        return work

    record = {"id": "a", "space": "patient", "extent": [200, 200, 200], "window": [-1000, 1000], "report": "",
    "row": {}}
    yield "a case as it should be", None, "", prepared(json.dumps(record | {"extent": [384, 384, 384]}))
    yield "a case too small", no, "a ", prepared(json.dumps(record))
    yield "a case 10^5 deep", no, "case.json", prepared("[" * 10**5)
    yield "a case of nulls", no, "case.json", prepared(json.dumps(dict.fromkeys(record)))
    yield "a case with an extent of nan", no, "", prepared(json.dumps(record | {"extent": [float("nan")] * 3}))
    yield "a case with an extent of texts", no, "case.json", prepared(json.dumps(record | {"extent": ["a", "b", "c"]}))
    yield "a case whose row is a list", no, "", prepared(json.dumps(record | {"row": [1]}))
    yield "a case whose id leads elsewhere", None, "", prepared(json.dumps(record | {"id": "../../x",
        "extent": [384] * 3}))
    yield "a case of 17 MB", no, "case.json", prepared(json.dumps(record | {"report": "x" * 2**25}))
    yield "a case in UTF-16", no, "case.json", prepared(json.dumps(record).encode("utf-16"))


def names():
    """Names of cases."""
    for name in ("a b", "a$x$b", "$\\frac$", "$", "a_{", "[/b]", "[red]", "a|b", "a,b", "a;b", 'a"b', "a'b", "a\nb",
        "a\tb", "a\rb", "é", "🫁", "-rf", "--help", "%s", "{0}", "{x",
                 "a" * 200, "a" * 255, "con", "a.", " ", "\u202eabc", "\u200b", "..a", "a\\", "=1+1", "~", "*", "?",
                 "<b>", "&amp;", "\x1b[31mred", "sirt", "volume.nii.gz", "reconstruction.json"):
        yield f"X-rays {name[:12]!r}", True if len(name) < 200 else None, "", lambda p, name=name: p.predict(p.case(
            name))
    yield "X-rays no UTF-8", True, "", lambda p: p.predict(p.case(os.fsdecode(b"caf\xe9")))
    for name in ("a$x$b", "$\\frac$", "[/b]", "a|b", "a,b", 'a"b', "a\nb", "🫁", "a" * 200, "=1+1", "\u202eabc",
        os.fsdecode(b"caf\xe9")):
        yield f"CT {name[:12]!r}", True if len(name) < 200 else None, "", lambda p, name=name: p.test(p.ct(
            f"{name}.nii.gz"))
        yield f"CT {name[:12]!r} in an ablation", True if len(name) < 200 else None, "", lambda p, name=name: p.ablate(
            {"phantoms": ..., "cts": str(p.ct(f"{name}.nii.gz").parent)})
    yield "page of '$x$y'", True, "", lambda p: p.dry(p.case("$\\x$y"))
    yield "page of no UTF-8", True, "", lambda p: p.dry(p.case(os.fsdecode(b"caf\xe9")))
    yield "two cases that differ in capitals", True, "", lambda p: (p.case("A"), p.case("a"), p.predict(p.given))


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
    yield "a method None", no, "method", reconstruct(y, BEAM, method=None)
    yield "a seed of 1.5", no, "seed", reconstruct(y, BEAM, seed=1.5)
    yield "a seed None", no, "seed", reconstruct(y, BEAM, seed=None)
    yield "a seed of numpy", None, "seed", reconstruct(y, BEAM, seed=np.int64(3))
    yield "a report of bytes", no, "report", reconstruct(y, BEAM, report=b"x")
    yield "a grid None", no, "", reconstruct(y, BEAM, grid=None)
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
            ("write_beam to nowhere", write_beam, ("no/where/g.yaml", BEAM), {}), ("write_beam of another ending",
            write_beam, ("g.json", BEAM), {}), ("write_beam of a mapping", write_beam, ("g.yaml", ORBIT), {}),
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


def interruptions():
    """Runs that are stopped, share a folder or lack room: nothing finished is lost, and the next run goes on."""
    code = "import sys; from phydict.cli.infer import main; main(sys.argv[1:])"

    def command(p, *more, cases=3) -> list[str]:
        for k in range(cases):
            p.case(f"case{k}")
        p.started()
        return [sys.executable, "-c", code, "predict", *SIRT[:2], "--model.method.init_args.iterations=400",
                "--model.cube.voxels=32", "--trainer.accelerator=cpu", f"--data.xrays={p.given}",
                f"--model.out={p.out}", *more]

    def start(args, **settings) -> subprocess.Popen:
        return subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                                env=os.environ | {
                                "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}, **settings)

    def finished(p) -> dict[str, bytes]:
        return {str(f): f.read_bytes() for f in (p.out / "sirt").glob("case*/*")}

    def whole(p, cases=3) -> None:
        for k in range(cases):
            names = {f.name for f in (p.out / "sirt" / f"case{k}").iterdir()}
            assert names == {"volume.nii.gz", "panel.png", "reconstruction.json", *CASE_FILES}, names
            load_ct(p.out / "sirt" / f"case{k}" / "volume.nii.gz")

    def goes_on(p, args, before) -> None:
        """The same command again ends well, keeps what was finished, and leaves nothing behind."""
        done = start(args)
        _out, err = done.communicate(timeout=1000)
        assert done.returncode == 0, err
        after = finished(p)
        assert all(after[name] == content for name, content in before.items()), "a finished case was changed"
        whole(p)

    def stopped(number, delay):
        def work(p):
            args = command(p)
            run = start(args)
            place = p.out / "sirt"
            while run.poll() is None and not (place.is_dir() and any(place.iterdir())):
                time.sleep(0.01)
            time.sleep(delay)
            run.send_signal(number)
            _out, err = run.communicate(timeout=1000)
            assert "Traceback" not in err, err
            assert run.returncode in (0, -number, 130, 143), (run.returncode, err)
            goes_on(p, args, {k: v for k, v in finished(p).items()})
        return work

    for number, name in ((signal.SIGKILL, "kill -9"), (signal.SIGINT, "SIGINT"), (signal.SIGTERM, "SIGTERM")):
        for delay in (0.0, 0.15, 0.6):
            yield f"{name} {delay} s after the first file", True, "", stopped(number, delay)

    def overwriting(p):
        args = command(p)
        goes_on(p, args, {})
        before = finished(p)
        run = start([*args, "--model.overwrite=true"])
        while run.poll() is None and not list((p.out / "sirt").glob(".case*")):
            time.sleep(0.01)
        run.kill()
        run.communicate()
        goes_on(p, args, {})
        assert finished(p).keys() == before.keys()

    yield "kill -9 while a case is overwritten", True, "", overwriting

    def small(p):
        args = command(p)
        run = start(args, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)))
        _out, err = run.communicate(timeout=1000)
        assert run.returncode == 2 and "Traceback" not in err and "could not be written" in err, (run.returncode, err)
        assert not [f for f in (p.out / "sirt").iterdir() if f.name != ".lock"], "something half-written is left"
        goes_on(p, args, {})

    yield "files of 20 kB at most", True, "", small

    def full(p):
        p.out.mkdir()
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(p.out)],
            capture_output=True).returncode:
            return
        try:
            run = start(command(p))
            _out, err = run.communicate(timeout=1000)
            assert run.returncode == 2 and "Traceback" not in err and "free some space" in err, (run.returncode, err)
            left = [f.name for f in (p.out / "sirt").iterdir()]
            assert not [name for name in left if name.startswith(".")], left
        finally:
            subprocess.run(["umount", str(p.out)])

    yield "a full disk", True, "", full

    def together(*more):
        def work(p):
            args = command(p)
            runs = [start([*args, *(extra for extra in (more if k else ()))]) for k in range(2)]
            told = [(run.communicate(timeout=1000)[1], run.returncode) for run in runs]
            assert all("Traceback" not in err for err, _ in told), told
            whole(p)
            if not more:
                assert [code for _, code in told] == [0, 0], told
            else:
                seeds = {json.loads((p.out / "sirt" / f"case{k}" / "reconstruction.json").read_text())[
                "seed"] for k in range(3)}
                assert [code for _, code in told] != [0, 0] or len(seeds) == 1, (told, seeds)
        return work

    yield "two runs into one folder", True, "", together()
    yield "two runs of other seeds into one folder", True, "", together("--model.seed=1")

    def nobody(p):
        args = command(p)
        for folder in (p.given, *p.given.rglob("*")):
            os.chmod(folder, 0o755 if folder.is_dir() else 0o644)
        os.chmod(p.root, 0o755), os.chmod(p.root.parent, 0o755)
        p.out.mkdir()
        try:
            run = start(args, user=65534, group=65534, extra_groups=[])
        except PermissionError:  # where that user may not run Python either, or nobody else can be run as
            return
        _out, err = run.communicate(timeout=1000)
        assert "Traceback" not in err and run.returncode == 2, (run.returncode, err)

    yield "as a user who may not write there", True, "", nobody
    yield "output closed", True, "", lambda p: (run := start([
        "sh", "-c", 'exec "$0" "$@" >&-', *command(p)]), told := run.communicate(timeout=1000), _must(
            run.returncode == 0 and "Traceback" not in told[1], told))
    yield "no UTF-8 console", True, "", lambda p: (p.case("käse"), run := subprocess.Popen(
        command(p), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {
            "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}), told := run.communicate(timeout=1000), _must(
                run.returncode == 0 and "Traceback" not in told[1], told))
    yield "a folder that is gone", False, "", lambda p: (args := command(p), gone := p.root / "gone", gone.mkdir(),
        run := start(
        ["sh", "-c", 'cd "$0" && rmdir "$0" && exec "$@"', str(gone), *args]), told := run.communicate(timeout=1000),
        _must(
            "Traceback" not in told[1] and run.returncode in (0, 2), (run.returncode, told)), sys.stderr.write(
                "error: as it should be"), sys.exit(2))


def _must(holds: bool, told: object) -> None:
    if not holds:
        raise AssertionError(told)
