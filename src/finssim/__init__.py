"""FinsSim: calibrate, simulate, train and deploy underwater robots through one set of interfaces.

The parts are imported by name, so that each costs only what it needs:

    from finssim.vehicles import load_vehicle
    from finssim.engine import Simulator
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
