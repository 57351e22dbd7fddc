"""Every command, including those of extensions, and helpers to run them."""

from finssim.cli import boundary
from finssim.cli.commands import COMMANDS, app
from finssim.core.registry import COMMANDS as FAMILY

EVERY = COMMANDS | {words: FAMILY.reference(words) for words in FAMILY.of_packages()}
"""Words of every command -> its function."""


def finssim(*words):
    """Run a command in this process and return its exit status."""
    return boundary.run(app, [str(word) for word in words])


def refusal(capsys, *words, notes=False):
    """Return the sentence with which a command refuses its input; notes on omissions may precede it."""
    capsys.readouterr()
    assert finssim(*words) == 2
    out, err = capsys.readouterr()
    lines = list(filter(None, err.splitlines()))
    assert sum(line.startswith("finssim: ") for line in lines) == 1 and "Traceback" not in err and out == ""
    assert notes or len(lines) == 1
    return lines[-1].removeprefix("finssim: ")
