"""Run the commands of docs/bluerov2.md, from no model to a policy of ArduSub's axes in the virtual tank.

On a vehicle `--robot mavlink://...` takes the place of the virtual one, `--lockstep` goes, and levels and steps are the
commands' own: these are for a look at all of it within a minute, and teach nobody to swim.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

VEHICLE = "bluerov2_heavy"
WORLD = f"pool --firmware ardusub --vehicle {VEHICLE} --site tank --start 0,0,-2,0 --lockstep --port 58620"
TANK = "--site tank --lockstep --pool-file none --let-in 0,0 --arm --robot mavlink://tcp:"


def finssim(line: str, **options) -> subprocess.Popen:
    """Start one command."""
    print(f"finssim {line}", flush=True)
    return subprocess.Popen([sys.executable, "-m", "finssim", *line.split()], **options)


def done(line: str) -> None:
    """One command, and its end."""
    if status := finssim(line).wait():
        raise SystemExit(f"finssim {line.split()[0]} ended with status {status}")


def swim(line: str) -> None:
    """One command on the vehicle, beside the virtual one."""
    with finssim(WORLD, stdout=subprocess.PIPE, text=True) as pool:
        try:
            address = next(words.split()[-1] for words in pool.stdout if words.startswith("lock-step"))
            done(f"{line} {TANK}{address}")
        finally:
            pool.terminate()


folder = Path(tempfile.mkdtemp(prefix="bluerov2-"))
trials, model, policy = folder / "trials", folder / "identified.yaml", folder / "policy"
swim(f"excite surge --levels 9 --unattended --vehicle {VEHICLE} --out {trials}")
done(f"trials check {trials} --vehicle {VEHICLE}")
done(f"calibrate hydrodynamics {trials} --vehicle {VEHICLE} --out {model}")
done(f"train t1 --vehicle {model} --action pilot6 --randomize pool --steps 8192 --out {policy}")
swim(
    f"run --policy {policy} --vehicle {model} --goal 0.3,0,-1.8,0 --duration 5 --record {folder / 'run.mcap'}"
)
print(f"everything is in {folder}")
