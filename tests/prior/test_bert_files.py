"""BERTs from folders and hub ids: CXR-BERT's and MedSyn's layouts are understood, and nothing but weights is loaded."""

import builtins
import json
from types import SimpleNamespace

import huggingface_hub.constants
import pytest
import torch
from huggingface_hub import HfApi
from safetensors.torch import save_file
from transformers import BertConfig, BertModel

from phydict.prior.bert_files import load_bert
from prior.tiny import REPORTS, write_cxr_bert


def states(tokenizer, bert, report):
    """Last hidden states of a report, without padding; `bert` is the loaded one or the masked language model."""
    with torch.no_grad():
        return bert(**tokenizer(report, return_tensors="pt"), output_hidden_states=True).hidden_states[-1]


def rewritten(folder, change):
    """Changes the dictionary of weights in a folder's pytorch_model.bin."""
    weights = torch.load(folder / "pytorch_model.bin", weights_only=True)
    torch.save(change(weights), folder / "pytorch_model.bin")


def test_cxr_bert_loads_without_its_code_and_without_asking(tmp_path, monkeypatch):
    monkeypatch.setattr(builtins, "input", lambda *_: pytest.fail("asked on stdin"))
    written = write_cxr_bert(tmp_path)
    tokenizer, bert = load_bert(tmp_path)
    for report in REPORTS:
        assert torch.equal(states(tokenizer, bert, report), states(tokenizer, written, report))
    assert "[UNK]" not in tokenizer.tokenize(REPORTS[0].upper())


@pytest.mark.parametrize("change", [
    lambda weights: {f"module.{name}": w for name, w in weights.items()},
    lambda weights: {name.removeprefix("bert."): w for name, w in weights.items()},
    lambda weights: {name.replace("LayerNorm.weight", "LayerNorm.gamma").replace("LayerNorm.bias", "LayerNorm.beta"): w
                     for name, w in weights.items()}], ids=["module.", "bare", "old names"])
def test_every_usual_naming_is_the_same_bert(tmp_path, change):
    written = write_cxr_bert(tmp_path)
    rewritten(tmp_path, change)
    tokenizer, bert = load_bert(tmp_path)
    assert torch.equal(states(tokenizer, bert, REPORTS[0]), states(tokenizer, written, REPORTS[0]))


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path):
    write_cxr_bert(tmp_path)
    name = "bert.embeddings.word_embeddings.weight"
    rewritten(tmp_path, lambda weights: weights | {name: weights[name] / 0})
    with pytest.raises(ValueError, match="not finite .embeddings.word_embeddings.weight has"):
        load_bert(tmp_path)


def test_weights_decide_how_many_positions_there_are(tmp_path):
    written = write_cxr_bert(tmp_path, positions=96, told_positions=24)
    tokenizer, bert = load_bert(tmp_path)
    report = "left nodule " * 40
    assert 24 < len(tokenizer(report)["input_ids"]) <= 96
    assert torch.equal(states(tokenizer, bert, report), states(tokenizer, written, report))


def test_safetensors_come_before_pickled_weights(tmp_path):
    written = write_cxr_bert(tmp_path, seed=1)
    save_file({name: w.clone() for name, w in written.state_dict().items()}, tmp_path / "model.safetensors")
    write_cxr_bert(tmp_path, seed=2)
    tokenizer, bert = load_bert(tmp_path)
    assert torch.equal(states(tokenizer, bert, REPORTS[0]), states(tokenizer, written, REPORTS[0]))


class Trap:
    def __reduce__(self):
        return open, ("sprung", "w")


def test_pickled_code_is_refused_and_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_cxr_bert(tmp_path)
    rewritten(tmp_path, lambda weights: weights | {"bert.trap": Trap()})
    with pytest.raises(ValueError, match="holds more than weights") as error:
        load_bert(tmp_path)
    assert not (tmp_path / "sprung").exists() and "\n" not in str(error.value)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_weights_are_one_sentence(tmp_path, share):
    write_cxr_bert(tmp_path)
    file = tmp_path / "pytorch_model.bin"
    file.write_bytes(file.read_bytes()[:int(share * file.stat().st_size)])
    with pytest.raises(ValueError, match="truncated") as error:
        load_bert(tmp_path)
    assert str(file) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("change", [
    lambda weights: {name: w for name, w in weights.items() if ".layer.1." not in name},
    lambda weights: {name.replace(".layer.1.", ".layer.2."): w for name, w in weights.items()},
    lambda weights: weights | {"bert.encoder.layer.2.output.dense.bias": torch.zeros(16)},
    lambda weights: weights | {"bert.embeddings.word_embeddings.weight": torch.zeros(7, 16)},
    lambda weights: {name.replace("bert.", "roberta."): w for name, w in weights.items()},
    lambda weights: [1.0]], ids=["lacks a layer", "renamed layer", "a layer more", "fewer words", "no BERT", "a list"])
def test_weights_of_another_model_are_refused(tmp_path, change):
    write_cxr_bert(tmp_path)
    rewritten(tmp_path, change)
    with pytest.raises(ValueError, match="not those of the BERT that its config.json describes") as error:
        load_bert(tmp_path)
    assert "\n" not in str(error.value)


def test_a_vocabulary_of_another_model_is_refused(tmp_path):
    write_cxr_bert(tmp_path)
    with (tmp_path / "vocab.txt").open("a") as words:
        words.write("pneumomediastinum\n")
    with pytest.raises(ValueError, match="give the vocabulary that belongs to it"):
        load_bert(tmp_path)


@pytest.mark.parametrize("file", ["config.json", "pytorch_model.bin", "vocab.txt"])
def test_a_folder_that_lacks_a_file_says_which(tmp_path, file):
    write_cxr_bert(tmp_path)
    (tmp_path / file).unlink()
    with pytest.raises(FileNotFoundError, match=f"no BERT text encoder at '{tmp_path}', since it lacks .*{file}"):
        load_bert(tmp_path)


def test_a_damaged_config_is_refused(tmp_path):
    write_cxr_bert(tmp_path)
    (tmp_path / "config.json").write_text('{"hidden_size":')
    with pytest.raises(ValueError, match="config.json describes"):
        load_bert(tmp_path)


# Hub ids

@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A hub out of reach with an empty local cache; the list of ids that were asked for."""
    asked = []

    def unreachable(self, hub_id, **_):
        asked.append(hub_id)
        raise ConnectionError("the hub is out of reach")

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(HfApi, "model_info", unreachable)
    return asked


def write_cached(tmp_path, hub_id):
    folder = tmp_path / "hub" / f"models--{hub_id.replace('/', '--')}"
    (folder / "refs").mkdir(parents=True)
    (folder / "refs" / "main").write_text("0" * 40)
    return write_cxr_bert(folder / "snapshots" / ("0" * 40)), folder / "snapshots" / ("0" * 40)


def test_a_cached_hub_id_needs_no_hub(tmp_path, hub):
    written, _ = write_cached(tmp_path, "some/cxr-bert")
    tokenizer, bert = load_bert("some/cxr-bert")
    assert torch.equal(states(tokenizer, bert, REPORTS[0]), states(tokenizer, written, REPORTS[0]))
    assert not hub


def test_a_hub_out_of_reach_is_asked_once(hub):
    with pytest.raises(FileNotFoundError, match="hub id that can be downloaded .the hub is out of reach") as error:
        load_bert("some/cxr-bert")
    assert hub == ["some/cxr-bert"] and "'some/cxr-bert'" in str(error.value)


def test_a_half_downloaded_hub_id_is_completed_or_refused(tmp_path, hub):
    _, folder = write_cached(tmp_path, "some/cxr-bert")
    (folder / "pytorch_model.bin").unlink()
    with pytest.raises(FileNotFoundError, match="out of reach"):
        load_bert("some/cxr-bert")
    assert hub == ["some/cxr-bert"]


def test_offline_nothing_is_sent(monkeypatch, tmp_path):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(FileNotFoundError, match="offline mode is enabled"):
        load_bert("some/cxr-bert")


def test_what_is_no_hub_id_is_not_asked_for(hub):
    for name in ("/no/such/folder", "./models/bert", "a b"):
        with pytest.raises(FileNotFoundError, match="give a folder with config.json"):
            load_bert(name)
    assert not hub


@pytest.mark.parametrize("held, wanted", [
    (["model.safetensors", "pytorch_model.bin"], "model.safetensors"), (["pytorch_model.bin"], "pytorch_model.bin")])
def test_a_download_takes_one_file_of_weights_and_no_code(tmp_path, hub, monkeypatch, held, wanted):
    taken = []

    def download(hub_id, revision=None, allow_patterns=None, local_files_only=False):
        if local_files_only:
            raise FileNotFoundError
        taken.extend(allow_patterns)
        assert revision == "0" * 40
        write_cxr_bert(tmp_path / "download")
        return str(tmp_path / "download")

    files = [SimpleNamespace(rfilename=name) for name in (*held, "config.json", "vocab.txt", "modeling_cxrbert.py")]
    monkeypatch.setattr(HfApi, "model_info", lambda *_, **__: SimpleNamespace(sha="0" * 40, siblings=files))
    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    load_bert("some/cxr-bert")
    assert [name for name in taken if name in ("model.safetensors", "pytorch_model.bin")] == [wanted]
    assert {"config.json", "vocab.txt"} < set(taken) and not any(name.endswith(".py") for name in taken)


def test_a_plain_bert_in_half_precision_becomes_single(tmp_path):
    write_cxr_bert(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    plain = BertModel(BertConfig.from_dict(config | {"model_type": "bert"})).half()
    plain.save_pretrained(tmp_path)
    weights = load_bert(tmp_path)[1].state_dict()
    assert all(torch.equal(w, plain.state_dict()[name].float()) for name, w in weights.items())
