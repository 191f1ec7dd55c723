"""Throughput: FLOP are those of the layers, counted by hand, and the rates follow from them."""

import csv
from types import SimpleNamespace

import pytest
import torch
from command_lines import arguments
from prior.tiny import tiny_prior

from phydict.cli.train import main
from phydict.grid import Grid
from phydict.prior import Prior, VolumeUNet
from phydict.runtime.precision import instruction_set
from phydict.training.throughput import Throughput, sample_flop
from phydict.units import HUWindow


def test_flop_are_those_of_the_layers_three_times():
    """Forward, gradient of the input and gradient of the weights cost the same, but the input itself needs none."""
    network, counted = VolumeUNet(4, 2, (16, 16), (False, False), 2, 8), []

    def count(layer, inputs, output):
        weights = layer.weight.numel() / (layer.out_channels if hasattr(layer, "out_channels") else layer.out_features)
        counted.append(2 * output.numel() * weights * (2 if layer is network.fold else 3))

    for layer in network.modules():
        if isinstance(layer, (torch.nn.Conv3d, torch.nn.Linear)):
            layer.register_forward_hook(count)
    network(torch.zeros(1, 4, 32, 32, 32), torch.zeros(1), torch.zeros(1, 1, 64))
    prior = Prior(network, Grid.cube(32), HUWindow())
    assert 1 <= sample_flop(prior, (32, 32, 32)) / sum(counted) < 1.05  # attention's own products are in no layer


def test_flop_are_counted_without_touching_the_prior():
    prior = tiny_prior()
    before = {name: weight.clone() for name, weight in prior.state_dict().items()}
    assert sample_flop(prior, prior.grid.shape) > 0
    assert all(torch.equal(weight, before[name]) for name, weight in prior.state_dict().items())


def test_rates_follow_from_one_another(cache, tmp_path, capsys):
    main(arguments(tmp_path, cache, "--trainer.max_epochs=1", "--trainer.limit_val_batches=0", "--throughput.peak=0.5"))
    said = capsys.readouterr().err
    assert f"weights in float32 on {instruction_set(torch.device('cpu'))}: a sample costs" in said
    assert "GFLOP forward and backward" in said and "0.5 TFLOP/s" in said
    with next(tmp_path.glob("logs/**/metrics.csv")).open() as file:
        rows = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]
    rows = [row for row in rows if "samples_per_s" in row]
    assert len(rows) == 3
    for row in rows:
        assert row["share_of_peak"] == pytest.approx(row["tflop_per_s"] / 0.5, rel=1e-4)
        assert row["tflop_per_s"] / row["samples_per_s"] == pytest.approx(
            rows[0]["tflop_per_s"] / rows[0]["samples_per_s"], rel=1e-4)


def test_a_peak_is_positive():
    with pytest.raises(ValueError, match="positive"):
        Throughput(peak=0.0)


def test_seconds_of_validations_and_checkpoints_are_none_of_a_step(monkeypatch):
    """Of steps of one second each, with a validation or a checkpoint of a hundred after every third."""
    clock, rates, meter = [0.0], [], Throughput(peak=1.0)
    monkeypatch.setattr("phydict.training.throughput.time.perf_counter", lambda: clock[0])
    trainer = SimpleNamespace(world_size=1)
    module = SimpleNamespace(log=lambda name, value, **_: rates.append(value) if name == "samples_per_s" else None)
    meter.on_fit_start(trainer, module)
    meter.flop = 1
    for step in range(12):
        meter.on_train_batch_start(trainer, module, {"volume": torch.zeros(2, 1)}, step)
        clock[0] += 1
        if step % 6 == 2:
            meter.on_validation_start(trainer, module)
            clock[0] += 100
        if step % 6 == 5:
            meter.on_save_checkpoint(trainer, module, {})
            clock[0] += 100
    assert rates == [2.0] * 8
