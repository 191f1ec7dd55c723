"""CT-CLIP's image tower in a size that takes no time, with random weights."""

import torch

from phydict.evaluation.ct_clip import CTCLIP, Towers

TINY = Towers(side=24, frames=12, patch=6, frame_patch=3, width=16, heads=2, head_width=4, depth=2, codes=32,
              text_width=6, latent=8)


def tiny() -> CTCLIP:
    torch.manual_seed(0)
    model = CTCLIP(TINY)
    for weight in [*model.parameters(), model.visual_transformer.vq._codebook.embed]:
        torch.nn.init.normal_(weight, std=0.5)
    return model.eval().requires_grad_(False)
