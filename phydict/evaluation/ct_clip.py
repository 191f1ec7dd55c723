"""CT-CLIP's two towers (Hamamci et al. 2024, arXiv:2403.17834), read from its own checkpoint CT-CLIP_v2.pt.

    volume (1, frames, side, side) -> patches -> spatial, then temporal attention -> nearest codes -> mean over frames
    -> linear -> unit vector           report -> CXR-BERT, first token -> linear -> unit vector

Written anew from the architecture; modules are named as in the checkpoint. Two of its habits are kept, since the
weights were trained with them: attention's keys and values see the tokens before its norm, and the position
convolution of the temporal layers reads tokens that lie in the order (row, column, frame) as if they lay in the order
(frame, row, column).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, interpolate, layer_norm, normalize, pad

from phydict.grid import Grid
from phydict.prior.bert_files import load_bert
from phydict.prior.finite import check_finite
from phydict.prior.tensors import read_torch


@dataclass(frozen=True)
class Towers:
    """Sizes; the defaults are the published model's. side, frames: voxels; patch, frame_patch: of a token."""

    side: int = 480
    frames: int = 240
    patch: int = 20
    frame_patch: int = 10
    width: int = 512
    heads: int = 8
    head_width: int = 32
    depth: int = 4
    codes: int = 8192
    text_width: int = 768
    latent: int = 512


class Norm(nn.Module):
    """Layer norm with a learned scale and a fixed shift."""

    beta: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))
        self.register_buffer("beta", torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return layer_norm(x, x.shape[-1:], self.gamma, self.beta)


class PositionConvolution(nn.Module):
    """A depthwise convolution over (frame, row, column), which sees no later frame."""

    def __init__(self, width: int):
        super().__init__()
        self.dsconv = nn.Conv3d(width, width, 3, groups=width)

    def forward(self, x: Tensor, shape: tuple[int, ...]) -> Tensor:
        volume = x.reshape(*shape, -1).movedim(-1, 1)
        return self.dsconv(pad(volume, (1, 1, 1, 1, 2, 0))).movedim(1, -1).reshape(x.shape)


class Attention(nn.Module):
    """Attention by cosines, scaled by 8."""

    def __init__(self, towers: Towers):
        super().__init__()
        inner = towers.heads * towers.head_width
        self.heads = towers.heads
        self.norm, self.context_norm = Norm(towers.width), Norm(towers.width)
        self.null_kv = nn.Parameter(torch.zeros(towers.heads, 0, towers.head_width))
        self.to_q = nn.Linear(towers.width, inner, bias=False)
        self.to_kv = nn.Linear(towers.width, 2 * inner, bias=False)
        self.q_scale, self.k_scale = (nn.Parameter(torch.ones(towers.head_width)) for _ in range(2))
        self.to_out = nn.Linear(inner, towers.width, bias=False)

    def forward(self, x: Tensor, bias: Tensor | None) -> Tensor:
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
                   for part in (self.to_q(self.norm(x)), *self.to_kv(x).chunk(2, -1)))
        weights = 8 * (normalize(q, dim=-1) * self.q_scale) @ (normalize(k, dim=-1) * self.k_scale).transpose(-1, -2)
        weights = (weights if bias is None else weights + bias).softmax(-1)
        return self.to_out((weights @ v).transpose(1, 2).flatten(2))


class GatedGELU(nn.Module):
    """The first half of the channels, each times the GELU of its partner in the second."""

    def forward(self, x: Tensor) -> Tensor:
        value, gate = x.chunk(2, -1)
        return gelu(gate) * value


class Transformer(nn.Module):
    """Layers of position convolution, attention and a gated perceptron, each added to its input."""

    def __init__(self, towers: Towers):
        super().__init__()
        inner, width = int(4 * (2 / 3) * towers.width), towers.width
        self.layers = nn.ModuleList(nn.ModuleDict({
            "0": PositionConvolution(width), "1": Attention(towers), "3": nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, 2 * inner, bias=False), GatedGELU(), nn.Identity(),
                nn.Linear(inner, width, bias=False))}) for _ in range(towers.depth))
        self.norm_out = Norm(width)

    def forward(self, x: Tensor, shape: tuple[int, ...], bias: Tensor | None = None) -> Tensor:
        for layer in self.layers:
            positions, attention, perceptron = layer.children()
            x = x + positions(x, shape)
            x = x + attention(x, bias)
            x = x + perceptron(x)
        return self.norm_out(x)


class PositionBias(nn.Module):
    """A bias per head (heads, N, N) of the logarithmic distances of N = rows x columns tokens."""

    def __init__(self, towers: Towers):
        super().__init__()
        width = towers.width
        self.net = nn.ModuleList([nn.Sequential(nn.Linear(2, width), nn.LeakyReLU(0.1)),
                                  nn.Sequential(nn.Linear(width, width), nn.LeakyReLU(0.1)),
                                  nn.Linear(width, towers.heads)])

    def forward(self, rows: int, columns: int) -> Tensor:
        device = next(self.parameters()).device
        place = torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device)).float()
        apart = place[:, None] - place[None]
        bias = apart.sign() * (apart.abs() + 1).log()
        for layer in self.net:
            bias = layer(bias)
        return bias.movedim(-1, 0)


class Codebook(nn.Module):
    """The codes that tokens are replaced by (1, codes, width), moving means of unit vectors and so shorter than 1."""

    embed: Tensor

    def __init__(self, towers: Towers):
        super().__init__()
        self.register_buffer("embed", torch.zeros(1, towers.codes, towers.width))


class Quantiser(nn.Module):
    """Each token's nearest code by the cosine."""

    def __init__(self, towers: Towers):
        super().__init__()
        self._codebook = Codebook(towers)

    def forward(self, x: Tensor) -> Tensor:
        codes = self._codebook.embed[0]
        directions = normalize(codes, dim=-1).T
        nearest = [(normalize(part, dim=-1) @ directions).argmax(-1) for part in x.flatten(0, -2).split(4096)]
        return codes[torch.cat(nearest)].view(*x.shape[:-1], -1)


class ImageTower(nn.Module):
    """A volume (B, 1, frames, side, side) in [-1, 1] -> codes (B, frames, rows, columns, width) of its patches."""

    def __init__(self, towers: Towers):
        super().__init__()
        self.towers = towers
        size = towers.patch**2 * towers.frame_patch
        self.spatial_rel_pos_bias = PositionBias(towers)
        self.to_patch_emb = nn.Sequential(nn.Identity(), nn.LayerNorm(size), nn.Linear(size, towers.width),
                                          nn.LayerNorm(towers.width))
        self.enc_spatial_transformer, self.enc_temporal_transformer = Transformer(towers), Transformer(towers)
        self.vq = Quantiser(towers)

    def forward(self, volume: Tensor) -> Tensor:
        batch, p, f = len(volume), self.towers.patch, self.towers.frame_patch
        patches = volume[:, 0].unflatten(1, (-1, f)).unflatten(3, (-1, p)).unflatten(5, (-1, p))  # B t f h p w p
        x = self.to_patch_emb(patches.permute(0, 1, 3, 5, 2, 4, 6).flatten(4))
        frames, rows, columns = shape = x.shape[1:4]
        x = self.enc_spatial_transformer(x.flatten(2, 3).flatten(0, 1), (batch, *shape),
                                         self.spatial_rel_pos_bias(rows, columns))
        x = x.view(batch, frames, rows * columns, -1).transpose(1, 2).flatten(0, 1)
        x = self.enc_temporal_transformer(x, (batch, *shape))
        x = x.view(batch, rows * columns, frames, -1).transpose(1, 2)
        return self.vq(x).view(batch, *shape, -1)


class CTCLIP(nn.Module):
    """Latents of volumes and reports whose cosines are CT-CLIP's scores.

    bert, tokenizer: CXR-BERT, None without the text tower.
    """

    def __init__(self, towers: Towers = Towers(), bert: nn.Module | None = None, tokenizer=None):
        super().__init__()
        tokens = (towers.side // towers.patch) ** 2
        self.towers, self.tokenizer = towers, tokenizer
        self.visual_transformer, self.text_transformer = ImageTower(towers), bert
        self.to_visual_latent = nn.Linear(tokens * towers.width, towers.latent, bias=False)
        self.to_text_latent = nn.Linear(towers.text_width, towers.latent, bias=False)

    @torch.no_grad()
    def image(self, volume: Tensor) -> Tensor:
        """Unit latents (B, latent) of prepared volumes (B, 1, frames, side, side)."""
        return normalize(self.to_visual_latent(self.visual_transformer(volume).mean(1).flatten(1)), dim=-1)

    @torch.no_grad()
    def text(self, report: str) -> Tensor:
        """The unit latent (1, latent) of a report, worded by `plain` and cut at 512 words."""
        if self.text_transformer is None:
            raise ValueError("CT-CLIP was read without its text tower: give clip.text")
        words = self.tokenizer(plain(report), return_tensors="pt", padding="max_length", truncation=True,
                               max_length=512)
        words = words.to(self.to_text_latent.weight.device)
        first = self.text_transformer(**words).last_hidden_state[:, 0]
        return normalize(self.to_text_latent(first), dim=-1)


def load_ct_clip(file: str | Path, text: str | Path | None = None, towers: Towers = Towers()) -> CTCLIP:
    """CT-CLIP from its checkpoint, in evaluation mode; `text`: a folder with CXR-BERT's config.json, weights and
    vocabulary, or its hub id, None for the image tower alone.

    Raises ValueError or FileNotFoundError, in one sentence, where a file is missing or is not CT-CLIP's.
    """
    if not Path(file).is_file():
        raise FileNotFoundError(f"there is no file {file}: give clip.weights CT-CLIP's checkpoint, CT-CLIP_v2.pt")
    tokenizer, bert = load_bert(text) if text else (None, None)
    model = CTCLIP(towers, bert, tokenizer)
    weights = read_torch(file)
    tensors = {name: value for name, value in weights.items() if isinstance(value, Tensor)} if isinstance(
        weights, dict) else {}
    wanted = model.state_dict()
    wrong = next((name for name, value in wanted.items()
                  if name not in tensors or tensors[name].shape != value.shape), None)
    if wrong:
        raise ValueError(f"{file} is not CT-CLIP's checkpoint ({wrong} is missing or of another shape): give "
                         "CT-CLIP_v2.pt")
    tensors = {name: tensors[name] for name in wanted}
    check_finite(tensors, file)
    model.load_state_dict(tensors)
    return model.eval().requires_grad_(False)


def plain(report: str) -> str:
    """A report as CT-CLIP's inference reads it: findings, then impression, without headings, quotes and brackets."""
    return re.sub("[\"'()]", "", re.sub(r"(^Findings|(^| )Impression): ", " ", report)).strip()


def prepared(hu: Tensor, grid: Grid, towers: Towers = Towers()) -> Tensor:
    """A volume (X, Y, Z) in HU, RAS+, as CT-CLIP's inference reads it: (1, 1, frames, side, side) in [-1, 1].

    Axes to left, posterior, superior; clipped to [-1000, 1000] HU; 0.75 x 0.75 x 1.5 mm by linear interpolation; cut or
    padded with air about the middle, an odd voxel at the far end; slices first.
    """
    sizes = [max(1, int(n * (mm / step))) for n, mm, step in zip(grid.shape, grid.spacing, (0.75, 0.75, 1.5))]
    volume = interpolate(hu.float().clamp(-1000, 1000).flip(0, 1)[None, None], sizes, mode="trilinear") / 1000
    margins: list[int] = []
    for have, want in zip(sizes[::-1], (towers.frames, towers.side, towers.side)):
        before = int((want - have) / 2)
        margins += [before, want - have - before]
    return pad(volume, margins, value=-1.0).permute(0, 1, 4, 2, 3)


def image_latent(model: CTCLIP, hu: Tensor, grid: Grid) -> Tensor:
    """The unit latent (1, latent) of a volume (X, Y, Z) in HU."""
    return model.image(prepared(hu, grid, model.towers).to(model.to_text_latent.weight.device))


def clip_scores(model: CTCLIP, hu: Tensor, true_latent: Tensor, grid: Grid, report: str = "") -> dict[str, float]:
    """{"clip_i2i": and, with a report and a text tower, "clip_t2i"} in percent: 100 max(cos, 0) of the latents of the
    volume (X, Y, Z) in HU and of the truth, which is given, and of the report."""
    image = image_latent(model, hu, grid)
    scores = {"clip_i2i": 100 * max(float((image * true_latent).sum()), 0.0)}
    if report and model.text_transformer is not None:
        scores["clip_t2i"] = 100 * max(float((image * model.text(report)).sum()), 0.0)
    return scores
