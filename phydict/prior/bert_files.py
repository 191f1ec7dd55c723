"""A BERT and its tokenizer from a folder or a hub id: weights and words alone, never code that came with them."""

from __future__ import annotations

import json
import reprlib
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors.torch import load_file
from torch import Tensor

if TYPE_CHECKING:
    from transformers import BertModel, BertTokenizer

from phydict.prior.finite import check_finite
from phydict.runtime.reading import reading, reason

CONFIG = "config.json"
WEIGHTS = ("model.safetensors", "pytorch_model.bin")
VOCABULARY = ("vocab.txt", "tokenizer.json")
BESIDE = ("tokenizer_config.json", "special_tokens_map.json")
NEEDED = "config.json, model weights and vocabulary"
"""What `load_bert` reads; of WEIGHTS and VOCABULARY the first that is there."""

ATTEMPT_SECONDS = 5.0
"""How long the one attempt to reach the hub may take."""

OLD_NAMES = {"LayerNorm.gamma": "LayerNorm.weight", "LayerNorm.beta": "LayerNorm.bias"}
UNUSED = ("embeddings.position_ids", "embeddings.token_type_ids")


def load_bert(source: str | Path) -> tuple[BertTokenizer, BertModel]:
    """The tokenizer and the BERT without pooler (float32) in a folder, or under a hub id.

    Any checkpoint whose encoder is a BERT is understood, bare or below "bert." and with further heads, which are left
    out: CXR-BERT (microsoft/BiomedVLP-CXR-BERT-specialized) as it is, and MedSyn's language model as a folder with its
    pytorch_model.bin and CXR-BERT's config.json and vocab.txt. The weights decide how many positions there are.
    A hub id is looked for in the local cache, then downloaded after one attempt to reach the hub, or none where
    HF_HUB_OFFLINE is set. Raises FileNotFoundError where there is none, ValueError where its files do not fit together
    or hold more than weights.
    """
    from transformers import BertConfig, BertModel, BertTokenizer

    folder = _folder(source)
    weights = _read_weights(next(folder / name for name in WEIGHTS if (folder / name).is_file()))
    try:
        config = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
        config.pop("model_type", None)
        config["max_position_embeddings"] = len(weights["embeddings.position_embeddings.weight"])
        most = max([len(weights), *(n for weight in weights.values() for n in weight.shape)])
        for size in ("hidden_size", "num_hidden_layers", "intermediate_size", "vocab_size"):
            if not 0 < config.get(size, 1) <= most:
                raise ValueError(f"{size} is {reprlib.repr(config[size])}")
        bert = BertModel(BertConfig.from_dict(config), add_pooling_layer=False)
        bert.load_state_dict(weights)
    except Exception as error:  # whatever the two files lead their readers to
        raise ValueError(f"the weights in '{folder}' are not those of the BERT that its {CONFIG} describes "
                         f"({reason(error)}): give the files of one model") from error
    with reading(f"the vocabulary in '{folder}'", f"give {' or '.join(VOCABULARY)} of that BERT"):
        tokenizer = BertTokenizer.from_pretrained(folder, local_files_only=True)
    if len(tokenizer) > bert.config.vocab_size:
        raise ValueError(f"the vocabulary in '{folder}' has {len(tokenizer)} words, but the BERT knows "
                         f"{bert.config.vocab_size}: give the vocabulary that belongs to it")
    return tokenizer, bert.eval()


def _folder(source: str | Path) -> Path:
    """The folder on disk that holds a source's files, downloaded to the local cache if need be."""
    from huggingface_hub.errors import HTTPError

    folder = Path(source)
    if not folder.is_dir():
        try:
            folder = _cached(str(source)) or _downloaded(str(source))
        except (OSError, ValueError, HTTPError) as error:
            raise FileNotFoundError(f"no BERT text encoder at '{source}': give a folder with {NEEDED}, or a hub id "
                                    f"that can be downloaded ({str(error).splitlines()[0]})") from error
    if missing := _missing(folder):
        raise FileNotFoundError(f"no BERT text encoder at '{source}', since it lacks {missing}: give a folder or hub "
                                f"id with {NEEDED}")
    return folder


def _cached(hub_id: str) -> Path | None:
    from huggingface_hub import snapshot_download

    try:
        folder = Path(snapshot_download(hub_id, local_files_only=True))
    except FileNotFoundError:
        return None
    return None if _missing(folder) else folder


def _downloaded(hub_id: str) -> Path:
    from huggingface_hub import HfApi, snapshot_download

    hub = HfApi().model_info(hub_id, timeout=ATTEMPT_SECONDS)  # a download's own attempts repeat for minutes
    held = {file.rfilename for file in hub.siblings or ()}
    weights = [name for name in WEIGHTS if name in held][:1]
    return Path(snapshot_download(hub_id, revision=hub.sha, allow_patterns=[CONFIG, *weights, *VOCABULARY, *BESIDE]))


def _missing(folder: Path) -> str:
    choices = {CONFIG: (CONFIG,), " or ".join(WEIGHTS): WEIGHTS, " or ".join(VOCABULARY): VOCABULARY}
    return ", ".join(name for name, files in choices.items() if not any((folder / file).is_file() for file in files))


def _read_weights(file: Path) -> dict[str, Tensor]:
    """The encoder's weights under BertModel's own names."""
    try:
        weights = load_file(file) if file.suffix == ".safetensors" else torch.load(file, "cpu", weights_only=True)
    except Exception as error:  # whatever a damaged file leads its readers to
        raise ValueError(f"'{file}' is truncated or holds more than weights, and code in it is never run: copy it "
                         "again, or give it as model.safetensors") from error
    named = {}
    for name, weight in weights.items() if isinstance(weights, dict) else ():
        if not isinstance(name, str) or not isinstance(weight, Tensor):
            continue
        name = name.removeprefix("module.").removeprefix("bert.")
        for old, new in OLD_NAMES.items():
            name = name.replace(old, new)
        if name.startswith(("embeddings.", "encoder.")) and name not in UNUSED:
            named[name] = weight
    check_finite(named, file)
    return named
