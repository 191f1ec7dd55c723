"""One file holds a prior: what is loaded denoises like what was saved, and a bad file ends in one sentence."""

import json
import resource

import pytest
import torch
from laws import random_like
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from phydict.prior import TextEncoder, inspect_prior, load_prior, save_prior
from phydict.prior.text_file import build_text
from phydict.runtime.shipped import shipped
from prior.tiny import REPORTS, tiny_prior, write_cxr_bert

X = random_like((1, 4, 16, 16, 16), torch.float32, seed=1)


def estimates(prior):
    return [prior.bind(report, 2.0, precision="float32").denoise(X, 0.3) for report in ("", REPORTS[0])]


@pytest.fixture
def file(tmp_path):
    save_prior(tiny_prior(), tmp_path / "new" / "tiny.safetensors", {"steps": 12, "data": "phantoms"})
    return tmp_path / "new" / "tiny.safetensors"


def test_a_loaded_prior_denoises_like_the_saved_one_to_half_precision(file):
    for found, expected in zip(estimates(load_prior(file)), estimates(tiny_prior())):
        assert (found - expected).square().mean().sqrt() < 3e-3 * expected.std()


@pytest.mark.parametrize("detail", [False, True], ids=["blocks alone", "with detail"])
def test_saved_in_full_precision_nothing_changes(tmp_path, detail):
    saved = tiny_prior(detail=detail)
    save_prior(saved, tmp_path / "full.safetensors", dtype=torch.float32)
    for found, expected in zip(estimates(load_prior(tmp_path / "full.safetensors")), estimates(saved)):
        assert torch.equal(found, expected)


def test_grid_window_schedule_and_training_come_along(file):
    prior, saved = load_prior(file), tiny_prior()
    assert prior.grid.same_as(saved.grid) and prior.window == saved.window
    assert prior.schedule == saved.schedule and prior.sigma_data == saved.sigma_data
    assert not prior.training and not any(w.requires_grad for w in prior.parameters())
    with safe_open(file, "pt") as opened:
        header = json.loads(opened.metadata()["phydict"])
    assert header["training"] == {"steps": 12, "data": "phantoms"}
    assert header["state"] == ["ct", "lung", "airway", "vessel"]


def test_a_prior_that_the_disk_cannot_hold_is_one_sentence_and_the_old_file_stays(file):
    before = file.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # no file may grow beyond 1000 bytes
    try:
        with pytest.raises(OSError, match="tiny.safetensors' could not be written .*File too large"):
            save_prior(tiny_prior(), file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [*file.parent.iterdir()] == [file] and file.read_bytes() == before


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e5], ids=["NaN", "infinite", "beyond half precision"])
def test_weights_that_are_not_finite_are_not_written_and_named(file, value):
    broken, before = tiny_prior(), file.read_bytes()
    broken.null.view(-1)[3] = value
    with pytest.raises(ValueError, match="tiny.safetensors' was not written, .*: null has 1 NaN or infinite values of"):
        save_prior(broken, file)
    assert file.read_bytes() == before and [*file.parent.iterdir()] == [file]


@pytest.mark.parametrize("part", ["null", "text."])
def test_weights_that_are_not_finite_are_refused_by_name(file, part):
    weights = load_file(file)
    name = next(key for key in weights if key.startswith(part))
    weights[name].view(-1)[0] = float("nan")
    with safe_open(file, "pt") as opened:
        save_file(weights, file, opened.metadata())
    said = rf"tiny.safetensors' holds weights that are not finite \({name} has 1 NaN"
    with pytest.raises(ValueError, match=said):
        load_prior(file).bind(REPORTS[0])  # the text is read with the first report
    with pytest.raises(ValueError, match=said):
        inspect_prior(file)


def test_the_text_encoder_stays_on_disk_until_the_first_report(file):
    prior = load_prior(file)
    prior.bind("", 2.0).denoise(X, 0.5)
    assert prior.text is None
    prior.bind(REPORTS[0])
    assert isinstance(prior.text, TextEncoder) and not prior.text.trainable
    assert prior.text.vocabulary == tiny_prior().text.vocabulary


@pytest.mark.parametrize("spoken", [False, True])
def test_a_loaded_prior_can_be_saved_again_and_still_reads_reports(file, tmp_path, spoken):
    prior = load_prior(file)
    if spoken:
        prior.bind(REPORTS[0])
    save_prior(prior, tmp_path / "again.safetensors")
    for found, expected in zip(estimates(load_prior(tmp_path / "again.safetensors")), estimates(load_prior(file))):
        assert torch.equal(found, expected)


def test_a_prior_without_text_survives_too(tmp_path):
    save_prior(tiny_prior(text=False), tmp_path / "mute.safetensors")
    prior = load_prior(tmp_path / "mute.safetensors")
    assert prior.bind().denoise(X, 0.5).isfinite().all()
    with pytest.raises(ValueError, match="without text"):
        prior.bind(REPORTS[0])


def test_saving_leaves_only_the_complete_file(file):
    save_prior(tiny_prior(seed=1), file)
    assert [f.name for f in file.parent.iterdir()] == ["tiny.safetensors"]
    assert not torch.equal(estimates(load_prior(file))[0], estimates(tiny_prior())[0])


def test_a_pretrained_encoder_is_named_and_not_copied(tmp_path):
    prior, folder = tiny_prior(), tmp_path / "bert"
    prior.text.bert.save_pretrained(folder)
    (folder / "vocab.txt").write_text("\n".join(prior.text.vocabulary))
    prior.text = TextEncoder.pretrained(folder, 24)
    save_prior(prior, tmp_path / "named.safetensors")
    with safe_open(tmp_path / "named.safetensors", "pt") as opened:
        assert not any(key.startswith("text.") for key in opened.keys())
    found = estimates(load_prior(tmp_path / "named.safetensors"))[1]
    assert (found - estimates(prior)[1]).square().mean().sqrt() < 3e-3 * found.std()


@pytest.mark.parametrize("padded_to", [None, 48])
def test_a_prior_reads_reports_as_it_was_trained_to(tmp_path, padded_to):
    write_cxr_bert(tmp_path / "bert")
    prior = tiny_prior()
    prior.text = TextEncoder.pretrained(tmp_path / "bert", 24, padded_to)
    save_prior(prior, tmp_path / "named.safetensors", dtype=torch.float32)
    report = "left nodule " * 15
    assert torch.equal(load_prior(tmp_path / "named.safetensors").context([report]), prior.context([report]))


def test_a_header_from_before_padding_was_a_choice_still_loads(tmp_path):
    write_cxr_bert(tmp_path)
    text = tiny_prior().describe()["text"] | {"source": str(tmp_path), "vocabulary": None}
    assert set(text) == {"source", "length", "width", "layers", "vocabulary"}
    states, mask = build_text(text, {})(REPORTS)
    assert not mask.all() and torch.equal(states, TextEncoder.pretrained(tmp_path, 24)(REPORTS)[0])


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no prior at '.*nowhere.safetensors'"):
        load_prior(tmp_path / "nowhere.safetensors")
    with pytest.raises(FileNotFoundError, match="no prior at"):
        load_prior(tmp_path)  # a folder


def test_a_device_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="^device warp cannot be used"):
        load_prior(device="warp")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_file_is_one_clear_sentence(file, share):
    content = file.read_bytes()
    file.write_bytes(content[:int(share * len(content))])
    with pytest.raises(ValueError, match="truncated or not a safetensors file") as error:
        load_prior(file)
    assert str(file) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"PK\x03\x04 a zip archive" * 20, b"\xff" * 64, b"{}"])
def test_another_kind_of_file_is_one_clear_sentence(tmp_path, content):
    (tmp_path / "other.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="truncated or not a safetensors file"):
        load_prior(tmp_path / "other.safetensors")


@pytest.mark.parametrize("metadata", [None, {"phydict": json.dumps({"format": 99})}, {"format": "pt"}])
def test_safetensors_without_a_prior_of_this_format_are_refused(tmp_path, metadata):
    save_file({"w": torch.zeros(2)}, tmp_path / "other.safetensors", metadata)
    with pytest.raises(ValueError, match="no phydict prior of format 1"):
        load_prior(tmp_path / "other.safetensors")


def with_header(file, weights=None, **changes):
    """The prior in `file` with parts of its header changed and further weights."""
    with safe_open(file, "pt") as opened:
        header = json.loads(opened.metadata()["phydict"])
    save_file(load_file(file) | (weights or {}), file, {"phydict": json.dumps(header | changes)})
    return file


@pytest.mark.parametrize("network, words", [
    ({"res_blocks": 100_000}, "network has 200,000 layers, more than 256"), ({"res_blocks": [100_000, 1]},
    "res_blocks is"),
    ({"channels": []}, "channels is"), ([], "network is"), ("x", "network is"), (3, "network is")])
def test_a_header_of_more_layers_than_can_be_meant_is_refused_before_they_are_made(file, network, words):
    whole = tiny_prior().network.settings | network if isinstance(network, dict) else network
    with pytest.raises(ValueError, match=f"tiny.safetensors' contradicts itself: .*{words}"):
        load_prior(with_header(file, {"long": torch.zeros(10**6, dtype=torch.bool), "none": torch.zeros(10**9, 0)},
                               network=whole))


@pytest.mark.parametrize("window", [[False, True], [-1000, 1e300], ["-1000", "600"], [-1000]])
def test_a_window_is_two_numbers_of_hu(file, window):
    with pytest.raises(ValueError, match="hu_window is .* where two numbers of HU are needed"):
        load_prior(with_header(file, hu_window=window))


def test_weights_of_eight_bits_are_no_trace(file):
    load_prior(with_header(file, {"network.fold.bias": load_file(file)["network.fold.bias"].to(torch.float8_e4m3fn)}))


@pytest.mark.parametrize("change", [{"vocabulary": ["a"] * 3}, {"vocabulary": []}, {"width": 7}])
def test_a_text_encoder_that_contradicts_its_header_names_the_file(file, change):
    with safe_open(file, "pt") as opened:
        text = json.loads(opened.metadata()["phydict"])["text"]
    prior = load_prior(with_header(file, text=text | change))
    with pytest.raises(ValueError, match="tiny.safetensors' contradicts itself: the text encoder"):
        prior.bind(REPORTS[0])


def test_the_shipped_prior_that_hears_no_sides_says_so_and_the_one_that_hears_them_does_not(recwarn):
    prior, hears = load_prior(), load_prior(shipped("data/prior/phydict_64_reports.safetensors"))
    for loaded in (prior, hears):
        loaded.bind("")
        loaded.bind("a nodule in the left lung")
    said = [str(w.message) for w in recwarn]
    assert len(said) == 1 and "phydict_64 takes from a report that there is a finding, not its side" in said[0]
