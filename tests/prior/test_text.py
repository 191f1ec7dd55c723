"""Reports as contexts: a vocabulary that is the same everywhere, MedSyn's convention, contexts kept, words lost."""

import warnings

import pytest
import torch

from phydict.prior import Prior, TextEncoder, learn_vocabulary
from phydict.runtime.warning import heard
from prior.tiny import REPORTS, tiny_prior, write_cxr_bert

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
    assert not TextEncoder.pretrained(tmp_path, 24)(REPORTS)[0].requires_grad


def write_bert(folder, encoder):
    encoder.bert.save_pretrained(folder)
    (folder / "vocab.txt").write_text("\n".join(encoder.vocabulary))


def test_a_bert_from_a_folder_speaks_like_the_one_that_was_written_there(tmp_path):
    small = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24).eval()
    write_bert(tmp_path, small)
    loaded = TextEncoder.pretrained(tmp_path, 24).eval()
    assert loaded.source == str(tmp_path)
    torch.testing.assert_close(loaded(REPORTS)[0], small(REPORTS)[0])
    assert TextEncoder.pretrained(tmp_path, 8)(REPORTS)[0].shape[1] == 8


# Contexts of frozen encoders

LONG = " ".join(REPORTS * 40)
"""About 1200 words."""


def frozen(folder, **kwargs):
    write_cxr_bert(folder, positions=kwargs.pop("positions", 64))
    return TextEncoder.pretrained(folder, **kwargs)


def count_readings(encoder):
    """A list that grows by the number of reports whenever the BERT reads."""
    readings = []
    encoder.bert.register_forward_hook(lambda bert, _, output: readings.append(len(output.last_hidden_state)))
    return readings


@pytest.mark.parametrize("report", [REPORTS[0], LONG], ids=["short", "longer than 192 tokens"])
def test_medsyns_contexts_are_the_first_192_states_of_a_prompt_padded_to_2048(tmp_path, report):
    model = write_cxr_bert(tmp_path, positions=2048, told_positions=512)
    encoder = TextEncoder.pretrained(tmp_path, length=192, padded_to=2048)
    tokens = encoder.tokenizer([report], padding="max_length", truncation=True, max_length=2048, return_tensors="pt")
    assert (tokens["attention_mask"].sum() > 192) == (report is LONG)
    with torch.no_grad():
        expected = model(**tokens, output_hidden_states=True).hidden_states[-1][:, :192]
    states, mask = encoder([report])
    torch.testing.assert_close(states, expected, atol=1e-4, rtol=1e-4)
    assert mask.all()


def test_medsyns_contexts_keep_padding_where_others_have_the_null_token(tmp_path):
    contexts = {}
    for padded_to in (None, 40):
        prior = tiny_prior()
        prior.text = frozen(tmp_path, length=24, padded_to=padded_to)
        contexts[padded_to] = prior.context([REPORTS[0]])[0]
    words = len(prior.text.tokenizer(REPORTS[0])["input_ids"])
    torch.testing.assert_close(contexts[None][:words], contexts[40][:words])
    null = prior.null.expand(1, 24 - words, -1)[0]
    assert torch.equal(contexts[None][words:], null) and not torch.isclose(contexts[40][words:], null).all(1).any()


def test_positions_that_a_checkpoint_lacks_are_stated(tmp_path):
    with pytest.warns(UserWarning, match="knows 64 of the 100 positions"):
        assert frozen(tmp_path, length=100).length == 64
    with pytest.warns(UserWarning, match="knows 64 of the 2048 positions .* cut to 64 tokens"):
        encoder = frozen(tmp_path, length=48, padded_to=2048)
    torch.testing.assert_close(encoder([LONG])[0], TextEncoder.pretrained(tmp_path, 48, 64)([LONG])[0])


def test_padding_below_the_length_is_refused(tmp_path):
    with pytest.raises(ValueError, match="padded to 8 tokens has no 24 of them"):
        frozen(tmp_path, length=24, padded_to=8)


@pytest.mark.parametrize("padded_to", [None, 40])
def test_a_kept_context_is_the_read_one_bit_for_bit(tmp_path, padded_to):
    keeping, reading = (frozen(tmp_path, length=24, padded_to=padded_to) for _ in range(2))
    reading.cache_bytes = 0
    readings = count_readings(keeping), count_readings(reading)
    for batch in (REPORTS, REPORTS[::-1], [REPORTS[1]], [LONG, REPORTS[2], LONG]):
        assert all(torch.equal(kept, read) for kept, read in zip(keeping(batch), reading(batch)))
    assert readings == ([1] * 4, [1] * 10)


def test_who_asks_and_how_does_not_matter_to_a_frozen_encoder(tmp_path):
    plain, asked = frozen(tmp_path, length=24), frozen(tmp_path, length=24)
    asked.train()  # as Lightning does; its dropout is 0.25
    asked.cache_bytes = 0
    expected = plain(REPORTS)[0]
    assert torch.equal(asked(REPORTS)[0], expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(asked(REPORTS)[0], expected)
    with torch.inference_mode():
        assert torch.equal(asked(REPORTS)[0], expected)


def test_a_context_kept_by_inference_serves_training(tmp_path):
    encoder = frozen(tmp_path, length=24)
    with torch.inference_mode():
        encoder(REPORTS)
    weight = torch.ones(16, requires_grad=True)
    (encoder(REPORTS)[0] * weight).sum().backward()
    assert weight.grad.abs().sum() > 0


def test_contexts_follow_changed_weights(tmp_path):
    encoder, other = frozen(tmp_path / "a", length=24), tmp_path / "b"
    write_cxr_bert(other, seed=1)
    before = encoder(REPORTS)[0]
    encoder.bert.load_state_dict(TextEncoder.pretrained(other, 24).bert.state_dict())
    assert torch.equal(encoder(REPORTS)[0], TextEncoder.pretrained(other, 24)(REPORTS)[0])
    assert not torch.allclose(encoder(REPORTS)[0], before)


def test_an_encoder_that_trains_keeps_nothing():
    encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 24)
    before, readings = encoder(REPORTS)[0], count_readings(encoder)
    encoder(REPORTS)[0].square().sum().backward()
    torch.optim.SGD(encoder.parameters(), 0.1).step()
    assert not torch.allclose(encoder(REPORTS)[0], before) and readings == [3, 3]
    encoder.trainable = False
    after = encoder(REPORTS)[0]
    assert not after.requires_grad and torch.equal(encoder(REPORTS)[0], after) and readings == [3, 3, 1, 1, 1]


def test_what_is_kept_stays_within_its_memory(tmp_path):
    encoder = frozen(tmp_path, length=24)
    encoder.cache_bytes = 2 * 24 * 16 * 4  # two contexts
    readings = count_readings(encoder)
    for _ in range(3):
        encoder(REPORTS)
    assert len(readings) == 3 + 1 + 1


def test_a_change_to_an_answer_does_not_reach_the_next_one(tmp_path):
    encoder = frozen(tmp_path, length=24)
    first = encoder(REPORTS)[0]
    expected = first.clone()
    first.zero_()
    assert torch.equal(encoder(REPORTS)[0], expected)


# What is said of reports

def test_reports_that_are_cut_are_counted_and_measured(tmp_path):
    encoder = frozen(tmp_path, length=24)
    words = "left nodule " * 20
    with pytest.warns(UserWarning, match="1 of 4 reports are longer than the 24 tokens .* up to 18 tokens at"):
        encoder.check([*REPORTS, words])
    tokens = encoder.tokenizer(words)["input_ids"]
    assert len(tokens) == 24 + 18
    assert torch.equal(encoder([words])[0], encoder(["left nodule " * 11])[0])  # 22 words, [CLS] and [SEP]


def test_a_sentence_that_is_cut_is_told_where_reports_are_read_by_sentence():
    encoder = TextEncoder.small(learn_vocabulary(REPORTS), 16, 1, 8, sentences=3)
    short, long = "Left nodule. No nodule.", "Left nodule. " + "left nodule " * 6
    with pytest.warns(UserWarning, match="1 of 4 sentences of reports are longer than the 8 tokens .* up to 6 tokens"):
        encoder.check([short, long])
    encoder.check([short])


def test_a_report_that_medsyns_bert_reads_whole_is_not_called_cut(tmp_path):
    encoder = frozen(tmp_path, length=24, padded_to=40)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        encoder.check(["left nodule " * 15])  # 30 words, [CLS] and [SEP]
    assert not torch.equal(encoder(["left nodule " * 15])[0], encoder(["left nodule " * 11])[0])
    with pytest.warns(UserWarning, match="1 of 1 reports are longer than the 40 tokens .* up to 22 tokens at"):
        encoder.check(["left nodule " * 30])
    assert torch.equal(encoder(["left nodule " * 30])[0], encoder(["left nodule " * 19])[0])


def test_reports_in_another_script_are_told_with_their_share(tmp_path):
    encoder = frozen(tmp_path, length=24)
    with pytest.warns(UserWarning, match="2 of 5 reports are in words .* up to 100% of a report"):
        encoder.check([*REPORTS, "Лёгкие чистые", "left lobe 肺 結節"])
    # What they say is lost, though not that something was said.
    assert torch.equal(encoder(["肺 結 節"])[0], encoder(["腫 瘤 大"])[0])
    assert not torch.equal(encoder(["肺 結 節"])[0], encoder([""])[0])


def test_a_report_is_spoken_of_each_time_and_good_ones_never(tmp_path):
    encoder = frozen(tmp_path, length=24)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        encoder.check(["", *REPORTS])
    for _ in range(2):  # the records of two cases with one report both hold it
        with pytest.warns(UserWarning, match="1 of 4 reports are longer"):
            encoder.check([LONG, LONG, *REPORTS])


def test_binding_a_prior_speaks_of_its_report():
    prior = tiny_prior()
    prior.unheard = "the side is not heard"
    for _ in range(2):
        with heard() as texts, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            prior.bind(LONG)
        assert [text.split(" than ")[0] for text in texts] == ["the side is not heard", "1 of 1 reports are longer"]
    with heard() as texts, pytest.warns(UserWarning, match="the side"):
        prior.bind(REPORTS[0])
    prior.bind("")
    assert texts == ["the side is not heard"]


def test_an_encoder_of_another_width_than_the_network_is_refused(tmp_path):
    prior = tiny_prior()
    narrow = TextEncoder.small(learn_vocabulary(REPORTS), 8, 1, 24)
    with pytest.raises(ValueError, match="width 8, but the network's context_dim is 16"):
        Prior(prior.network, prior.grid, prior.window, narrow)
