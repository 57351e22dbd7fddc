"""A small invented vehicle file that tests copy and modify."""

MINNOW = """\
title: Minnow
description: invented for tests
origin: measured
source: kitchen scale

water: {density: 1000.0, gravity: 9.81}
body:
  mass: 11.2
  inertia: [0.2, 0.3, 0.4]
  center_of_gravity: [0.0, 0.0, -0.02]
  displaced_volume: 0.0113
  center_of_buoyancy: [0.0, 0.0, 0.02]
  size: [0.5, 0.4, 0.3]
  surface_half_height: 0.1
hydrodynamics:
  calibrated:
    added_mass: [5, 6, 7, 0.1, 0.1, 0.1]
    linear_damping: [10, 11, 12, 1, 1, {value: 1.5, origin: guessed, note: nobody spun it}]
    quadratic_damping: [20, 21, 22, 2, 2, 2]
thruster_groups:
  small:
    {force_min: -4.0, force_max: 5.0, c_plus: 4.1e-4, c_minus: 3.5e-4, rpm_min: -1100, rpm_max: 1100,
     domain: speed, time_constant: 0.1}
thrusters:
  front_left: {group: small, position: [0.14, 0.10, 0.0], axis: [0.70710678, -0.70710678, 0.0]}
  front_right: {group: small, position: [0.14, -0.10, 0.0], axis: [0.70710678, 0.70710678, 0.0]}
  up: {group: small, position: [0, 0, 0], axis: [0, 0, 1], force_max: 6.0, c_plus: 5.0e-4}
controlled_axes: [surge, heave, yaw]
"""
