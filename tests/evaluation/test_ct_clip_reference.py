"""CT-CLIP's scores beside those of its authors' code, of weights, volumes and a report that formulas give.

The figures are what the repository ibrahimethemhamamci/CT-CLIP gives: CTViT and CTCLIP (commits 7edd2e0, 0544c3a and
b0a0e80, vector-quantize-pytorch 1.1.2), volumes prepared as by its scripts/data_inference_nii.py (commit 13d84fb),
scores as by ctgen_evaluation/evaluate_clip.py of forithmus/VLM3D-Dockers (commit 2fd55f1).
"""

from __future__ import annotations

import math
import zlib

import pytest
import torch
from torch import Tensor
from transformers import BertConfig, BertModel

from phydict.datasets import join_report
from phydict.evaluation.ct_clip import CTCLIP, Towers, clip_scores, image_latent, load_ct_clip, plain, prepared
from phydict.grid import Grid

TOWERS = Towers(side=24, frames=12, patch=6, frame_patch=3, width=16, heads=2, head_width=4, depth=2, codes=32,
                text_width=8, latent=8)
GRID = Grid((40, 29, 31), (0.6, 0.6, 1.5))
FINDINGS, IMPRESSION = "Nodule (5 mm) in the 'upper' lobe.", "No pleural effusion."
WORDS = "[PAD] [UNK] [CLS] [SEP] [MASK] . ( ) ' : 5 mm in the upper lobe nodule no pleural effusion findings impression"
BERT = BertConfig(vocab_size=len(WORDS.split()), hidden_size=8, num_hidden_layers=2, num_attention_heads=2,
                  intermediate_size=16)


def wave(name: str, shape: tuple[int, ...]) -> Tensor:
    """Values in [-1, 1] that look random."""
    n = torch.arange(math.prod(shape), dtype=torch.float64)
    return (0.7 * n**2 + zlib.crc32(name.encode()) % 1000).sin().float().view(shape)


def weight(name: str, shape: tuple[int, ...]) -> Tensor:
    """A scale about 1, a shift, a matrix that keeps lengths, or codes of several lengths."""
    values = wave(name, shape)
    if name.endswith("embed"):
        return values * torch.linspace(0.05, 0.5, shape[1])[:, None]
    if len(shape) == 1:
        return (0.0 if name.endswith(("bias", "beta")) else 1.0) + 0.3 * values
    return values * (2 / max(1, math.prod(shape[1:]))) ** 0.5


def hu(name: str) -> Tensor:
    return 700 * (wave("patient", GRID.shape) + wave(name, GRID.shape))


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> CTCLIP:
    folder = tmp_path_factory.mktemp("cxr-bert")
    (folder / "vocab.txt").write_text("\n".join(WORDS.split()))
    BertModel(BERT).save_pretrained(folder)
    names = CTCLIP(TOWERS, BertModel(BERT)).state_dict()
    torch.save({name: weight(name, tuple(w.shape)) for name, w in names.items()}, folder / "CT-CLIP_v2.pt")
    return load_ct_clip(folder / "CT-CLIP_v2.pt", folder, TOWERS)


def test_latents_and_scores_are_the_authors(model):
    report = join_report(FINDINGS, IMPRESSION)
    image = [0.173841, 0.10507, -0.427961, 0.122372, 0.463267, -0.686814, 0.077743, -0.261229]
    text = [0.153641, 0.06557, -0.74431, 0.280333, 0.32203, -0.060431, 0.383532, -0.291647]
    assert model.image(prepared(hu("made"), GRID, TOWERS))[0].tolist() == pytest.approx(image, abs=1e-4)
    assert model.text(report)[0].tolist() == pytest.approx(text, abs=1e-4)
    assert clip_scores(model, hu("made"), image_latent(model, hu("true"), GRID), GRID, report) == {
        "clip_i2i": pytest.approx(62.5258, abs=0.01), "clip_t2i": pytest.approx(68.3133, abs=0.01)}


def test_the_code_nearest_by_direction_is_taken_at_its_own_length(model):
    quantiser = model.visual_transformer.vq
    codes = quantiser._codebook.embed[0]
    assert codes.norm(dim=-1).max() > 5 * codes.norm(dim=-1).min()
    assert torch.equal(quantiser(3 * codes), codes)


def test_a_report_is_read_without_headings_quotes_and_brackets():
    assert plain(join_report(FINDINGS, IMPRESSION)) == "Nodule 5 mm in the upper lobe. No pleural effusion."
    assert plain(join_report("Not given.", IMPRESSION)) == IMPRESSION
    assert plain("Impression of the findings: none.") == "Impression of the findings: none."


@pytest.mark.parametrize("shape, kept", [((27, 21, 1), slice(1, 25)), ((26, 21, 1), slice(1, 25))])
def test_an_odd_voxel_is_cut_and_padded_at_the_far_end(shape, kept):
    volume = 100 + torch.arange(shape[0]).float().view(-1, 1, 1).expand(shape)
    got = prepared(volume.flip(0), Grid(shape, (0.75, 0.75, 1.5)), TOWERS)[0, 0, 5]
    assert torch.allclose(1000 * got[:, 1], torch.arange(100.0, 100 + shape[0])[kept])
    assert (got[:, [0, 22, 23]] == -1).all() and (got[:, 1:22] > 0).all()


def test_metal_is_clipped_before_it_is_averaged_with_its_neighbours():
    volume = torch.zeros(24, 24, 24)
    volume[:, :, 12] = 3000
    assert prepared(volume, Grid(volume.shape, (0.75, 0.75, 0.75)), TOWERS).max() == pytest.approx(0.5)
