"""Reports are learnt before denoising: kinds told, denials heard, and what is stated drawn on the side it names."""

import re
from statistics import mean

import numpy as np
import pytest
import torch

from phydict.datasets.phantoms.findings import KINDS
from phydict.datasets.phantoms.places import examples, extents
from phydict.datasets.phantoms.teaching import teaching_sentences
from phydict.datasets.prose import naming_words, written_words
from phydict.grid import Grid
from phydict.prior import Prior, TextEncoder, VolumeUNet, learn_vocabulary
from phydict.training.reports import Disguise, Targets, learn_sentences
from phydict.units import HUWindow

INDEX = {(f.kind, f.side, f.lobe): number for number, f in enumerate(examples())}
SIDES = ("right", "left")
WORDS = {"effusion": ("A large pleural effusion on the {}.", "There is a {} pleural effusion."),
         "consolidation": ("Consolidation in the {} lower lobe.", "Focal consolidation in the {} lower lobe is seen.")}
STATED = [(words.format(side), (INDEX[kind, side, "lower" if kind == "consolidation" else ""],))
          for kind, texts in WORDS.items() for words in texts for side in SIDES]
DENIED = [(f"{no} {kind}.", ()) for kind in ("pleural effusion", "consolidation") for no in ("No", "There is no")]
SENTENCES = STATED + DENIED + [("The liver is normal.", ())]
STRANGE = ["zebra", "quartz", "violet"]


def untaught(seed: int = 0) -> Prior:
    torch.manual_seed(seed)
    text = TextEncoder.small(learn_vocabulary([text for text, _ in SENTENCES] + STRANGE), 32, 2, 24, sentences=8)
    return Prior(VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 32, KINDS), Grid.cube(16, 384.0), HUWindow(), text)


@pytest.fixture(scope="module")
def prior() -> Prior:
    taught = untaught()
    losses = learn_sentences(taught, SENTENCES, 200, words=STRANGE)
    assert mean(losses[-10:]) < 0.3 * mean(losses[:3]), (losses[:3], losses[-10:])
    return taught.requires_grad_(False)


def drawn(prior: Prior, report: str, kind: str) -> torch.Tensor:
    return prior.network.text_map(prior.context([report]))[0, KINDS.index(kind)]


def test_what_a_report_states_is_drawn_on_its_side_and_what_it_denies_is_not(prior):
    for kind, texts in WORDS.items():
        for words in texts:
            right, left = (drawn(prior, words.format(side), kind) for side in SIDES)
            assert right[4:].sum() > 1.5 * left[4:].sum() and left[:4].sum() > 1.5 * right[:4].sum()
            assert right.mean() > 2 * drawn(prior, f"No {'pleural ' * (kind == 'effusion')}{kind}.", kind).mean()


def test_a_statement_is_heard_among_sentences_that_say_nothing_of_it(prior):
    alone = drawn(prior, STATED[0][0], "effusion")
    among = drawn(prior, f"The liver is normal. No consolidation. {STATED[0][0]} The liver is normal.", "effusion")
    assert (among - alone).abs().max() < 0.1 * alone.max()


def test_unknown_words_are_passed_over(prior):
    plain, strewn = (drawn(prior, text, "effusion") for text in (
        "There is a left pleural effusion.", "There is a violet left pleural effusion zebra."))
    assert (plain - strewn).abs().max() < 0.3 * plain.max()


def test_targets_are_the_kinds_that_are_stated_and_what_fills_most_of_each_cell():
    targets = Targets(8, 384.0)
    first, second = INDEX["nodule", "left", "upper"], INDEX["nodule", "right", "upper"]
    kinds, filled = targets([(first, second), ()])
    assert kinds[0].nonzero().flatten().tolist() == [KINDS.index("nodule")] and not kinds[1].any()
    expected = torch.from_numpy(extents(8, 384.0)[[first, second]].max(0)).flatten()
    assert torch.equal(filled[0, KINDS.index("nodule")], expected) and not filled[1].any()


def test_learning_replays_from_its_seed_and_leaves_what_rests_at_rest():
    def run():
        taught = untaught(1)
        taught.text.requires_grad_(False)
        before = taught.text.bert.embeddings.word_embeddings.weight.clone()
        losses = learn_sentences(taught, SENTENCES, 3, words=STRANGE)
        assert not torch.equal(before, taught.text.bert.embeddings.word_embeddings.weight)
        assert not any(weight.requires_grad for weight in taught.text.parameters())
        assert all(weight.requires_grad for weight in taught.network.text_map.parameters())
        return losses

    assert run() == run()


@pytest.mark.slow
def test_a_short_lesson_of_written_sentences_teaches_the_side_of_what_others_state():
    torch.manual_seed(0)
    text = TextEncoder.small(learn_vocabulary([*written_words(), *STRANGE]), 64, 2, 64, sentences=8)
    taught = Prior(VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 64, KINDS), Grid.cube(16, 384.0), HUWindow(), text)
    learn_sentences(taught, teaching_sentences(8_000, 1), 400, words=STRANGE)
    found, right = examples(), []
    with torch.no_grad():
        for sentence, stated in teaching_sentences(600, 2):
            if len(stated) == 1 and found[stated[0]].side in SIDES:
                _, extent = taught.network.text_map.answers(text.read_sentences([sentence])[None])
                halves = extent[0, 0, KINDS.index(found[stated[0]].kind)].unflatten(0, (2, -1)).sum(1)
                right.append(bool(halves[1] > halves[0]) == (found[stated[0]].side == "right"))
    assert len(right) > 50 and mean(right) > 0.85, mean(right)


def test_a_disguised_sentence_keeps_every_word_that_tells_or_states_nothing():
    disguise, draw, kept = Disguise([*STRANGE, "no", "nodule"]), np.random.default_rng(0), 0
    for text, stated in STATED * 60:
        words, findings = disguise(text, stated, draw)
        telling = [[word for word in re.findall(r"\w+", line.lower()) if word in disguise.telling]
                   for line in (text, words)]
        if findings:
            assert findings == stated and telling[0] == telling[1]
            assert re.findall("right|left|lower", words) == re.findall("right|left|lower", text)
            kept += 1
        else:
            assert not set(telling[1]) & set(naming_words())
    assert 0.8 * 60 * len(STATED) < kept < 0.95 * 60 * len(STATED)
