"""Run `finssim` commands with what the Python of Windows lacks taken away: python as_windows.py '[["vehicles"], ...]'.

Prints the exit status of each, one JSON list. Not taken away: `os.name`, which the standard library itself needs.
"""

import json
import os
import signal
import sys
import warnings

MODULES = "resource fcntl termios tty pty pwd grp curses readline"
SIGNALS = "SIGHUP SIGUSR1 SIGUSR2 SIGALRM SIGKILL SIGSTOP SIGCONT SIGCHLD SIGPIPE SIGQUIT"
FUNCTIONS = (
    "sched_getaffinity fork forkpty getuid geteuid getgid killpg setsid getloadavg nice register_at_fork"
)

sys.modules.update(dict.fromkeys(MODULES.split()))
for home, names in ((signal, SIGNALS), (os, FUNCTIONS)):
    for name in names.split():
        if hasattr(home, name):
            delattr(home, name)
# Text files of FinsSim name their encoding: Windows would take that of the code page.
warnings.filterwarnings("error", category=EncodingWarning, module=r"finssim\.")

if __name__ == "__main__":
    from finssim.cli import boundary
    from finssim.cli import commands as cli
    from finssim.core import system

    system.replace_unwritable(sys.stdout, sys.stderr)
    statuses = []
    for words in json.loads(sys.argv[1]):
        try:
            statuses.append(boundary.run(cli.app, words))
        except BaseException as error:
            statuses.append(repr(error))
    print()
    print(json.dumps(statuses))
