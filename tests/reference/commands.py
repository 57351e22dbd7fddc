"""Every command, those of the extensions included."""

from finssim.cli.commands import COMMANDS
from finssim.core.registry import COMMANDS as FAMILY

EVERY = COMMANDS | {words: FAMILY.reference(words) for words in FAMILY.of_packages()}
"""Words of every command -> its function."""
