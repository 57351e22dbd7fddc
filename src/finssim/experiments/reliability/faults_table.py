"""The table of `finssim experiment faults`: a row for each kind of fault, its figures those of the worst trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from finssim.experiments.reliability.catalogue import SCENARIOS
from finssim.experiments.reliability.process_trial import KILLS
from finssim.experiments.reliability.verdict import INSET, LONGEST_LOSS, STILL, STOP_WITHIN
from finssim.experiments.transfer.table import OURS, Shown

__all__ = ["faults_table"]

HEADS = (
    "",
    "trials",
    "thrust gone [s]",
    "frames off [s]",
    "inside by [m]",
    "ended",
    "record lost [s]",
    "verdict",
)

NOTE = (
    f"Passed: no thrust above {STILL:g} N later than {STOP_WITHIN:g} s after the fault, or always inside the workspace "
    f"(the vehicle file's less {INSET[0]:g} m at the sides, {INSET[2]:g} m above and below); nothing raised; record "
    f"readable, lacking at most {LONGEST_LOSS:g} s. Thrust and position are true; thrust includes the motors' lag. "
    "Times and record: the longest of the trials; inside by: the least distance to a face. drives on: thrusters still "
    "worked when the fault ended or the trial was over."
)


def faults_table(result: Mapping[str, Any]) -> Shown:
    """The table of a result of `faults_experiment`."""
    rows = dict.fromkeys(trial["job"]["row"] for trial in result["trials"])
    tried = {name: [t for t in result["trials"] if t["job"]["row"] == name] for name in rows}
    good = sum(bool(t["ok"]) for name, trials in tried.items() if not _control(name) for t in trials)
    total = sum(len(trials) for name, trials in tried.items() if not _control(name))
    return Shown(
        title="Faults",
        headline=(
            f"Faults in the virtual pool, severity {result['severity']}, pools: {len(result['seeds'])}; "
            f"{result['vehicle']['name']} {result['vehicle']['sha256'][:12]}; passed: {good} of {total}"
        ),
        heads=HEADS,
        rows=[(_row(name, trials), OURS) for name, trials in tried.items()],
        note=NOTE,
        sentences=[
            _complaint(t) for name, ts in tried.items() if not _control(name) for t in ts if not t["ok"]
        ],
    )


def _row(name: str, trials: Sequence[Mapping[str, Any]]) -> list[str]:
    title = KILLS[name][0] if name in KILLS else SCENARIOS[name].title
    margins = [t["margin_m"] for t in trials if t["margin_m"] is not None]
    lost = [t["record_lost_s"] for t in trials if t["record_lost_s"] is not None]
    return [
        title,
        str(len(trials)),
        _longest(trials, "thrust_gone_s"),
        _longest(trials, "frames_off_s"),
        f"{min(margins):.2f}" if margins else "–",
        _ended(trials),
        f"{max(lost):.2f}" if len(lost) == len(trials) else "unreadable",
        _verdict(name, trials),
    ]


def _longest(trials: Sequence[Mapping[str, Any]], key: str) -> str:
    """The longest time, and how many trials went on driving."""
    times = [t[key] for t in trials if t[key] is not None]
    going = len(trials) - len(times)
    words = [f"{max(times):.2f}"] if times else []
    return ", ".join(words + ([f"{going} drive on" if times else "drives on"] if going else []))


def _ended(trials: Sequence[Mapping[str, Any]]) -> str:
    """States of the bridge, with their reasons, the most frequent first."""
    counts = Counter(t["state"] + (f": {t['reason']}" if t["reason"] else "") for t in trials)
    return "; ".join(f"{n} × {what}" if len(counts) > 1 else what for what, n in counts.most_common())


def _verdict(name: str, trials: Sequence[Mapping[str, Any]]) -> str:
    good = sum(bool(t["ok"]) for t in trials)
    if _control(name):
        return "fails, as it must" if not good else "PASSED, which a control must not"
    return "passed" if good == len(trials) else f"FAILED {len(trials) - good}"


def _complaint(trial: Mapping[str, Any]) -> str:
    """What was wrong with a trial that failed."""
    job, gone, margin = trial["job"], trial["thrust_gone_s"], trial["margin_m"]
    went = "thrust never ended" if gone is None else f"thrust ended after {gone:.2f} s"
    where = "" if margin is None else f", inside by {margin:.2f} m"
    lost = trial["record_lost_s"]
    record = trial["record_problem"] or ("" if lost is None else f"record lacks {lost:.2f} s")
    raised = f"; raised {trial['raised']}" if trial["raised"] else ""
    return f"{job['row']} {job['target']}, pool {job['plant']}: {went}{where}; {record}{raised}"


def _control(name: str) -> bool:
    return name in SCENARIOS and SCENARIOS[name].must_fail
