"""What the command lines say when they stop."""

import errno
import os
import warnings

import pytest

from phydict.command_line import noted, one_sentence_errors, quiet


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_one_sentence_that_says_how_to_go_on(number, capsys):
    with pytest.raises(SystemExit) as stopped, one_sentence_errors(to_go_on="add --ckpt_path"):
        raise OSError(number, os.strerror(number), "metrics.csv")
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1
    assert os.strerror(number) in said and "'metrics.csv'" in said and "free some space; to go on, add --ckpt" in said


def test_a_cases_warnings_are_noted_and_shown_with_its_name_however_often_others_gave_them(capsys):
    found = {"anna": [], "bert": []}
    with quiet():
        for name, own in found.items():
            with noted(own, name):
                for _ in range(2):
                    warnings.warn("too dark", stacklevel=1)
                    warnings.warn("not about the case", RuntimeWarning, stacklevel=1)
    assert found == {"anna": ["too dark"], "bert": ["too dark"]}
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "dark" in line] == ["warning: anna: too dark", "warning: bert: too dark"]
