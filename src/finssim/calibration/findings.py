"""What is found out about data and fits: one record for all of it, filtered by its code and worded here alone."""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

__all__ = ["SENTENCES", "SEVERITIES", "Finding", "Severity", "finding", "sentences"]

Severity = Literal["refused", "care", "note"]
"""What a finding makes of a trial or fit: nothing can rest on it; something may not; worth knowing."""

SEVERITIES: tuple[Severity, ...] = ("refused", "care", "note")
"""The worst first."""

MOST_NAMES = 8
"""Items of a list that a sentence names."""

MOST_SUBJECTS = 3
"""Subjects that a sentence names where it holds for several."""


class _Template(string.Formatter):
    """`str.format` that writes a tuple as a list of words."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if not isinstance(value, (tuple, list)):
            return str(super().format_field(value, format_spec))
        return _listed([format(item, format_spec) for item in value], MOST_NAMES)


def _listed(words: list[str], most: int) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


@dataclass(frozen=True)
class Finding:
    """One remark about data or a fit."""

    code: str
    """Key of `SENTENCES`."""
    severity: Severity
    subject: str = ""
    """What it is about: a trial, file, thruster, axis or parameter; empty where that goes without saying."""
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Fields of the sentence, in SI or in the unit that the sentence names."""

    @property
    def text(self) -> str:
        """The sentence without its subject: what, and what to do."""
        return _Template().format(SENTENCES[self.code][1], **self.values)

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}" if self.subject else self.text

    def about(self, subject: str) -> Finding:
        """The same about something, or about a part of it where it has a subject already."""
        return replace(self, subject=f"{subject}: {self.subject}" if self.subject else subject)

    def as_json(self) -> dict[str, Any]:
        """Code, severity, subject, values and sentence; numbers that are not finite become None."""
        return {
            "code": self.code,
            "severity": self.severity,
            "subject": self.subject,
            "values": {name: _plain(value) for name, value in self.values.items()},
            "sentence": str(self),
        }


def finding(code: str, subject: str = "", /, *, severity: Severity | None = None, **values: Any) -> Finding:
    """A finding with the severity that its code usually has.

    Args:
        code: Key of `SENTENCES`.
        subject: What it is about.
        severity: Where it differs from the usual one.
        values: Fields of the sentence.
    """
    return Finding(code, severity or SENTENCES[code][0], subject, values)


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Sentences in their order; what holds for several subjects is one sentence."""
    subjects: dict[tuple[str, str], list[str]] = {}
    for one in findings:
        named = subjects.setdefault((one.code, one.text), [])
        if one.subject not in named:
            named.append(one.subject)
    return [
        f"{_listed(named, MOST_SUBJECTS)}: {text}" if any(named) else text
        for (_, text), named in subjects.items()
    ]


def _plain(value: Any) -> Any:
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


SENTENCES: dict[str, tuple[Severity, str]] = {
    # Reading tables and trials.
    "zero_bytes": ("note", "the file ends in zero bytes, as after a crash: it was read up to them"),
    "last_cell_cut": ("note", "the last line has no end: its last cell may be cut and was left out"),
    "last_line_cut": ("note", "the last line is cut short and was left out"),
    "ragged_rows": (
        "note",
        "{rows} rows do not have {expected} cells and were left out (first: row {first})",
    ),
    "not_numbers": (
        "note",
        "column '{column}': {cells} cells hold no number and count as empty (first: '{cell}' in row {row})",
    ),
    "column_kind": ("note", "column '{column}' holds {kind}, not numbers, and was left out"),
    "infinite_numbers": ("note", "column '{column}': {cells} infinite numbers count as empty"),
    "unknown_column": ("note", "column '{column}' is not one of a trial and was left out{hint}"),
    "unknown_columns": ("note", "{count} more columns are not of a trial and were left out: {columns}"),
    "unknown_phases": (
        "note",
        "phase '{word}'{hint} known words are {known}; {count} unknown words count as empty",
    ),
    "repeated_samples": (
        "note",
        "{group}: every new sample is repeated, {rows:.1f} rows on average; repeats count as empty",
    ),
    "upside_down": (
        "note",
        "the attitude has the vehicle on its back most of the time: are convert.body and convert.world what the log "
        "uses?",
    ),
    "quaternion_incomplete": (
        "note",
        "columns {columns} were left out: an attitude needs qx, qy, qz and qw",
    ),
    "quaternion_lengths": (
        "note",
        "{samples} quaternions have a length below 0.5 (0 means no fix) and count as empty",
    ),
    "dates": ("note", "t holds dates; times count from {start}"),
    "epoch": ("note", "t counts from 1970; times count from the first row, {start:.6f} s"),
    "rows_untimed": ("note", "{rows} rows have no time and were left out"),
    "times_sorted": ("note", "times step back at {rows} of {total} rows; the rows were sorted by time"),
    "clock_jump": (
        "care",
        "the clock jumps back from {before:.6g} s to {after:.6g} s at row {row}: the rows from there on were moved "
        "{shift:.6g} s later, behind a gap, because the time that passed is not known",
    ),
    "times_conflict": (
        "note",
        "{times} times are there more than once with different numbers (first: {first:.6g} s); the later numbers were "
        "kept",
    ),
    "times_repeat": ("note", "{rows} rows repeat a time and were laid over the first"),
    # Importing logs.
    "topic_short": ("note", "{topic} holds fewer than two messages"),
    "no_metadata": (
        "note",
        "{bag} has no metadata.yaml, as after a crash: read from {files} files in it",
    ),
    "as_read": ("note", "{remark}"),
    "bag_damaged": ("note", "the bag is damaged and was read up to there: {reason}"),
    "pressure_left_out": ("note", "pressure of {topic} left out, because the depth is there"),
    "columns_left_out": ("note", "{columns} of {topic} left out for those of {better}"),
    "file_missing": ("note", "no file fits {pattern} of the map"),
    "file_left_out": ("note", "{file} is in no pattern of the map and is left out"),
    "samples_untimed": ("note", "{samples} samples without a time left out"),
    "samples_repeat": ("note", "{samples} samples repeat the time before and were left out"),
    "clock_origin": ("note", "t = 0 is {start:.6f} s of the log's clock"),
    "log_cut": ("note", "cut from {start:.3f} to {end:.3f} s of the log"),
    "sticks_mixed": ("note", "sticks went through the mixer of frame {frame}, gain {gain:g}"),
    "outputs_mapped": (
        "note",
        "outputs drive thrusters {how}: {pairs} (a minus turns the pulse about {neutral:g} µs)",
    ),
    "pulses_unnamed": (
        "note",
        "no vehicle is named, so the pulses keep the numbers of the outputs: give --vehicle",
    ),
    "depth_of_pressure": ("note", "depth from pressure with {density:g} kg/m³"),
    "surface_pressure_assumed": (
        "note",
        "{pressure:.0f} Pa were taken at the surface: give surface_pressure, 1 hPa is 1 cm",
    ),
    "depth_of_barometer": (
        "note",
        "depth from barometer {number}, zero where the autopilot calibrated it",
    ),
    "depth_of_message": ("note", "depth from {kind}, zero at the autopilot's {ground:.0f} Pa"),
    "column_empty": ("note", "{column} holds no finite number and is left out"),
    "velocity_at_sensor": (
        "note",
        "u v w from {kind}, at the sensor: give velocity_at if it is not at the body origin",
    ),
    "velocity_left_out": (
        "note",
        "the velocity of {kind} is left out: in {share:.0%} of it the autopilot had no measurement of horizontal "
        "velocity or position",
    ),
    "velocity_estimated": (
        "note",
        "u v w from {kind}, an estimate by the autopilot's filter: smoother and later than a measurement",
    ),
    "vehicle_unknown": (
        "note",
        "recorded with vehicle {vehicle}, which is not in the catalogue: give --vehicle FILE",
    ),
    "vehicle_changed": (
        "note",
        "recorded with another state of {vehicle}'s file, which the record keeps",
    ),
    # What a trial's inputs and motion rest on.
    "inputs_incomplete": ("note", "{kind}* is there for some thrusters only; {used} was used"),
    "inputs_held": (
        "note",
        "{kind} keeps its levels exactly and jumps from row to row: read as held from each row to the next; write "
        "'inputs_between: linear' in trial.yaml if it was sampled while it changed",
    ),
    "wrench_zero": ("note", "no column {columns}: taken as zero"),
    "inputs_zero_after": ("note", "the inputs end before the recording: none from there on"),
    "rates_unknown": (
        "note",
        "velocity_at is not the body origin, but the angular rates are not all known: unknown ones were 0",
    ),
    "taken_level": (
        "note",
        "roll and pitch are not measured: velocities from position or depth take the vehicle as level",
    ),
    "accelerations_unused": (
        "note",
        "ax, ay, az hold gravity, and roll and pitch are not measured: they were not used",
    ),
    # `finssim trials check`.
    "unusable": ("refused", "{reason}"),
    "too_short": ("refused", "lasts {duration:.2g} s, expected at least {least:g} s"),
    "few_samples": ("note", "{columns} hold fewer than two samples and are not used"),
    "gap": ("note", "a gap of {longest:.3g} s, which no fit bridges"),
    "gaps": ("note", "{gaps} gaps, the longest of {longest:.3g} s, which no fit bridges"),
    "ends_missing": ("care", "missing in {share:.0%} of the trial, at its ends"),
    "jitter": ("note", "the time between samples varies by {share:.0%}: stamps of receipt?"),
    "slow": (
        "care",
        "{rate:.2g} Hz is slow for a vehicle: only the simulation method can use it",
    ),
    "constant": ("note", "{value:g} throughout"),
    "above_surface": (
        "care",
        "{height:.2g} m above the surface: another zero ('convert: {{offset: {{{column}: ...}}}}')? Models count the "
        "vehicle as submerged",
    ),
    "depth_above_surface": (
        "care",
        "{height:.2g} m above the surface: positive up ('convert: {{scale: {{depth: -1}}}}'), or another zero "
        "('convert: {{offset: {{depth: ...}}}}')? Models count the vehicle as submerged",
    ),
    "values_held": (
        "note",
        "each value stays for {rows:g} rows: it comes at {rate:.3g} Hz, not {row_rate:.3g} Hz",
    ),
    "stuck": ("care", "stands at {value:.4g} for {span:.2g} s from {start:.4g} s: stuck?"),
    "clipped_above": ("care", "never above {value:.4g}, where it stays for {samples} samples: clipped?"),
    "clipped_below": ("care", "never below {value:.4g}, where it stays for {samples} samples: clipped?"),
    "degrees": (
        "refused",
        "{column} reaches {value:.3g} {unit}: degrees? give 'convert: {{scale: {{{column}: 0.0174533}}}}'",
    ),
    "acceleration_unit": (
        "refused",
        "ax, ay, az are {value:.4g} at rest: in {unit}? give 'convert: {{scale: {{ax: {factor:g}, ay: {factor:g}, az: "
        "{factor:g}}}}}'",
    ),
    "no_gravity": ("note", "ax, ay, az hold no gravity"),
    "accelerometer_turned": (
        "care",
        "the accelerometer's gravity is {angle:.0f}° from {reference}: is it mounted turned?",
    ),
    "gravity_wrong_way": (
        "refused",
        "the accelerometer feels gravity the wrong way (az about {az:.3g} m/s², expected +9.81 when level): axes "
        "forward-right-down? give 'convert: {{body: FRD}}'",
    ),
    "acceleration_sign": (
        "refused",
        "{column} runs against the {angle} of the attitude: one of them has the other sign",
    ),
    "rate_sign": (
        "refused",
        "{column} runs against the change of {other}: one of them has the other sign (convert.body?)",
    ),
    "heading_drift": (
        "care",
        "the heading drifts by {drift:.2g} rad against the integrated gyro: a compass disturbed by the motors, or a "
        "gyro with a bias? Fits of yaw go by the gyro; velocities from x, y are turned by the heading, and are wrong "
        "where it is",
    ),
    "z_down": ("refused", "z grows with depth: positive down? give 'convert: {{world: NED}}'"),
    "heading_disagrees": (
        "care",
        "x, y and the heading disagree by {angle:.0f}°: u, v come out turned if derived from x, y",
    ),
    "mirrored": (
        "refused",
        "u, v turned by the yaw run mirrored to x, y: the sign of v, y or yaw is the other one",
    ),
    "speed_ratio": ("care", "x, y change {ratio:.3g} times as fast as u, v say: a wrong unit?"),
    "energy_taken": (
        "care",
        "the inputs take {work:.3g} J out of {axis}: {wrench} runs against {velocity}: one has the wrong sign, or "
        "something else drove the vehicle",
    ),
    "duplicate": (
        "refused",
        "holds the same numbers as {other}, which would count twice: leave one out",
    ),
    "no_vehicle": (
        "refused",
        "no vehicle: give --vehicle, or 'vehicle: NAME' in trial.yaml; only the sampling was checked",
    ),
    "vehicle_refused": ("refused", "trial.yaml: vehicle: {reason}"),
    "nothing_excited": ("refused", "no axis is excited: nothing can be identified"),
    "nothing_measured": ("refused", "no velocity, rate, attitude or depth to go by"),
    "axis_still": ("care", "trial.yaml says {axis}, and {axis} is not excited"),
    "stream_offset": (
        "note",
        "{group} comes {offset:.3f} s {sense} against {reference} (± {half:.3f} s): give 'convert: {{time_offset: "
        "{{{group}: {seconds:.3f}}}}}'",
    ),
    "stream_offset_common": (
        "care",
        "{group} comes {offset:.3f} s {sense} against {reference} in {trials} trials: give 'convert: {{time_offset: "
        "{{{group}: {seconds:.3f}}}}}'",
    ),
    "inputs_zero": (
        "refused",
        "the inputs are zero throughout: write 'passive: true' if the thrusters were off",
    ),
    "pulses_dead": ("refused", "no pulse leaves the dead band of its speed controller"),
    "inputs_end": (
        "care",
        "the inputs end {rest:.3g} s before the recording, at {end:.4g} s: what follows is left out; write "
        "'inputs_after: zero' in trial.yaml if the thrusters stopped there, as on disarming",
    ),
    "voltage_missing": (
        "care",
        "no battery voltage: thrust from pulses takes that of the speed controller's table",
    ),
    "wrench_beyond": (
        "care",
        "{column} is beyond the {limit:.3g} {unit} that {vehicle} can give in {share:.0%} of its time ({axis}): is it "
        "in {unit}, and this vehicle?",
    ),
    "command_beyond": (
        "care",
        "{column} is beyond the {limit:.3g} {unit} that {vehicle} can give in {share:.0%} of its time ({axis}): what "
        "was asked for cannot have acted",
    ),
    "saturated": (
        "care",
        "{thrusters} at the limit in more than {share:.0%} of the time: the excitation saturates",
    ),
    "in_dead_zone": (
        "care",
        "{thrusters} inside the dead zone for more than a fifth of the time: thrust uncertain",
    ),
    "never_pushed": ("note", "{thrusters} never pushed"),
    "several_vehicles": ("care", "trials of several vehicles: {vehicles}: fit them one by one"),
    "equal_names": ("note", "several trials are called {names}"),
    "none_usable": ("refused", "no trial can be used"),
    "all_held_out": ("refused", "every usable trial is held out: nothing is left to fit"),
    "none_held_out": (
        "note",
        "no trial is held out: 'role: held-out' in trial.yaml keeps one for replay",
    ),
    "few_trials": (
        "note",
        "trials to fit: {trials}; intervals from so few are wide and rest on assumptions",
    ),
    "axes_untold": ("note", "no trial tells anything of {axes}"),
    # Fits of motion.
    "axis_unmeasured": ("care", "left out of {axis}: no velocity of it, measured or derived"),
    "attitude_needed": ("care", "left out of {axis}: it needs the attitude for its restoring moment"),
    "no_stretch": ("care", "left out of {axis}: no stretch of {seconds:.1f} s without a gap"),
    "axis_idle": ("care", "left out of {axis}: hardly any wrench or motion on it"),
    "tilted_left_out": (
        "care",
        "{percent:.2g} % of the samples, at a tilt beyond {tilt:.0f}°, were left out",
    ),
    "tilted_kept": (
        "care",
        "{percent:.2g} % of the samples are at a tilt beyond {tilt:.0f}°; they were kept, as the axes that they "
        "depend on are fitted too, but the intervals are then somewhat too sure",
    ),
    "axis_not_driven": ("care", "no trial excites it; the vehicle file keeps its numbers"),
    "axis_doubtful": ("care", "no trial excites it; expect little of its numbers"),
    "axis_untold": ("care", "nothing was measured that tells of it; left out"),
    "buoyancy_traded": (
        "care",
        "the trials go one way only and never coast, so that the buoyancy excess trades off with the damping: add a "
        "dive followed by a coast",
    ),
    "at_bound": ("care", "rests on its bound: free, it would be {free:.3g} {unit}"),
    "inertia_too_small": (
        "care",
        "an effective inertia of {effective:.4g} {unit} is below the rigid {rigid:.4g} {unit} of the vehicle file, so "
        "that added mass would be negative: check the thrust and the file's mass or inertia",
    ),
    "few_speeds": (
        "care",
        "damping rests on speeds of {low:.2g}-{high:.2g} {unit}, less than a decade",
    ),
    "damping_unknown": (
        "care",
        "damping is not determined by speeds of {low:.2g}-{high:.2g} {unit}; the vehicle file keeps its numbers",
    ),
    "axis_refused": ("care", "{reason}; the vehicle file keeps its numbers"),
    "motion_late": (
        "care",
        "the motion {sense} the recorded inputs by {lag:.3f} s [{low:.3f}, {high:.3f}]; the fit allows for it, but "
        "check the clocks, or the delay and lag of the motors",
    ),
    "velocity_late": (
        "care",
        "the velocity seems to be logged {late:.2f} s later than the gyro: look with `finssim trials check`, and give "
        "'convert: {{time_offset: {{velocity: -{late:.2f}}}}}'; the inertias become surer by it",
    ),
    "least_squares": (
        "care",
        "the estimate could not be simulated, so ordinary least squares was used, which noise of the velocity biases",
    ),
    "block_intervals": (
        "care",
        "with so few trials ({trials}) intervals come from blocks within them; what differs from trial to trial is "
        "not in them",
    ),
    "attitude_missing": (
        "care",
        "no attitude in {trials}: the vehicle was taken as level, so that weight and buoyancy bend the estimates where "
        "it was not",
    ),
    "velocity_unknown": (
        "care",
        "the velocity of {axes} is unknown; couplings with it were taken as zero",
    ),
    "term_unfitted": (
        "care",
        "no axis on which it acts has a fit to believe; the vehicle file keeps its number",
    ),
    "term_disagrees": (
        "care",
        "axes disagree ({estimates}); their weighted mean was taken",
    ),
    "stiffness_disagrees": (
        "care",
        "roll and pitch disagree on the stiffness ({roll:.4g} and {pitch:.4g} N m/rad), which one height of the centre "
        "of buoyancy cannot give; their weighted mean was taken",
    ),
    "undetermined": (
        "care",
        "the trials do not determine {parameters}: add trials that excite them, or fix a value beforehand",
    ),
    "thrust_traded": (
        "care",
        "thrust_scale trades off with {parameters}: the motion gives only their ratios: fix one of them, for instance "
        "the thrust by a bollard pull or a mass by weighing",
    ),
    "traded": (
        "care",
        "{parameters} trade off: a combination of them is known {ratio:.3g} times better than each; {remedy}",
    ),
    "equilibrium_moved": (
        "care",
        "the equilibrium of {axis} moved during the decay; straight pieces follow it",
    ),
    "inertia_below_rigid": (
        "care",
        "{assumed} the inertia is {inertia:.4g} kg m², below the file's rigid {rigid:.4g} kg m²: check the centres of "
        "gravity and buoyancy, or the inertia",
    ),
    "buoyancy_contradicted": (
        "care",
        "the vehicle file's buoyancy less weight is {file:.3g} N, outside the {low:.2g} to {high:.2g} N of the rise: "
        "weigh the vehicle in water, or set body.displaced_volume",
    ),
    "buoyancy_sign": (
        "care",
        "the vehicle file's buoyancy less weight is {file:.3g} N, outside the {low:.2g} to {high:.2g} N of the rise: "
        "the vehicle rises, the file's sinks: weigh the vehicle in water, or set body.displaced_volume",
    ),
    "interrupted": ("care", "the fit was interrupted; these are the best numbers until then"),
    "not_converged": (
        "care",
        "the fit had not converged after {iterations} iterations: shorter segments or fewer parameters may help",
    ),
    "trial_left_out": ("care", "left out: no stretch has both inputs and measurements"),
    "replays_worse": (
        "care",
        "the calibrated vehicle replays these trials worse (NRMSE {after:.2f}) than the vehicle file does "
        "({before:.2f}): do not use it for this axis; try --method {method}, or trials that move it alone",
    ),
    "voltage_unknown": (
        "care",
        "no trial has a battery voltage, so that the thrust is known to {percent:.0f} % at best, and masses and drag "
        "with it: give a column 'voltage', or 'voltage:' in trial.yaml or in the map",
    ),
    "held_out": ("note", "left out: its header says that it is held out, for replay"),
    "check_failed": (
        "care",
        "the calibrated vehicle fails a check that it passed before, {check}: {sentence}",
    ),
    "further_than_mean": (
        "care",
        "the fit is further from the data than their mean is (R² {r2:.2f})",
    ),
    "nothing_determined": (
        "care",
        "the data determine nothing that the vehicle file holds: all its numbers stay",
    ),
    # Fits of thrusters and motors.
    "groups_unnamed": (
        "care",
        "{vehicle} has the propeller groups {groups}, and the tables name none: all thrusters get the same curve; name "
        "a group in the file's name to fit it by itself",
    ),
    "no_shaft_speeds": (
        "care",
        "the tables hold no shaft speeds: those of the vehicle file's curve were used, c± stay",
    ),
    "voltage_trend": ("care", "{trends} over the tables' voltages"),
    "voltage_chosen": ("care", "{trends} over the tables' voltages; the curve is that of {voltage:g} V"),
    "voltage_pooled": (
        "care",
        "c± do not depend on the voltage as far as the tables tell; all voltages were used",
    ),
    "law_without_voltage": (
        "care",
        "the tables give no voltage, so the pulse's law was not fitted: say voltage=",
    ),
    "law_refused": ("care", "the pulse's law was not fitted: {reason}"),
    "read_as_sweep": ("note", "read as a sweep of {rows} rows, for it holds few constant levels"),
    "read_as_levels": ("note", "read as {levels} levels, of each the last {share:.0%}"),
    "load_cell_offset": ("note", "the load cell reads {offset:.3g} N at standstill, taken off"),
    "force_sign": ("note", "forces have no sign in the table, taken from the {source}"),
    "speed_sign": ("note", "speeds have no sign in the table, taken from the pulse or the force"),
    "rows_unsigned": (
        "note",
        "{rows} rows left out: their force is too small to tell the speed's sign",
    ),
    "no_steps": ("care", "its command holds no steps, nothing was fitted"),
    "not_followed": ("care", "{column} does not follow the command, the vehicle file stays"),
    "steps_refused": (
        "care",
        "no step is within {limit:.0%} error and overshoot of first order plus dead time (error {error:.0%}), the "
        "vehicle file keeps its response",
    ),
    "steps_left_out": (
        "care",
        "{steps} of {total} steps left out: error or overshoot beyond {limit:.0%}",
    ),
    "other_domain": (
        "care",
        "a first order of the {domain} fits better ({other:.1%} against {error:.1%}): consider domain: {domain} in the "
        "vehicle file",
    ),
    "steady_gain": (
        "care",
        "the steady response is {gain:.2f} of what was asked: the thrust curve or the speed loop behind it is off",
    ),
    "pulses_raw": (
        "note",
        "pulses were taken as they are, for the vehicle file has no 'esc' of this thruster",
    ),
    "sign_of_command": ("note", "{column} has no sign, that of the command was taken"),
    "spikes": ("note", "{samples} samples of {column} stand alone far from their neighbours, left out"),
    "group_mean": ("care", "no steps; they get the mean time constant of their group"),
    "file_response": ("care", "no steps; they keep the vehicle file's time constant"),
    "loop_overshoots": (
        "care",
        "the speed loop overshoots by {overshoot:.0%} if gain, delay and lag are at the ends of their intervals: log "
        "more steps",
    ),
    # Calibrations by sight.
    "row_incomplete": ("note", "line {line}: left out: {missing} is missing"),
    "pixel_missing": ("note", "line {line}: left out: {point} has no pixel"),
    "counted_twice": ("note", "is there twice with the same pixel: counted once"),
    "not_surveyed": ("note", "not in the survey, so left out: {names}"),
    "board_unseen": ("note", "left out: the board is not seen in it"),
    "view_left_out": ("note", "left out: {reason}"),
    "views_flat": (
        "care",
        "all views are within {tilt:.0f} degrees of fronto-parallel: focal length and distance are not separable: tilt "
        "the board by 20 to 50 degrees about both its axes",
    ),
    "few_tilted": (
        "care",
        "only {views} views show the board tilted by more than 20 degrees: the focal length rests on them: tilt the "
        "board in more pictures",
    ),
    "edges_empty": (
        "care",
        "no corner within {shares}: distortion there is extrapolated: take pictures with the board in the corners",
    ),
    "few_views": (
        "care",
        "{views} views are few: intervals are wide and rest on single pictures: take 15 to 30",
    ),
    "lens_undetermined": (
        "care",
        "the pictures do not determine {parameters}: {reason}: take more, with the board tilted",
    ),
    "coefficients_zero": (
        "care",
        "{parameters} are not told apart from 0: plumb_bob does as well: --model plumb_bob",
    ),
    "pixels_uncertain": (
        "care",
        "pixels are known to {inside:.2f} px (95 %) where corners were seen, but only to {anywhere:.1f} px at the "
        "worst place of the picture",
    ),
    "camera_below": (
        "note",
        "the camera is on the -z side: the survey's z points down (or a flat survey is left-handed, which its points "
        "cannot tell); heights and --z of other commands are meant in that frame",
    ),
    "lens_refitted": (
        "note",
        "the camera file does not fit these pixels: {groups} of the lens fitted here as well, because points held out "
        "are met better so; a calibration of the camera by itself is worth more",
    ),
    "plane_tilted": (
        "note",
        "the pixels contradict a plane along the survey's axis and want it {lean:.2f} degrees tilted: its direction "
        "was fitted freely; the survey's z may not be plumb (a sloping floor taken for level), or the camera "
        "file is off",
    ),
    "lens_exact": (
        "note",
        "the lens is taken as exact, because neither the camera file nor the options tell its errors: if its focal "
        "length or centre is off, the intervals of the camera's place are too narrow; a lens that was calibrated is "
        "usually known to 0.3 % and 4 px, --focal-sigma 0.003 --center-sigma 4",
    ),
    "plane_contradicted": (
        "care",
        "the pixels by themselves put the plane {distance:.0f} mm {sense} the camera than it was measured, which its "
        "error does not explain: check the tape, the survey's zero, the window and the camera file",
    ),
    "camera_on_plane": (
        "care",
        "the camera ends on the plane itself, with residuals of {residual:.1f} px: the plane's place, the window, the "
        "index or the camera file is wrong; do not use this pool file",
    ),
    "straight_better": (
        "care",
        "straight lines meet held-out points better ({straight:.2f} px) than refraction does ({refraction:.2f} px): "
        "there is probably no water between camera and points, or the index, the window or the place given for the "
        "plane is wrong; do not use this pool file under water",
    ),
    "marks_unmarked": (
        "care",
        "without {marks}, the plane is found {clearance:.2f} m from the camera in place of {instead:.2f} m, beyond "
        "them, and straight lines meet them: mark them dry (a column dry with yes); do not use this pool file",
    ),
    "marks_dry": (
        "care",
        "{marks}: {place}, and met by straight lines: mark what lies there dry (a column dry with yes), which makes "
        "the camera's place surer",
    ),
    "handedness_open": (
        "care",
        "flat points cannot tell whether the survey's z points down or its x and y are left-handed (seen from the "
        "camera, y to the right of x): it is taken for the first; if z points up, every height but theirs comes out "
        "mirrored: negate y in the survey, or give --water-height, which tells the two apart",
    ),
    "plane_touches": (
        "care",
        "the plane ends against {places}, which it cannot pass: where nothing touches it in truth, the pixels want it "
        "further on than it can be; check the coordinates of what it touches, the thickness of the window, the index "
        "and the camera file",
    ),
    "other_place": (
        "care",
        "another place of the plane fits about as well (camera {other:.2f} m from it instead of {chosen:.2f} m): "
        "measure it with a tape",
    ),
    "points_narrow": (
        "care",
        "all points lie within {radius:.2f} m of the axis through the camera ({angle:.0f} degrees off it): "
        "{quantities} and index are not separable{remedy}, or add points further out",
    ),
    "one_depth": (
        "care",
        "all points are at one depth (within {spread:.2f} m): {quantities} are told only by how refraction bends rays "
        "far out, here to ±{half:.0f} mm{remedy}, or survey some points at another depth",
    ),
    "height_unknown": (
        "care",
        "not determined ({estimate:.3f} m, 95 % from {low:.3f} to {high:.3f}): positions at the depths surveyed are "
        "right all the same, at other depths they are not to be trusted",
    ),
    "focal_of_one_depth": (
        "care",
        "the focal length was fitted to points of one depth: it and the camera's height stand for each other; "
        "calibrate the camera by itself (finssim calibrate camera)",
    ),
    "index_pulled": (
        "care",
        "the pixels want an index of {index:.4f} in place of {given:g}, {times:.1f} times the error given: check the "
        "window, the {place} and the camera file{remedy}",
    ),
    "focal_pulled": (
        "care",
        "the focal length came out {change:+.0%} from the camera file's, further than was expected ({expected:.1%}): "
        "give --focal-sigma 0.3 if the file is a guess",
    ),
    "tilt_pulled": (
        "care",
        "the pixels want the plane {lean:.2f} degrees tilted: the survey's axis may not be plumb; raise --tilt-sigma "
        "or level the survey{remedy}",
    ),
    "few_places": (
        "care",
        "{places} surveyed places: intervals from so few are rough; survey 20 or more",
    ),
    "residuals_large": (
        "care",
        "residuals of {residual:.1f} px are larger than corners are usually found (0.1 to 0.5 px): check the camera "
        "file, or let the lens be fitted ({options})",
    ),
    "survey_rough": (
        "care",
        "the survey seems {times:.1f} times less exact than said ({error:.1f} mm): measure again, or give "
        "--survey-sigma",
    ),
    "rows_wrong": ("care", "rows left out as wrong: {rows}; check ids and coordinates"),
    # Mounts of tags and sensors.
    "imu_missing": (
        "care",
        "no {file}: how tags sit in the body is not told, only how they sit to one another",
    ),
    "attitude_made": (
        "care",
        "{file} holds no attitude: roll and pitch are made from gyro and accelerometer",
    ),
    "tilt_unknown": (
        "care",
        "{file} holds neither an attitude nor rates with accelerations: no tilt is known",
    ),
    "depth_missing": ("care", "no {file}: heights over the pressure port are not told"),
    "tag_turn_unknown": (
        "care",
        "the motion does not tell the turn of tag {tag} about body {axes}: it keeps the file's, which so defines the "
        "body's axes: rock the vehicle by 10 degrees and more about two axes to tell it from the IMU",
    ),
    "tag_place_unknown": (
        "care",
        "the motion does not tell {axes} of tag {tag} to {limit:g} m: it keeps the file's, which so defines the body's "
        "origin: measure one tag by hand, rock further, or turn on the spot about a known point (--turns-about)",
    ),
    "tags_apart": (
        "care",
        "tag {tags}: too few pictures show it together with others to tell its place",
    ),
    "gyro_unused": ("care", "the gyro was not used: {reason}"),
    "imu_turned": (
        "care",
        "the gyro says that the IMU is turned by {angle:.0f} deg about body {axis} against the tags found: check "
        "sensors.imu.orientation, or estimate it (--estimate sensors)",
    ),
    "imu_turn_unknown": (
        "care",
        "the motion does not tell how the IMU is turned about body {axes}: rock the vehicle about at least two axes, "
        "by 10 degrees and more",
    ),
    "windows_disagree": (
        "care",
        "{share:.0%} of the windows disagree and have no weight: look at the attitude",
    ),
    "depths_alike": (
        "care",
        "the depths span {span:.2f} m: too little to tell the scale, so that fresh and salt water ({share:.1%}) look "
        "alike: dive to two depths half a metre apart, or more",
    ),
    "water_setting": (
        "care",
        "the sensor reads as if set to {setting}: set its water density",
    ),
    "scale_unexplained": (
        "care",
        "the sensor's scale is {scale:.3f}, and no water explains it: check its setting and the survey",
    ),
    # Replays.
    "nothing_to_replay": ("refused", "nothing measured while the input is known"),
    "no_input": ("note", "no input: every axis that moves is compared"),
    "no_interval": ("note", "{reason}"),
    "not_scored": ("note", "{axis}: {reason}"),
    "velocity_derived": ("note", "{axis}: the velocity was not measured but {source}"),
    "no_axis": ("note", "no axis is excited and measured"),
    "clocks_apart": (
        "note",
        "{model}: the motion {sense} the recorded commands by {late:.2f} s, which the comparison allows for: "
        "two clocks",
    ),
}
"""Code -> its usual severity, and its sentence with the fields that `Finding.values` fills."""
