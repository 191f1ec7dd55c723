"""Settings and classes that once had another name or place: the old one is refused with the new one's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from phydict.runtime.yaml_file import parse_yaml

CONFIGURATION = ("-c", "--config")
"""Options that name a configuration file, or hold settings themselves."""

SAMPLER = {
    "fresh_noise": "noise_fraction", "overshoot": "momentum", "randomised_noise": "sampling_noise",
    "warm_start": "t_start", "last": "t_end", "refine_from": "ec_delta", "refine_iterations": "ec_steps",
    "refine_guided": "ec_guided", "at_zero": "final_denoise", "renewed": "eta (of DDS) or zeta (of DiffPIR)",
    "trust": "prior_weight"}
LIKELIHOOD = {"variation": "tv_weight", "edge": "tv_eps", "refit": "refit_scatter",
              "weighted": "weighted_least_squares"}
FIELDS = {"method": SAMPLER, "sampler": SAMPLER, "likelihood": LIKELIHOOD, "final_likelihood": LIKELIHOOD,
          "augmentation": {"waves": "elastic_mm", "gain": "hu_scale", "offset": "hu_offset",
                           "table": "surroundings.table", "field": "surroundings.field"}}
"""Of the settings in each place, old name -> new name."""

GROUPS = {
    "model.sampling": ("guidance", "samples", "precision"),
    "model.optimisation": ("learning_rate", "weight_decay", "warmup", "decay_from", "decay_steps", "sigma_data",
                           "mask_weight"),
    "model.validation": ("preview_steps",), "model.execution": ("gradient_checkpointing", "channels_last", "compile"),
    "data.source": ("reports", "metadata", "fixed", "first_reconstruction", "exclude"),
    "data.orbit": ("views", "source_to_detector", "source_to_isocentre", "detector", "pixel"),
    "data.loading": ("epoch_size", "batch_size", "workers", "ct_fraction")}
"""Groups of settings that once lay beside them, model.guidance as model.sampling.guidance."""

PLACES = {
    "model.calibrate": "calibrate", "model.voxels": "model.grid (of infer.py) or model.cube.voxels (of train.py)",
    "model.side": "model.grid.side (of infer.py) or model.cube.side (of train.py)",
    "model.guide_fine": "model.super_resolution.guided", "model.sr_guided": "model.super_resolution.guided",
    "model.fine_sampler": "model.super_resolution.sampler", "model.sr_sampler": "model.super_resolution.sampler",
    "model.fine_noise": "model.super_resolution.noise_augmentation",
    "model.sr_noise_augmentation": "model.super_resolution.noise_augmentation",
    "model.fine_memory": "model.super_resolution.memory", "model.sr_memory": "model.super_resolution.memory",
    "data.with_report": "model.sampling.with_report",
    "model.super_resolution.path": "model.super_resolution.file.path",
    "model.montage_steps": "model.validation.preview_steps", "model.validation_views": "model.validation.views",
    "model.text_length": "model.text.length", "model.text_padded_to": "model.text.padded_to",
    "model.text_dropout": "model.text.dropout", "model.text_steps": "model.text.pretrain_steps",
    "model.text_pretrain_steps": "model.text.pretrain_steps", "data.holdout_fraction": "data.holdout.fraction",
    "data.validation_phantoms": "data.holdout.phantoms", "data.crop": "data.crops.size",
    "data.validation_crops": "data.crops.validation",
} | {f"{group.partition('.')[0]}.{name}": f"{group}.{name}" for group, names in GROUPS.items() for name in names}
"""Old path of a setting -> new path."""

VALUES = {"model.super_resolution": "model.super_resolution.file", "model.text": "model.text.encoder",
          "data.holdout": "data.holdout.ids"}
"""What was one value and is now a group of settings -> which of them it is."""

MODULES = {
    "phydict.datamodule": "phydict.training", "phydict.prior_training": "phydict.training",
    "phydict.super_resolution_data": "phydict.training", "phydict.super_resolution_training": "phydict.training",
    "phydict.reconstruction_data": "phydict.inference", "phydict.reconstructor": "phydict.reconstruction",
    "phydict.training_progress": "phydict.training.progress", "phydict.throughput": "phydict.training.throughput",
    "phydict.prior.medsyn": "phydict.prior.medsyn.prior", "phydict.prior.pretrained": "phydict.prior.medsyn.checkpoint"
} | {f"phydict.posterior.{name}": "phydict.posterior" for name in (
    "admm_tv", "daps", "dds", "diffpir", "dps", "langevin", "likelihood", "likelihood_draw", "pnp_dm", "prior_only",
    "reward", "sampler", "split_gibbs")}
"""Old module of classes that a setting may be -> where they are now."""


def check_setting(path: str, value: object = None) -> None:
    """Raises ValueError, in one sentence with the new name, where `path` (a.b.init_args.c), a part of it or what
    `value`, nested settings, holds is an old setting, or where a text is an old class."""
    place: list[str] = []
    parts = path.split(".")
    for n, name in enumerate(parts, 1):
        if name == "init_args":
            continue
        new = FIELDS.get(place[-1], {}).get(name) if place else None
        place.append(name)
        if new := new or PLACES.get(".".join(place)):
            raise ValueError(f"{'.'.join(parts[:n])} is now {new}: rename it")
    if path in VALUES and value is not None and not isinstance(value, Mapping) and not str(value).startswith("{"):
        raise ValueError(f"{path} is now {VALUES[path]}: rename it")
    if isinstance(value, Mapping):
        for name, inner in value.items():
            check_setting(f"{path}.{name}" if path else str(name), inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            check_setting(path, inner)
    elif isinstance(value, str) and (module := MODULES.get(value.rpartition(".")[0])):
        raise ValueError(f"{path} is {value}, which is now {module}.{value.rpartition('.')[2]}: rename it")


def check_options(args: Sequence[str]) -> None:
    """Raises ValueError, as `check_setting` does, for what a command line gives as `--path=value` or `--path value`,
    and for settings that stand in a configuration's place."""
    for arg, following in zip(args, [*args[1:], ""]):
        option, equals, value = arg.partition("=")
        value = value if equals else following
        if option in CONFIGURATION:
            check_setting("", _settings(value) if ":" in value else {})
        elif option.startswith("--"):
            check_setting(option[2:], _settings(value) if value.startswith("{") else value)


def _settings(text: str) -> object:
    """Settings written as YAML; the text itself where it is none, which the command line's own parser refuses."""
    try:
        return parse_yaml(text, "settings")
    except ValueError:
        return text
