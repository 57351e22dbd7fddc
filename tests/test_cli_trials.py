"""`finssim trials` and `finssim excite`, with words as a user types them."""

import json

import pytest

from finssim.trials.trial_files import load_trials
from finssim.vehicles import load_vehicle
from reference.commands import finssim, refusal


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """Two simulated trials of surge, as `excite` writes them."""
    out = tmp_path_factory.mktemp("excite") / "trials"
    assert (
        finssim("excite", "surge", "--vehicle", "finsrov", "--levels", "9", "--simulate", "--out", out) == 0
    )
    return out


@pytest.mark.parametrize("group", ["trials", "calibrate", "experiment"])
def test_a_group_alone_shows_its_commands(capsys, group):
    """A group without a further word shows its commands and is not an error."""
    assert finssim(group) == 0
    assert "Commands:" in capsys.readouterr().out


def test_excite_writes_trials_that_read_back(trials):
    """Both directions of the level are written, with the vehicle's name and the measured quantities."""
    found = load_trials([trials])
    assert {trial.name for trial in found} == {"surge_plus_9", "surge_minus_9"}
    assert all(trial.has("u", "tau_x", "rpm_H_LF") for trial in found)


def test_excite_writes_programmes_for_a_robot(capsys, tmp_path):
    """Without --simulate, each programme becomes a table; --json names the folders."""
    words = ["excite", "surge,yaw", "--vehicle", "finsrov", "--levels", "surge=5,10", "--levels", "yaw=1"]
    assert finssim(*words, "--out", tmp_path / "p", "--json") == 0
    folders = json.loads(capsys.readouterr().out)["trials"]
    assert len(folders) == 6
    assert (tmp_path / "p" / "yaw_plus_1" / "programme.csv").is_file()


def test_import_makes_a_trial_of_a_table(capsys, tmp_path):
    """A table with canonical columns needs no column map."""
    rows = "\n".join(f"{0.1 * i:.1f},{min(i, 10)},{0.01 * i}" for i in range(40))
    (tmp_path / "pool.csv").write_text(f"t,tau_x,u\n{rows}\n", encoding="utf-8")
    assert finssim("trials", "import", tmp_path / "pool.csv", "--out", tmp_path / "out", "--json") == 0
    (folder,) = json.loads(capsys.readouterr().out)["trials"]
    assert load_trials([folder])[0].has("tau_x", "u")


@pytest.mark.slow
def test_check_says_what_trials_can_tell(capsys, trials):
    """The check prints text, or one JSON object that names every trial."""
    assert finssim("trials", "check", trials, "--vehicle", "finsrov") == 0
    assert "surge_plus_9" in capsys.readouterr().out
    assert finssim("trials", "check", trials, "--vehicle", "finsrov", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert {"surge_plus_9", "surge_minus_9"} == {trial["name"] for trial in found["trials"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["excite", "surg", "--vehicle", "finsrov"], "unknown axis 'surg'"),
        (["excite", "pitch", "--vehicle", "bluerov2"], "cannot control pitch"),
        (["excite", "surge", "--vehicle", "finrov"], "did you mean 'finsrov'"),
        (["excite", "surge", "--vehicle", "finsrov", "--kind", "chirp"], "unknown kind of programme 'chirp'"),
        (["excite", "surge", "--vehicle", "finsrov", "--levels", "ten"], "expected numbers such as 5,10"),
        (["excite", "surge", "--vehicle", "finsrov", "--levels", "5", "--levels", "yaw=1"], "one of the two"),
        (
            ["excite", "surge", "--vehicle", "finsrov", "--kind", "multisine", "--duration", "0"],
            "duration is 0 s",
        ),
        (["trials", "import", "nowhere.csv"], "nowhere.csv: no such file"),
        (["trials", "import", "notes.txt", "--format", "word"], "format is 'word'"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(capsys, tmp_path, words, sentence):
    """Each request is refused in a sentence, and nothing is written."""
    assert sentence in refusal(capsys, *words, "--out", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_the_vehicle_of_imported_trials_is_found_from_any_directory(capsys, tmp_path, monkeypatch):
    """A vehicle file beside the logs, given by a relative path, is found from elsewhere and after moving the folder."""
    home, away = tmp_path / "dive", tmp_path / "moved"
    (home / "sub").mkdir(parents=True)
    (home / "own.yaml").write_text("extends: bluerov2\n", encoding="utf-8")
    rows = "\n".join(f"{0.1 * i:.1f},{min(i, 10)},{0.01 * i}" for i in range(40))
    (home / "pool.csv").write_text(f"t,tau_x,u\n{rows}\n", encoding="utf-8")
    monkeypatch.chdir(home)
    assert finssim("trials", "import", "pool.csv", "--vehicle", "own.yaml", "--out", "trials") == 0

    def refused(trials):
        capsys.readouterr()
        finssim("trials", "check", trials, "--json")
        (trial,) = json.loads(capsys.readouterr().out)["trials"]
        return "vehicle_refused" in {entry["code"] for entry in trial["findings"]}

    monkeypatch.chdir(tmp_path)
    assert not refused(home / "trials")
    home.rename(away)
    assert not refused(away / "trials")
    (away / "own.yaml").unlink()
    assert refused(away / "trials")


def test_check_ends_with_3_if_no_trial_can_be_used(capsys, tmp_path):
    """Status 3 lets a script detect that no trial can be used."""
    (tmp_path / "still.csv").write_text("t,u\n0,0\n0.1,0\n0.2,0\n", encoding="utf-8")
    assert finssim("trials", "check", tmp_path, "--vehicle", "bluerov2") == 3
    assert "refused" in capsys.readouterr().out


def test_check_refuses_what_is_no_trial(capsys, tmp_path):
    """A folder without trials and a path that does not exist are refused."""
    assert "contains no trial" in refusal(capsys, "trials", "check", tmp_path)
    assert "no such file" in refusal(capsys, "trials", "check", tmp_path / "nowhere")


def test_a_place_that_takes_no_files(capsys):
    """An unwritable output directory is refused in a sentence."""
    assert "write elsewhere" in refusal(
        capsys, "excite", "surge", "--vehicle", "finsrov", "--out", "/proc/x/trials"
    )
    assert load_vehicle("finsrov").calibrations == ()
