"""The text encoder of a prior's file: its header's "text", and the weights that belong to it."""

from __future__ import annotations

import reprlib
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from phydict.prior.finite import check_finite
from phydict.prior.stage_file import ADVICE, check_sizes, whole_of
from phydict.prior.text import TextEncoder
from phydict.runtime.reading import naming, reason, refusing


def has_text(header: dict) -> bool:
    """Whether a header describes a text encoder. Raises ValueError where "text" is not what `Prior.describe` gives."""
    text, keys = header.get("text", "missing"), ("source", "length", "width", "layers", "vocabulary")
    if text is None:
        return False
    if not isinstance(text, dict) or any(key not in text for key in keys):
        raise ValueError(f"text is {reprlib.repr(text)}, where {', '.join(keys)} are needed, or null")
    for key in ("length", "width", "layers"):
        whole_of(text, key)
    for key in ("padded_to", "sentences"):
        if key in text:
            whole_of(text, key)
    words = text["vocabulary"]
    if not isinstance(text["source"], str | None) or (text["source"] is None and not (
            isinstance(words, list) and all(isinstance(word, str) for word in words))):
        raise ValueError(f"text.source is {reprlib.repr(text['source'])} and text.vocabulary {reprlib.repr(words)}, "
                         "where one of them names a text encoder or lists words")
    return True


def build_text(text: dict, weights: dict[str, Tensor]) -> TextEncoder:
    """The text encoder of a header's "text", frozen; `weights` ("text.") are used unless it is a pretrained one."""
    if text["source"]:
        return TextEncoder.pretrained(text["source"], text["length"], text.get("padded_to"))
    weights = {k.removeprefix("text."): w for k, w in weights.items() if k.startswith("text.")}
    try:
        check_sizes("text", {key: text[key] for key in ("length", "width", "layers")}, weights)
        held = len(weights["bert.embeddings.word_embeddings.weight"])
        if len(text["vocabulary"]) != held:
            raise ValueError(f"it lists {len(text['vocabulary'])} words, but its weights have {held}")
        encoder = TextEncoder.small(text["vocabulary"], text["width"], text["layers"], text["length"],
                                    text.get("sentences"))
        encoder.load_state_dict(weights)
    except Exception as error:  # of whatever kind: it is the header that leads to it
        raise ValueError(f"the text encoder is not the one that the header describes ({reason(error)})") from error
    encoder.trainable = False
    return encoder.eval().requires_grad_(False)


def load_text(path: Path, text: dict) -> TextEncoder:
    with refusing(path, ADVICE):
        with safe_open(path, "pt") as file:
            weights = {k: file.get_tensor(k) for k in file.keys() if k.startswith("text.")}
        check_finite(weights, path)
        with naming(f"'{path}' contradicts itself"), torch.random.fork_rng(devices=[]):  # what it begins with is random
            return build_text(text, weights)
