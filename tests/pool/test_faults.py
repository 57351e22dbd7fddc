"""Each fault affects the frames as described, and nothing else."""

import math

import numpy as np
import pytest

from finssim.pool.virtual_pool import NUMBERS, FaultError, Faults
from finssim.robot.links.frames import TELEMETRY, Decoder, encode_telemetry, forms
from finssim.robot.messages import Telemetry

ZERO = Telemetry(1, 10, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0, 0.0, 9.8), 0.5, 1.0e5, 0, (0.0,) * 8)


def telemetry(i):
    return Telemetry(
        i, 10 * i, (0.0, 0.0, 0.0, 1.0), (0.1 * i,) * 3, (0.0, 0.0, 9.8), 0.5, 1.0e5, 0, (0.0,) * 8
    )


def sequences(faults, n=400):
    """Return the sequence numbers that arrive, in order of arrival."""
    decoder, arrivals = Decoder(), []
    for i in range(n):
        arrivals += faults.arrivals(0.01 * i, faults.encode(telemetry(i)))
    return [
        m.sequence for _, frame in sorted(arrivals, key=lambda a: a[0]) for m in decoder.feed(frame)
    ], decoder


def test_without_faults_every_frame_arrives_once_unchanged():
    """Frames are identical byte by byte."""
    faults = Faults()
    assert faults.arrivals(1.0, faults.encode(ZERO)) == [(1.0, encode_telemetry(ZERO))]
    assert sequences(faults)[0] == list(range(400))


@pytest.mark.parametrize("probability", [0.0, 0.1, 0.5, 1.0])
def test_frames_are_lost_with_the_chance_asked_for(probability):
    """The losses agree to three standard deviations of 400 draws."""
    lost = 1.0 - len(sequences(Faults(drop=probability))[0]) / 400.0
    assert abs(lost - probability) <= 3.0 * math.sqrt(probability * (1.0 - probability) / 400.0)


def test_commands_are_lost_apart_from_telemetry():
    """Each direction has its own probability of loss."""
    faults = Faults(drop_commands=1.0)
    assert faults.lost(commands=True) and not faults.lost()


def test_corrupt_frames_do_not_pass_the_decoder():
    """All frames are corrupted, and none is accepted with a wrong CRC."""
    seen, decoder = sequences(Faults(corrupt=1.0))
    assert seen == [] and decoder.refused["bad_crc"] > 100


def test_reordered_frames_are_overtaken_and_duplicates_come_twice():
    """The same frames arrive in another order or twice."""
    seen, _ = sequences(Faults(reorder=0.2))
    assert sorted(seen) == list(range(400)) and seen != sorted(seen)
    seen, _ = sequences(Faults(duplicate=1.0))
    assert seen == [i for i in range(400) for _ in range(2)]


def test_frozen_sensors_stand_while_the_controller_runs():
    """Readings are constant while sequence and clock advance; they change again once the fault ends."""
    faults, decoder = Faults(), Decoder()
    faults.freeze_sensors = True
    frames = [decoder.feed(faults.encode(telemetry(i)))[0] for i in (1, 2, 3)]
    assert [f.sequence for f in frames] == [1, 2, 3] and len({f.gyro for f in frames}) == 1
    faults.freeze_sensors = False
    assert decoder.feed(faults.encode(telemetry(4)))[0].gyro[0] == pytest.approx(0.4)


@pytest.mark.parametrize("name", [*NUMBERS, "gyro.2", "motor_rpm.7"])
def test_a_field_can_be_nan_with_a_right_checksum(name):
    """Exactly this field is NaN on the wire; the decoder finds the CRC valid and refuses the number."""
    faults, decoder = Faults(), Decoder()
    faults.nan_field = name
    frame = faults.encode(ZERO)
    assert (
        decoder.feed(frame) == [] and decoder.refused["not_finite"] == 1 and decoder.refused["bad_crc"] == 0
    )
    whole = forms(TELEMETRY, 8)[0]
    payload = np.frombuffer(frame[12:-2], dtype="<f4")
    field, _, element = name.partition(".")
    assert np.count_nonzero(np.isnan(payload)) == (1 if element else whole.counts[field])


def test_what_is_no_fault_is_refused_when_it_is_set():
    """An invalid fault is refused when it is set, not when the next frame is sent."""
    faults = Faults()
    for name, value in (("drop", 1.5), ("corrupt", -0.1), ("nan_field", "altitude"), ("nan_field", "gyro.3")):
        with pytest.raises(FaultError):
            setattr(faults, name, value)


def test_equal_seeds_lose_equal_frames():
    """Other seeds lose other frames."""
    assert (
        sequences(Faults(3, drop=0.3))[0]
        == sequences(Faults(3, drop=0.3))[0]
        != sequences(Faults(4, drop=0.3))[0]
    )
