"""On a CUDA device everything gives what it gives on the CPU: projectors, reconstructions, losses, metrics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from laws import assert_adjoint, assert_gradient_is_adjoint, random_like
from prior.tiny import REPORTS, tiny_prior, tiny_refiner
from rivals.tiny_rivals import lively, tiny_xray2ctpa
from torch import Tensor
from torch.utils.data import default_collate

from phydict.datasets import phantom_case
from phydict.evaluation import body_weights, volume_metrics
from phydict.evaluation.published import PUBLISHED
from phydict.evaluation.sharpness import sharpness_scores
from phydict.grid import Cube, Grid
from phydict.methods import METHODS, onto_grid, reconstruct
from phydict.posterior import Posterior, Sampler
from phydict.prior import VolumeUNet, save_prior, save_stage
from phydict.reconstruction import Reconstructor
from phydict.rivals import LiftedNetwork, X2CTNetwork, XrayToCTPANetwork
from phydict.training import PriorTraining
from phydict.training.refiner import RefinerTraining
from phydict.training.rivals import LiftedTraining, OrbitScenes
from phydict.training.scenes import Scenes
from phydict.training.settings import TextSettings
from phydict.training.stage import StageTraining
from phydict.training.x2ct import Adversary, X2CTTraining
from phydict.training.xray2ctpa import LatentSettings, XrayToCTPATraining
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Ideal, Polychromatic, Projector
from phydict.xray.binning import benchmark_orbit

DEVICE = "cuda"

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.filterwarnings("default")]  # what a device's own libraries warn of is no fault

GRID = Grid((20, 18, 16), (16.0, 18.0, 20.0))
ORBIT = ConeBeam.orbit(3, 1020, 740, (14, 18), (31.0, 27.0), start=0.3)
UPRIGHT = {"orbit": ORBIT, "half fan": ORBIT.shifted(columns=150.0)}
BEAMS = UPRIGHT | {"tilted": ORBIT.tilted(20.0)}
KINDS = [(kind, beam) for beam in BEAMS for kind in ("auto", "separable", "siddon", "eq4", "joseph", "matrix")
         if kind != "separable" or beam in UPRIGHT]


def projector(kind: str, beam: str, memory: int = 2**29) -> Projector:
    return Projector(GRID, BEAMS[beam], kind, memory, DEVICE, full_detector=True)


def there(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """A function of tensors on the device as one of the CPU's."""
    def carried(x: Tensor) -> Tensor:
        answer = function(x.to(DEVICE))
        assert answer.device.type == DEVICE
        return answer.cpu()
    return carried


def assert_like(found: Tensor, expected: Tensor, tolerance: float) -> None:
    """Relative difference of norms."""
    assert expected.norm() > 0 and (found - expected).norm() <= tolerance * expected.norm()


@pytest.mark.parametrize("kind, beam", KINDS)
def test_projections_and_back_projections_are_the_cpus(kind, beam):
    A = projector(kind, beam)
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float64, 1e-12)):
        mu = random_like((2, 1, *GRID.shape), dtype).abs()
        y = random_like((2, ORBIT.views, *ORBIT.shape), dtype)
        assert_like(there(A)(mu), A(mu), tolerance)
        assert_like(there(A.T)(y), A.T(y), tolerance)


@pytest.mark.parametrize("kind, beam", KINDS)
def test_the_adjoint_is_exact_and_is_the_gradient(kind, beam):
    A, volume = projector(kind, beam), (2, 1, *GRID.shape)
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float64, 1e-11)):
        assert_adjoint(there(A), there(A.T), volume, dtype, tolerance)
        assert_gradient_is_adjoint(there(A), there(A.T), volume, dtype, tolerance)
        assert_gradient_is_adjoint(there(A.T), there(A), (2, ORBIT.views, *ORBIT.shape), dtype, tolerance)


def test_a_plane_sweep_in_small_parts_is_the_whole_one():
    whole, parts = projector("joseph", "tilted"), projector("joseph", "tilted", memory=20_000)
    mu, y = random_like((2, 1, *GRID.shape)), random_like((2, ORBIT.views, *ORBIT.shape))
    assert_like(there(parts)(mu), there(whole)(mu), 1e-12)
    assert_like(there(parts.T)(y), there(whole.T)(y), 1e-12)


def test_blocks_of_columns_do_not_show(monkeypatch):
    monkeypatch.setattr("phydict.xray.projectors.separable_sparse.BLOCK_VALUES", 2000)
    A = Projector(GRID, ORBIT.shifted(columns=20.0), "separable", device=DEVICE, full_detector=True)
    mu, y = random_like((2, 1, *GRID.shape)), random_like((2, ORBIT.views, *ORBIT.shape))
    assert_like(there(A)(mu), A(mu), 1e-12)
    assert_like(there(A.T)(y), A.T(y), 1e-12)


@pytest.mark.parametrize("kind", ["separable", "siddon", "eq4", "joseph", "matrix"])
def test_a_projection_in_a_training_of_mixed_precision_is_in_single_precision(kind):
    A = projector(kind, "orbit")
    mu, y = random_like((1, 1, *GRID.shape), torch.float32), random_like((1, 3, *ORBIT.shape), torch.float32)
    with torch.autocast(DEVICE, torch.bfloat16):
        image, back = there(A)(mu), there(A.T)(y)
    assert image.dtype == back.dtype == torch.float32
    assert_like(image, A(mu), 1e-5)
    assert_like(back, A.T(y), 1e-5)


@pytest.mark.parametrize("simulate", [Ideal(), Polychromatic()], ids=["ideal", "polychromatic"])
def test_simulated_xrays_are_the_cpus(simulate):
    mu = HUWindow().to_mu(phantom_case(5, Grid.cube(16), HUWindow())["volume"])[None]
    A = Projector(Grid.cube(16), ORBIT, device=DEVICE, full_detector=True)
    assert_like(there(lambda x: simulate(A, x, 3))(mu), simulate(A, mu, 3), 1e-4)


CHEST = Grid.cube(64)


@pytest.fixture(scope="module")
def scene() -> tuple[Tensor, Tensor, ConeBeam]:
    """HU of a phantom (X, Y, Z), its four X-rays, and their geometry."""
    case, beam = phantom_case(3, CHEST, HUWindow()), benchmark_orbit(CHEST, 4).binned(4)
    mu = HUWindow().to_mu(case["volume"])[None]
    return HUWindow().to_hu(case["volume"])[0], Projector(CHEST, beam, full_detector=True)(mu)[0], beam


@pytest.mark.parametrize("name, voxels, hu", [
    ("phydict_fast", 64, 2.0), ("phydict_learned", 64, 2.0), ("tv", 32, 1.0), ("cgls", 32, 2.0), ("fdk", 64, 0.1)])
def test_a_reconstruction_is_the_cpus(scene, name, voxels, hu):
    """Root mean square of the difference in HU. Shipped networks follow the X-rays to their device."""
    truth, y, beam = scene
    grid = None if voxels == 64 else Grid.cube(voxels)
    here, far = (reconstruct(y.to(device), beam, method=name, grid=grid, precision="float32")
                 for device in ("cpu", DEVICE))
    assert far.volume.device.type == "cpu"
    assert (far.volume - here.volume).square().mean().sqrt() < hu
    assert far.misfit == pytest.approx(here.misfit, rel=0.05, abs=1e-4)
    assert far.intervals.keys() == here.intervals.keys()
    for level, width in here.intervals.items():
        assert_like(far.intervals[level], width, 0.02)
    if voxels == 64:
        scores = [volume_metrics(found.volume[None, None], truth[None, None])["psnr"] for found in (here, far)]
        assert scores[1] == pytest.approx(scores[0], abs=0.1)


def test_networks_in_bfloat16_reconstruct_as_well_as_in_single_precision(scene):
    truth, y, beam = scene
    scores = [volume_metrics(reconstruct(y.to(DEVICE), beam, method="phydict_learned", precision=precision)
                             .volume[None, None], truth[None, None])["psnr"] for precision in ("float32", "bfloat16")]
    assert scores[1] == pytest.approx(scores[0], abs=0.3)


SMALL, FINER = Grid.cube(16), Grid.cube(32)
WINDOW = HUWindow(-1000, 600)
CASE = phantom_case(3, SMALL, WINDOW)
SCENES = [(name, "line integrals") for name in ("dds", "daps", "dps", "diffvox")] + [
    (name, scene) for name in ("phydict_fast", "phydict_learned")
    for scene in ("line integrals", "display values", "a tube", "finer voxels")] + [
    ("phydict_fast", "samples"), ("phydict_fast", "report"), ("phydict_learned", "report")]


def untrained(name: str, scene: str, device: str) -> Reconstructor:
    """A method with a tiny prior in float64."""
    chosen = METHODS[name]
    if not isinstance(chosen, Sampler):
        return chosen
    prior = tiny_refiner(uncertain=True, begins=scene == "report") if chosen.needs_refiner else tiny_prior(detail=True)
    method = Posterior(prior.double().to(device), chosen, precision="float32", samples=2 if scene == "samples" else 1)
    return onto_grid(method, FINER if scene == "finer voxels" else None)


@pytest.mark.parametrize("name, scene", SCENES)
def test_a_method_gives_the_cpus_volume_in_double_precision(name, scene):
    views, simulate = (8, Polychromatic(scatter=0.3)) if scene == "a tube" else (3, Ideal())
    beam = ConeBeam.orbit(views, 1020, 740, (28, 28), 20.0)
    y = simulate(Projector(SMALL, beam, full_detector=True), WINDOW.to_mu(CASE["volume"]).double()[None], 4)[0]
    y = y + 0.01 * random_like(y.shape)
    y, display = (0.3 * y + 0.1, True) if scene == "display values" else (y, False)
    report, grid = REPORTS[0] if scene == "report" else "", FINER if scene == "finer voxels" else SMALL
    here, far = (untrained(name, scene, device).reconstruct(
        y.to(device), Projector(grid, beam, device=device, full_detector=True), report, display, seed=7)
        for device in ("cpu", DEVICE))
    assert far.volume.shape == grid.shape and not far.volume.is_cuda
    assert (far.volume - here.volume).square().mean().sqrt() < (5.0 if name == "diffvox" else 0.05)
    assert far.scatter == pytest.approx(here.scatter, abs=1e-4) and far.hardened == here.hardened
    assert scene != "a tube" or here.scatter or here.hardened
    for level, width in here.intervals.items():
        assert_like(far.intervals[level], width, 1e-3)
    if scene == "samples":
        assert_like(far.deviation, here.deviation, 1e-3)


def prior_training(folder: Path) -> StageTraining:
    network = VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 16)
    return PriorTraining(network, TextSettings(reports=REPORTS, dropout=0.0), cube=Cube(16), window=(-1000, 600))


def refiner_training(folder: Path, scenes: Scenes = Scenes()) -> StageTraining:
    return RefinerTraining(scenes=scenes, cube=Cube(16), window=(-1000, 600), initial=str(folder / "prior.safetensors"))


def xray2ctpa_training(folder: Path, latent: LatentSettings, initial: str | None = None) -> StageTraining:
    return XrayToCTPATraining(lively(lambda: XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4)), OrbitScenes(views=2),
                              Cube(16), (-1000, 600), latent=latent, initial=initial)


TRAININGS: dict[str, Callable[[Path], StageTraining]] = {
    "prior": prior_training,
    "refiner": refiner_training,
    "refiner of scenes with every fault": lambda folder: refiner_training(folder, Scenes(
        4, 0.0, 0.0, 1.0, model_error=1.0, misplaced=1.0, scatter=1.0, counting=1.0, tilted=1.0)),
    "lifted": lambda folder: LiftedTraining(
        lively(lambda: LiftedNetwork((4, 6), 2, 4, (4, 6, 8))), cube=Cube(16), window=(-1000, 600)),
    "x2ct": lambda folder: X2CTTraining(
        lively(lambda: X2CTNetwork(8, 4, (2, 2), (4, 8, 8))), OrbitScenes(views=2), Cube(16), (-1000, 600),
        adversary=Adversary(width=4)),
    "xray2ctpa's slices": lambda folder: xray2ctpa_training(folder, LatentSettings()),
    "xray2ctpa's diffusion": lambda folder: xray2ctpa_training(
        folder, LatentSettings(autoencoder_steps=0), str(folder / "xray2ctpa.safetensors"))}


@pytest.fixture(scope="module")
def stages(tmp_path_factory) -> Path:
    """A folder of stages to train on."""
    folder = tmp_path_factory.mktemp("stages")
    save_prior(tiny_prior(detail=True), folder / "prior.safetensors", dtype=torch.float32)
    save_stage(tiny_xray2ctpa(), folder / "xray2ctpa.safetensors", dtype=torch.float32)
    return folder


def step(training: StageTraining, device: str, mixed: bool = False) -> float:
    """The loss of one batch on a device, after checking it and its gradients."""
    batch = {key: value.to(device) if isinstance(value, Tensor) else value
             for key, value in default_collate([CASE]).items()}
    training = training.to(device)
    with torch.autocast(device, torch.bfloat16, enabled=mixed):
        loss = training.batch_loss(batch, (1,))
    loss.backward()
    gradients = [weight.grad for weight in training.parameters() if weight.grad is not None]
    assert loss.device.type == device and loss.isfinite()
    assert any(gradient.any() for gradient in gradients)
    assert all(gradient.device.type == device and gradient.isfinite().all() for gradient in gradients)
    return float(loss.detach())


@pytest.mark.parametrize("name", TRAININGS)
def test_a_training_step_has_the_cpus_loss_and_finite_gradients(name, stages):
    here, far, mixed = (step(TRAININGS[name](stages), device, mixed)
                        for device, mixed in (("cpu", False), (DEVICE, False), (DEVICE, True)))
    if name not in ("prior", "x2ct"):  # whose noise or dropout is drawn on the device
        assert far == pytest.approx(here, rel=0.01, abs=0.01)
        assert mixed == pytest.approx(here, rel=0.1, abs=0.1)


def test_metrics_of_volumes_there_are_those_of_volumes_here(scene):
    truth = scene[0]
    found = (truth + 60 * random_like(truth.shape, truth.dtype)).clamp(-1000, 1000)
    spacing, lung = CHEST.spacing, phantom_case(3, CHEST, HUWindow())["masks"][0]

    def scores(volume: Tensor, true: Tensor, inside: Tensor) -> dict[str, float]:
        body = body_weights(true[None, None], spacing)
        told = volume_metrics(volume[None, None], true[None, None], inside[None, None], body)
        told |= {name: score(volume, true, HUWindow()) for name, score in PUBLISHED.items()}
        return told | sharpness_scores(volume, true, inside, CHEST)

    here, far = (scores(*(x.to(device) for x in (found, truth, lung))) for device in ("cpu", DEVICE))
    assert far == pytest.approx(here, rel=1e-4)
