"""Tries of robustness.py on machines and shells as strangers have them, and of Python."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import torch
from prior.tiny import tiny_prior
from stranger_files import (
    NO,
    dicoms_of_strangers,
    geometry_by_hand,
    pictures_of_attackers,
    priors_of_strangers,
    volumes_of_strangers,
)
from tries import BEAM, ROOT, SIRT, xrays

import phydict
from phydict import Grid
from phydict.datasets import phantom_case


def surroundings():
    """What a shell, a cluster or a container leaves in the environment."""
    code = "import sys; from phydict.cli.infer import main; main(sys.argv[1:])"

    def with_(good, **variables):
        def work(p):
            folder = p.case()
            p.started()
            run = subprocess.run(
                [sys.executable, "-c", code, "predict", *SIRT, f"--data.xrays={folder}", f"--model.out={p.out}"],
                env={**os.environ, "PYTHONPATH": str(ROOT), **variables}, capture_output=True, text=True, timeout=1500)
            sys.stderr.write(run.stderr)
            if run.returncode:
                sys.exit(run.returncode)
            assert (p.out / "sirt/case/volume.nii.gz").is_file()
        return good, "", work

    yield "of a cluster's job of four tasks", *with_(None, SLURM_NTASKS="4", SLURM_JOB_ID="1", SLURM_PROCID="0",
        SLURM_LOCALID="0", SLURM_NODEID="0", SLURM_JOB_NAME="bash", SLURM_JOB_NUM_NODES="1")
    yield "of a torchrun that is over", *with_(None, WORLD_SIZE="2", RANK="0", LOCAL_RANK="0", MASTER_ADDR="localhost",
        MASTER_PORT="29555", TORCHELASTIC_RUN_ID="x", GROUP_RANK="0", LOCAL_WORLD_SIZE="2")
    yield "a seed in words", *with_(None, PL_GLOBAL_SEED="often")
    yield "no folder for temporary files and no home", *with_(True, TMPDIR="/nowhere", HOME="/nowhere")
    yield "a console of one column", *with_(True, COLUMNS="1", LINES="1", TERM="dumb")
    yield "a picture engine that is not there", *with_(None, MPLBACKEND="nonsense", MPLCONFIGDIR="/proc")
    yield "caches that cannot be written", *with_(True, NUMBA_CACHE_DIR="/proc/x", XDG_CACHE_HOME="/proc/x",
        TORCHINDUCTOR_CACHE_DIR="/proc/x")
    yield "threads in words", *with_(None, OMP_NUM_THREADS="many", MKL_NUM_THREADS="-1")
    yield "the locale C", *with_(True, LC_ALL="C", LANG="C", PYTHONUTF8="0")


def new_options():
    """Options that came last."""
    yield "a projector that is not there", NO, "projector", lambda p: p.predict(p.case(), "--model.projector=magic")
    yield "a projector that is a number", NO, "projector", lambda p: p.predict(p.case(), "--model.projector=3")
    yield "a projector null", NO, "projector", lambda p: p.predict(p.case(), "--model.projector=null")
    for kind in ("separable", "siddon", "eq4", "joseph", "matrix"):
        yield f"projector {kind}", None, "", lambda p, kind=kind: p.predict(p.case(), f"--model.projector={kind}")
    yield "a matrix of 10 views of 300 x 300 pixels", None, "", lambda p: p.test(
        "phantom", "--data.phantoms=1", "--model.projector=matrix", "--data.orbit.detector=[300,300]",
        "--data.orbit.pixel=[1.5,1.5]", "--data.orbit.views=10")
    for changes in ("views", "=3", "views=", "views=[", "views=[1", "views=&a [*a]", "views={a: 1}", "a..b=1",
                    "method=os.system", "method=builtins.eval", "method=phydict.prior.Prior", "method=nowhere.Method",
                    "method=phydict.posterior.Sampler", "method=.", "projector=magic", "projector=[auto,magic]",
                    "out=x", "seed=[[1]]", "views=" + "[" * 500, "views=" + "9" * 500, "=", "views=[]", "views=\0",
                    "method=[sirt,sirt]", "voxels=[16,17]", "detector=[24,0]"):
        yield f"ablate --set {changes[:30]!r}", None if changes.startswith("method=[sirt") else NO, "", \
            lambda p, changes=changes: p.ablate({}, "--set", changes)
    yield "ablate --set of nothing", NO, "set", lambda p: p.ablate({}, "--set")
    yield "ablate --set of a method that shouts when it is imported", NO, "", lambda p: (
        p.write("shout.py", "raise SystemExit('mine')"), sys.path.insert(0, str(p.given)),
        _without(p.given, lambda: p.ablate({}, "--set", "method=shout.Method")))
    yield "ablate --set of a module with a fault", NO, "", lambda p: (
        p.write("faulty.py", "1 / 0"), sys.path.insert(0, str(p.given)),
        _without(p.given, lambda: p.ablate({}, "--set", "method=faulty.Method")))
    yield "trainer.fast_dev_run", None, "", lambda p: p.predict(p.case(), "--trainer.fast_dev_run=true")
    yield "trainer.logger true", None, "", lambda p: p.predict(p.case(), "--trainer.logger=true")
    yield "trainer.limit_predict_batches 1 of 2", NO, "not reconstructed", lambda p: (p.case("a"), p.case("b"),
        p.predict(p.given, "--trainer.limit_predict_batches=1"))
    yield "trainer.default_root_dir /proc", None, "", lambda p: p.predict(p.case(), "--trainer.default_root_dir=/proc")
    yield "trainer.profiler simple", None, "", lambda p: p.predict(p.case(), "--trainer.profiler=simple")
    yield "trainer.inference_mode true", None, "", lambda p: p.predict(p.case(), "--trainer.inference_mode=true")


def _without(folder: Path, work) -> None:
    """Runs `work`, and takes `folder` from where modules are looked for, and its modules from those that are known."""
    try:
        work()
    finally:
        sys.path.remove(str(folder))
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)
        for name in ("shout", "faulty"):
            sys.modules.pop(name, None)


def places():
    """Links and devices where results go."""
    yield "a case's place is a link to the X-rays", NO, "", lambda p: (c := p.case(), (p.out / "sirt").mkdir(
        parents=True), (p.out / "sirt/case").symlink_to(c), p.predict(c, "--model.overwrite=true"))

    def linked(p):
        c = p.case()
        p.predict(c)
        (p.out / "sirt/case").rename(p.given / "kept")
        (p.out / "sirt/case").symlink_to(p.given / "kept")
        p.predict(c, "--model.overwrite=true")

    yield "a finished case is a link to one elsewhere", None, "", linked
    yield "the lock is a folder", None, "", lambda p: ((p.out / "sirt/.lock").mkdir(parents=True), p.predict(p.case()))
    yield "the lock is a link to a view", None, "", lambda p: (c := p.case(), (p.out / "sirt").mkdir(parents=True),
        (p.out / "sirt/.lock").symlink_to(c / "view_0.npy"), p.predict(c))
    yield "the lock is a pipe", None, "", lambda p: (c := p.case(), (p.out / "sirt").mkdir(parents=True), os.mkfifo(
        p.out / "sirt/.lock"), p.predict(c))
    yield "the method's folder is a link to the X-rays", NO, "model.out", lambda p: (c := p.case(), p.out.mkdir(),
        (p.out / "sirt").symlink_to(c), p.predict(c))
    yield "a page's place is a link to a view", None, "", lambda p: (c := p.case(), (p.out / "dry_run").mkdir(
        parents=True), (p.out / "dry_run/case.png").symlink_to(c / "view_0.npy"), p.dry(c))
    yield "the table's place is a link to a CT", NO, "", lambda p: (c := p.ct(), (p.out / "sirt").mkdir(parents=True),
        (p.out / "sirt/results.csv").symlink_to(c), p.test(c))
    yield "the output is a tilde", None, "", lambda p: p.predict(p.case(), out="~")
    yield "the output is -", None, "", lambda p: p.predict(p.case(), out="-")
    yield "the output is .", None, "", lambda p: p.predict(p.case(), out=".")
    yield "the output is the folder around both", NO, "model.out", lambda p: p.predict(p.case("sirt"), out=p.given)
    yield "a volume that is a hard link to a view", None, "", lambda p: (c := p.case(), p.predict(c), (
        v := p.out / "sirt/case/volume.nii.gz").unlink(), os.link(c / "view_0.npy", v), p.predict(
            c, "--model.overwrite=true"))
    yield "a case that may not be written", None, "", lambda p: (c := p.case(), p.predict(c), os.chmod(
        p.out / "sirt/case", 0o500), p.predict(c, "--model.overwrite=true"))


def python_of_strangers():
    """Calls from Python that a newcomer types."""
    y = xrays()
    sirt = phydict.METHODS["sirt"].__class__(iterations=2)

    def reconstruct(*args, **named):
        return lambda p: p.call(phydict.reconstruct, *args, **{"method": sirt, "grid": Grid.cube(16)} | named)

    done = partial(phydict.reconstruct, y, BEAM, method=sirt, grid=Grid.cube(16))
    yield "a projector that is not there", NO, "projector", reconstruct(y, BEAM, projector="magic")
    yield "a projector None", None, "TypeError", reconstruct(y, BEAM, projector=None)
    yield "X-rays and beam the other way round", None, "TypeError", reconstruct(BEAM, y)
    yield "X-rays of two of three views", NO, "view", reconstruct(y[:2], BEAM)
    yield "X-rays turned", NO, "", reconstruct(y[:, :, :20], BEAM)
    yield "one NaN", NO, "", reconstruct(torch.where(torch.arange(24) == 3, torch.nan, y), BEAM)
    yield "a path for X-rays", NO, "", reconstruct(ROOT / "data/example/xrays", BEAM)
    yield "a path for the beam", NO, "ConeBeam", reconstruct(y, "geometry.yaml")
    yield "a prior for a method without", None, "", reconstruct(y, BEAM, prior=tiny_prior())
    yield "a seed of true", NO, "seed", reconstruct(y, BEAM, seed=True)
    yield "a report of a list", NO, "report", reconstruct(y, BEAM, report=["a"])
    yield "guidance -5", None, "", reconstruct(y, BEAM, prior=tiny_prior(), method="prior_only", guidance=-5.0)
    yield "samples 0", NO, "samples", reconstruct(y, BEAM, prior=tiny_prior(), method="prior_only", samples=0)
    yield "a grid of one voxel", None, "", reconstruct(y, BEAM, grid=Grid.cube(1))
    yield "a prior that is nowhere", NO, "nowhere", reconstruct(y, BEAM, prior="nowhere", method="prior_only")
    yield "save to a folder", NO, "", lambda p: (r := done(), p.call(r.save_nifti, p.root))
    yield "save to nowhere", None, "", lambda p: (r := done(), p.call(r.save_nifti, p.root / "a/b/c.nii.gz"))
    yield "save as text", None, "", lambda p: (r := done(), p.call(r.save_nifti, p.root / "c.txt"))
    yield "phantom -1", NO, "seed", lambda p: p.call(phantom_case, -1, Grid.cube(16), phydict.HUWindow())
    yield "phantom 1.5", None, "TypeError", lambda p: p.call(phantom_case, 1.5, Grid.cube(16), phydict.HUWindow())
    yield "load_xrays of a list", None, "TypeError", lambda p: p.call(phydict.load_xrays, [p.case()])
    yield "load_xrays with a beam for a geometry", None, "TypeError", lambda p: p.call(
        phydict.load_xrays, p.case(), BEAM)
    yield "hu_to_mu of a list", None, "TypeError", lambda p: p.call(phydict.hu_to_mu, [0, 1])
    yield "case_seed of a number", None, "TypeError", lambda p: p.call(phydict.case_seed, 0, 3)


GROUPS = (new_options, pictures_of_attackers, geometry_by_hand, dicoms_of_strangers, volumes_of_strangers,
          places, priors_of_strangers, python_of_strangers, surroundings)
