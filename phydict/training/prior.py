"""Training the base prior: its text first, then denoising."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from phydict.datasets import MASKS
from phydict.datasets.phantoms.findings import KINDS
from phydict.datasets.phantoms.teaching import teaching_sentences
from phydict.datasets.prose import written_words
from phydict.datasets.reports import read_texts
from phydict.diffusion import Denoiser
from phydict.evaluation import method_panel
from phydict.grid import Cube
from phydict.prior import DetailNetwork, Prior, TextEncoder, VolumeUNet, learn_vocabulary, load_prior
from phydict.prior.unet import TextMap
from phydict.runtime.progress import CaseProgress
from phydict.runtime.warning import warn
from phydict.training.denoising import DenoisingTraining
from phydict.training.reports import BATCH, learn_sentences
from phydict.training.scores import reconstruction_scores
from phydict.training.settings import Execution, PriorOptimisation, PriorValidation, TextSettings
from phydict.training.sharding import shard
from phydict.training.stage import check_continues, check_network
from phydict.units import HUWindow
from phydict.xray.boxes import in_other_voxels

SENTENCES, VOCABULARY_SIZE = 20_000, 5000
SENTENCE_LENGTH, MOST_SENTENCES = 64, 64
"""Tokens that a small encoder reads of a sentence, and sentences that it reads of a report."""


class PriorTraining(DenoisingTraining):
    """Learns a Prior, first its text, then denoising.

    Args:
        network: the UNet; none given: that of initial, else the default VolumeUNet
        text: what reads reports, and how it learns to
        detail: the network for what the UNet's blocks of voxels cannot hold; none given: the default DetailNetwork
        cube: of voxels
        window: HU that the prior's range [-1, 1] stands for
        optimisation: how the weights are learnt
        validation: what validation shows and measures
        execution: how the network is run
        initial: a prior's file to start from, which then decides the networks and the text, and may be of other voxels
            over the same box, such as coarser ones that it learnt from first; one without a detail network is given
            this training's
        seed: of times, noise and text dropout
    """

    prior: Prior

    def __init__(self, network: VolumeUNet | None = None, text: TextSettings = TextSettings(),
                 detail: DetailNetwork | None = None, cube: Cube = Cube(),
                 window: tuple[float, float] = (-1000.0, 1000.0), optimisation: PriorOptimisation = PriorOptimisation(),
                 validation: PriorValidation = PriorValidation(), execution: Execution = Execution(),
                 initial: str | None = None, seed: int = 0):
        if text.renew and not initial:
            raise ValueError("model.text.renew gives a prior a new text side, but none was given to start from: give "
                             "model.initial, or leave it out")
        requested, network = network is not None, network or VolumeUNet()
        if network.state_channels > 1 + len(MASKS):
            raise ValueError(f"model.network has state_channels for a CT and up to {len(MASKS)} masks, at most "
                             f"{1 + len(MASKS)}, but {network.state_channels} was given")
        encoder = None if initial else _text_encoder(text, network)
        prior = Prior(network, cube.grid(), HUWindow(*window), encoder, sigma_data=optimisation.sigma_data,
                      detail=detail or DetailNetwork(network.state_channels))
        if initial:
            prior = _loaded(initial, prior)
            check_network("prior", initial, prior.network.settings, network.settings if requested else {})
            if detail and prior.detail:
                check_network("prior", initial, prior.detail.settings, detail.settings, "detail")
            if not text.renew:
                _check_text(text, initial, prior.text)
        if text.renew:
            prior = _renewed(prior, _text_encoder(text, prior.network))
        new_text = text.renew or not initial
        super().__init__(prior, prior.sigma_data, optimisation, validation.preview_steps, seed,
                         optimisation.mask_weight, initial)
        reader = self.prior.text
        if reader is not None and text.reports:
            reader.check(text.reports)
        self.prior.network.run_with(execution.gradient_checkpointing, execution.channels_last, execution.compile)
        own_text = reader is not None and reader.source is None
        self.text_dropout, self.pretrain_steps = text.dropout, text.pretrain_steps if own_text and new_text else 0
        self.validation_views = validation.views
        if reader is not None and own_text and text.frozen and (self.pretrain_steps or not new_text):
            self._keep_text(reader)

    def _keep_text(self, reader: TextEncoder) -> None:
        """What reads reports and draws what they say stays as it is."""
        reader.trainable = False
        for part in (reader, self.prior.network.text_map, self.prior.null):
            part.requires_grad_(False)

    def configure_model(self) -> None:
        mesh = self.device_mesh  # only of a strategy that shards the weights
        if mesh is None:
            return
        if self.averaging():
            raise ValueError("sharded weights cannot be averaged: train without EMAWeightAveraging "
                             "(trainer.callbacks: null), as configs/prior/fsdp.yaml does")
        # A sharded optimizer resumes only if it has moved each of its weights: those that denoising leaves alone rest.
        if isinstance(self.prior.network.text_map, TextMap):
            self.prior.network.text_map.to_sketch.requires_grad_(False)
        shard(self.prior, mesh["data_parallel"])

    def _condition(self, batch: dict, x0: Tensor, generators: list[torch.Generator]) -> tuple[Tensor, ...]:
        reports = batch["report"] if self.prior.text is not None else [""] * len(x0)
        keep = [float(torch.rand(1, generator=generator)) >= self.text_dropout for generator in generators]
        return (self.prior.context([r if k else "" for r, k in zip(reports, keep)]),)

    def _denoiser(self, batch: dict, x0: Tensor) -> Denoiser:
        return self.prior.bind(batch["report"][0] if self.prior.text is not None else "")

    def validation_step(self, batch: dict, index: int) -> None:
        super().validation_step(batch, index)
        if not self.validation_views or self.device_mesh is not None:
            return
        with torch.autocast(self.device.type, enabled=False):
            scores = reconstruction_scores(self.prior, batch["volume"], self.validation_views,
                                           self.validation_number(index))
        for name in ("psnr", "ssim"):
            self.log_case(index, f"val/{name}", scores[name], prog_bar=name == "psnr")

    def _write_preview(self, file: Path, batch: dict, x0: Tensor, sample: Tensor) -> None:
        window = self.prior.window
        method_panel(file, {"prior sample": window.to_hu(sample[0, 0].cpu())}, window.to_hu(x0[0, 0].cpu()),
                     self.prior.grid, title=batch["report"][0][:80] or "no report")

    def learn_reports(self) -> None:
        """Teaches a new small report encoder and the map of kinds, once, before the first denoising step.

        It belongs before `fit`, since distributed training watches every backward pass from there on.
        """
        if not self.pretrain_steps or self.prior.text is None:
            return
        sentences = teaching_sentences(min(SENTENCES, BATCH * self.pretrain_steps), self.seed)
        words = [word for word in self.prior.text.vocabulary if word.isalpha() and len(word) > 1]
        with CaseProgress() as progress:
            progress.begin("report encoder and map of kinds", 1, self.pretrain_steps, "learn",
                           noun=f"set of {len(sentences)} sentences")
            progress.case("sentences")
            losses = learn_sentences(self.prior, sentences, self.pretrain_steps, self.seed, words, progress.advance)
            progress.finished(f"loss {losses[0]:.3f} -> {losses[-1]:.3f}")

    def _clean_state(self, batch: dict) -> tuple[Tensor, Tensor]:
        channels = self.prior.network.state_channels
        x0 = torch.cat([batch["volume"], 2 * batch["masks"] - 1], 1)[:, :channels]
        known = self.mask_weight * batch["has_masks"].float()
        weight = torch.cat([torch.ones_like(known[:, :1]), known], 1)[:, :channels]
        return x0, weight[..., None, None, None]


def _loaded(path: str, requested: Prior) -> Prior:
    """The prior in a file, to be trained on the voxels of `requested`, whose detail network it is given where it has
    none."""
    prior = load_prior(path)
    if not isinstance(prior, Prior):
        raise ValueError(f"training starts from priors of phydict's own, but {path} is MedSyn's: leave out "
                         "model.initial")
    if prior.grid.same_as(in_other_voxels(requested.grid, prior.grid.shape)):
        prior.work_on(requested.grid)
    check_continues("prior", path, prior, requested.grid, requested.window)
    if prior.load_text is not None:
        prior.text, prior.load_text = prior.load_text(), None
        prior.text.trainable = prior.text.source is None
    prior.detail = prior.detail or requested.detail
    prior = prior.train().requires_grad_(True)
    if prior.text is not None:
        prior.text.requires_grad_(prior.text.trainable)
    return prior


def _check_text(text: TextSettings, initial: str, own: TextEncoder | None) -> None:
    """Raises ValueError where settings of a new text side were given beside a prior that brings its own."""
    has = {"encoder": "none" if own is None else own.source or "small", "length": getattr(own, "length", None),
           "padded_to": getattr(own, "padded_to", None), "texts": None}
    for name, value in has.items():
        if (given := getattr(text, name)) not in (value, getattr(TextSettings, name)):
            raise ValueError(f"model.text.{name} is {given}, but the prior {initial} that training continues from has "
                             "what reads reports already: leave it out, or set model.text.renew for a new text side")


def _renewed(prior: Prior, text: TextEncoder | None) -> Prior:
    """A prior with other text; without a report it is the same but for the map that was laid over its input."""
    renewed = Prior(prior.network, prior.grid, prior.window, text, prior.schedule, prior.sigma_data, prior.skip_std,
                    detail=prior.detail)
    renewed.null = prior.null
    return renewed.train()


def _text_encoder(text: TextSettings, network: VolumeUNet) -> TextEncoder | None:
    """What `text` asks for to read reports; a small one also gives the network a map for each kind of finding."""
    if text.encoder == "none":
        return None
    if text.encoder != "small":
        return TextEncoder.pretrained(text.encoder, text.length, text.padded_to)
    if not text.reports:
        warn("the data have no reports: this prior will know no text")
        return None
    network.draw_kinds(KINDS)
    texts = read_texts(text.texts) if text.texts else []
    vocabulary = learn_vocabulary([*written_words(), *text.reports, *texts], VOCABULARY_SIZE)
    return TextEncoder.small(vocabulary, network.context_dim, length=SENTENCE_LENGTH, sentences=MOST_SENTENCES)
