"""What --help shows: the settings of the method given, own options each with a sentence, Lightning's of use alone."""

import re

import pytest

from phydict.cli.infer import main as infer
from phydict.cli.train import main as train
from phydict.methods import METHODS
from phydict.runtime.help import settings_of
from phydict.xray import Ideal, Polychromatic


def help_of(main, capsys, *args):
    with pytest.raises(SystemExit) as stop:
        main(list(args))
    assert stop.value.code in (0, None)
    return capsys.readouterr().out


@pytest.mark.parametrize("settings", [*METHODS.values(), Ideal(), Polychromatic()],
                         ids=lambda settings: type(settings).__name__)
def test_every_setting_has_a_sentence(settings):
    assert [name for name, _, sentence in settings_of(settings, "") if not sentence] == []


@pytest.mark.parametrize("args, shown", [
    (["predict", "--model.method", "tv", "--help"], "--model.method.weight 0.0024"),
    (["test", "--help", "--model.method=phydict_fast"], "--model.method.likelihood.iterations 12"),
    (["predict", "-c", "configs/reconstruct/sirt.yaml", "--help"], "--model.method.iterations 1000"),
    (["predict", "--model.method", "phydict.posterior.DDS", "--help"], "--model.method.eta 0.85"),
    (["ablate", "--set", "method=[tv,dds]", "--help"], "method.eta 0.85"),
    (["ablate", "--model.method", "tv", "--help"], "method.weight 0.0024")])
def test_help_shows_the_settings_of_the_method(capsys, args, shown):
    assert f"  {shown}" in help_of(infer, capsys, *args)


@pytest.mark.parametrize("main, command", [(infer, "predict"), (infer, "test"), (train, "fit"), (train, "validate")])
def test_help_is_for_users(capsys, main, command):
    text = help_of(main, capsys, command, "--help")
    assert not re.findall(r"^  (--[\w.]+) [^ \n]*(?:\n|  ) *\(type", text, re.MULTILINE), "options without a sentence"
    options = re.findall(r"^  (--[\w.]+)", text, re.MULTILINE)
    lightning = [name for name in options if name.startswith(("--trainer.", "--checkpoint.", "--best."))]
    assert 2 <= len(lightning) <= 12 and options[-len(lightning):] == lightning, "Lightning's come last"
    assert "--model.seed" in options and not {"--optimizer", "--lr_scheduler", "--model"} & set(options)


def test_what_help_leaves_out_is_still_accepted(capsys):
    text = help_of(infer, capsys, "predict", "--data.xrays", "x", "--trainer.num_nodes", "2", "--print_config")
    assert "num_nodes: 2" in text
