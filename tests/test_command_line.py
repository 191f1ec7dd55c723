"""What the command lines say when they stop."""

import errno
import os

import pytest

from phydict.command_line import one_sentence_errors


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_one_sentence_that_says_how_to_go_on(number, capsys):
    with pytest.raises(SystemExit) as stopped, one_sentence_errors(to_go_on="add --ckpt_path"):
        raise OSError(number, os.strerror(number), "metrics.csv")
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1
    assert os.strerror(number) in said and "'metrics.csv'" in said and "free some space; to go on, add --ckpt" in said
