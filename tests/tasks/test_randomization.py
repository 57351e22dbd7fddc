"""Every drawn value lies in its range, the range is filled, and the vehicle is physical."""

import numpy as np
import pytest

from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import (
    AXES,
    AxisScales,
    Ranges,
    RangesError,
    ThrustScales,
    WaveRanges,
    available,
    load_ranges,
)
from finssim.tasks import Environment, StationKeeping

WORLDS = 2000

RANGES = Ranges(
    name="everything",
    mass=(0.9, 1.2),
    volume=(0.8, 1.3),
    inertia=(0.5, 1.5),
    center_of_gravity=(-0.02, 0.01),
    center_of_buoyancy=(-0.03, 0.05),
    added_mass=AxisScales(all=(0.9, 1.1), axes={"surge": (0.5, 0.6), "yaw": (2.0, 3.0)}),
    linear_damping=AxisScales(axes={"sway": (0.7, 0.8)}),
    quadratic_damping=AxisScales(all=(2.0, 3.0)),
    thrust=ThrustScales(all=(0.9, 1.0), each=(0.95, 1.05)),
    time_constant=(0.5, 1.5),
    delay=(0.25, 2.0),
    slew=(0.8, 1.2),
    current=(0.05, 0.35),
    waves=WaveRanges(count=(0, 2), amplitude=(0.01, 0.03), wavelength=(3.0, 8.0)),
)


@pytest.fixture(scope="module")
def pair():
    """Many randomised worlds, and one nominal world."""
    task = StationKeeping()
    return Environment(task, worlds=WORLDS, randomization=Randomization(RANGES), seed=5), Environment(task)


def ratio(pair, name):
    """Return a field divided by its nominal value, one row per world."""
    drawn, nominal = (getattr(env.simulator.plant, name).numpy()[:, 0] for env in pair)
    return drawn / nominal


def fills(sample, low, high):
    """Assert that samples lie within [low, high] and use the range to within 2 % of its width."""
    slack = 1e-5 * max(abs(low), abs(high))
    width = high - low
    assert sample.min() >= low - slack and sample.max() <= high + slack
    assert sample.min() < low + 0.02 * width and sample.max() > high - 0.02 * width


@pytest.mark.parametrize("name", ["mass", "volume", "delay"])
def test_scalars_fill_their_ranges(pair, name):
    fills(ratio(pair, name), *getattr(RANGES, name))


@pytest.mark.parametrize("name", ["time_constant", "slew"])
def test_motors_of_a_vehicle_share_a_factor(pair, name):
    factor = ratio(pair, name)
    fills(factor, *getattr(RANGES, name))
    np.testing.assert_allclose(factor, factor[:, :1].repeat(8, axis=1), rtol=1e-5)


def test_every_thruster_has_its_own_gain_beside_the_common_one(pair):
    gain = ratio(pair, "gain")
    assert gain.min() >= 0.9 * 0.95 - 1e-6 and gain.max() <= 1.0 * 1.05 + 1e-6
    # Var = Var(common) + Var(each) to first order: widths 0.1 and 0.1, and a common part correlates all pairs.
    correlation = np.corrcoef(gain.T)[np.triu_indices(8, 1)]
    np.testing.assert_allclose(correlation, 0.5, atol=0.1)


def test_centres_move_in_every_axis_within_their_ranges(pair):
    for name, interval in (("r_g", RANGES.center_of_gravity), ("r_b", RANGES.center_of_buoyancy)):
        drawn, nominal = (getattr(env.simulator.plant, name).numpy()[:, 0] for env in pair)
        for axis in range(3):
            fills((drawn - nominal)[:, axis], *interval)


def test_inertia_about_the_centre_of_gravity_scales(pair):
    """Steiner's part follows the drawn mass and centre; the rest scales by one factor."""
    plant = pair[0].simulator.plant
    r, m = plant.r_g.numpy()[:, 0].astype(float), plant.mass.numpy()[:, 0].astype(float)
    steiner = np.einsum(
        "w,wij->wij", m, (r**2).sum(axis=1)[:, None, None] * np.eye(3) - np.einsum("wi,wj->wij", r, r)
    )
    about_g = plant.inertia.numpy()[:, 0] - steiner
    nominal = np.array(pair[0].simulator.vehicles[0].body.inertia)
    factor = np.einsum("wii->wi", about_g) / np.diag(nominal)
    np.testing.assert_allclose(factor, factor[:, :1].repeat(3, axis=1), rtol=1e-4)
    fills(factor[:, 0], *RANGES.inertia)


@pytest.mark.parametrize(("field", "part"), [("D1", "linear_damping"), ("D2", "quadratic_damping")])
def test_damping_scales_axis_by_axis(pair, field, part):
    scales = getattr(RANGES, part)
    drawn, nominal = (getattr(env.simulator.plant, field).numpy()[:, 0] for env in pair)
    for i, (axis, low, high) in enumerate(zip(AXES, *scales.bounds(), strict=True)):
        if nominal[0, i, i] == 0.0:
            assert not drawn[:, i, i].any()
            continue
        factor = drawn[:, i, i] / nominal[0, i, i]
        ends = scales.all[0] * low, scales.all[1] * high
        assert ends[0] - 1e-4 <= factor.min() and factor.max() <= ends[1] + 1e-4, axis
        assert factor.max() - factor.min() >= 0.5 * (ends[1] - ends[0])


def test_added_mass_scales_where_its_coefficients_hold(pair):
    """At the reference point (here the nominal centre of gravity) the diagonal has the drawn factors."""
    vehicle = pair[0].simulator.vehicles[0]
    x, y, z = vehicle.hydrodynamics["calibrated"].reference_point
    H = np.eye(6)
    H[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    back = np.linalg.inv(H)
    M_A = pair[0].simulator.plant.M_A.numpy()[:, 0].astype(float)
    diagonal = np.einsum("wii->wi", back.T @ M_A @ back)
    factor = diagonal / np.diag(vehicle.hydrodynamics["calibrated"].added_mass)
    low, high = (np.array(x) for x in RANGES.added_mass.bounds())
    assert (factor >= 0.9 * low - 2e-3).all() and (factor <= 1.1 * high + 2e-3).all()
    assert factor[:, 0].max() < 0.7 and factor[:, 5].min() > 1.7


@pytest.mark.parametrize("ranges", [RANGES, *available()])
def test_every_drawn_vehicle_could_exist(ranges):
    """Added mass is symmetric positive semidefinite, total mass matrix positive definite, damping
    dissipative."""
    env = Environment(StationKeeping(), worlds=500, randomization=Randomization(ranges), seed=11)
    plant = env.simulator.plant
    M_A, M_inv = (getattr(plant, name).numpy()[:, 0].astype(float) for name in ("M_A", "M_inv"))
    np.testing.assert_allclose(M_A, M_A.transpose(0, 2, 1), atol=1e-5)
    assert np.linalg.eigvalsh(M_A).min() > -1e-5
    assert np.linalg.eigvalsh(0.5 * (M_inv + M_inv.transpose(0, 2, 1))).min() > 0.0
    for name in ("D1", "D2"):
        D = getattr(plant, name).numpy()[:, 0].astype(float)
        assert np.linalg.eigvalsh(0.5 * (D + D.transpose(0, 2, 1))).min() >= 0.0
    assert (plant.mass.numpy() > 0.0).all() and (plant.volume.numpy() > 0.0).all()


def test_the_mass_matrix_that_is_used_is_the_drawn_one(pair):
    """M_inv inverts M_RB(drawn mass, centre, inertia) + M_A(drawn)."""
    plant = pair[0].simulator.plant
    names = ("mass", "r_g", "inertia", "M_A", "M_inv")
    fields = (getattr(plant, name).numpy()[:20, 0].astype(float) for name in names)
    for m, r, I, M_A, M_inv in zip(*fields, strict=True):
        S = m * np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
        M = np.block([[m * np.eye(3), -S], [S, I]]) + M_A
        np.testing.assert_allclose(M_inv @ M, np.eye(6), atol=2e-4)


def test_the_water_is_drawn_too(pair):
    """Currents are within their speeds from every direction; waves within their sizes, on the dispersion
    relation."""
    water = pair[0].simulator.water
    current = water.current.numpy().astype(float)
    fills(np.linalg.norm(current, axis=1), *RANGES.current)
    assert not current[:, 2].any()
    direction = np.arctan2(current[:, 1], current[:, 0])
    assert abs(np.exp(1j * direction).mean()) < 5.0 / np.sqrt(WORLDS)
    amplitude, k, omega = (
        x.numpy().astype(float) for x in (water.wave_amplitude, water.wave_number, water.wave_frequency)
    )
    present = amplitude > 0.0
    counts = np.bincount(present.sum(axis=1), minlength=3) / WORLDS
    np.testing.assert_allclose(counts, 1.0 / 3.0, atol=0.05)
    fills(amplitude[present], *RANGES.waves.amplitude)
    fills(2.0 * np.pi / k[present], *RANGES.waves.wavelength)
    np.testing.assert_allclose(omega**2, 9.81 * k * np.tanh(k * 1.0), rtol=1e-5)


def test_volume_with_mass_keeps_the_trim():
    """With this option of the published ranges, volume and mass scale together."""
    env = Environment(StationKeeping(), worlds=300, randomization=Randomization("fossen_learn_to_swim"))
    vehicle = env.simulator.vehicles[0]
    mass = env.simulator.plant.mass.numpy()[:, 0] / vehicle.body.mass
    volume = env.simulator.plant.volume.numpy()[:, 0] / vehicle.body.displaced_volume
    np.testing.assert_allclose(mass, volume, rtol=1e-6)
    assert np.ptp(mass) > 0.03


def test_buoyancy_is_drawn_on_top_of_a_volume_with_mass():
    """The ratio of displaced mass to mass fills its range for every mass."""
    ranges = Ranges(name="trim", mass=(0.8, 1.2), volume="with_mass", buoyancy=(0.96, 1.04))
    env = Environment(StationKeeping(), worlds=300, randomization=Randomization(ranges))
    body = env.simulator.vehicles[0].body
    mass = env.simulator.plant.mass.numpy()[:, 0] / body.mass
    volume = env.simulator.plant.volume.numpy()[:, 0] / body.displaced_volume
    fills((volume / mass).astype(float), 0.96, 1.04)
    assert np.ptp(mass) > 0.3


def test_every_episode_has_another_vehicle():
    """A reset draws again in the selected worlds, and in no other."""
    env = Environment(StationKeeping(), worlds=10, randomization=Randomization(RANGES))
    before = env.simulator.plant.mass.numpy().copy()
    env.reset(mask=np.arange(10) < 4)
    changed = (env.simulator.plant.mass.numpy() != before)[:, 0]
    assert changed.tolist() == [True] * 4 + [False] * 6


def test_ranges_of_one_change_nothing():
    """Factors of 1 give the vehicle of the file."""
    none = Randomization(Ranges(name="none"))
    plain, drawn = Environment(StationKeeping()), Environment(StationKeeping(), randomization=none)
    for name, field in plain.simulator.plant.fields.items():
        got = drawn.simulator.plant.fields[name].numpy()
        np.testing.assert_allclose(got, field.numpy(), rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "mass: [1.2, 0.8]",
            r"ranges.yaml: mass: is \[1.2, 0.8\], expected two finite numbers \[low, high\]",
        ),
        ("mass: [-1, 1]", "expected numbers above 0"),
        ("mass: [.nan, 1]", "expected two finite numbers"),
        ("masse: [1, 1]", "ranges.yaml: unknown entry 'masse'; did you mean 'mass'"),
        ("added_mass: {axes: {sorge: [1, 1]}}", "unknown entry 'sorge'; did you mean 'surge'"),
        ("[1, 2", "ranges.yaml: line .: not valid YAML"),
        ("- 1", "ranges.yaml: expected keys"),
    ],
)
def test_a_wrong_ranges_file_gets_its_sentence(tmp_path, text, sentence):
    (tmp_path / "ranges.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(RangesError, match=sentence):
        load_ranges(tmp_path / "ranges.yaml")


def test_an_unknown_name_is_told_the_nearest():
    with pytest.raises(RangesError, match="did you mean 'hold_for_position'"):
        load_ranges("hold_for_positon")


def test_the_published_sets_ship():
    assert {"equivalent_box", "fossen_learn_to_swim", "hold_for_position"} <= set(available())


def test_without_thruster_dynamics_thrust_follows_in_one_physics_step():
    """The ranges of the paper's ablation remove lag and delay; with the nominal ones a step does not suffice."""

    def reached(ranges):
        environment = Environment(
            StationKeeping(), worlds=4, action="thruster8", randomization=ranges, seed=3
        )
        environment.step(np.full((4, 8), 0.5, dtype=np.float32))
        thrust = environment.simulator.numpy("actuator")[:, 0]
        return thrust / (0.5 * environment.simulator.vehicles[0].force_limits[1])

    np.testing.assert_allclose(reached(Randomization("no_thruster_dynamics")), 1.0, atol=1e-5)
    assert (reached(None) < 0.9).all()


def test_the_ranges_of_a_pool_draw_currents_and_unlike_propellers():
    """Every world has its own values, within the bounds of the file."""
    environment = Environment(StationKeeping(), worlds=64, randomization=Randomization("pool"), seed=3)
    gain = environment.simulator.plant.gain.numpy()[:, 0]
    current = np.linalg.norm(environment.simulator.water.current.numpy(), axis=1)
    assert 0.72 <= gain.min() and gain.max() <= 1.21 and gain.std(axis=1).min() > 0.02
    assert current.max() <= 0.1 + 1e-6 and current.std() > 0.01
