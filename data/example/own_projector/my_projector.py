"""A projector of one's own: samples along each ray, equally far apart, and the adjoint by automatic differentiation."""

import numpy as np
import torch
from torch.nn.functional import grid_sample

SAMPLES = 128


class MyProjector:
    """A: attenuation (B, 1, X, Y, Z) in 1/mm -> line integrals (B, K, V, U)."""

    def __init__(self, grid, beam):
        self.grid, self.reach = grid, np.linalg.norm(grid.extent) / 2
        self.points = [self._points(source, pixels) for source, pixels in zip(beam.sources, beam.pixels())]

    def __call__(self, mu):
        views = [grid_sample(mu, points.to(mu).expand(len(mu), -1, -1, -1, -1), align_corners=True)
                 for points in self.points]
        return torch.cat(views, 1).sum(-1) * (2 * self.reach / SAMPLES)

    def T(self, xrays):
        mu = torch.zeros(len(xrays), 1, *self.grid.shape).to(xrays)
        with torch.enable_grad():
            return torch.autograd.grad(self(mu.requires_grad_()), mu, xrays)[0]

    def _points(self, source, pixels):
        """Where a view's rays are sampled, (1, V, U, SAMPLES, 3), as grid_sample counts: the last axis first."""
        rays = pixels - source
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        middle = (rays * (self.grid.centre - source)).sum(-1)[..., None]  # mm to where a ray is nearest to the centre
        at = middle + self.reach * (2 * (np.arange(SAMPLES) + 0.5) / SAMPLES - 1)
        index = self.grid.index(source + at[..., None] * rays[..., None, :])
        return torch.from_numpy((2 * index / (np.array(self.grid.shape) - 1) - 1)[None, ..., ::-1].astype(np.float32))
