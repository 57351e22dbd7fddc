"""What T2's policy is fed: the published 30 numbers, written out here a second time."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.control.observe_t2 import SCHEMA, observe_t2
from finssim.control.trajectories import TRAJECTORIES

CIRCLE = TRAJECTORIES["circle"]


def state(seed):
    rng = np.random.default_rng(seed)
    q = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3)).as_quat()
    return SimpleNamespace(position=rng.uniform(-1.0, 1.0, 3), quaternion=q, nu=rng.uniform(-3.0, 3.0, 6))


@pytest.mark.parametrize("t", [0.0, 12.34, CIRCLE.duration - 0.15, CIRCLE.duration + 5.0])
def test_it_is_the_published_one(t):
    measured = state(int(t))
    R = Rotation.from_quat(measured.quaternion).inv()
    offsets = [R.apply(CIRCLE.at(t + k).position - measured.position) / 3.0 for k in (0.0, 0.1, 0.2, 0.3)]
    v = R.apply(CIRCLE.at(t).velocity)
    psi, s = np.arctan2(v[1], v[0]), min(t / CIRCLE.duration, 1.0)
    turns = [np.sin(2 * np.pi * s), np.cos(2 * np.pi * s), np.sin(4 * np.pi * s), np.cos(4 * np.pi * s)]
    nu = np.clip(measured.nu, -2.0, 2.0)
    expected = [*np.ravel(offsets), *v, *nu, *R.apply([0, 0, 1]), np.sin(psi), np.cos(psi), *turns]
    np.testing.assert_allclose(observe_t2(measured, CIRCLE, t), expected, atol=1e-12)


def test_a_batch_is_its_members_one_by_one():
    one, two = state(0), state(1)
    both = SimpleNamespace(**{k: np.stack([getattr(one, k), getattr(two, k)]) for k in vars(one)})
    batch = observe_t2(both, CIRCLE, 3.0)
    np.testing.assert_allclose(
        batch, [observe_t2(one, CIRCLE, 3.0), observe_t2(two, CIRCLE, 3.0)], atol=1e-15
    )
    at_times = observe_t2(both, CIRCLE, np.array([3.0, 8.0]))
    np.testing.assert_allclose(at_times[1], observe_t2(two, CIRCLE, 8.0), atol=1e-15)


def test_the_schema_names_every_number_once():
    assert SCHEMA.size == 30
    assert sorted(i for entry in SCHEMA.entries for i in entry.indices) == list(range(30))
