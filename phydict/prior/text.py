"""Radiology reports as contexts for cross-attention, through transformers, from a folder or a hub id."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import torch
from tokenizers import normalizers, pre_tokenizers
from torch import Tensor, nn
from transformers import BertConfig, BertModel, BertTokenizer


class TextEncoder(nn.Module):
    """A BERT and its tokenizer: reports -> token embeddings (B, length, D).

    length: a report is cut or padded to this many tokens, so a context never depends on its batch.
    trainable: whether the weights learn with the prior (the small default) or stay frozen (a pretrained BERT).
    source: folder or hub id it was loaded from; None for a BERT that belongs to its prior.
    """

    def __init__(self, tokenizer: BertTokenizer, bert: BertModel, length: int = 128, trainable: bool = False,
                 source: str | None = None):
        super().__init__()
        self.tokenizer, self.bert, self.length, self.source = tokenizer, bert, length, source
        self.trainable = trainable
        self.bert.requires_grad_(trainable)

    @property
    def width(self) -> int:
        """D, the width of a token's embedding."""
        return self.bert.config.hidden_size

    @classmethod
    def pretrained(cls, source: str | Path, length: int = 128) -> TextEncoder:
        """From a folder or hub id holding a BERT and its vocabulary (for example CXR-BERT); its weights stay frozen.

        Raises FileNotFoundError, with what to do, when it is neither on disk nor reachable.
        """
        try:
            tokenizer = BertTokenizer.from_pretrained(source)
            bert = BertModel.from_pretrained(source, add_pooling_layer=False)
        except OSError as error:
            raise FileNotFoundError(
                f"no BERT text encoder at '{source}': give a folder with config.json, model weights and vocabulary, "
                f"or a hub id that can be downloaded ({str(error).splitlines()[0]})") from error
        if len(tokenizer) <= len(tokenizer.all_special_tokens):
            raise FileNotFoundError(f"no BERT text encoder at '{source}': its vocabulary is missing, give a folder "
                                    "with config.json, model weights and vocabulary")
        return cls(tokenizer, bert, min(length, bert.config.max_position_embeddings), source=str(source))

    @classmethod
    def small(cls, vocabulary: list[str], width: int = 64, layers: int = 2, length: int = 128) -> TextEncoder:
        """A new small BERT over a WordPiece vocabulary (see `learn_vocabulary`); it trains with its prior."""
        tokenizer = BertTokenizer(vocab={word: i for i, word in enumerate(vocabulary)})
        bert = BertModel(BertConfig(
            vocab_size=len(vocabulary), hidden_size=width, num_hidden_layers=layers, num_attention_heads=4,
            intermediate_size=4 * width, max_position_embeddings=length, hidden_dropout_prob=0.0,
            attention_probs_dropout_prob=0.0), add_pooling_layer=False)
        return cls(tokenizer, bert, length, trainable=True)

    @property
    def vocabulary(self) -> list[str]:
        """The words in the order of their token ids."""
        words = self.tokenizer.get_vocab()
        return sorted(words, key=words.get)

    def forward(self, reports: list[str]) -> tuple[Tensor, Tensor]:
        """Reports -> token embeddings (B, length, D) and their mask (B, length), True where a token stands."""
        tokens = self.tokenizer(
            reports, padding="max_length", truncation=True, max_length=self.length, return_tensors="pt")
        mask = tokens["attention_mask"].to(self.bert.device)
        with torch.set_grad_enabled(self.trainable and torch.is_grad_enabled()):
            states = self.bert(
                input_ids=tokens["input_ids"].to(self.bert.device), attention_mask=mask).last_hidden_state
        return states, mask.bool()


def learn_vocabulary(reports: Iterable[str], size: int = 2000) -> list[str]:
    """WordPiece vocabulary of at most `size` pieces: special tokens, every character seen, then the commonest words.

    Unlike the usual merging trainers it is the same in every process and on every machine, as resuming and
    distributed training need.
    """
    normalize, split = normalizers.BertNormalizer(lowercase=True), pre_tokenizers.BertPreTokenizer()
    words = Counter(word for report in reports
                    for word, _ in split.pre_tokenize_str(normalize.normalize_str(report)))
    letters = sorted(set("".join(words)))
    pieces = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", *letters, *("##" + letter for letter in letters)]
    common = sorted((word for word in words if len(word) > 1), key=lambda word: (-words[word], word))
    return (pieces + common)[:size]
