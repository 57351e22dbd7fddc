"""Equations of Fossen's vehicles in float64, x forward, y right, z down, independent of the importers, and their files.

The numbers are those of public vehicles; the files are written here.
"""

import numpy as np

from reference.gz_sim import Origin

F = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
"""Signs that convert forward, left, up to forward, right, down, and back."""


def S(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def coriolis(M, nu):
    """Return C(nu) of Fossen 2021, eq. 3.60."""
    C, a = np.zeros((6, 6)), M @ nu
    C[:3, 3:] = C[3:, :3] = -S(a[:3])
    C[3:, 3:] = -S(a[3:])
    return C


class Fossen(Origin):
    """M nu_dot + C_RB nu + C_A nu + D nu + D_n |nu| nu + g = tau, all about CO; `run` is that of its base."""

    def __init__(self, m, inertia, rg, rb, B, added, linear, quadratic, g=9.81):
        self.M_RB = np.block([[m * np.eye(3), -m * S(rg)], [m * S(rg), np.diag(inertia) - m * S(rg) @ S(rg)]])
        self.M_A, self.D, self.Dn = (np.diag(np.abs(x)) for x in (added, linear, quadratic))
        self.W, self.B = m * g, B
        self.arm = self.W * S(rg) - B * S(rb)

    def added_coriolis(self, nu):
        return coriolis(self.M_A, nu)

    def drag(self, nu):
        return (self.D + self.Dn * np.abs(nu)) @ nu

    def rate(self, R, nu, tau):
        """Return the acceleration of many states, x forward, y left, z up: rotation (n, 3, 3), velocity and
        wrench (n, 6)."""
        out, inverse = [], np.linalg.inv(self.M_RB + self.M_A)
        for turn, v, push in zip(R, nu * F, tau * F, strict=True):
            # The world's z axis, in body axes with z down.
            down = np.array([-turn[2, 0], turn[2, 1], turn[2, 2]])
            total = push + np.concatenate([(self.W - self.B) * down, self.arm @ down]) - self.drag(v)
            total -= (coriolis(self.M_RB, v) + self.added_coriolis(v)) @ v
            out.append(inverse @ total * F)
        return np.array(out)


class Torpedo(Fossen):
    """`remus100` of cybergalactic/PythonVehicleSimulator, commit c717e07: hull, and propeller by its speed and U."""

    def __init__(self, L=1.6, diam=0.19, m=None, Cd=0.42, rho=1026.0, fraction=0.7):
        a, b = L / 2, diam / 2
        m = 4 / 3 * np.pi * rho * a * b**2 if m is None else m
        Ix, Iy = 0.4 * m * b**2, 0.2 * m * (a**2 + b**2)
        e = np.sqrt(1 - (b / a) ** 2)
        alpha = (2 * (1 - e**2) / e**3) * (0.5 * np.log((1 + e) / (1 - e)) - e)
        beta = 1 / e**2 - (1 - e**2) / (2 * e**3) * np.log((1 + e) / (1 - e))
        k1, k2 = alpha / (2 - alpha), beta / (2 - beta)
        k = e**4 * (beta - alpha) / ((2 - e**2) * (2 * e**2 - (2 - e**2) * (beta - alpha)))
        super().__init__(m, [Ix, Iy, Iy], [0, 0, 0.02], [0, 0, 0], m * 9.81,
                         [m * k1, m * k2, m * k2, 0.3 * Ix, k * Iy, k * Iy], [0] * 6, [0] * 6)  # fmt: skip
        M = np.diag(self.M_RB + self.M_A)
        w = np.sqrt(self.W * 0.02 / M[3:5])
        self.damping = np.array(
            [M[0] / 20, M[1] / 20, M[2] / 20, M[3] * 0.6 * w[0], M[4] * 1.6 * w[1], M[5] / 1]
        )
        self.L, self.diam, self.area, self.rho = L, diam, fraction * L * diam, rho
        self.CD_0 = Cd * np.pi * b**2 / self.area
        self.rpm = 0.0

    def added_coriolis(self, nu):
        C = coriolis(self.M_A, nu)
        for i, j in ((4, 0), (4, 2), (5, 0), (5, 1)):
            C[i, j] = C[j, i] = 0.0
        return C

    def drag(self, nu):
        U, D = np.linalg.norm(nu[:3]), self.damping.copy()
        D[:2] *= np.exp(-3 * U)
        ratio, alpha = self.diam**2 / self.area, np.arctan2(nu[2], nu[0])
        CL = np.pi * ratio / (1 + np.sqrt(1 + (ratio / 2) ** 2)) * alpha
        CD = self.CD_0 + CL**2 / (np.pi * 0.7 * ratio)
        drag, lift = (0.5 * 1026.0 * U**2 * self.area * x for x in (CD, CL))
        wrench = D * nu
        wrench[0] += np.cos(alpha) * drag - np.sin(alpha) * lift
        wrench[2] += np.sin(alpha) * drag + np.cos(alpha) * lift
        curve = 1.2108 + (1.0836 - 1.2108) * (0.5 - 0.4933) / (0.5585 - 0.4933)  # Hoerner's at B/2T = 0.5
        x = np.linspace(-self.L / 2, self.L / 2, 21)
        flow = (
            0.5 * 1026.0 * self.diam * curve * np.abs(nu[1] + x * nu[5]) * (nu[1] + x * nu[5]) * self.L / 20
        )
        wrench[[1, 5]] += np.sum(flow), np.sum(x * flow)
        return wrench - self.propulsion(U)

    def propulsion(self, U):
        n, D = self.rpm / 60, 0.14
        K = self.rho * D**4 * (0.4566 * n * abs(n) + (0.1798 - 0.4566) / 0.6632 * 0.944 * U / D * abs(n))
        return np.array([0.9 * K, 0, 0, 0, 0, 0])
