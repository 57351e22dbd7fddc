"""Logs without outputs, from the pilot's axes through the mixer; and BlueOS recordings, with telemetry as
JSON."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from finssim.control.ardusub import Mixer
from finssim.control.guidance import Station
from finssim.core.frames import TO_FOSSEN
from finssim.identification.hydrodynamics import fit_hydrodynamics
from finssim.pool.ardusub_sitl import SitlWorld
from finssim.trials.check import check_trials
from finssim.trials.importers import ardusub
from finssim.trials.importers.column_map import ColumnMap
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.importers.log import Request
from finssim.vehicles import load_vehicle

pytest.importorskip("pymavlink")

LOGS = Path(__file__).parents[2] / "data" / "ardusub"
BIN, TLOG = LOGS / "small.BIN", LOGS / "small_cut.tlog"
HEAVY = load_vehicle("bluerov2_heavy")
START = 1_700_000_000.0
MANUAL, ALT_HOLD = 19, 2


def pulses_of(trial):
    """Return pulses, (n, thrusters), without unknown rows."""
    return np.stack(
        [trial.series(f"pwm_{name}")[1] for name in load_vehicle(trial.header.vehicle).thrusters], -1
    )


def test_a_real_logs_sticks_give_its_outputs(monkeypatch):
    """RCIN of a real dive through the mixer equals its RCOU, to the rounding of pulses, while armed in
    MANUAL."""
    (outputs,) = read_trials([BIN], vehicle="bluerov2", split="arming")
    monkeypatch.setattr(ardusub, "_pulses", lambda *_: [])
    (sticks,) = read_trials([BIN], vehicle="bluerov2", split="arming")
    assert "sticks_mixed" in {one.code for one in sticks.findings}
    logged = np.median(pulses_of(outputs), axis=0)
    assert len(np.unique(logged)) > 1
    np.testing.assert_allclose(np.median(pulses_of(sticks), axis=0), logged, atol=1.5)


class Dive:
    """Messages of a dive at 10 Hz: one second disarmed, then armed with sticks, the last second in ALT_HOLD."""

    def __init__(self, sticks=None):
        self.messages = []
        station = {"type": 6, "autopilot": 8, "base_mode": 192, "custom_mode": 0, "system_status": 4}
        for i in range(60 if sticks else 0):
            time, armed = 0.1 * i, i >= 10
            mode = {"base_mode": 209 if armed else 81, "custom_mode": ALT_HOLD if i >= 50 else MANUAL}
            vehicle = {"type": 12, "autopilot": 3, **mode, "system_status": 4}
            self.add(time - 0.01, 255, 190, "HEARTBEAT", station)
            self.add(time - 0.01, 1, 1, "HEARTBEAT", vehicle)
            angles = {"time_boot_ms": 100 * i, "roll": 0.0, "pitch": 0.0, "yaw": -0.01 * i}
            self.add(
                time,
                1,
                1,
                "ATTITUDE",
                {**angles, "rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": -0.1 * armed},
            )
            getattr(self, sticks)(time, 100 * i)

    def add(self, time, system, component, kind, fields):
        self.messages.append((time, system, component, kind, fields))

    def channels(self, time, ms):
        raw = {f"chan{n}_raw": 1500 for n in range(1, 19)}
        raw |= {"chan1_raw": 1520, "chan2_raw": 1460, "chan3_raw": 1400, "chan4_raw": 1460, "chan5_raw": 1700}
        self.add(time, 1, 1, "RC_CHANNELS", {"time_boot_ms": ms, "chancount": 8, "rssi": 255, **raw})

    def joystick(self, time, ms):
        self.add(time, 1, 1, "NAMED_VALUE_FLOAT", {"time_boot_ms": ms, "name": "PilotGain", "value": 0.5})
        axes = {"x": 1000, "y": 0, "z": 250, "r": -200, "s": 20, "t": -40}
        self.add(time, 255, 190, "MANUAL_CONTROL", {"target": 1, "buttons": 0, **axes})

    def tlog(self, path):
        """Write the dive as a ground station does."""
        from pymavlink.dialects.v20 import ardupilotmega

        with path.open("wb") as file:
            for time, system, component, kind, told in self.messages:
                fields = told | ({"name": told["name"].encode()} if "name" in told else {})
                fields |= {"mavlink_version": 3} if kind == "HEARTBEAT" else {}
                link = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=component)
                message = getattr(ardupilotmega, f"MAVLink_{kind.lower()}_message")(**fields)
                file.write(struct.pack(">Q", round(1e6 * (START + time))) + message.pack(link))
        return path

    def mcap(self, path):
        """Write the dive as BlueOS' recorder does: one channel per message, all also in mavlink/out, flags
        and kinds by name."""
        from mcap.writer import Writer

        modes = {209: "MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | MAV_MODE_FLAG_SAFETY_ARMED"}
        firmwares = {3: {"type": "MAV_AUTOPILOT_ARDUPILOTMEGA"}, 8: {"type": "MAV_AUTOPILOT_INVALID"}}
        with path.open("wb") as file:
            writer, known = Writer(file, chunk_size=1 << 14), {}
            writer.start()
            for time, system, component, kind, fields in self.messages:
                told, stamp = {**fields, "type": kind}, round(1e9 * (START + time))
                if kind == "HEARTBEAT":
                    mode = fields["base_mode"]
                    told |= {"base_mode": modes.get(mode, {"bits": mode})}
                    told |= {"autopilot": firmwares[fields["autopilot"]]}
                if "name" in fields:
                    told["name"] = [*fields["name"], "\0"]
                header = {"system_id": system, "component_id": component, "sequence": 0}
                text = json.dumps({"header": header, "message": told}).encode()
                for topic in ("mavlink/out", f"mavlink/{system}/{component}/{kind}"):
                    if topic not in known:
                        schema = writer.register_schema(topic.replace("/", "."), "jsonschema", b"{}")
                        known[topic] = writer.register_channel(topic, "json", schema)
                    writer.add_message(known[topic], stamp, text, stamp)
            writer.finish()
        return path


@pytest.mark.parametrize("form", ["tlog", "mcap"])
@pytest.mark.parametrize("sticks", ["channels", "joystick"])
def test_axes_in_manual_become_pulses(tmp_path, form, sticks):
    """Half ahead, a quarter down, a little of the others: neutral while disarmed, dropped in another mode."""
    path = getattr(Dive(sticks), form)(tmp_path / f"dive.{form}")
    (trial,) = read_trials([path], vehicle="bluerov2_heavy")
    expected = Mixer.of_frame("VECTORED_6DOF").pulses([-0.1, 0.05, -0.1, -0.25, 0.5, 0.0])
    pulses = pulses_of(trial)
    assert len(pulses) == 50
    np.testing.assert_array_equal(pulses[:10], 1500.0)
    np.testing.assert_allclose(pulses[10:], np.tile(expected, (40, 1)), atol=1e-3)
    assert {"sticks_mixed", "other_modes_left_out"} <= {one.code for one in trial.findings}
    assert trial.t[-1] < 5.0 and trial.series("r")[1][-1] == pytest.approx(0.1)


def test_a_recording_of_blueos_is_what_a_tlog_is(tmp_path):
    """The real telemetry recorded as JSON gives the same trial; a cut recording is read up to the cut."""
    from pymavlink import mavutil

    dive, log = Dive(), mavutil.mavlogfile(str(TLOG))
    while (message := log.recv_match()) is not None:
        fields = {name: value for name, value in message.to_dict().items() if name != "mavpackettype"}
        sender = message.get_srcSystem(), message.get_srcComponent()
        dive.add(message._timestamp - START, *sender, message.get_type(), fields)
    path = dive.mcap(tmp_path / "dive.mcap")
    (told,) = read_trials([path], vehicle="bluerov2_heavy")
    (usual,) = read_trials([TLOG], vehicle="bluerov2_heavy")
    assert set(told.channels) == set(usual.channels)
    for name in usual.channels:
        np.testing.assert_array_equal(told.series(name)[1], usual.series(name)[1])
        np.testing.assert_allclose(told.series(name)[0], usual.series(name)[0], atol=1e-5)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (cut,) = read_trials([path], vehicle="bluerov2_heavy")
    assert 10 < len(cut.series("yaw")[0]) < len(usual.series("yaw")[0])


def test_without_a_frame_there_are_no_inputs(tmp_path):
    """If the log names no frame and the vehicle has no autopilot, its motion is read and no inputs are
    invented."""
    path = Dive("channels").tlog(tmp_path / "dive.tlog")
    log = ardusub.read(path, Request(ColumnMap(), HEAVY.replace({"autopilot": None})))
    assert not any("pwm_T1" in stream.channels for stream in log.streams)


def test_check_judges_such_a_dive(tmp_path):
    """`trials check` takes the pulses as commands, and reports what they identify on each axis."""
    path = Dive("channels").tlog(tmp_path / "dive.tlog")
    (report,) = check_trials(read_trials([path], vehicle="bluerov2_heavy"))
    assert report.verdict != "refused" and report.inputs == "pwm"
    assert "yaw" in {axis.axis for axis in report.axes}


@pytest.mark.slow
def test_a_dive_of_sticks_alone_identifies_the_vehicle(tmp_path):
    """Steps ahead, astern and of yaw in the water of `ardusub-sitl`, with sticks, attitude and a DVL's deltas on the
    ground station's log: the fit finds damping and added mass of the vehicle file as precisely as the scale of
    thrust, 6 % low by its prior, is known."""
    world, mixer, dive = (
        SitlWorld(HEAVY, start=Station((0.0, 0.0, -20.0), 0.0)),
        Mixer.of_frame("VECTORED_6DOF"),
        Dive(),
    )
    noise, travelled = np.random.default_rng(0), np.zeros(3)
    for i in range(4400):
        time, step = 0.02 * i, int(0.02 * i) // 4 - 1
        demands, level = np.zeros(6), (0.13, 0.17, 0.21)[step // 2 % 3] * (1.0 if step // 6 % 2 else -1.0)
        demands[4 if step < 12 else 2] = level if step >= 0 and step % 2 == 0 else 0.0
        pulses = (*np.round(mixer.pulses(demands)).astype(int).tolist(), *[1500] * 8)
        if i % 5 == 0:
            state = json.loads(world.answer())
            angles = dict(zip(("roll", "pitch", "yaw"), state["attitude"], strict=True))
            rates = np.array(state["imu"]["gyro"]) + 1e-3 * noise.standard_normal(3)
            rates = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), rates.tolist(), strict=True))
            raw = {f"chan{n}_raw": 1500 for n in range(1, 19)}
            raw |= {"chan4_raw": round(1500 + 400 * demands[2]), "chan5_raw": round(1500 + 400 * demands[4])}
            ms = {"time_boot_ms": round(1000 * time)}
            dive.add(time, 1, 1, "ATTITUDE", {**ms, **angles, **rates})
            dive.add(time, 1, 1, "RC_CHANNELS", {**ms, "chancount": 8, "rssi": 255, **raw})
            told = travelled + 5e-4 * noise.standard_normal(3)
            delta = {"time_usec": 0, "time_delta_usec": 100_000, "angle_delta": [0.0] * 3, "confidence": 90.0}
            dive.add(time, 255, 0, "VISION_POSITION_DELTA", {**delta, "position_delta": told.tolist()})
            travelled[:] = 0.0
        if i % 50 == 0:
            mode = {"type": 12, "autopilot": 3, "base_mode": 209, "custom_mode": MANUAL, "system_status": 4}
            dive.add(time, 1, 1, "HEARTBEAT", mode)
        world.step(pulses, 50)
        travelled += 0.02 * TO_FOSSEN.vector(world.simulator.numpy("velocity")[0, 0, :3])
    trials = read_trials([dive.tlog(tmp_path / "dive.tlog")], vehicle="bluerov2_heavy")
    (report,) = check_trials(trials)
    told = {
        axis.axis: {name for name, one in axis.identifiability.items() if one.identifiable}
        for axis in report.axes
    }
    assert {"m_eff", "d1", "d2"} <= told["surge"] & told["yaw"] and "d1" not in told["sway"]
    found = fit_hydrodynamics(trials, HEAVY, axes=["surge", "yaw"], known={}).estimates
    for name, true in (
        ("surge.d2", 141.0),
        ("surge.m_eff", 19.86),
        ("yaw.d2", 1.5),
        ("yaw.added_mass", 0.2215),
    ):
        low, high = found[name].ci95
        assert low < true < high
        own = 0.0 if name != "yaw.added_mass" else HEAVY.body.inertia[2][2]
        free = (found[name].estimate + own) / found["thrust_scale"].estimate - own
        assert free == pytest.approx(true, rel=0.08)
