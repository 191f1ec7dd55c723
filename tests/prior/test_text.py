"""Reports as contexts: a vocabulary that is the same everywhere, and encoders from a folder."""

import huggingface_hub.constants
import pytest
import torch
from transformers import BertConfig, BertModel

from phydict.prior import TextEncoder, learn_vocabulary
from prior.tiny import REPORTS

STRANGE = "Naïve Übermaß: 2.5×3 cm (T4/N1), SUV≥4; [UNKNOWN] ground-glass!"


def test_the_vocabulary_does_not_depend_on_the_order_of_the_reports():
    reports = [*REPORTS, STRANGE, REPORTS[0]]
    assert learn_vocabulary(reports) == learn_vocabulary(reversed(reports)) == learn_vocabulary(iter(sorted(reports)))


def test_every_word_of_the_reports_has_pieces_and_common_words_are_one():
    reports = [*REPORTS, STRANGE]
    encoder = TextEncoder.small(learn_vocabulary(reports), 16, 1, 64)
    for report in reports:
        pieces = encoder.tokenizer.tokenize(report)
        assert pieces and "[UNK]" not in pieces
    assert encoder.tokenizer.tokenize("left nodule") == ["left", "nodule"]
    assert "[UNK]" not in encoder.tokenizer.tokenize("dullness")  # a new word of known letters
    assert "[UNK]" in encoder.tokenizer.tokenize("肺")


def test_a_small_vocabulary_keeps_the_commonest_words():
    reports = ["effusion effusion effusion nodule nodule mass"]
    letters = 5 + 2 * len(set("effusionnodulemass"))
    assert learn_vocabulary(reports, letters + 1)[letters:] == ["effusion"]
    assert learn_vocabulary(reports, letters + 2)[letters:] == ["effusion", "nodule"]
    whole = learn_vocabulary(reports)
    assert len(whole) == len(set(whole)) == letters + 3


def test_token_ids_are_places_in_the_vocabulary():
    words = learn_vocabulary(REPORTS)
    encoder = TextEncoder.small(words, 16, 1, 16)
    assert encoder.vocabulary == words
    assert encoder.tokenizer("left")["input_ids"] == [words.index(w) for w in ("[CLS]", "left", "[SEP]")]


def test_case_does_not_matter_and_words_do():
    encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24).eval()
    upper, lower, other = encoder([REPORTS[0].upper(), REPORTS[0].lower(), REPORTS[1]])[0]
    assert torch.equal(upper, lower) and not torch.allclose(upper, other)


def test_a_long_report_is_cut_to_the_encoders_length():
    encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24)
    states, mask = encoder(["left lobe " * 200])
    assert states.shape == (1, 24, 16) and mask.all()


def test_the_small_encoder_learns_and_a_pretrained_one_is_frozen(tmp_path):
    small = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24)
    assert small(REPORTS)[0].requires_grad
    write_bert(tmp_path, small)
    assert not TextEncoder.pretrained(tmp_path)(REPORTS)[0].requires_grad


def write_bert(folder, encoder):
    encoder.bert.save_pretrained(folder)
    (folder / "vocab.txt").write_text("\n".join(encoder.vocabulary))


def test_a_bert_from_a_folder_speaks_like_the_one_that_was_written_there(tmp_path):
    small = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24).eval()
    write_bert(tmp_path, small)
    loaded = TextEncoder.pretrained(tmp_path).eval()
    assert loaded.source == str(tmp_path) and loaded.length == 24  # what the BERT has positions for
    torch.testing.assert_close(loaded(REPORTS)[0], small(REPORTS)[0])
    assert TextEncoder.pretrained(tmp_path, 8)(REPORTS)[0].shape[1] == 8


@pytest.mark.parametrize("source", ["somebody/no-such-bert", "/no/such/folder"])
def test_an_encoder_that_is_nowhere_says_what_to_give(monkeypatch, source):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(FileNotFoundError, match="config.json, model weights and vocabulary") as error:
        TextEncoder.pretrained(source)
    assert source in str(error.value) and "\n" not in str(error.value)


def test_a_folder_without_weights_or_without_vocabulary_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    config = BertConfig(vocab_size=40, hidden_size=16, num_hidden_layers=1, num_attention_heads=4, intermediate_size=32)
    config.save_pretrained(tmp_path / "weightless")
    BertModel(config, add_pooling_layer=False).save_pretrained(tmp_path / "speechless")
    for folder in ("weightless", "speechless"):
        with pytest.raises(FileNotFoundError, match="no BERT text encoder at"):
            TextEncoder.pretrained(tmp_path / folder)
