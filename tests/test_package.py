"""What is installed: the package with all that it needs beside its modules, from a checkout and from a wheel."""

import os
import subprocess
import sys
import sysconfig
import tomllib
import venv
from importlib import import_module
from pathlib import Path

import pytest
from prior.tiny import tiny_prior
from setuptools.dist import Distribution

import phydict
from phydict.cli import infer, train
from phydict.prior import DEFAULT_PRIOR, fingerprint, load_prior, save_prior
from phydict.runtime.shipped import own_or_shipped, shipped

ROOT = Path(__file__).parents[1]
SHIPPED = sorted(
    file.relative_to(ROOT) for pattern in ("data/prior/*.safetensors", "data/spectra/*.csv", "configs/*/*.yaml",
                                           "data/example/xrays/*") for file in ROOT.glob(pattern))


@pytest.fixture
def distribution(monkeypatch):
    """The project as its build sees it."""
    monkeypatch.chdir(ROOT)
    project = Distribution()
    project.parse_config_files(["pyproject.toml"])
    return project


def test_a_wheel_holds_every_package_and_every_file_that_is_looked_for(distribution):
    build = distribution.get_command_obj("build_py")
    build.ensure_finalized()
    held = {Path(package.replace(".", "/")) / file for package, _, _, files in build.data_files for file in files}
    assert {Path("phydict") / file for file in SHIPPED} <= held and Path("phydict/py.typed") in held
    folders = {file.parent.relative_to(ROOT) for file in (ROOT / "phydict").rglob("*.py")}
    assert folders <= {Path(package.replace(".", "/")) for package in distribution.packages}
    distribution.script_name = "setup.py"
    data = build.find_package_modules("phydict.data", build.get_package_dir("phydict.data"))
    assert "prepare_cts" in {module for _, module, _ in data}  # data/README.md runs it with -m


def test_the_version_is_the_same_everywhere(distribution):
    assert distribution.metadata.version == phydict.__version__
    assert "version" in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dynamic"]


@pytest.mark.parametrize("command, file, main", [
    ("phydict-train", "train.py", train.main), ("phydict-infer", "infer.py", infer.main)])
def test_a_command_is_what_its_script_in_the_checkout_runs(command, file, main):
    module, name = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"][command].split(":")
    assert getattr(import_module(module), name) is main
    assert f"from {module} import {name}" in (ROOT / file).read_text()


@pytest.mark.parametrize("name", SHIPPED, ids=str)
def test_what_is_shipped_is_found_from_anywhere(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert own_or_shipped(name) == shipped(name) and shipped(name).read_bytes() == (ROOT / name).read_bytes()
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).touch()
    assert own_or_shipped(name) == name  # what is there comes first


@pytest.mark.parametrize("name", ["data/../phydict/grid.py", "phydict/grid.py", "data/none.csv", "../data/prior", "."])
def test_nothing_else_is_found_elsewhere(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert own_or_shipped(name) == Path(name)


def test_the_default_prior_is_the_shipped_one_unless_the_folder_has_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "data/prior/phydict_64.safetensors"
    assert fingerprint(name) == fingerprint(DEFAULT_PRIOR) and load_prior(name).grid.same_as(load_prior().grid)
    assert load_prior(name).unheard == load_prior().unheard != ""
    (tmp_path / name).parent.mkdir(parents=True)
    save_prior(tiny_prior(), name)
    assert fingerprint(name) != fingerprint(DEFAULT_PRIOR) and not load_prior(name).grid.same_as(load_prior().grid)


SCRIPT = """if True:
    import torch
    import phydict
    from phydict.runtime.shipped import PACKAGE
    from phydict.xray import Grid, Polychromatic, Projector

    assert PACKAGE.parent.name == "site-packages" and phydict.__version__
    prior = phydict.load_prior()
    beam = phydict.ConeBeam.orbit(views=2, source_to_detector=1020, source_to_isocentre=740, shape=(56, 56), pixel=10)
    mu = torch.zeros(1, 1, *prior.grid.shape)
    mu[..., 20:44, 20:44, :] = 0.02
    xrays = Polychromatic()(Projector(prior.grid, beam, full_detector=True), mu)
    result = phydict.reconstruct(xrays[0], beam)
    print("misfit", result.misfit)"""


@pytest.mark.slow
def test_a_wheel_from_the_source_archive_works_in_an_empty_folder(tmp_path):
    """Installed without dependencies into an environment of its own, which sees this one's packages."""
    dist, folder, environment = tmp_path / "dist", tmp_path / "empty", tmp_path / "environment"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*command, cwd=folder):
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True, cwd=cwd, env=clean)
        assert done.returncode == 0, done.stderr
        return done.stdout

    folder.mkdir()
    dist.mkdir()
    run(sys.executable, "-c", f"import setuptools.build_meta as b; b.build_sdist({str(dist)!r})", cwd=ROOT)
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", dist, *dist.glob("*.tar.gz"))
    venv.create(environment, with_pip=False)
    python = environment / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "outer.pth").write_text(sysconfig.get_path("purelib") + "\n")
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", *dist.glob("*.whl"))

    assert 0 < float(run(python, "-c", SCRIPT).split()[-1]) < 0.2
    infer, train = environment / "bin" / "phydict-infer", environment / "bin" / "phydict-train"
    assert "predict" in run(infer, "--help") and "fit" in run(train, "--help")
    run(infer, "predict", "--model.method", "sirt", "--model.method.init_args.iterations", 2, "--data.xrays",
        "data/example/xrays")
    assert (folder / "runs/reconstructions/sirt/xrays/volume.nii.gz").is_file()
    missing = subprocess.run([infer, "predict", "-c", "quick"], capture_output=True, text=True, cwd=folder, env=clean)
    assert missing.returncode == 2 and "phydict_fast" in missing.stderr
