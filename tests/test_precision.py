"""What networks compute in is decided by the hardware, in one place, and told."""

import json
import os
import subprocess
import sys
import warnings

import pytest
import torch
from posterior.scene import PROJECTOR, views
from prior.tiny import tiny_prior
from rivals.tiny_rivals import tiny_lifted

from phydict.baselines import SIRT
from phydict.diffusion import CosineSchedule
from phydict.posterior import DDS, Posterior, PriorOnly, SplitGibbs
from phydict.prior import PriorContract
from phydict.rivals import RivalAnswer
from phydict.runtime import precision
from phydict.runtime.precision import (
    bfloat16_gain,
    computes_bfloat16,
    gains_by_bfloat16,
    instruction_set,
    network_precision,
    precision_name,
    resolve_precision,
)

CPU = torch.device("cpu")
AVX2 = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"}
X86 = pytest.mark.skipif(not torch.cpu._is_avx2_supported(), reason="these variables limit x86 processors")


@pytest.fixture(autouse=True)
def said_anew():
    precision._warn_slow.cache_clear()
    precision._warn_gpu.cache_clear()


@pytest.fixture
def hardware(monkeypatch):
    """Makes the CPU one that computes bfloat16, so many times faster than float32, or not."""
    def able(gain: float) -> None:
        monkeypatch.setattr(precision, "computes_bfloat16", lambda device: gain > 0)
        monkeypatch.setattr(precision, "bfloat16_gain", lambda device: gain)
    return able


@pytest.mark.parametrize("asked, gain, state, chosen", [
    ("auto", 2, torch.float32, torch.bfloat16), ("auto", 0, torch.float32, torch.float32),
    ("auto", 0.5, torch.float32, torch.float32), ("auto", 2, torch.float64, torch.float64),
    ("float32", 2, torch.float32, torch.float32), ("float32", 2, torch.float64, torch.float64),
    ("bfloat16", 2, torch.float64, torch.bfloat16), ("bfloat16", 0.5, torch.float32, torch.bfloat16)])
def test_the_hardware_and_its_speed_decide_unless_someone_asks(hardware, asked, gain, state, chosen):
    hardware(gain)
    assert resolve_precision(asked, CPU, state) == chosen
    with network_precision(asked, torch.zeros(1, dtype=state)) as used:
        assert used == chosen
        product = torch.zeros(2, 2, dtype=state) @ torch.zeros(2, 2, dtype=state)
        assert product.dtype == (torch.bfloat16 if chosen == torch.bfloat16 and state != torch.float64 else state)


def test_slow_bfloat16_runs_and_warns_once_with_the_factor(hardware, monkeypatch):
    hardware(0)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    with pytest.warns(RuntimeWarning, match="AVX2 does not compute it.*about 200 times slower"):
        assert resolve_precision("bfloat16", CPU) == torch.bfloat16
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve_precision("bfloat16", CPU) == torch.bfloat16


def test_bfloat16_that_is_slower_than_float32_warns_with_the_factor(hardware):
    hardware(0.4)
    with pytest.warns(RuntimeWarning, match=r"computes it 2\.5 times slower than float32"):
        assert resolve_precision("bfloat16", CPU) == torch.bfloat16


@pytest.mark.skipif(not computes_bfloat16(CPU), reason="this processor does not compute bfloat16")
def test_the_gain_is_measured_once_so_that_a_process_keeps_to_a_precision(monkeypatch):
    gain = bfloat16_gain(CPU)
    assert 0.05 < gain < 50
    monkeypatch.setattr(precision, "time", None)
    assert bfloat16_gain(CPU) == gain


def test_a_gpu_without_bfloat16_computes_in_float32_and_is_named_once(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: including_emulation)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "an old GPU")
    gpu = torch.device("cuda")
    with pytest.warns(RuntimeWarning, match="an old GPU does not compute bfloat16: networks run in float32"):
        assert resolve_precision("auto", gpu) == torch.float32
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve_precision("auto", gpu) == torch.float32
    assert instruction_set(gpu) == "an old GPU"


def test_other_devices_compute_in_float32():
    assert resolve_precision("auto", torch.device("mps")) == torch.float32


@pytest.mark.parametrize("given", ["half", "", None, True])
def test_another_precision_is_refused_in_a_sentence(given):
    for refused in (lambda: resolve_precision(given, CPU), lambda: Posterior(tiny_prior(), precision=given)):
        with pytest.raises(ValueError, match="precision is auto, float32 or bfloat16, but .* was given"):
            refused()


@X86
def test_a_cpu_limited_to_avx2_decides_for_float32():
    code = ("import json, torch; from phydict.runtime.precision import *; cpu = torch.device('cpu');"
            "x = torch.zeros(1);"
            "print(json.dumps([torch.backends.cpu.get_cpu_capability(), torch.ops.mkldnn._is_mkldnn_bf16_supported(),"
            "precision_name('auto', x), instruction_set(cpu)]))")
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | AVX2, stdout=subprocess.PIPE, text=True,
                          check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == ["AVX2", False, "float32", "AVX2"]


def test_a_processor_with_bfloat16_is_named_so():
    said = instruction_set(CPU)
    assert said.startswith(torch.backends.cpu.get_cpu_capability())
    assert said.endswith(("with bfloat16", "with AMX")) == computes_bfloat16(CPU)
    assert precision_name("auto", torch.zeros(1)) == ("bfloat16" if gains_by_bfloat16(CPU) else "float32")


@pytest.mark.parametrize("asked", ["float32", "bfloat16"])
def test_a_reconstruction_names_what_it_was_computed_in_and_differs_with_it(asked):
    method = Posterior(tiny_prior(), PriorOnly(2), precision=asked)
    found = method.reconstruct(views(), PROJECTOR, seed=1)
    assert found.precision == asked
    difference = found.volume - Posterior(tiny_prior().double(), PriorOnly(2)).reconstruct(
        views().double(), PROJECTOR, seed=1).volume
    assert (difference.abs().max() > 0.1) == (asked == "bfloat16")


def test_methods_without_a_network_name_the_precision_of_the_xrays():
    for kind in ("float32", "float64"):
        found = SIRT(iterations=1).reconstruct(views().to(getattr(torch, kind)), PROJECTOR)
        assert found.precision == str(found.volume.dtype).removeprefix("torch.") == kind


def test_a_rival_says_what_its_network_computed_in_whatever_the_type_of_the_x_rays():
    double, single = (RivalAnswer(tiny_lifted()).reconstruct(y, PROJECTOR) for y in (views().double(), views()))
    torch.testing.assert_close(double.volume.float(), single.volume, atol=0.01, rtol=0)  # HU; single precision
    assert double.precision == single.precision


class InHalf(PriorContract, torch.nn.Module):
    """A prior of one's own whose weights and answers are in half precision."""

    grid, window = PROJECTOR.grid, tiny_prior(False).window
    schedule = CosineSchedule()

    def __init__(self, kind: torch.dtype):
        super().__init__()
        self.share = torch.nn.Parameter(torch.tensor(0.25, dtype=kind))

    def bind(self, report, guidance, precision):
        return self

    def denoise(self, x, t):
        return self.share * x.to(self.share)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("sampler", [SplitGibbs(3), DDS(3), PriorOnly(2)])
def test_a_prior_of_ones_own_in_half_precision_leaves_x_rays_and_volume_in_single(kind, sampler):
    half, single = (Posterior(InHalf(of), sampler).reconstruct(views(), PROJECTOR) for of in (kind, torch.float32))
    assert torch.equal(half.xrays, views()) and half.volume.dtype == torch.float32
    torch.testing.assert_close(half.volume, single.volume, atol=20, rtol=0)
