"""`excite` writes programmes that a robot can run, and trials that read back."""

import csv

import numpy as np
import pytest
import yaml

from finssim.core.files import OutputError
from finssim.evaluation.excitation import PlanSettings, SimulationSettings, excite
from finssim.identification.programme import programmes
from finssim.identification.synthetic import simulate_programme
from finssim.trials.trial_files import load_trial
from finssim.vehicles import load_vehicle

BLUEROV2 = load_vehicle("bluerov2")


def test_a_written_programme_holds_the_thrusts_of_its_wrench(tmp_path):
    """B times the thruster columns is the wrench column, in every row; times and phases are the programme's."""
    folders = excite("sway,yaw", vehicle="bluerov2", out=tmp_path / "plan", plan=PlanSettings(levels=["5"]))
    plan = programmes("sway,yaw", BLUEROV2, levels=[5.0])
    assert [f.name for f in folders] == [p.name for p in plan]
    for folder, programme in zip(folders, plan, strict=True):
        with (folder / "programme.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        force = np.array([[float(row[f"force_{n}"]) for n in BLUEROV2.thruster_names] for row in rows])
        tau = np.array([[float(row[f"tau_{c}"]) for c in "xyzkmn"] for row in rows])
        controlled = [0, 1, 2, 3, 5]
        given = force @ BLUEROV2.control_matrix.T
        np.testing.assert_allclose(given[:, controlled], tau[:, controlled], atol=2e-3)  # regularisation
        np.testing.assert_allclose([float(row["t"]) for row in rows], programme.t)
        assert [row["phase"] for row in rows] == programme.phase.tolist()
        about = yaml.safe_load((folder / "programme.yaml").read_text())
        assert about["peak"] == {f"tau_{'y' if 'sway' in folder.name else 'n'}": 5.0}


@pytest.mark.slow
def test_simulated_trials_open_as_they_were_made(tmp_path):
    """A trial read back from its folder has the digest of the one in memory."""
    folders = excite(
        "surge",
        vehicle="bluerov2",
        out=tmp_path / "trials",
        plan=PlanSettings(levels=["5"]),
        simulation=SimulationSettings(simulate=True),
        seed=3,
    )
    made = simulate_programme(programmes("surge", BLUEROV2, levels=[5.0]), BLUEROV2, seed=3)
    assert [load_trial(folder).sha256 for folder in folders] == [trial.sha256 for trial in made]


def test_an_earlier_output_is_replaced_and_a_foreign_folder_is_not(tmp_path):
    """A second run replaces the programmes; a folder with anything else in it is refused."""
    excite("surge", vehicle="bluerov2", out=tmp_path / "plan", plan=PlanSettings(levels=["5,6"]))
    excite("surge", vehicle="bluerov2", out=tmp_path / "plan", plan=PlanSettings(levels=["5"]))
    assert len(list((tmp_path / "plan").iterdir())) == 2 + 1
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="already holds files"):
        excite("surge", vehicle="bluerov2", out=tmp_path / "mine")
