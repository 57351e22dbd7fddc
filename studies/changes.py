"""Cost of a changed vehicle, and benefit of tracking the change: `python -m studies.changes --out changes`.

In each pool, the parameters of the vehicle are first tracked in its original state, which gives the model.
Then it gets a payload of 1 kg, a thruster with 70 % of its thrust, or 30 % more drag. After a minute of
driving, the estimates are compared with the truth, and controllers hold setpoints of T1 with the earlier
model and with the tracked one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from finssim.cli.command_line import run_script
from finssim.control.guidance import Reference, Station
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.evaluation.campaign import check_choices, write_json
from finssim.evaluation.metrics import T1_SETPOINTS, T1_START, in_room
from finssim.evaluation.robot_trials import RobotTrial, play_in_pool
from finssim.evaluation.tables import Table
from finssim.evaluation.trials import DURATION, GoalTrial, VehicleMotion, guide_of
from finssim.identification.adaptation import Adaptation, Follower
from finssim.identification.vehicle_file import write_vehicle
from finssim.learning.train import TrainingSettings, train
from finssim.pool import read_truth
from finssim.pool.plan import PoolPlan, make_plan
from finssim.pool.plant_spec import PlantSpec, Severity
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

CHANGES = ("payload", "thruster", "drag")
CONTROLLERS = ("pid", "nmpc", "policy")
MODELS = ("unchanged", "changed", "followed")
SETPOINTS = ("P02", "P05")
"""Setpoints of T1 that are held."""
LEG = 8.0
"""Time at each setpoint during tracking [s]."""
MINUTE = 60.0
"""Duration of tracking [s]."""
LOAD, LOAD_DENSITY, LOAD_PLACE = 1.0, 3000.0, (0.1, 0.0, -0.1)
"""Payload: mass [kg], density [kg/m³] and position in the body frame [m]."""
WEAK, MORE_DRAG = 0.7, 1.3
"""Factors on the thrust of the first horizontal thruster and on the drag [-]."""


@dataclass(frozen=True)
class Tour:
    """Published setpoints in sequence, repeated."""

    poses: Array
    """x, y, z [m] and yaw [rad], world frame, (n, 4)."""
    name: str = "tour"
    duration: float = float("inf")
    """Duration [s]."""

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the reference at times t [s]."""
        t = np.asarray(t, float)
        pose = self.poses[(t // LEG).astype(int) % len(self.poses)]
        still = np.zeros(t.shape)
        return Reference(pose[..., :3], np.zeros((*t.shape, 3)), pose[..., 3], still)


def changed(spec: PlantSpec, change: str, thruster: str) -> PlantSpec:
    """Return the plant after a change in `CHANGES`; `thruster` is the weak one."""
    if change == "payload":
        body, volume = spec.body, LOAD / LOAD_DENSITY
        mass, displaced = body.mass + LOAD, body.displaced_volume + volume
        place = np.array(LOAD_PLACE)
        centres = {
            "center_of_gravity": (np.array(body.center_of_gravity) * body.mass + LOAD * place) / mass,
            "center_of_buoyancy": (np.array(body.center_of_buoyancy) * body.displaced_volume + volume * place)
            / displaced,
        }
        tuples = {name: tuple(values.tolist()) for name, values in centres.items()}
        return spec.model_copy(
            update={"body": body.model_copy(update={"mass": mass, "displaced_volume": displaced, **tuples})}
        )
    if change == "thruster":
        one = spec.thrusters[thruster]
        weak = {"gain_plus": WEAK * one.gain_plus, "gain_minus": WEAK * one.gain_minus}
        return spec.model_copy(
            update={"thrusters": {**spec.thrusters, thruster: one.model_copy(update=weak)}}
        )
    rows = {
        name: tuple(tuple((MORE_DRAG * np.array(row)).tolist()) for row in getattr(spec.damping, name))
        for name in ("linear", "quadratic")
    }
    return spec.model_copy(update={"damping": spec.damping.model_copy(update=rows)})


def follow(plan: PoolPlan, vehicle: Vehicle, seed: int) -> Adaptation:
    """Drive a tour of a minute with the tuned PID of `vehicle` and return the estimated changes of the vehicle."""
    follower = Follower(vehicle)

    def watch(runtime: Runtime) -> None:
        reading = runtime.reading
        if reading is not None and reading.ready and runtime.bridge.state == "armed":
            follower.add(reading.time, reading.nu, reading.quaternion, reading.position, runtime.bridge.force)

    poses = np.array([in_room(pose, vehicle) for pose in T1_SETPOINTS.values()])
    *position, yaw = in_room(T1_START, vehicle).tolist()
    trial = RobotTrial(
        name="tour", pilot=make_pilot("pid", vehicle), guide=Tour(poses), duration=MINUTE + 1.0,
        over=lambda runtime: runtime.t >= MINUTE + 1.0, watch=watch,
    )  # fmt: skip
    play_in_pool(trial, Station(tuple(position), yaw), vehicle, plan, seed=seed)
    return follower.finish()


def hold(plan: PoolPlan, vehicle: Vehicle, controller: str, setpoint: str, seed: int) -> dict[str, Any]:
    """Hold one setpoint of T1 with the robot's software, and return its measures from the truth."""
    guide = guide_of(setpoint, vehicle)
    *position, yaw = in_room(T1_START, vehicle).tolist()
    trial = RobotTrial(
        name=setpoint, pilot=make_pilot(controller, vehicle), guide=guide, duration=DURATION,
        over=lambda runtime: runtime.t >= DURATION,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth"
        outcome = play_in_pool(trial, Station(tuple(position), yaw), vehicle, plan, seed=seed, truth=file)
        truth = read_truth(file)
    rows = truth.time >= outcome.runtime.started
    motion = VehicleMotion(
        t=truth.time[rows] - outcome.runtime.started, position=truth.position[rows],
        quaternion=truth.quaternion[rows], thrust=truth.thrust[rows],
    )  # fmt: skip
    limits = vehicle.force_limits
    return GoalTrial(name=setpoint, guide=guide, motion=motion).measures(
        "t1", limits, stopped=bool(outcome.fault)
    )


def found(adaptation: Adaptation, change: str, thruster: str, density: float) -> dict[str, Any]:
    """Return the estimate of a change, its truth, and the other estimates that differ from the model.

    Args:
        adaptation: Result of the tracking.
        change: Change in `CHANGES`.
        thruster: Name of the weak thruster.
        density: Density of the water [kg/m³].
    """
    name, truth = {
        "payload": ("weight", LOAD * 9.81 * (1.0 - density / LOAD_DENSITY)),
        "thruster": (f"thruster.{thruster}", WEAK),
        "drag": ("drag", MORE_DRAG),
    }[change]
    estimates = adaptation.estimates
    e = estimates[name]
    others = [n for n, other in estimates.items() if other.identifiable and n != name]
    if change == "payload":
        others = [n for n in others if not n.startswith("weight_")]
    return {
        "name": name, "truth": truth, "estimate": e.estimate, "ci95": list(e.ci95), "unit": e.unit,
        "differs": e.identifiable, "holds": bool(e.ci95[0] <= truth <= e.ci95[1]), "others": others,
    }  # fmt: skip


def changes(
    *,
    out: Path,
    vehicle: str = "finsrov",
    severity: str = "realistic",
    seeds: Annotated[int, (1, None)] = 3,
    seed: int = 1,
    controllers: str = "pid,nmpc,policy",
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Track vehicles that change, and compare controllers with and without the tracked model.

    Example: python -m studies.changes --seeds 1 --controllers pid --out changes

    Args:
        out (DIR): Directory for the result, and the vehicles and policies of each pool.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        severity (WORD): Deviation of the pools from the vehicle file: nominal, realistic or hard.
        seeds: Number of pools.
        seed: Seed of the first pool; equal seeds give equal results.
        controllers (NAMES): Controllers to compare, of pid,nmpc,policy.
        progress: Receives the completed fraction and the state.

    Returns:
        Content of `changes.json`: `followed`, the estimates; `trials`, the measures of each held setpoint; and
        `complete`, false after Ctrl-C.
    """
    start_warp()
    chosen = tuple(controllers.split(","))
    check_choices(chosen, CONTROLLERS, "controller", ValueError)
    hardness = _severity(severity)
    body, folder = load_vehicle(vehicle), Path(out)
    weak = body.thruster_names[-1]
    followed: list[dict[str, Any]] = []
    trials: list[dict[str, Any]] = []
    pools = range(seed, seed + seeds)
    total = len(pools) * (1 + 2 * len(CHANGES)) * len(chosen)

    def held(models: Mapping[str, Vehicle], plan: PoolPlan, row: Mapping[str, Any], place: Path) -> None:
        for model, known in models.items():
            for controller in chosen:
                progress(
                    len(trials) / (total * len(SETPOINTS)),
                    f"pool {row['pool']}, {row['change']}, {model}, {controller}",
                )
                who = controller
                if controller == "policy":
                    who = str(_policy(known, place / model, None if model == "unchanged" else place.parent))
                for setpoint in SETPOINTS:
                    measures = hold(plan, known, who, setpoint, seed=row["pool"])
                    trials.append({**row, "model": model, "controller": controller, **measures})

    def result() -> dict[str, Any]:
        vehicle_of = {"name": body.name, "sha256": body.sha256}
        return {
            "experiment": "changes", "vehicle": vehicle_of, "severity": severity, "followed": followed,
            "trials": trials, "complete": len(trials) == total * len(SETPOINTS), "provenance": provenance(),
        }  # fmt: skip

    try:
        for pool in pools:
            drawn = make_plan(body, str(pool), hardness, camera="corners", seed=pool)
            place = folder / f"pool{pool}"
            known = follow(drawn, body, pool).adapted
            held({"unchanged": known}, drawn, {"pool": pool, "change": "none"}, place)
            for change in CHANGES:
                plan = replace(drawn, spec=changed(drawn.spec, change, weak))
                adaptation = follow(plan, known, pool)
                row = {"pool": pool, "change": change}
                followed.append({**row, **found(adaptation, change, weak, body.water.density)})
                held({"changed": known, "followed": adaptation.adapted}, plan, row, place / change)
    finally:  # after Ctrl-C, write the results so far
        write_json(folder / "changes.json", result(), tables_of(result()))
    return result()


def _severity(word: str) -> Severity:
    check_choices([word], ("nominal", "realistic", "hard"), "severity", ValueError)
    return word  # type: ignore[return-value]


def _policy(vehicle: Vehicle, place: Path, first: Path | None) -> Path:
    """Return a policy for a vehicle, trained from that of the unchanged vehicle if it exists."""
    out = place / "policy"
    if place.name == "changed" and first is not None:
        return first / "unchanged" / "policy"
    place.mkdir(parents=True, exist_ok=True)
    write_vehicle(vehicle, place / "vehicle.yaml")
    if not out.exists():
        train("t1", TrainingSettings(vehicle=str(place / "vehicle.yaml"), randomize="pool", seed=1), out=out)
    return out


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the estimates, and the measures of the held setpoints by change, model and controller."""
    estimates = [
        [
            str(f["pool"]), f["change"], f["name"], f"{f['truth']:.3g}", f"{f['estimate']:.3g}",
            f"[{f['ci95'][0]:.3g}, {f['ci95'][1]:.3g}]", f["unit"], "yes" if f["differs"] else "no",
            ", ".join(f["others"]) or "none",
        ]
        for f in result["followed"]
    ]  # fmt: skip
    heads = [
        "pool",
        "change",
        "estimate of",
        "truth",
        "estimate",
        "95 %",
        "unit",
        "found",
        "others that differ",
    ]
    tables = [Table(title="After a minute of driving", heads=heads, rows=estimates, left=(1, 2, 8))]
    rows = []
    keys = dict.fromkeys((t["change"], t["controller"], t["model"]) for t in result["trials"])
    for change, controller, model in sorted(keys, key=lambda key: (key[1], key[0] != "none", key[0])):
        of = [
            t
            for t in result["trials"]
            if (t["change"], t["controller"], t["model"]) == (change, controller, model)
        ]
        settled = [t["t_s_s"] for t in of if t["success"]]
        errors = [t["e_p_m"] for t in of if t["e_p_m"] is not None]
        rows.append([
            controller, change, model, f"{sum(t['success'] for t in of)}/{len(of)}",
            f"{100.0 * np.mean(errors):.2f}" if errors else "–", f"{np.mean(settled):.2f}" if settled else "–",
        ])  # fmt: skip
    heads = ["controller", "change", "model", "held", "e_p [cm]", "t_s [s]"]
    return [*tables, Table(title="Setpoints of T1", heads=heads, rows=rows, left=(0, 1, 2))]


if __name__ == "__main__":
    run_script("studies.changes:changes")
