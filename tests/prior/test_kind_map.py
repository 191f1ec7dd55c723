"""A map for each kind: the sentence that says most counts, whatever else is said; and files keep their maps."""

import json

import pytest
import torch
from laws import random_like
from safetensors import safe_open
from safetensors.torch import save_file

from phydict.prior import VolumeUNet, load_prior, save_prior
from phydict.prior.kind_map import KindMap
from phydict.prior.sentences import split_sentences
from phydict.prior.unet import TextMap
from prior.tiny import REPORTS, tiny_prior

KINDS = ("nodule", "effusion", "mass")


def made() -> KindMap:
    torch.manual_seed(0)
    return KindMap(16, KINDS, cells=4, maps=5)


def test_a_reports_map_is_the_largest_of_its_sentences_maps_in_any_order():
    kinds, context = made(), random_like((2, 6, 16), torch.float32)
    alone = torch.stack([kinds(context[:, s:s + 1]) for s in range(6)])
    torch.testing.assert_close(kinds(context), alone.amax(0))
    torch.testing.assert_close(kinds(context.flip(1)), kinds(context))
    torch.testing.assert_close(kinds(torch.cat([context, context], 1)), kinds(context))


def test_an_untaught_map_changes_nothing_and_learns():
    torch.manual_seed(0)
    settings = {"state_channels": 2, "channels": (8, 8), "attention": (False, True), "head_channels": 8,
                "context_dim": 16}
    net = VolumeUNet(**settings)
    torch.nn.init.normal_(net.unfold.weight, std=0.1)
    x, t, context = random_like((1, 2, 8, 8, 8), torch.float32), torch.tensor([0.5]), random_like((1, 3, 16)).float()
    before = net(x, t, context)
    net.draw_kinds(KINDS)
    assert torch.equal(net(x, t, context), before) and net.settings["kinds"] == list(KINDS)
    net(x, t, context).square().mean().backward()
    assert net.hint.weight.grad.abs().max() > 0 and net.hint.weight.shape[1] == len(KINDS)


def test_what_a_network_makes_of_a_kinds_map_stays_with_a_new_map_of_the_same_kinds(prior):
    network, used = prior.network, prior.network.hint.weight.clone()
    before = network.text_map
    network.draw_kinds(KINDS)
    assert network.text_map is not before and torch.equal(network.hint.weight, used)
    network.draw_kinds((*KINDS[:2], "emphysema"))
    assert not network.hint.weight.any()


@pytest.fixture
def prior():
    made = tiny_prior()
    made.network.draw_kinds(KINDS)
    made.text.sentences = 6
    torch.nn.init.normal_(made.network.hint.weight)
    return made.requires_grad_(False)


def test_a_file_keeps_kinds_and_sentences(prior, tmp_path):
    save_prior(prior, tmp_path / "p.safetensors", dtype=torch.float32)
    loaded = load_prior(tmp_path / "p.safetensors")
    assert loaded.network.text_map.kinds == KINDS
    x, t, report = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4]), " ".join(REPORTS)
    assert torch.equal(loaded(x, t, loaded.context([report])), prior(x, t, prior.context([report])))
    assert loaded.context([report]).shape == (1, 6, 16) and loaded.text.sentences == 6


def test_a_file_without_kinds_is_read_as_it_was_written(tmp_path):
    first = tiny_prior()
    save_prior(first, tmp_path / "p.safetensors", dtype=torch.float32)
    with safe_open(tmp_path / "p.safetensors", "pt") as file:
        header = json.loads(file.metadata()["phydict"])
    assert "kinds" not in header["network"] and "sentences" not in header["text"]
    loaded = load_prior(tmp_path / "p.safetensors")
    assert isinstance(loaded.network.text_map, TextMap)
    x, t = torch.randn(1, 4, 16, 16, 16), torch.tensor([0.4])
    assert torch.equal(loaded(x, t, loaded.context(REPORTS[:1])), first(x, t, first.context(REPORTS[:1])))


@pytest.mark.parametrize("part, key, value", [
    ("network", "kinds", ["nodule"] * 4), ("network", "kinds", [1, "a"]), ("network", "kinds", "nodule"),
    ("network", "kinds", ["a"] * 10**6), ("text", "sentences", -1), ("text", "sentences", "six")])
def test_a_header_of_other_kinds_is_refused(prior, tmp_path, part, key, value):
    file = tmp_path / "p.safetensors"
    save_prior(prior, file, dtype=torch.float32)
    with safe_open(file, "pt") as held:
        header, weights = json.loads(held.metadata()["phydict"]), {k: held.get_tensor(k) for k in held.keys()}
    header[part][key] = value
    save_file(weights, file, {"phydict": json.dumps(header)})
    with pytest.raises(ValueError, match="header|contradicts|sentences"):
        load_prior(file).context([REPORTS[0]])


@pytest.mark.parametrize("report, sentences", [
    ("Findings: A nodule of 3.5 mm. No mass; clear pleura! Impression: Normal.",
     ["A nodule of 3.5 mm.", "No mass;", "clear pleura!", "Normal."]),
    ('Open airways. " Bilateral effusion " Goitre', ["Open airways.", "Bilateral effusion", "Goitre"]),
    ("No effusion, e.g. pleural. No infection (i.e. pneumonia); an approx. 5 mm nodule vs. Fig. 2 of Dr. Lung. Normal.",
     ["No effusion, e.g. pleural.", "No infection (i.e. pneumonia);", "an approx. 5 mm nodule vs. Fig. 2 of Dr. Lung.",
      "Normal."]),
    ("1. Left mass.\n2. Small heart.", ["Left mass.", "Small heart."]), ("", []), ("... 12. - 3;", [])])
def test_sentences_of_a_report(report, sentences):
    assert split_sentences(report) == sentences


def test_a_sentence_is_read_the_same_whatever_stands_beside_it(prior):
    alone = prior.context([REPORTS[0]])[0, 0]
    among = prior.context([f"{REPORTS[2]} {REPORTS[0]} Impression: {REPORTS[0]}"])[0]
    torch.testing.assert_close(among[1], alone, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(among[2], alone, rtol=1e-4, atol=1e-5)
    assert torch.equal(among[3:], prior.null[0].expand(3, -1))


def test_sentences_beyond_the_last_are_left_out_and_counted(prior):
    report = f"{REPORTS[0]} " * 9
    with pytest.warns(UserWarning, match="1 of 1 reports are longer than the 6 sentences .* up to 3 sentences at"):
        prior.bind(report)
    assert torch.equal(prior.context([report]), prior.context([f"{REPORTS[0]} " * 6]))


def test_a_report_without_a_word_is_none(prior):
    assert torch.equal(prior.context(["12. 3.", REPORTS[0]])[0], prior.null[0].expand(6, -1))
