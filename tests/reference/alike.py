"""Motion of an imported vehicle beside that of its origin's equations."""

import numpy as np

from finssim.core.rotations import matrix_to_quat
from finssim.sim import Simulator
from reference.cases import disturb
from reference.gz_sim import euler


def simulated(vehicle, R, nu, tau, duration):
    """Velocities of a free vehicle under constant wrenches, every 0.05 s, (t, n, 6)."""
    simulator = Simulator(vehicle, worlds=len(nu), control_step=0.05, substeps=10, integrator="rk4")
    quaternions = np.array([matrix_to_quat(x) for x in R])[:, None]
    simulator.place(position=(0.0, 0.0, -200.0), quaternion=quaternions, velocity=nu[:, None])
    disturb(simulator, tau[:, None])
    out = [nu]
    for _ in range(round(duration / 0.05)):
        simulator.step()
        out.append(simulator.numpy("velocity")[:, 0].copy())
    return np.array(out)


def assert_moves_alike(vehicle, origin, force, duration=4.0, tolerance=0.002):
    """Six steps of force, release at rest, and a decay from a tilt with all velocities, at all times."""
    tau, nu, R = np.zeros((8, 6)), np.zeros((8, 6)), np.repeat(np.eye(3)[None], 8, axis=0)
    tau[:6] = np.diag(force)
    nu[7], R[7] = [0.5, 0.3, -0.2, 0.4, -0.3, 0.5], euler(0.4, -0.3, 1.0)
    found = simulated(vehicle, R, nu, tau, duration)
    _, expected = origin.run(R, nu, tau, duration)
    expected = expected[::5]
    for part in (slice(0, 3), slice(3, 6)):
        scale = np.maximum(np.abs(expected[..., part]).max(axis=(0, 2)), 0.01)
        assert (np.abs(found - expected)[..., part].max(axis=(0, 2)) < tolerance * scale).all()
