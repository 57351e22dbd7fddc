"""Apply a constant wrench forward and in yaw for ten seconds, and print the resulting position."""

from finssim.control import Allocator
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle

vehicle = load_vehicle("finsrov")
simulator = Simulator(vehicle, control_step=0.1)
simulator.place(position=(0.0, 0.0, -2.0))

# A wrench in body axes about the vehicle's wrench reference: surge, sway, heave [N], roll, pitch, yaw [N m].
thrust = Allocator.from_vehicle(vehicle).allocate([10.0, 0.0, 0.0, 0.0, 0.0, 0.5])
simulator.set_thrust(thrust)
for _ in range(100):
    simulator.step()

x, y, z = simulator.numpy("position")[0, 0]
u = simulator.numpy("velocity")[0, 0, 0]
print(f"after 10 s: x {x:.2f} m, y {y:.2f} m, depth {-z:.2f} m, surge {u:.3f} m/s")
