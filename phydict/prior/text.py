"""Radiology reports as contexts for cross-attention, through transformers, from a folder or a hub id."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from phydict.prior.bert_files import load_bert
from phydict.prior.sentences import split_sentences
from phydict.runtime.warning import warn

if TYPE_CHECKING:
    from transformers import BertModel, BertTokenizer

FOREIGN = 0.2
"""Share of a report's tokens that may be [UNK] before `TextEncoder.check` warns."""

TOGETHER = 16
"""Sentences that are read at once: those of a batch differ much in length, and padding costs time."""


class TextEncoder(nn.Module):
    """A BERT and its tokenizer: reports -> embeddings of their tokens (B, length, D) or sentences (B, sentences, D).

    length: a report (with sentences: a sentence) is cut or padded to this many tokens, so a context never depends on
    its batch.
    trainable: whether the weights learn with the prior (the small default) or stay frozen (a pretrained BERT).
    source: folder or hub id it was loaded from; None for a BERT that belongs to its prior.
    padded_to: MedSyn's convention (see `pretrained`): the BERT reads up to this many tokens, of which the first
    `length` are kept; None: it reads no more than `length`.
    sentences: how many of a report's sentences are read, each alone and into one state (that of [CLS]), so that "no"
    reaches no further than its sentence; None: the report is read as a whole, into one state per token.

    A frozen encoder reads each report alone, without dropout and in the precision of its weights, and keeps the result
    in main memory until its weights change or `cache_bytes` are full: a report's context costs one reading.
    A word that the vocabulary lacks becomes [UNK], a token without meaning, as do most words in another script.
    """

    cache_bytes = 2**30

    def __init__(self, tokenizer: BertTokenizer, bert: BertModel, length: int = 128, trainable: bool = False,
                 source: str | None = None, padded_to: int | None = None, sentences: int | None = None):
        super().__init__()
        if length < 1:
            raise ValueError(f"a text encoder reads at least 1 token of a report, but a length of {length} was given")
        if padded_to is not None and padded_to < length:
            raise ValueError(f"a report padded to {padded_to} tokens has no {length} of them to keep: give a padded_to "
                             "of at least the length")
        self.tokenizer, self.bert, self.length, self.source = tokenizer, bert, length, source
        self.trainable, self.padded_to, self.sentences = trainable, padded_to, sentences
        self.bert.requires_grad_(trainable)
        self._kept: dict[str, tuple[Tensor, Tensor]] = {}
        self._kept_of: tuple | None = None
        self._kept_bytes = 0

    @property
    def width(self) -> int:
        """D, the width of a token's embedding."""
        return self.bert.config.hidden_size

    @property
    def states(self) -> int:
        """L, how many states a context has."""
        return self.sentences or self.length

    @classmethod
    def pretrained(cls, source: str | Path, length: int = 128, padded_to: int | None = None) -> TextEncoder:
        """From a folder or hub id holding a BERT and its vocabulary (see `load_bert`); its weights stay frozen.

        For contexts as MedSyn (10.1109/TMI.2024.3415032) was trained with, give its language model or CXR-BERT with
        length=192, padded_to=2048: the last hidden states of the first 192 positions of a report that was cut or padded
        to 2048 tokens, states of padding included, which cross-attention sees. The BERT itself masks padding, so that
        padding beyond the first `length` changes nothing and is left out.
        Where the BERT has fewer positions than requested, both are lowered to these, and a warning says so.
        Raises FileNotFoundError, with what to do, when it is neither on disk nor reachable.
        """
        tokenizer, bert = load_bert(source)
        positions, requested = bert.config.max_position_embeddings, padded_to or length
        if requested > positions:
            warn(f"the text encoder at '{source}' knows {positions} of the {requested} positions requested: "
                 f"reports are cut to {positions} tokens")
        return cls(tokenizer, bert, min(length, positions), source=str(source),
                   padded_to=padded_to and min(padded_to, positions))

    @classmethod
    def small(cls, vocabulary: list[str], width: int = 64, layers: int = 2, length: int = 128,
              sentences: int | None = None) -> TextEncoder:
        """A new small BERT over a WordPiece vocabulary (see `learn_vocabulary`); it trains with its prior."""
        from transformers import BertConfig, BertModel, BertTokenizer

        tokenizer = BertTokenizer(vocab={word: i for i, word in enumerate(vocabulary)})
        bert = BertModel(BertConfig(
            vocab_size=len(vocabulary), hidden_size=width, num_hidden_layers=layers, num_attention_heads=4,
            intermediate_size=4 * width, max_position_embeddings=length, hidden_dropout_prob=0.0,
            attention_probs_dropout_prob=0.0), add_pooling_layer=False)
        return cls(tokenizer, bert, length, trainable=True, sentences=sentences)

    @property
    def vocabulary(self) -> list[str]:
        """The words in the order of their token ids."""
        words = self.tokenizer.get_vocab()
        return sorted(words, key=words.__getitem__)

    def forward(self, reports: list[str]) -> tuple[Tensor, Tensor]:
        """Reports -> states (B, L, D) and their mask (B, L), True where cross-attention looks: at tokens or sentences,
        and with padded_to at padding too."""
        if self.trainable:
            return self._read(reports)
        states, masks = zip(*map(self._read_once, reports))
        return torch.stack(states).to(self.bert.device), torch.stack(masks).to(self.bert.device)

    def check(self, reports: Iterable[str]) -> None:
        """Warns of reports that are longer than is read (`sentences`, else `padded_to`, else `length`), of sentences
        that are, and of reports in words that the vocabulary lacks.
        """
        given = [report for report in dict.fromkeys(reports) if report]
        if not given:
            return
        tokens = self.tokenizer(given, add_special_tokens=False, verbose=False)["input_ids"]
        sizes, read, unit = [len(ids) + 2 for ids in tokens], self.padded_to or self.length, "tokens"
        if self.sentences:
            sizes, read, unit = [len(split_sentences(report)) for report in given], self.sentences, "sentences"
        excess = [size - read for size in sizes if size > read]
        if excess:
            warn(f"{len(excess)} of {len(given)} reports are longer than the {read} {unit} that the text "
                 f"encoder reads: up to {max(excess)} {unit} at their end are left out")
        if self.sentences:
            read_ones = [one for report in given for one in split_sentences(report)[:self.sentences]]
            lengths = [len(ids) for ids in self.tokenizer(read_ones, verbose=False)["input_ids"]]
            if excess := [length - self.length for length in lengths if length > self.length]:
                warn(f"{len(excess)} of {len(lengths)} sentences of reports are longer than the {self.length} tokens "
                     f"that the text encoder reads: up to {max(excess)} tokens at their end are left out; divide them "
                     "into shorter ones")
        unknown = [sum(token == self.tokenizer.unk_token_id for token in ids) / max(len(ids), 1) for ids in tokens]
        foreign = [share for share in unknown if share > FOREIGN]
        if foreign:
            warn(f"{len(foreign)} of {len(given)} reports are in words that the text encoder does not know, up "
                 f"to {max(foreign):.0%} of a report, and say little to it: give them in the language that "
                 "it learnt, or leave them out")

    def read_sentences(self, sentences: list[str]) -> Tensor:
        """Sentences -> the state of each (N, D). Those of like length are read together, padded to the longest."""
        tokens = [torch.tensor(sentence) for sentence in
                  self.tokenizer(sentences, truncation=True, max_length=self.length)["input_ids"]]
        order = sorted(range(len(tokens)), key=lambda place: len(tokens[place]))
        states = []
        for first in range(0, len(order), TOGETHER):
            batch = [tokens[place] for place in order[first:first + TOGETHER]]
            ids = pad_sequence(batch, batch_first=True, padding_value=self.tokenizer.pad_token_id)
            mask = torch.arange(ids.shape[1]) < torch.tensor([[len(sentence)] for sentence in batch])
            states.append(self.bert(input_ids=ids.to(self.bert.device), attention_mask=mask.to(
                self.bert.device, torch.long)).last_hidden_state[:, 0])
        return torch.cat(states)[torch.tensor(order, device=self.bert.device).argsort()]

    def _read(self, reports: list[str]) -> tuple[Tensor, Tensor]:
        return self._read_by_sentence(reports, self.sentences) if self.sentences else self._read_as_a_whole(reports)

    def _read_by_sentence(self, reports: list[str], most: int) -> tuple[Tensor, Tensor]:
        split = [split_sentences(report)[:most] for report in reports]
        states = torch.zeros(len(reports), most, self.width, device=self.bert.device, dtype=self.bert.dtype)
        mask = torch.tensor([[place < len(sentences) for place in range(most)] for sentences in split])
        if mask.any():
            states[mask] = self.read_sentences([sentence for sentences in split for sentence in sentences]).to(states)
        return states, mask.to(states.device)

    def _read_as_a_whole(self, reports: list[str]) -> tuple[Tensor, Tensor]:
        window = self.length
        if self.padded_to:
            tokens = self.tokenizer(reports, truncation=True, max_length=self.padded_to)["input_ids"]
            window = max(window, *map(len, tokens))
        tokens = self.tokenizer(
            reports, padding="max_length", truncation=True, max_length=window, return_tensors="pt")
        mask = tokens["attention_mask"].to(self.bert.device)
        states = self.bert(
            input_ids=tokens["input_ids"].to(self.bert.device), attention_mask=mask).last_hidden_state
        attended = torch.ones_like(mask) if self.padded_to else mask
        return states[:, :self.length], attended[:, :self.length].bool()

    def _read_once(self, report: str) -> tuple[Tensor, Tensor]:
        """What `_read` says of one report, without its batch axis: from the cache, or put there."""
        weights = (self.bert.device, self.bert.dtype,
                   sum(0 if w.is_inference() else w._version for w in self.bert.parameters()))
        if weights != self._kept_of:
            self._kept, self._kept_of, self._kept_bytes = {}, weights, 0
        if report in self._kept:
            return self._kept[report]
        self.bert.eval()
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(self.bert.device.type, enabled=False):
            states, mask = (part[0].cpu() for part in self._read([report]))
        if self._kept_bytes + states.nbytes <= self.cache_bytes:
            self._kept[report] = states.clone(), mask.clone()
            self._kept_bytes += states.nbytes
        return states, mask


def learn_vocabulary(reports: Iterable[str], size: int = 2000) -> list[str]:
    """WordPiece vocabulary of at most `size` pieces: special tokens, every character seen, then the commonest words.

    Unlike the usual merging trainers it is the same in every process and on every machine, as resuming and
    distributed training need.
    """
    from tokenizers import normalizers, pre_tokenizers

    normalize, split = normalizers.BertNormalizer(lowercase=True), pre_tokenizers.BertPreTokenizer()
    words = Counter(word for report in reports
                    for word, _ in split.pre_tokenize_str(normalize.normalize_str(report)))
    letters = sorted(set("".join(words)))
    pieces = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", *letters, *("##" + letter for letter in letters)]
    common = sorted((word for word in words if len(word) > 1), key=lambda word: (-words[word], word))
    return (pieces + common)[:size]
