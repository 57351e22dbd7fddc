"""Programmes: the published procedure, levels that suit the vehicle, multi-sines that separate axes within limits."""

import json

import numpy as np
import pytest

from finssim.control.allocation import Allocator
from finssim.identification.fit import Dive
from finssim.identification.programme import Leg, alternating, programmes, read_legs, which_axes
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import PHASES
from finssim.vehicles import AXES, load_vehicle

FINSROV = load_vehicle("finsrov")


def level(programme):
    """Return the signed peak of the programme's own axis."""
    wrench = programme.tau_desired[:, AXES.index(programme.axes[0])]
    return float(wrench[np.abs(wrench).argmax()])


@pytest.mark.parametrize(
    ("axis", "levels"),
    [
        ("surge", [6, 12, 18]),
        ("sway", [4.5, 9, 13.5]),
        ("heave", [4.5, 9, 13.5]),
        ("roll", [0.18, 0.36]),
        ("pitch", [0.18, 0.36]),
        ("yaw", [0.6, 1.2, 1.8]),
    ],
)
def test_published_levels_are_driven_in_both_directions(axis, levels):
    """FinsROV's levels are the published ones, each forwards and backwards."""
    found = sorted(level(p) for p in programmes(axis, FINSROV))
    assert found == pytest.approx(sorted([*levels, *(-x for x in levels)]))


def test_a_step_lasts_as_the_published_procedure_says():
    """1 s before, 1 s of baseline, 9 s held, 2 s and 1 s without thrust, at 50 Hz; only its axis is driven."""
    step = programmes("surge", FINSROV)[0]
    assert [word for i, word in enumerate(step.phase) if i == 0 or word != step.phase[i - 1]] == [
        "rest", "baseline", "excitation", "coast", "rest"
    ]  # fmt: skip
    seconds = {word: float((step.phase == word).sum() / step.rate) for word in PHASES}
    assert seconds == {"baseline": 1.0, "excitation": 9.0, "coast": 2.0, "rest": 2.0}
    assert step.rate == 50.0
    driven = step.tau_desired.any(axis=1)
    assert (driven == (step.phase == "excitation")).all()
    assert not step.tau_desired[:, 1:].any()


def test_a_pulse_rings_down_and_a_dive_coasts():
    """Roll is pushed for 0.6 s and free for 3 s; a dive is followed by up to 30 s without thrust."""
    pulse = programmes("roll", FINSROV)[0]
    assert (pulse.phase == "excitation").sum() == 30
    assert (pulse.phase == "coast").sum() == 150
    dives = [p for p in programmes("heave", FINSROV) if level(p) < 0.0]
    assert {(p.phase == "coast").sum() for p in dives} == {1500}
    assert all(p.ascent_speed == 0.01 for p in dives)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bluerov2", "bluerov2_heavy", "rexrov", "remus100", "lauv", "warpauv"])
@pytest.mark.parametrize("kind", ["published", "validation", "multisine"])
def test_every_vehicle_gets_levels_within_its_limits(name, kind):
    """`all` selects the axes that the vehicle controls, and the thrusters can deliver every level."""
    vehicle = load_vehicle(name)
    plan = programmes("all", vehicle, kind=kind)
    assert {axis for p in plan for axis in p.axes} == set(vehicle.controlled_axes)
    assert len({p.name for p in plan}) == len(plan)
    allocator = Allocator.from_vehicle(vehicle)
    rows = [AXES.index(axis) for axis in vehicle.controlled_axes]
    for p in plan:
        thrust = allocator.allocate(p.tau_desired)
        missing = np.abs(allocator.achieved(thrust) - p.tau_desired)[:, rows]
        assert (missing.max(axis=0) <= 5e-3 * vehicle.wrench_limits[rows]).all(), p.name


def test_harmonics_of_a_multisine_belong_to_one_axis_each():
    """Over the excitation the wrenches of any two axes are orthogonal, and lie within the band."""
    p = programmes("all", FINSROV, kind="multisine", band=(0.1, 0.8), duration=40.0)[0]
    tau = p.tau_desired[p.phase == "excitation"]
    scaled = tau / np.linalg.norm(tau, axis=0)
    np.testing.assert_allclose(scaled.T @ scaled, np.eye(6), atol=1e-9)
    power = np.abs(np.fft.rfft(tau, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(tau), 1.0 / p.rate)
    outside = (frequency < 0.1 - 1e-9) | (frequency > 0.8 + 1e-9)
    assert (power[outside].sum(axis=0) < 1e-9 * power.sum(axis=0)).all()


def test_repeats_of_a_multisine_differ_and_seeds_repeat_them():
    """Each repeat has other phases; the same seed gives the same programmes."""
    one, two = programmes("surge,sway", FINSROV, kind="multisine", repeats=2, seed=3)
    assert not np.allclose(one.tau_desired, two.tau_desired)
    again = programmes("surge,sway", FINSROV, kind="multisine", repeats=2, seed=3)
    assert (again[1].tau_desired == two.tau_desired).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"axes": "surg"}, "unknown axis 'surg'"),
        ({"axes": "surge,surge"}, "each axis once"),
        ({"axes": "surge", "levels": [18.7]}, "18.7 N is beyond finsrov's limit of 18.59 N"),
        ({"axes": "yaw", "levels": {"yaw": [-1.0]}}, "expected magnitudes above 0 N m"),
        ({"axes": "yaw", "levels": []}, "none given"),
        ({"axes": "yaw", "kind": "chirp"}, "published, validation, multisine"),
        ({"axes": "yaw", "repeats": 0}, "repeats is 0"),
        ({"axes": "all", "kind": "multisine", "duration": 5.0}, "too few for 6 axes"),
        ({"axes": "all", "kind": "multisine", "band": (0.5, 0.1)}, "expected rising"),
    ],
)
def test_what_cannot_be_is_refused_with_the_reason(arguments, sentence):
    """The message states the problem and the limit."""
    axes = arguments.pop("axes")
    with pytest.raises(CalibrationError, match=sentence):
        programmes(axes, FINSROV, **arguments)


def test_a_recommended_dive_goes_to_both_sides_and_ends_where_it_began(tmp_path):
    """Pushes to both sides are equal; the dive reads back from a report, and is refused if it cannot be played."""
    leg = Leg("yaw", 2.0, 4.0, times=3)
    one = alternating(leg)
    assert one.tau_desired.sum(axis=0) == pytest.approx(np.zeros(6)) and np.abs(one.tau_desired).max() == 2.0
    assert one.duration == pytest.approx(leg.duration)
    dive = Dive(legs=(leg,), widest="yaw.d1", factor=0.5)
    (tmp_path / "fit.json").write_text(json.dumps({"next_dive": dive.as_json()}))
    legs = read_legs(tmp_path)
    assert legs == [leg]
    assert [p.name for p in programmes("all", FINSROV, legs=legs)] == [f"yaw_2_4s_{n}" for n in (1, 2, 3)]
    for axes, some, sentence in (
        ("surge", legs, "no steps of surge, but of yaw"),
        ("all", [Leg("yaw", 99.0, 4.0)], "99 N m is beyond finsrov's limit"),
    ):
        with pytest.raises(CalibrationError, match=sentence):
            programmes(axes, FINSROV, legs=some)
    for text, sentence in (
        ("{}", "no next dive: expected the report"),
        ('{"next_dive": null}', "drove no axis"),
    ):
        (tmp_path / "fit.json").write_text(text)
        with pytest.raises(CalibrationError, match=sentence):
            read_legs(tmp_path)
    with pytest.raises(CalibrationError, match=r"cannot read .*nowhere \(No such file"):
        read_legs(tmp_path / "nowhere")


def test_an_axis_without_authority_is_refused():
    """The six thrusters of a BlueROV2 do not pitch it, and the message lists the axes that they control."""
    with pytest.raises(CalibrationError, match="cannot control pitch: its thrusters control surge, sway"):
        which_axes("surge,pitch", load_vehicle("bluerov2"))
