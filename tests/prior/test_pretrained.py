"""Others' weights: what is read strictly is the network that was written, and what is not whole is refused."""

import json
import os
import pickle

import pytest
import torch
import yaml
from laws import random_like
from safetensors import safe_open

from phydict.cli.infer import InferenceCLI
from phydict.grid import Grid
from phydict.inference import ReconstructionData, ReconstructionTask
from phydict.inference.settings import Orbit
from phydict.prior import (
    MedSynCheckpoint,
    TextEncoder,
    file_read,
    fingerprint,
    inspect_prior,
    load_prior,
    load_super_resolution,
    save_prior,
)
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution
from phydict.units import HUWindow
from prior.medsyn_files import entries, super_resolution_unet, text_unet, write
from prior.tiny import tiny_prior

X = random_like((1, 4, 6, 4, 8), torch.float32, seed=1)
TIME = torch.tensor([0.4])
CONTEXT = random_like((1, 6, 16), torch.float32, seed=2)
FORMATS = ("model_1.safetensors", "pytorch_model_1.bin")


def estimate(network, condition=CONTEXT):
    return network(X, TIME, condition)


@pytest.fixture(scope="module")
def source():
    return text_unet()


@pytest.mark.parametrize("prefix", ["denoise_fn.", "module.denoise_fn.", ""])
@pytest.mark.parametrize("name", FORMATS)
def test_both_formats_and_prefixes_give_the_network_that_was_written(name, prefix, source, tmp_path):
    prior = load_prior(write(tmp_path / name, entries(source, prefix)))
    assert isinstance(prior, MedSynPrior) and torch.equal(estimate(prior.network), estimate(source))
    assert not prior.training and not any(weight.requires_grad for weight in prior.parameters())
    assert sum(w.numel() for w in prior.parameters()) == sum(w.numel() for w in source.parameters())


@pytest.mark.parametrize("name", FORMATS)
def test_the_second_stage_too(name, tmp_path):
    fine = super_resolution_unet()
    stage = load_super_resolution(write(tmp_path / name, entries(fine)))
    assert isinstance(stage, MedSynSuperResolution) and torch.equal(estimate(stage.network, X), estimate(fine, X))


@pytest.mark.parametrize("settings", [{"width": 16, "multipliers": (1, 2, 4), "heads": 2},
                                      {"tokens": 9, "context_dim": 24}])
def test_sizes_are_read_from_the_shapes(settings, tmp_path):
    network = text_unet(**settings)
    found = load_prior(write(tmp_path / FORMATS[0], entries(network))).network
    assert {k: v.shape for k, v in found.state_dict().items()} == {k: v.shape for k, v in network.state_dict().items()}


def test_safetensors_keep_one_name_of_the_shared_attention_and_any_one_will_do(source, tmp_path):
    whole = entries(source)
    tied = [name for name in whole if "spatial_attn" in name and "gamma" not in name]
    with safe_open(write(tmp_path / FORMATS[0], whole), "pt") as file:
        assert len(tied) == 8 and len([name for name in file.keys() if name in tied]) == 2
    for kept in "1234":
        part = {k: w for k, w in whole.items() if k not in tied or f"attn{kept}." in k}
        prior = load_prior(write(tmp_path / f"{kept}.bin", part))
        assert torch.equal(estimate(prior.network), estimate(source))


def test_old_buffers_are_ignored_and_half_precision_becomes_full(source, tmp_path):
    old = {"betas": torch.zeros(5), "alphas_cumprod_prev": torch.zeros(5), "ddim_alphas": torch.zeros(3),
           "sqrt_one_minus_alphas_cumprod": torch.zeros(5), "lpips.net.slice1.0.weight": torch.zeros(2, 2)}
    prior = load_prior(write(tmp_path / "old.bin", entries(source) | old))
    assert torch.equal(estimate(prior.network), estimate(source))
    half = {name: weight.half() for name, weight in entries(source).items()}
    prior = load_prior(write(tmp_path / "half.bin", half))
    assert all(weight.dtype == torch.float32 for weight in prior.parameters())
    assert (estimate(prior.network) - estimate(source)).std() < 0.01 * estimate(source).std()
    assert len({id(prior.network.get_submodule(f"mid_spatial_attn{n}").fn.fn.fn.to_qkv.weight) for n in (1, 4)}) == 1


@pytest.fixture(scope="module")
def results(tmp_path_factory, source):
    """A results folder of MedSyn's with two saved states, and the networks of the latest: online, averaged."""
    folder, online, averaged = tmp_path_factory.mktemp("model") / "results", text_unet(1), text_unet(2)
    write(folder / "9_ckpt" / FORMATS[0], entries(source))
    write(folder / "10_ckpt" / "model.safetensors", entries(online))
    write(folder / "10_ckpt" / FORMATS[0], entries(averaged))
    (folder / "10_ckpt" / "random_states_0.pkl").write_bytes(pickle.dumps(os.system))
    (folder / "best_ckpt").mkdir()
    return folder, online, averaged


def test_of_a_folder_the_latest_state_and_the_averaged_weights_are_read(results):
    folder, online, averaged = results
    for path in (folder, folder / "10_ckpt"):
        for which, network in (("auto", averaged), ("ema", averaged), ("online", online)):
            found = load_prior(MedSynCheckpoint(str(path), which)).network
            assert torch.equal(estimate(found), estimate(network))
        assert torch.equal(estimate(load_prior(path).network), estimate(averaged))


def test_of_the_second_stages_folder_the_online_weights_are_read_as_medsyns_inference_does(tmp_path):
    folder, online, averaged = tmp_path / "results" / "3_ckpt", super_resolution_unet(1), super_resolution_unet(2)
    for names in (("model.safetensors", FORMATS[0]), ("pytorch_model.bin", FORMATS[1])):
        for name, network in zip(names, (online, averaged)):
            write(folder / name, entries(network))
        for which, network in (("auto", online), ("online", online), ("ema", averaged)):
            found = load_super_resolution(MedSynCheckpoint(str(tmp_path / "results"), which)).network
            assert torch.equal(estimate(found, X), estimate(network, X))
        assert fingerprint(folder) == fingerprint(folder / names[0])
        assert file_read(folder) == file_read(tmp_path / "results") == f"3_ckpt/{names[0]} (online)"
        by_default = {file: told["by its name"] for file, told in inspect_prior(folder).items()}
        assert by_default == {str(folder / names[0]): "online, read by default", str(folder / names[1]): "ema"}
        (folder / names[0]).unlink()
        assert file_read(folder) == f"3_ckpt/{names[1]} (ema)"
        (folder / names[1]).unlink()


def test_a_folder_without_averaged_weights_gives_the_online_ones_unless_asked(source, tmp_path):
    write(tmp_path / "pytorch_model.bin", entries(source))
    assert torch.equal(estimate(load_prior(tmp_path).network), estimate(source))
    with pytest.raises(FileNotFoundError, match="model_1.safetensors or pytorch_model_1.bin, but .* pytorch_model.bin"):
        load_prior(MedSynCheckpoint(str(tmp_path), "ema"))


def test_the_order_of_the_way_up_is_a_switch(results):
    orders = [load_prior(MedSynCheckpoint(str(results[0]), upsample_first=order)).network for order in (False, True)]
    assert torch.equal(estimate(orders[0]), estimate(results[2]))
    assert not torch.allclose(estimate(orders[0]), estimate(orders[1]), rtol=0.01)


def test_the_language_model_is_found_above_and_read_with_medsyns_convention(results, monkeypatch):
    asked = {}

    def pretrained(source, length, **settings):
        asked.update(source=source, length=length, **settings)
        return lambda reports: CONTEXT.expand(len(reports), -1, -1)

    monkeypatch.setattr(TextEncoder, "pretrained", pretrained)
    with pytest.raises(FileNotFoundError, match="pretrained_lm"):
        load_prior(results[0]).context(["a report"])
    (results[0].parent / "pretrained_lm").mkdir()
    assert torch.equal(load_prior(results[0]).context(["a report"]), CONTEXT)
    assert asked == {"source": results[0].parent / "pretrained_lm", "length": 6, "padded_to": 2048}
    load_prior(MedSynCheckpoint(str(results[0]), text="elsewhere")).context(["a report"])
    assert str(asked["source"]) == "elsewhere"


def test_a_prior_is_known_again_by_its_weights(results, tmp_path):
    folder = results[0]
    assert fingerprint(folder) == fingerprint(str(folder / "10_ckpt" / FORMATS[0]))
    assert fingerprint(folder) != fingerprint(MedSynCheckpoint(str(folder), "online"))


class Code:
    def __reduce__(self):
        return os.system, ("touch executed",)


def changed(**changes):
    def make(file, source):
        whole = entries(source)
        for name, tensor in changes.items():
            whole.pop(name.replace("__", "."), None)
            if tensor is not None:
                whole[name.replace("__", ".")] = tensor
        write(file, whole)
    return make


BAD = {
    "truncated bin": ("a.bin", lambda file, source: file.write_bytes(
        write(file, entries(source)).read_bytes()[:5000]), ["truncated"]),
    "truncated safetensors": ("a.safetensors", lambda file, source: file.write_bytes(
        write(file, entries(source)).read_bytes()[:-100]), ["truncated"]),
    "empty": ("a.bin", lambda file, source: file.write_bytes(b""), ["truncated"]),
    "code beside weights": ("a.bin", lambda file, source: torch.save(entries(source) | {"code": Code()}, file),
                            ["asks for code (posix.system)", "refused"]),
    "pickle of code": ("a.pt", lambda file, source: file.write_bytes(pickle.dumps(Code())), ["code", "refused"]),
    "a web page": ("a.bin", lambda file, source: file.write_text("<html>not found</html>"), ["no file of weights"]),
    "one tensor": ("a.bin", lambda file, source: torch.save(torch.zeros(3), file), ["no dictionary of tensors"]),
    "an optimiser": ("optimizer.bin", lambda file, source: torch.save({"state": {}, "groups": [1]}, file),
                     ["no dictionary of tensors"]),
    "a training": ("a.ckpt", lambda file, source: torch.save({"phydict": {"format": 1}, "state_dict": {}}, file),
                   ["train.py export"]),
    "another network": ("a.bin", lambda file, source: torch.save({"conv.weight": torch.zeros(3)}, file),
                        ["none of MedSyn's networks", "conv.weight"]),
    "the other stage": ("a.bin", lambda file, source: write(file, entries(super_resolution_unet())),
                        ["is MedSyn's 256^3 super-resolution stage", "64^3 stage", "results_text_low_res"]),
    "a missing tensor": ("a.safetensors", changed(denoise_fn__downs__1__0__res_conv__bias=None),
                         ["1 missing (downs.1.0.res_conv.bias)"]),
    "no shared attention": ("a.bin", changed(**{
        f"denoise_fn__mid_spatial_attn{n}__fn__fn__fn__to_qkv__weight": None for n in "1234"}),
        ["4 missing (mid_spatial_attn1.fn.fn.fn.to_qkv.weight", "..."]),
    "an unexpected tensor": ("a.safetensors", changed(denoise_fn__extra=torch.zeros(2)), ["1 unexpected (extra)"]),
    "another shape": ("a.bin", changed(denoise_fn__init_conv__bias=torch.zeros(9)),
                      ["1 of another shape (init_conv.bias (9,) instead of (8,))"]),
    "a scalar": ("a.bin", changed(denoise_fn__downs__0__0__block1__proj__weight=torch.tensor(1.0)),
                 ["1 of another shape (downs.0.0.block1.proj.weight () instead of (8, 8, 1, 3, 3))"]),
    "too narrow": ("a.bin", changed(denoise_fn__init_conv__weight=torch.zeros(2, 4, 7, 7, 7)), ["2 channels"]),
    "untied attention": ("a.bin", changed(
        denoise_fn__mid_spatial_attn2__fn__fn__fn__to_qkv__weight=torch.zeros(96, 16)), ["share one to_qkv"]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_checkpoint_is_one_sentence_and_never_run(case, source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name, make, words = BAD[case]
    make(tmp_path / name, source)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ValueError) as error:
        load_prior(MedSynCheckpoint(str(tmp_path / name)))
    said = str(error.value)
    assert all(word in said for word in [*words, name]) and "\n" not in said, said
    assert sorted(tmp_path.iterdir()) == before
    report = inspect_prior(tmp_path / name)[str(tmp_path / name)]  # says the same, and raises nothing
    if case == "the other stage":
        assert "super-resolution" in report["kind"] and report["fits"] == "yes"
    elif case == "a training":
        assert "phydict training checkpoint" in report["kind"]
    else:
        assert report["kind"].startswith("unknown") or report["fits"].startswith("no"), report


@pytest.mark.parametrize("name", ["a.bin", "a.safetensors"])
def test_weights_that_are_not_finite_are_refused_by_name(name, source, tmp_path):
    bad = entries(source)["denoise_fn.init_conv.bias"].clone()
    bad[2] = float("nan")
    changed(denoise_fn__init_conv__bias=bad, denoise_fn__betas=torch.tensor([float("nan")]))(tmp_path / name, source)
    for read in (load_prior, inspect_prior):
        with pytest.raises(ValueError, match=rf"{name}' holds weights that are not finite .*init_conv.bias has 1 NaN"):
            read(tmp_path / name)


def test_a_network_of_more_levels_than_can_be_meant_is_refused_before_it_is_made(source, tmp_path):
    deep = entries(source) | {f"denoise_fn.downs.{level}.x": torch.zeros(1) for level in range(40)}
    with pytest.raises(ValueError, match="model.safetensors' is not MedSyn's: it has 40 levels, more than 16"):
        load_prior(write(tmp_path / "model.safetensors", deep))


def test_each_stage_refuses_the_other(source, tmp_path):
    with pytest.raises(ValueError, match="is MedSyn's 64.3 stage .*, but the 256.3 super-resolution .*results_SR_"):
        load_super_resolution(write(tmp_path / "one.bin", entries(source)))


@pytest.mark.parametrize("settings, error, words", [
    ({"which": "best"}, ValueError, "auto, ema or online, but 'best'"),
    ({"which": "ema", "path": "a.bin"}, ValueError, "is a file, which is read as it is"),
    ({"path": "nowhere"}, FileNotFoundError, "no prior at 'nowhere': .* there is none")])
def test_a_checkpoint_that_cannot_be_chosen_is_refused(settings, error, words, source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a.bin", entries(source))
    with pytest.raises(error, match=words):
        load_prior(MedSynCheckpoint(**{"path": str(tmp_path)} | settings))


def test_inspecting_tells_medsyns_stages_apart(results, tmp_path):
    folder, online, _ = results
    found = inspect_prior(folder)
    assert list(found) == [str(folder / "10_ckpt" / name) for name in (FORMATS[0], "model.safetensors")]
    averaged, plain = found.values()
    assert "64^3" in averaged["kind"] and averaged["by its name"] == "ema, read by default"
    assert plain["by its name"] == "online"
    count = sum(weight.numel() for weight in online.parameters())
    assert averaged["parameters"] == f"{count:,}" and averaged["width"] == "8 16"
    assert averaged["names of the shared self-attention"] == "2 of 8" and averaged["fits"] == "yes"
    file = write(tmp_path / "sr.bin", entries(super_resolution_unet(), "module.denoise_fn.") | {"betas": torch.ones(2)})
    fine = inspect_prior(file)[str(file)]
    assert "256^3" in fine["kind"] and fine["ignored"] == "1 (betas)" and fine["prefix"] == "module.denoise_fn."


def test_inspecting_tells_phydicts_own_files(tmp_path):
    save_prior(tiny_prior(), tmp_path / "tiny.safetensors", {"steps": 12})
    (told,) = inspect_prior(tmp_path / "tiny.safetensors").values()
    assert told["kind"] == "phydict base prior" and told["grid"] == "16 x 16 x 16" and told["text"] == "its own"
    assert json.loads(told["training"]) == {"steps": 12}
    assert int(told["parameters"].replace(",", "")) == sum(w.numel() for w in tiny_prior().parameters())


def test_inspecting_nothing_and_an_empty_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is nothing at"):
        inspect_prior(tmp_path / "nowhere")
    assert "holds no model_1.safetensors" in inspect_prior(tmp_path)[str(tmp_path)]["kind"]


@pytest.mark.parametrize("switch", [False, True])
def test_the_command_line_takes_medsyns_folder_and_its_switches(switch, results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    method = {"class_path": "phydict.posterior.PriorOnly", "init_args": {"iterations": 2}}
    prior = {"path": str(results[0]), "which": "online", "upsample_first": True} if switch else str(results[0])
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"model": {"name": "mine", "method": method, "prior": prior}}))
    model = InferenceCLI(
        ReconstructionTask, ReconstructionData, run=False, save_config_callback=None,
        trainer_defaults={"logger": False, "accelerator": "cpu", "devices": 1, "enable_progress_bar": False,
                          "enable_checkpointing": False, "enable_model_summary": False},
        args=["--config=mine.yaml"]).model
    assert model.prior.network.upsample_first is switch and model.voxels.result.extent == pytest.approx([316, 316, 292])
    expected = dict(results[1 if switch else 2].state_dict())
    assert all(torch.equal(weight, expected[name]) for name, weight in model.prior.network.state_dict().items())
    assert model.settings["prior_crc32"] == fingerprint(
        results[0] / "10_ckpt" / ("model.safetensors" if switch else FORMATS[0]))
    assert model.settings["prior_file"] == (
        "10_ckpt/model.safetensors (online)" if switch else f"10_ckpt/{FORMATS[0]} (ema)")


def test_the_xrays_of_a_ct_are_simulated_on_the_box_of_the_prior():
    """A prior's grid need not be a cube."""
    data, grid = ReconstructionData(cts="phantom", orbit=Orbit(views=2)), Grid((8, 8, 4), 40.0)
    seen = []
    data.simulator = lambda projector, mu, seed: seen.append(projector.grid) or mu[0]
    case = {"volume": torch.zeros(1, 8, 8, 4), "fine": torch.zeros(1, 16, 16, 8)}
    for given in (case, {"volume": case["volume"]}):
        data.simulate(given, 0, grid, HUWindow(), torch.device("cpu"))
    assert [tuple(own.extent) for own in seen] == [tuple(grid.extent)] * 2
    assert [own.shape for own in seen] == [(16, 16, 8), (8, 8, 4)]
