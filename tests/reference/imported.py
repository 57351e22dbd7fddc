"""Shared code of the importers' tests: motion of the imported vehicle and of its origin, and changes of a
file."""

from xml.etree.ElementTree import tostring

import numpy as np

from finssim.core.rotations import matrix_to_quat
from finssim.sim import Simulator
from finssim.vehicles import VehicleError
from finssim.vehicles.importers.draft import read_foreign
from reference.cases import disturb
from reference.gz_sim import element, euler


def setting(path, text, **attributes):
    """Return a change that writes a text into the first element of a path."""

    def change(root):
        root.find(path).text = text
        root.find(path).attrib.update(attributes)

    return change


def adding(path, tag, text=None, **attributes):
    return lambda root: element(root.find(path), tag, text, **attributes)


def simulated(vehicle, R, nu, tau, duration):
    """Return velocities of a free vehicle under constant wrenches, every 0.05 s, (t, n, 6)."""
    simulator = Simulator(vehicle, worlds=len(nu), control_step=0.05, substeps=10, integrator="rk4")
    quaternions = np.array([matrix_to_quat(x) for x in R])[:, None]
    simulator.place(position=(0.0, 0.0, -200.0), quaternion=quaternions, velocity=nu[:, None])
    disturb(simulator, tau[:, None])
    out = [nu]
    for _ in range(round(duration / 0.05)):
        simulator.step()
        out.append(simulator.numpy("velocity")[:, 0].copy())
    return np.array(out)


def driven(vehicle, duration):
    """Return the velocity of a free vehicle from rest, after its thrusters ran at full static thrust, (6,)."""
    simulator = Simulator(vehicle, control_step=0.05, substeps=10, integrator="rk4")
    simulator.place(position=(0.0, 0.0, -200.0))
    simulator.set_thrust(vehicle.force_limits[1])
    for _ in range(round(duration / 0.05)):
        simulator.step()
    return simulator.numpy("velocity")[0, 0].copy()


def assert_moves_alike(vehicle, origin, force, duration=4.0, tolerance=0.002, ahead=(0.0, 0.0)):
    """Compare six steps of force, release at rest, and a decay from a tilt with all velocities, at all times.

    Args:
        vehicle: The imported vehicle.
        origin: Equations of the other program.
        force: Step along each axis [N, N m], (6,).
        duration: Duration of each motion [s].
        tolerance: Share of the greatest velocity.
        ahead: Surge force [N] and speed [m/s] of all motions.
    """
    tau, nu, R = np.zeros((8, 6)), np.zeros((8, 6)), np.repeat(np.eye(3)[None], 8, axis=0)
    tau[:6] = np.diag(force)
    tau[:, 0] += ahead[0]
    nu[:, 0] = ahead[1]
    nu[7], R[7] = [0.5, 0.3, -0.2, 0.4, -0.3, 0.5], euler(0.4, -0.3, 1.0)
    found = simulated(vehicle, R, nu, tau, duration)
    _, expected = origin.run(R, nu, tau, duration)
    expected = expected[::5]
    for part in (slice(0, 3), slice(3, 6)):
        scale = np.maximum(np.abs(expected[..., part]).max(axis=(0, 2)), 0.01)
        assert (np.abs(found - expected)[..., part].max(axis=(0, 2)) < tolerance * scale).all()


def unnoticed(root, read, path):
    """Return names of elements to which an x can be appended without a refusal and without a note.

    Args:
        root: Function that makes the root of a file.
        read: Function that reads the file's draft.
        path: The file.
    """
    path.write_bytes(tostring(root()))
    first, found = read(path).not_read, []
    for k in range(1, len(list(root().iter()))):
        changed = root()
        one = list(changed.iter())[k]
        one.tag += "x"
        path.write_bytes(tostring(changed))
        try:
            added = read(path).not_read - first
        except VehicleError as error:
            assert path.name in str(error)
        else:
            if not any(one.tag in text for text in added):
                found.append(one.tag)
    return found


def imported(path):
    return read_foreign(path).vehicle(path.parent)
