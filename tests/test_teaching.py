"""How a training treats reports and the text side of a prior."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from prior.tiny import REPORTS, tiny_prior
from torch.utils.data import default_collate

from phydict.datasets.phantoms.findings import KINDS
from phydict.grid import Cube
from phydict.prior import DetailNetwork, VolumeUNet, load_prior, save_prior
from phydict.training import PriorTraining
from phydict.training.data import PriorData
from phydict.training.settings import TextSettings


def test_a_dropped_report_is_none_at_all(cache):
    data = PriorData(phantoms=4, cache=str(cache), cube=Cube(16))
    batch = default_collate([data.phantoms[i] for i in range(4)])
    silent = batch | {"report": [""] * 4}
    for dropout, heard in ((0.0, True), (1.0, False)):
        task = PriorTraining(tiny_prior().network, TextSettings(reports=data.reports, dropout=dropout), cube=Cube(16))
        with torch.no_grad():
            assert (task.batch_loss(batch) != task.batch_loss(silent)) == heard


def test_training_goes_on_from_a_prior_and_refuses_one_of_another_grid(tmp_path):
    path = tmp_path / "prior.safetensors"
    first = tiny_prior()
    save_prior(first, path, dtype=torch.float32)
    task = PriorTraining(initial=str(path), cube=Cube(16), window=(-1000, 600))
    x, t = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4])
    reports = ["Pleural effusion (right), 12 mm."]
    torch.testing.assert_close(task.prior(x, t, task.prior.context(reports)), first(x, t, first.context(reports)))
    for name, weight in task.prior.named_parameters():
        assert weight.requires_grad != name.startswith(("text.", "network.text_map.", "null")), name
    task = PriorTraining(initial=str(path), cube=Cube(16), window=(-1000, 600), text=TextSettings(frozen=False))
    assert all(w.requires_grad for w in task.prior.parameters())
    with pytest.raises(ValueError, match="another grid"):
        PriorTraining(initial=str(path), cube=Cube(32, 300.0), window=(-1000, 600))


def test_a_prior_that_training_starts_from_keeps_its_own_network_and_scale(tmp_path):
    path, first = str(tmp_path / "prior.safetensors"), tiny_prior(text=False)
    first.sigma_data = 0.7
    save_prior(first, path, dtype=torch.float32)
    task = PriorTraining(first.network, initial=path, cube=Cube(16), window=(-1000, 600))
    torch.testing.assert_close(task.time_weight(torch.ones(1)).squeeze(), torch.tensor(0.7**-2))
    with pytest.raises(ValueError, match="model.network has channels .8, 8., but the prior .* leave model.network out"):
        PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8, 16), initial=path, cube=Cube(16),
                      window=(-1000, 600))


@pytest.mark.parametrize("option, given", [
    ("text.encoder", {"text": TextSettings("none")}), ("text.encoder", {"text": TextSettings("nowhere")}),
    ("text.length", {"text": TextSettings(length=64)}), ("text.padded_to", {"text": TextSettings(padded_to=2048)}),
    ("text.texts", {"text": TextSettings(texts="nowhere.txt")}), ("detail", {"detail": DetailNetwork(4, 8)})])
def test_what_a_prior_that_training_starts_from_brings_itself_is_not_silently_ignored(tmp_path, option, given):
    save_prior(tiny_prior(detail=True), tmp_path / "prior.safetensors", dtype=torch.float32)
    initial = {"initial": str(tmp_path / "prior.safetensors"), "cube": Cube(16), "window": (-1000, 600)}
    PriorTraining(**initial, text=TextSettings(dropout=0.5, frozen=False), detail=tiny_prior(detail=True).detail)
    with pytest.raises(ValueError, match=f"model.{option} .* that training continues from has .*: leave"):
        PriorTraining(**initial, **given)


def test_text_that_is_kept_is_taught_first_and_not_moved_by_denoising(cache):
    data = PriorData(phantoms=4, cache=str(cache), cube=Cube(16))
    for frozen in (True, False):
        text = TextSettings(reports=data.reports, pretrain_steps=2, frozen=frozen)
        task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8), text, cube=Cube(16))
        untaught = {name: weight.clone() for name, weight in task.prior.state_dict().items()}
        task.learn_reports()
        taught = {name: weight.clone() for name, weight in task.prior.state_dict().items()}
        text_side = {name for name in taught if name.startswith(("text.", "network.text_map.", "null"))}
        moved = {name for name in taught if not torch.equal(taught[name], untaught[name])}
        assert moved and moved < text_side and "null" not in moved
        task.prior.network.hint.weight.data.normal_()
        task.prior.network.unfold.weight.data.normal_()
        optimizer = task.configure_optimizers()["optimizer"]
        task.batch_loss(default_collate([data.phantoms[i] for i in range(4)])).backward()
        optimizer.step()
        moved = {name for name, weight in task.prior.state_dict().items() if not torch.equal(taught[name], weight)}
        assert bool(moved & text_side) != frozen and moved - text_side


def test_a_prior_gets_a_new_text_side_and_is_the_same_without_a_report(tmp_path):
    path = tmp_path / "prior.safetensors"
    first = tiny_prior()
    torch.nn.init.zeros_(first.network.hint.weight)
    torch.nn.init.zeros_(first.network.hint.bias)
    save_prior(first, path, dtype=torch.float32)
    settings = {"initial": str(path), "cube": Cube(16), "window": (-1000, 600)}
    text = TextSettings(reports=REPORTS, pretrain_steps=2)
    kept, renewed = (PriorTraining(text=replace(text, renew=renew), **settings) for renew in (False, True))
    assert kept.prior.text.vocabulary == first.text.vocabulary and not hasattr(kept.prior.network.text_map, "kinds")
    assert renewed.prior.network.text_map.kinds == KINDS and "effusion" in renewed.prior.text.vocabulary
    x, t = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4])
    for task in (kept, renewed):
        assert torch.equal(task.prior(x, t, task.prior.context([""])), first(x, t, first.context([""])))
    before = {name: weight.clone() for name, weight in kept.prior.state_dict().items()}
    for task in (kept, renewed):
        task.learn_reports()  # a new one alone
    assert all(torch.equal(weight, before[name]) for name, weight in kept.prior.state_dict().items())
    export = tmp_path / "renewed.safetensors"
    save_prior(renewed.prior, export, dtype=torch.float32)
    again = load_prior(export)
    assert torch.equal(again.network.text_map(again.context(REPORTS[:1])),
                       renewed.prior.network.text_map(renewed.prior.context(REPORTS[:1])))
    with pytest.raises(ValueError, match="model.initial"):
        PriorTraining(text=replace(text, renew=True), cube=Cube(16))


def test_a_small_encoder_knows_the_words_of_a_file_of_texts(tmp_path):
    (tmp_path / "texts.txt").write_text("Hamartoma with popcorn calcification.\n")
    for texts in (None, str(tmp_path / "texts.txt")):
        task = PriorTraining(VolumeUNet(4, 2, (8, 8), (False, True), 1, 8),
                             TextSettings(reports=["Clear lungs."], texts=texts), cube=Cube(16))
        assert ("hamartoma" in task.prior.text.vocabulary) == (texts is not None)
