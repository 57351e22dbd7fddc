"""`python -m studies.changes`: plants that have changed, a minute of driving, and the tables."""

import numpy as np
import pytest

from finssim.pool import draw_plant
from finssim.pool.plan import make_plan
from finssim.vehicles import load_vehicle
from studies import changes as study

VEHICLE = load_vehicle("finsrov")
SPEC = draw_plant(VEHICLE, 3, "nominal")


def weight_in_water(body):
    return 9.81 * (body.mass - VEHICLE.water.density * body.displaced_volume)


def test_each_change_is_the_one_that_it_says():
    """A kilogram of 3000 kg/m³ at its position, one thruster of eight, all of the damping; nothing else."""
    loaded = study.changed(SPEC, "payload", "")
    more = weight_in_water(loaded.body) - weight_in_water(SPEC.body)
    assert more == pytest.approx(9.81 * (1.0 - VEHICLE.water.density / 3000.0))
    moment = loaded.body.mass * np.array(loaded.body.center_of_gravity)
    moment -= SPEC.body.mass * np.array(SPEC.body.center_of_gravity)
    assert moment == pytest.approx(study.LOAD_PLACE)
    assert (loaded.thrusters, loaded.damping) == (SPEC.thrusters, SPEC.damping)
    weak = study.changed(SPEC, "thruster", "H_LB").thrusters
    assert {n for n in weak if weak[n] != SPEC.thrusters[n]} == {"H_LB"}
    assert weak["H_LB"].gain_plus == pytest.approx(0.7 * SPEC.thrusters["H_LB"].gain_plus)
    fouled = study.changed(SPEC, "drag", "").damping
    assert np.array(fouled.linear) == pytest.approx(1.3 * np.array(SPEC.damping.linear))
    assert np.array(fouled.quadratic) == pytest.approx(1.3 * np.array(SPEC.damping.quadratic))


@pytest.mark.slow
def test_a_minute_of_driving_finds_a_weak_thruster_and_the_tables_say_so():
    """The robot's software runs in lock-step with a pool whose camera, IMU and motors are noisy."""
    plan = make_plan(VEHICLE, "3", "nominal", camera="corners", seed=3)
    plan = study.replace(plan, spec=study.changed(plan.spec, "thruster", "H_LB"))
    result = study.found(study.follow(plan, VEHICLE, 3), "thruster", "H_LB", VEHICLE.water.density)
    assert result["differs"] and result["holds"] and result["others"] == []
    trial = {"pool": 3, "change": "thruster", "model": "changed", "controller": "pid", "success": True}
    row = {"pool": 3, "change": "thruster", **result}
    tables = study.tables_of({"followed": [row], "trials": [{**trial, "e_p_m": 0.014, "t_s_s": 4.5}]})
    assert tables[0].rows[0][0] == "3" and tables[0].rows[0][7:] == ["yes", "none"]
    assert tables[1].rows == [["pid", "thruster", "changed", "1/1", "1.40", "4.50"]]
