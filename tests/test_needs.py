"""Only what a scene needs: what each preset imports, makes and differentiates, and nothing beyond."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fitting import fit_to_grid
from floors import LIGHTNING, ROOT, files, module_of, part
from posterior.scene import BEAM, views
from prior.tiny import REPORTS, tiny_for, tiny_prior

from phydict import METHODS, ConeBeam, Grid, reconstruct
from phydict.methods import reconstructor
from phydict.posterior import DPS, GradientSteps, Posterior, Reward, Sampler
from phydict.prior import save_prior
from phydict.runtime.profiling import CPU, CUDA, peak_memory, process_peak, profiled, reset_peak_memory, stage
from phydict.xray import Projector

SCENES = """
import json, sys, warnings
import phydict
bare, shape = sorted({name.partition(".")[0] for name in sys.modules}), phydict.load_prior().grid.shape
from dataclasses import replace
from importlib import import_module
import torch
from phydict.posterior import GradientSteps, Reward
warnings.simplefilter("ignore")
made, begin = set(), torch.nn.Module.__init__
torch.nn.Module.__init__ = lambda self, *a, **k: made.add(type(self).__name__) or begin(self, *a, **k)
beam = phydict.ConeBeam.orbit(3, 1020, 740, (32, 32), 17.5)
xrays = torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(0))
networks = {}
for name, report in json.loads(sys.argv[2]):
    method = phydict.METHODS[name]
    if name == "phydict_paper":
        method = replace(method, likelihood=GradientSteps(reward=Reward(lpips=0.0)))
    few = {key: 2 for key in ("iterations", "ec_steps") if hasattr(method, key)}
    made.clear()
    phydict.reconstruct(xrays, beam, sys.argv[1], replace(method, **few), report=report, grid=phydict.Grid.cube(16))
    networks[f"{name} {report}".strip()] = sorted(made)
modules = sorted(sys.modules)
for name in json.loads(sys.argv[3]):
    import_module(name)
print(json.dumps({"bare": bare, "shape": shape, "modules": modules, "networks": networks,
                  "below": sorted(sys.modules)}))
"""

NEVER = ("lightning", "pytorch_lightning", "tensorboard", "lungmask", "itk", "ignite", "phydict.training",
         "phydict.cli", "phydict.inference")
"""Of use to training, to tables and to other files, and to no reconstruction in memory. MONAI is not among them,
nor are transformers and lpips: the networks are MONAI's, which imports all of itself and those two with it."""
HEAVY = {"monai", "lightning", "pytorch_lightning", "transformers", "lpips", "torchvision", "matplotlib",
         "torchmetrics", "numba", "nibabel", "huggingface_hub"}
"""What a bare import brings none of."""

PRESETS = ("sirt", "fdk", "phydict_fast", "phydict_paper", "phydict_released")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict:
    """Modules imported, and networks made by each preset, in a process of its own that imports the package, loads a
    prior, reconstructs with them in turn, with a report last of all, and imports all that is below the top floor."""
    file = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(tiny_prior(), file)
    runs = [*((name, "") for name in PRESETS), ("phydict_fast", REPORTS[0])]
    below = [module_of(file) for file in files() if part(file) not in LIGHTNING]
    assert "phydict.methods" in below and "phydict.xray.projectors.siddon" in below
    done = subprocess.run([sys.executable, "-c", SCENES, str(file), json.dumps(runs), json.dumps(below)],
                          capture_output=True, text=True, cwd=ROOT,
                          env={"PYTHONPATH": str(ROOT), "PATH": "", "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_bare_import_brings_nothing_heavy_and_everything_below_the_top_floor_runs_without_lightning(scenes):
    assert "torch" in scenes["bare"] and not HEAVY & set(scenes["bare"])
    assert scenes["shape"] == [64, 64, 64]
    below = {name.partition(".")[0] for name in scenes["below"]}
    assert "monai" in below and not {"lightning", "pytorch_lightning"} & below


def test_no_reconstruction_imports_training_or_lightning(scenes):
    assert set(NEVER) & set(scenes["modules"]) == set()


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_makes_the_networks_that_it_uses_alone(scenes, name):
    networks = set(scenes["networks"][name])
    assert ("LPIPS" in networks) == (name == "phydict_released")  # LPIPS at weight 0 is not made for phydict_paper
    assert ("Prior" in networks) == isinstance(METHODS[name], Sampler)
    assert not {"TextEncoder", "BertModel", "SuperResolution", "LocalUNet"} & networks


def test_a_report_loads_the_text_encoder_and_nothing_else(scenes):
    without, told = (set(scenes["networks"][name]) for name in ("phydict_fast", f"phydict_fast {REPORTS[0]}"))
    assert {"TextEncoder", "BertModel"} <= told - without and not {"SuperResolution", "LPIPS"} & told


class Watched:
    """A prior whose denoiser notes whether gradients are recorded."""

    def __init__(self, prior):
        self.prior, self.grid, self.window, self.state_channels = prior, prior.grid, prior.window, prior.state_channels
        self.recorded: set[bool] = set()

    def bind(self, *settings):
        bound = self.prior.bind(*settings)
        self.schedule = bound.schedule

        class Denoiser:
            schedule = bound.schedule

            @staticmethod
            def denoise(x, t):
                x0 = bound.denoise(x, t)
                self.recorded.add(torch.is_grad_enabled() or x0.requires_grad)
                return x0

        return Denoiser()


def reduced(method: Sampler) -> Sampler:
    few = {"iterations": 2, "ec_steps": 2, "levels": 2, "burn_in": 1, "thinning": 1}
    method = replace(method, **{key: value for key, value in few.items() if hasattr(method, key)})
    if hasattr(method, "likelihood") and isinstance(method.likelihood, GradientSteps):
        method = replace(method, likelihood=GradientSteps(reward=Reward()), final_likelihood=None)
    return method


@pytest.mark.parametrize("name", [name for name, method in METHODS.items()
                                  if isinstance(method, Sampler) and not method.needs_refiner])
def test_gradients_are_recorded_inside_the_likelihood_step_alone(name, monkeypatch):
    sampler, prior, projected = reduced(METHODS[name]), Watched(tiny_prior()), []
    through = Projector.__call__
    monkeypatch.setattr(Projector, "__call__", lambda self, mu: projected.append(mu.requires_grad) or through(self, mu))
    result = reconstruct(views(), BEAM, prior, sampler)
    # of the one method that differentiates the denoiser itself; a look at what it answers never does
    assert prior.recorded == ({True, False} if isinstance(sampler, DPS) else {False})
    by_gradients = isinstance(sampler, DPS) or isinstance(getattr(sampler, "likelihood", None), GradientSteps)
    assert any(projected) == by_gradients
    assert not result.volume.requires_grad and not result.reprojection.requires_grad


def test_the_detector_is_binned_to_the_grid_unless_a_method_wants_every_pixel():
    beam = ConeBeam.orbit(2, 1020, 740, (448, 448), 1.25)
    for name, method in METHODS.items():
        ready = reconstructor(method, tiny_for(method))
        xrays, projector = fit_to_grid(ready, Grid.cube(16), torch.zeros(2, 448, 448), beam)
        full = isinstance(ready, Posterior) and ready.sampler.full_detector
        assert (xrays.shape[-1] == 448) == full == (projector.beam.shape == (448, 448)), name


def test_without_a_profile_nothing_is_measured_and_with_one_stages_nest():
    with stage("outside"):
        pass
    with profiled() as profile:
        for _ in range(3):
            with stage("outer"), stage("inner"):
                kept = torch.zeros(10_000_000)
        del kept
    with stage("after"):
        pass
    assert list(profile.uses) == ["outer", "outer / inner"]
    outer, inner = profile.uses.values()
    assert outer.calls == inner.calls == 3 and outer.seconds >= inner.seconds > 0
    assert outer.peak_mib >= inner.peak_mib > 0


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_all_memory_is_in_mib(monkeypatch):
    with profiled() as profile, stage("held"):
        kept = torch.ones(2**26)
    resident = int(re.search(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024
    assert profile.uses["held"].peak_mib == pytest.approx(resident, rel=0.02) and len(kept)
    assert peak_memory(CPU) == pytest.approx(resident, rel=0.02)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 3 * 2**20)
    assert peak_memory(CUDA) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_a_profile_sets_no_peak_of_the_whole_process_back():
    reset_peak_memory(CPU)
    torch.ones(2**26).sum()  # 256 MiB
    before = process_peak()
    with profiled(), stage("small"):
        pass
    assert peak_memory(CPU) < before - 200 and process_peak() >= before


def test_a_profile_holds_the_calls_that_a_reconstruction_reports_and_its_table_every_stage():
    with profiled() as profile:
        result = reconstruct(views(), BEAM, tiny_prior(), replace(METHODS["phydict_fast"], iterations=3))
    assert profile.uses["sample / network"].calls == result.network_calls == 3
    projector = {name: use.calls for name, use in profile.uses.items() if name.endswith(" / projector")}
    asking = projector.pop("fit to grid / projector")  # on coarse voxels, whether the patient continues
    assert asking > 0 and sum(projector.values()) == result.projector_calls
    for name, seconds in result.seconds.items():
        assert profile.uses[name].seconds <= seconds
    lines = profile.table().splitlines()
    assert len(lines) == 1 + len(profile.uses) and "peak MiB" in lines[0]


def test_profiling_changes_nothing_in_the_result():
    plain = reconstruct(views(), BEAM, tiny_prior(), METHODS["phydict_fast"])
    with profiled():
        assert torch.equal(reconstruct(views(), BEAM, tiny_prior(), METHODS["phydict_fast"]).volume, plain.volume)
