"""Push a crate across a pool with two vehicles in it, and take a picture."""

import numpy as np

from finssim.control.allocation import Allocator
from finssim.engine import PictureError, Pool, Scene
from finssim.vehicles import load_vehicle

# A box of 20 cm and 12 kg. `gravcomp` is its buoyancy: water carries two thirds of the weight.
CRATE = """<body name="crate" pos="0.6 0 -0.9" gravcomp="0.667">
  <freejoint/><geom type="box" size="0.1 0.1 0.1" density="1500" rgba="0.8 0.4 0.2 1"/>
</body>"""

vehicle = load_vehicle("finsrov")
scene = Scene([vehicle, vehicle], pool=Pool(length=4.0, width=2.0, depth=1.0), objects=CRATE)
scene.place(position=[[[-0.3, 0.0, -0.85], [-1.4, 0.5, -0.4]]])

# Surge [N] and a little heave to stay at the crate's height, for the first vehicle; the second one waits.
thrust = Allocator.from_vehicle(vehicle).allocate([16.0, 0.0, -0.3, 0.0, 0.0, 0.0])
scene.set_thrust([[thrust, np.zeros_like(thrust)]])
pushes = []
for _ in range(60):
    scene.step()
    pushes.append(-scene.contact_wrench()[0, 0, 0])  # mean of the control step, body frame

crate, _ = scene.pose("crate")
print(
    f"after {scene.time:.0f} s: crate at x {crate[0]:.2f} m, from 0.60 m; mean push {np.mean(pushes[-20:]):.1f} N"
)
try:
    picture = scene.render("corner", width=800, height=600)
    print(
        f"picture of {picture.shape[1]} x {picture.shape[0]} pixels, mean colour {picture.mean(axis=(0, 1)).round()}"
    )
except PictureError as error:
    print(error)
