"""The scripted tries of robustness.py: what strangers and attackers may give, group by group."""

from __future__ import annotations

import gzip
import json
import os
import struct
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import nibabel
import numpy as np
import torch
import yaml
from dicom_files import orbit_tags, write_dicom
from PIL import Image
from prior.tiny import tiny_prior
from robustness import Try, state
from safetensors.torch import save_file

import phydict
from phydict import ConeBeam, Grid, HUWindow
from phydict.cli.infer import main as infer
from phydict.cli.train import main as train
from phydict.datasets import phantom_case, save_xrays

ROOT = Path(__file__).parents[2]
ORBIT = {"views": 3, "source_to_detector": 1020.0, "source_to_isocentre": 740.0, "shape": [24, 24],
         "pixel": [24.0, 24.0]}
BEAM = ConeBeam.orbit(**ORBIT)
PICKLE = b"cos\nsystem\n(S'touch pwned'\ntR."
"""Runs a command where it is unpickled."""

SIRT = ["-c", "sirt", "--model.method.init_args.iterations=2", "--model.grid.voxels=16", "--trainer.accelerator=cpu"]


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
    return prior.describe() | {"training": {}}, {k: w.half().contiguous() for k, w in prior.state_dict().items()}


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
        self.infer(command, "-c", "sirt", "-c", file, "--model.method.init_args.iterations=2", "--model.grid.voxels=16",
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
    # The others take their places from here.
    from ct_tries import cts, preparations, series, tables
    from geometry_tries import geometries, geometry_files
    from image_tries import dicoms, images, nifti_images, reports
    from interruption_tries import interruptions
    from prior_tries import priors, trainings
    from python_tries import python_api
    from setting_tries import ablations, configurations, names, outputs
    from stranger_tries import GROUPS

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
    yield "voxels nan", no, "voxels", lambda p: p.predict(p.case(), "--model.grid.voxels=nan")
    yield "voxels -4", no, "", lambda p: p.predict(p.case(), "--model.grid.voxels=-4")
    yield "voxels 1", no, "48 mm", lambda p: p.predict(p.case(), "--model.grid.voxels=1")
    yield "voxels 3", no, "48 mm", lambda p: p.predict(p.case(), "--model.grid.voxels=3")
    yield "side of 1 mm", None, "", lambda p: p.predict(p.case(), "--model.grid={voxels: 4, side: 1}")
    yield "side inf", no, "", lambda p: p.predict(p.case(), "--model.grid.side=inf")
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
    yield "only is a folder", no, "give another only", lambda p: p.test(p.ct().parent, f"--data.only={p.given}")
    yield "only is empty", no, "names no case", lambda p: p.test(
        p.ct().parent, f"--data.only={p.write('ids', '')}")
    yield "only names another", no, "names zz", lambda p: p.test(
        p.ct().parent, f"--data.only={p.write('ids', 'zz')}")
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
