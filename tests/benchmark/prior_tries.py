"""Tries of robustness.py: files of priors, and trainings."""

from __future__ import annotations

import json
import struct

import numpy as np
import torch
from prior.tiny import tiny_super_resolution
from tries import PICKLE, ROOT, tiny

from phydict.prior import save_stage


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
    yield "grid far away", *header(None, "", grid=grid | {
        "affine": [[24, 0, 0, 1e8], [0, 24, 0, 0], [0, 0, 24, 0], [0, 0, 0, 1]]})
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
    yield "a second stage of another size", no, "", lambda p: (save_stage(
        tiny_super_resolution(48, 2), p.given / "f.safetensors"), p.sampled(p.prior(),
        f"--model.super_resolution.file={p.given / 'f.safetensors'}"))
    yield "a second stage as it should be", True, "", lambda p: (save_stage(
        tiny_super_resolution(32, 2), p.given / "f.safetensors"), p.sampled(p.prior(),
        f"--model.super_resolution.file={p.given / 'f.safetensors'}"))


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
