"""CT-CLIP's towers: the checkpoint's names and shapes, its files, the preparation of volumes, and the scores."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from evaluation.tiny_ct_clip import TINY, tiny

from phydict.evaluation.ct_clip import CTCLIP, clip_scores, image_latent, load_ct_clip, prepared
from phydict.grid import Grid

GRID = Grid((32, 32, 24), (0.75, 0.75, 1.5))


def hu(seed: int) -> torch.Tensor:
    return 500 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(seed))


def test_names_and_shapes_are_the_checkpoints():
    with torch.device("meta"):
        found = {name: tuple(weight.shape) for name, weight in CTCLIP().state_dict().items()}
    vit = "visual_transformer"
    for name, shape in {
            f"{vit}.to_patch_emb.1.weight": (4000,), f"{vit}.to_patch_emb.2.weight": (512, 4000),
            f"{vit}.enc_spatial_transformer.layers.3.0.dsconv.weight": (512, 1, 3, 3, 3),
            f"{vit}.enc_temporal_transformer.layers.0.1.to_q.weight": (256, 512),
            f"{vit}.enc_temporal_transformer.layers.0.1.to_kv.weight": (512, 512),
            f"{vit}.enc_spatial_transformer.layers.0.3.1.weight": (2730, 512),
            f"{vit}.enc_spatial_transformer.layers.0.3.4.weight": (512, 1365),
            f"{vit}.spatial_rel_pos_bias.net.2.weight": (8, 512), f"{vit}.vq._codebook.embed": (1, 8192, 512),
            "to_visual_latent.weight": (512, 294912), "to_text_latent.weight": (512, 768)}.items():
        assert found[name] == shape, name


def test_the_truth_scores_100_and_noise_less():
    model, truth = tiny(), hu(0)
    latent = image_latent(model, truth, GRID)
    assert clip_scores(model, truth, latent, GRID) == {"clip_i2i": pytest.approx(100)}
    assert clip_scores(model, hu(1), latent, GRID)["clip_i2i"] < 99.9


def test_a_report_is_scored_by_its_latent_and_a_negative_cosine_counts_as_none():
    model = tiny()
    image = model.image(prepared(hu(0), GRID, TINY))
    model.tokenizer = lambda report, **_: SimpleNamespace(to=lambda device: {"sign": 1.0 if report == "so" else -1.0})
    wanted = torch.linalg.lstsq(model.to_text_latent.weight, image[0]).solution
    nearest = torch.nn.functional.normalize(model.to_text_latent.weight @ wanted, dim=0)

    class Bert(torch.nn.Module):
        def forward(self, sign):
            return SimpleNamespace(last_hidden_state=sign * wanted[None, None])

    model.text_transformer = Bert()
    scores = [clip_scores(model, hu(0), image, GRID, report) for report in ("so", "not so")]
    assert scores[0]["clip_t2i"] == pytest.approx(100 * float(nearest @ image[0]), rel=1e-3)
    assert scores[0]["clip_t2i"] > 10
    assert scores[1]["clip_t2i"] == 0 and "clip_t2i" not in clip_scores(model, hu(0), image, GRID)


def test_a_checkpoint_comes_back_with_its_further_entries_left_out(tmp_path):
    model = tiny()
    torch.save(model.state_dict() | {"temperature": torch.tensor(1.0)}, tmp_path / "clip.pt")
    found, x = load_ct_clip(tmp_path / "clip.pt", towers=TINY), prepared(hu(0), GRID, TINY)
    assert torch.equal(found.image(x), model.image(x)) and found.image(x).norm() == pytest.approx(1)
    assert not found.training and not any(weight.requires_grad for weight in found.parameters())


def test_what_is_no_checkpoint_of_ct_clip_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"clip.weights CT-CLIP's checkpoint"):
        load_ct_clip(tmp_path / "none.pt")
    torch.save({"a": torch.zeros(1)}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match=r"is not CT-CLIP's checkpoint \(.* is missing"):
        load_ct_clip(tmp_path / "other.pt", towers=TINY)
    torch.save(tiny().state_dict() | {"to_text_latent.weight": torch.full((8, 6), torch.nan)}, tmp_path / "nan.pt")
    with pytest.raises(ValueError, match="NaN"):
        load_ct_clip(tmp_path / "nan.pt", towers=TINY)


def test_volumes_are_turned_to_slices_rows_and_columns_cut_about_the_middle_and_padded_with_air():
    volume = torch.full(GRID.shape, -1000.0)
    volume[4, 8, 17] = 600  # left of the middle, posterior, superior
    got = prepared(volume, GRID, TINY)
    assert got.shape == (1, 1, 12, 24, 24) and got.max() == pytest.approx(0.6)
    assert [int(i) for i in (got[0, 0] > 0).nonzero()[0]] == [17 - 6, 31 - 4 - 4, 31 - 8 - 4]
    small = prepared(torch.zeros(8, 8, 8), Grid((8, 8, 8), (0.75, 0.75, 1.5)), TINY)
    assert (small == 0).sum() == 8**3 and (small == -1).sum() == small.numel() - 8**3
    assert prepared(torch.full(GRID.shape, 3000.0), GRID, TINY).max() == 1
