"""X-ray2CTPA for K views: sampling ends where its noise says, views in any order, one seed one volume."""

import pytest
import torch
from safetensors.torch import save_file
from scenes import WINDOW, block

from phydict.grid import Cube, Grid
from phydict.methods import reconstruct
from phydict.prior import save_stage
from phydict.rivals import Rival, RivalAnswer, XrayToCTPANetwork
from phydict.rivals.rival import WATER_MM, bound_orbit
from phydict.rivals.slice_unet import StackAttention, waves
from phydict.training.rivals import OrbitScenes
from phydict.training.xray2ctpa import LatentSettings, XrayToCTPATraining
from phydict.units import MU_WATER, HUWindow
from phydict.xray import Projector
from rivals.tiny_rivals import GRID, lively, tiny_xray2ctpa

BEAM = bound_orbit(GRID, 2)


def water(beam=BEAM) -> torch.Tensor:
    return Projector(GRID, beam, full_detector=True)(block() + 1) * 0.8


def task(**latent) -> XrayToCTPATraining:
    return XrayToCTPATraining(lively(lambda: XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4)), OrbitScenes(views=2),
                              Cube(16), (-1000, 600), latent=LatentSettings(**latent))


@pytest.fixture
def autoencoder(tmp_path) -> str:
    """A file of an autoencoder's weights."""
    save_file(task().prior.network.autoencoder.state_dict(), tmp_path / "autoencoder.safetensors")
    return str(tmp_path / "autoencoder.safetensors")


@torch.no_grad()
def test_sampling_ends_at_the_latent_whose_velocity_is_found(monkeypatch):
    network, y = tiny_xray2ctpa().network, water() / WATER_MM
    geometry = network.geometry(GRID, BEAM, y)
    wanted = torch.rand(1, *geometry[1].shape, generator=torch.Generator().manual_seed(0)) - 0.5

    def knows(x, t, condition):
        signal, sigma = network.schedule.scales(t)
        return (signal * x - wanted) / sigma

    monkeypatch.setattr(network.denoiser, "forward", knows)
    found = network.reconstruct(y, geometry, torch.Generator().manual_seed(1))
    torch.testing.assert_close(found, network.decoded(wanted), atol=1e-4, rtol=0)


def test_the_seed_decides_the_volume_and_the_xrays_condition_it():
    method, y = RivalAnswer(tiny_xray2ctpa(), precision="float32"), water()[0] * MU_WATER
    one, again, other = (reconstruct(y, BEAM, method=method, grid=GRID, seed=seed).volume for seed in (1, 1, 2))
    assert torch.equal(one, again) and not torch.allclose(one, other, atol=1)
    flipped = reconstruct(y.flip(2), BEAM, method=method, grid=GRID, seed=1).volume
    assert not torch.allclose(one, flipped, atol=1e-3, rtol=0)


@torch.no_grad()
def test_views_in_another_order_give_the_same_ct():
    rival = tiny_xray2ctpa()
    one, other = (rival.reconstruct(y, beam, torch.Generator().manual_seed(0)) for y, beam in (
        (water(), BEAM), (water()[:, [1, 0]], BEAM.select([1, 0]))))
    torch.testing.assert_close(one, other, atol=1e-4, rtol=0)


def test_the_code_of_a_slice_is_its_own_in_the_networks_precision():
    attend, codes = StackAttention(8), []
    attend.enter.register_forward_pre_hook(lambda _, given: codes.append(given[0].detach()))
    with torch.autocast("cpu", torch.bfloat16):
        attend(torch.zeros(1, 8, 1, 1, 256, dtype=torch.bfloat16))
    torch.testing.assert_close(codes[0][0].float(), waves(torch.arange(256.0), 8), atol=0.01, rtol=0)


def test_each_part_learns_in_its_own_time(autoencoder):
    first, then = task(autoencoder_steps=1), task(autoencoder_steps=0, autoencoder=autoencoder)
    for training, learnt in ((first, "autoencoder"), (then, "denoiser"), (then, "encoder")):
        training.zero_grad()
        training.case_loss(block(), water(), BEAM, torch.Generator().manual_seed(0)).backward()
        moved = {name.split(".")[2] for name, weight in training.named_parameters() if weight.grad is not None}
        assert learnt in moved and ("autoencoder" in moved) == (training is first)
    assert first.prior.network.latent_size > 0 and then.prior.network.latent_size > 0


def test_the_size_of_latents_is_that_of_the_largest_of_the_first_cases(autoencoder):
    training = task(autoencoder_steps=0, autoencoder=autoencoder)
    network, sizes = training.prior.network, []
    for ct in (-torch.ones(block().shape), block(), -torch.ones(block().shape)):
        training.case_loss(ct, water(), BEAM, torch.Generator().manual_seed(0))
        sizes.append(float(network.latent_size))
    with torch.no_grad():
        assert sizes[0] < sizes[1] == sizes[2] == pytest.approx(float(network.latent(block()).abs().max()), rel=1e-5)


@pytest.mark.parametrize("steps", [0, 1])
def test_the_size_of_latents_is_that_of_the_cases_of_all_processes(monkeypatch, autoencoder, steps):
    """Each sees one of three cases: all have the size of one process that sees them in turn, and its loss."""
    latent = {"autoencoder_steps": steps} | ({} if steps else {"autoencoder": autoencoder})
    cases, one, alone, given = [0.5 * block(), block(), 0.9 * block()], task(**latent), task(**latent), []
    monkeypatch.setattr(alone, "_everywhere", lambda size: given.append(size) or size[None])

    def loss(training: XrayToCTPATraining, case: torch.Tensor) -> torch.Tensor:
        return training.case_loss(case, water(), BEAM, torch.Generator().manual_seed(0)).detach()

    losses = [loss(one, case) for case in cases]
    for case in cases:
        loss(alone, case)
    for rank, case in enumerate(cases):
        shared = task(**latent)
        monkeypatch.setattr(XrayToCTPATraining, "global_rank", rank)
        monkeypatch.setattr(shared, "_everywhere", lambda size: torch.stack(given))
        assert torch.equal(loss(shared, case), losses[rank])
        assert shared.network.latent_size == one.network.latent_size


def test_a_trained_diffusion_keeps_the_size_of_its_latents_and_is_validated_from_its_file(tmp_path):
    save_stage(tiny_xray2ctpa(), file := str(tmp_path / "rival.safetensors"))
    scenes, window = OrbitScenes(views=2), (WINDOW.low, WINDOW.high)
    went_on = XrayToCTPATraining(scenes=scenes, cube=Cube(16), window=window, latent=LatentSettings(0), initial=file)
    went_on.case_loss(block(), water(), BEAM, torch.Generator().manual_seed(0))
    assert float(went_on.prior.network.latent_size) == 1.0
    logged = []
    went_on.log = lambda name, *_, **__: logged.append(name)
    went_on.log_case = lambda index, name, *_, **__: logged.append(name)
    went_on.validation_number = lambda index: index
    went_on.validation_step({"volume": block()}, 0)
    assert "val/psnr" in logged


def test_a_rival_that_knows_xrays_goes_on_with_the_latents_that_it_knows(tmp_path):
    first, file = tiny_xray2ctpa(), str(tmp_path / "rival.safetensors")
    for knows in (True, False):
        first.network.denoiser.leave.weight.data *= knows
        save_stage(first, file)
        went_on = XrayToCTPATraining(scenes=OrbitScenes(views=2), cube=Cube(16), window=(WINDOW.low, WINDOW.high),
                                     initial=file)
        assert went_on.learns_slices != knows


def test_what_has_learnt_nothing_of_xrays_or_of_slices_is_refused(tmp_path):
    network = XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4)
    method = RivalAnswer(Rival(network, GRID, HUWindow(), BEAM))
    with pytest.raises(ValueError, match="has learnt its autoencoder alone"):
        reconstruct(water()[0] * MU_WATER, BEAM, method=method, grid=GRID)
    with pytest.raises(ValueError, match="no autoencoder that has learnt was given"):
        task(autoencoder_steps=0)


def test_ones_own_weights_are_taken_and_others_are_refused(tmp_path, autoencoder):
    own, file = task(), autoencoder
    other = XrayToCTPANetwork((4, 4), 8, (4, 8), (4, 8), 4)
    settings = {"scenes": OrbitScenes(views=2), "cube": Cube(16), "window": (-1000, 600)}
    taken = XrayToCTPATraining(other, latent=LatentSettings(0, autoencoder=file), **settings)
    for name, weight in own.prior.network.autoencoder.state_dict().items():
        assert torch.equal(weight, taken.prior.network.autoencoder.state_dict()[name])
    with pytest.raises(ValueError, match="does not hold the weights of this XrayEmbedding") as refused:
        XrayToCTPATraining(other, latent=LatentSettings(encoder=file), **settings)
    assert len(str(refused.value)) < 500 and "such as blocks.0" in str(refused.value)
    assert "give another model.latent.encoder, or the network's settings" in str(refused.value)
    with pytest.raises(ValueError, match=r"model\.initial brings all of its weights"):
        XrayToCTPATraining(other, latent=LatentSettings(encoder=file), initial=file, **settings)
    with pytest.raises(ValueError, match=r"nowhere\.safetensors"):
        XrayToCTPATraining(other, latent=LatentSettings(encoder=str(tmp_path / "nowhere.safetensors")), **settings)


def test_what_it_is_not_for_is_refused():
    method, beam = RivalAnswer(tiny_xray2ctpa()), bound_orbit(GRID, 3)
    with pytest.raises(ValueError, match="trained for 2 X-rays, but 3 were given"):
        reconstruct(water(beam)[0] * MU_WATER, beam, method=method, grid=GRID)
    with pytest.raises(ValueError, match="divisible by 4"):
        tiny_xray2ctpa(Grid.cube(18))
    with pytest.raises(ValueError, match="multiples of 4"):
        XrayToCTPANetwork(channels=(6, 8))
    with pytest.raises(ValueError, match=r"model\.latent"):
        LatentSettings(slices=0)
