"""A calibration's report is self-contained and has all that a reader needs to judge or repeat it."""

import dataclasses
import json
import re

import numpy as np
import pytest

from finssim.core.files import OutputError
from finssim.identification.fit import Curve, Dive, Estimate
from finssim.identification.plant_terms import matrices
from finssim.identification.programme import Leg
from finssim.identification.report import fit_json, fit_report, write_report
from finssim.identification.vehicle_file import calibrated
from finssim.trials.findings import finding
from identification.made_fits import made_fit

WEAK = [finding("unusable", reason="surge <alone> is weak")]
COMMAND = "finssim calibrate hydrodynamics trials --vehicle finsrov --out mine.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The report of a hand-made fit."""
    fit = made_fit()
    out = tmp_path_factory.mktemp("report") / "report"
    write_report(fit, out, calibrated(fit), command=COMMAND, findings=WEAK)
    return out


def test_the_page_loads_nothing(folder):
    """Pictures are embedded; there is no script, style sheet or address; text is escaped."""
    html = (folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(sources) == 2 and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", html) and "<script" not in html
    assert "surge &lt;alone&gt; is weak" in html


def test_a_reader_finds_what_they_need(folder):
    """The page contains estimates with intervals, kept values, warnings, trials by digest, and the command to
    repeat it."""
    text = (folder / "report.html").read_text(encoding="utf-8")
    vehicle = calibrated(made_fit())
    for words in (
        "37.9 to 40.2",
        "4 of 6 parameters",
        "yaw.d2 0.4776",
        "is at its bound",
        "11" * 32,
        COMMAND,
        vehicle.sha256,
        "&quot;seed&quot;: 4",
    ):
        assert words in text


def test_the_page_begins_with_a_picture_and_what_to_record_next(tmp_path):
    """Curves come first, then known and unknown parameters and the next dive, then tables."""
    dive = Dive(legs=(Leg("yaw", 2.0, 4.0, times=3),), widest="yaw.d2", factor=0.4)
    fit = made_fit(next_dive=dive)
    write_report(fit, tmp_path / "report", calibrated(fit))
    text = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    order = (
        '<img alt="Measured and simulated',
        "4 of 6 parameters",
        "Not determined: yaw.d2 (hardly)",
        "Record next: yaw at ±2 N m",
    )
    places = [text.index(words) for words in (*order, "<th>parameter</th>", '<img alt="Correlation')]
    assert places == sorted(places)
    record = json.loads((tmp_path / "report" / "fit.json").read_text(encoding="utf-8"))
    assert record["next_dive"]["legs"] == [{"axis": "yaw", "level": 2.0, "hold": 4.0, "times": 3}]


def test_a_given_inertia_is_not_called_determined_and_a_kept_stiffness_is_one():
    """The file contains the height of the centre of buoyancy, from which k follows."""
    given = Estimate(
        name="yaw.m_eff", estimate=0.4, ci95=(0.4, 0.4), unit="kg m²", identifiable=True, note="given"
    )
    k = Estimate(
        name="roll.k", estimate=8.0, ci95=(0.0, 90.0), unit="N m/rad", identifiable=False,
        path="body.center_of_buoyancy.2",
    )  # fmt: skip
    fit = made_fit(estimates=made_fit().estimates | {"yaw.m_eff": given, "roll.k": k})
    vehicle = calibrated(fit)
    lead = fit_report(fit, vehicle).lead
    assert "Given: yaw.m_eff 0.4 kg m²." in lead and "yaw.m_eff" not in lead[0]
    kept = fit_json(fit, vehicle)["kept"]["roll.k"]
    assert kept == pytest.approx(matrices(fit.before).arm[2]) and kept > 1.0


def test_words_of_numbers_fit_what_they_are_of():
    """A position is in metres, tight intervals have a decimal, and a kept stiffness replaces the height in the file."""
    more = [
        Estimate(name=name, estimate=value, ci95=ci, unit=unit, identifiable=told, note="", path=path)
        for name, value, ci, unit, told, path in (
            ("gravity_y", 1e-4, (-0.003, 0.0032), "m", True, "body.center_of_gravity.1"),
            ("yaw.m_eff", 1.0, (0.997, 1.003), "kg m²", True, None),
            ("roll.k", 5.0, (1.0, 9.0), "N m/rad", False, "body.center_of_buoyancy.2"),
        )
    ]
    fit = made_fit()
    fit = dataclasses.replace(fit, estimates=dict(fit.estimates) | {one.name: one for one in more})
    report = fit_report(fit, calibrated(fit), ())
    assert "gravity_y (±0.0031 m)" in report.lead[0] and "yaw.m_eff (±0.3 %)" in report.lead[0]
    assert report.remarks[-1].endswith("yaw.d2 0.4776, heave.d1 80.1, roll.k 13.08"), report.remarks


def test_the_pictures_are_files_too(folder):
    """Every picture of the page is also a PNG beside it."""
    pictures = sorted(folder.glob("*.png"))
    assert [path.name for path in pictures] == ["correlation.png", "curves_1.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    assert json.loads((folder / "fit.json").read_text())["parameters"]["surge.d1"]["estimate"] == 39.1


def test_equal_fits_make_equal_reports(folder, tmp_path):
    """Reports of equal fits are equal: neither text nor pictures contain a clock time."""
    fit = made_fit()
    write_report(fit, tmp_path / "r", calibrated(fit), command=COMMAND, findings=WEAK)
    assert (tmp_path / "r" / "report.html").read_bytes() == (folder / "report.html").read_bytes()


def test_a_fit_of_almost_nothing_has_a_report(tmp_path):
    """A fit without a curve, a correlation or a finite interval has a report."""
    fit = made_fit()
    fit = dataclasses.replace(
        fit,
        curves=(),
        correlation=None,
        changes={},
        quality={},
        estimates={"heave.d1": fit.estimates["heave.d1"]},
    )
    write_report(fit, tmp_path / "r", calibrated(fit))
    assert "0 of 1 parameters" in (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    assert not list((tmp_path / "r").glob("*.png"))


@pytest.mark.slow
def test_many_curves_are_drawn_up_to_a_limit_that_is_said(tmp_path):
    """A hundred curves give eight figures and a sentence."""
    x = np.arange(3.0)
    curve = Curve(title="c", x_label="t [s]", y_label="u", x=x, measured=x, fitted=x)
    fit = dataclasses.replace(made_fit(), curves=(curve,) * 100)
    write_report(fit, tmp_path / "r", calibrated(fit))
    assert len(list((tmp_path / "r").glob("curves_*.png"))) == 8
    assert "52 more curves are not drawn" in (tmp_path / "r" / "report.html").read_text(encoding="utf-8")


def test_lines_of_a_curve_break_at_gaps():
    """For two segments with a gap in the first, the line breaks at the gap and between them, and time continues."""
    t = np.concatenate([np.arange(0.0, 1.0, 0.1), np.arange(11.0, 12.0, 0.1)])
    curve = Curve.joined(
        "c",
        "u",
        [
            (t, t, t),
            (
                t[:10],
                t[:10],
                t[:10],
            ),
        ],
    )
    holes = np.flatnonzero(np.isnan(curve.x))
    assert holes.tolist() == [10, 21, 32]
    for line in (curve.measured, curve.fitted):
        np.testing.assert_array_equal(np.isnan(line), np.isnan(curve.x))
    assert np.nanmax(np.diff(curve.x[:10])) < 0.11 and curve.x[22] == pytest.approx(t[-1] + 1.0)


def test_somebodys_files_are_not_replaced(tmp_path):
    """A folder with other files is refused; an earlier report is replaced."""
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OutputError, match="already holds files"):
        write_report(made_fit(), tmp_path, calibrated(made_fit()))
