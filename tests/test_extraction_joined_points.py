"""Points of two parts of a level, against the weights and covariances written out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dahl_ident.extraction.from_record import Point, joined

MEANS = (
    "bias_real", "bias_imag", "displacement_share", "force_share", "displacement_distortion",
    "force_distortion", "asymmetry", "displacement_steps", "force_steps", "displacement_clipped",
    "force_clipped",
)  # fmt: skip


def point(size, cycles, start, **changes):
    """Return a point at 2 Hz whose own variances are `size`, and a quarter of it repeats."""
    joint = size * np.array([np.diag([1.0, 2.0, 2.0]), np.diag([1.0, 6.0, 6.0])])
    quality = {
        **{name: np.full(2, size) for name in MEANS},
        "settled": np.array([True, True]),
        "more_periods": np.array([0, int(size)]),
        "num_periods": cycles + 1,
        "settling_periods": 1,
        "start_time": start,
        "end_time": start + (cycles + 1) / 2.0,
        "verdict": ["good", "good"],
    }
    return Point(
        2.0, 1.0 + 1e-4 * size, 3.0, [1, 3], np.array([1.0 + size * 1j, size]),
        joint, 0.25 * joint, np.array([4.0, 8.0]), False, {**quality, **changes},
    )  # fmt: skip


A, B = point(1.0, 6, 0.0), point(2.0, 2, 4.0)


def test_both_parts_count_by_their_cycles():
    (both,) = joined([A], [B])
    np.testing.assert_allclose(both.response, 0.75 * A.response + 0.25 * B.response)
    assert both.amplitude == pytest.approx(0.75 * A.amplitude + 0.25 * B.amplitude)
    own = 0.75**2 * 0.75 * A.joint + 0.25**2 * 0.75 * B.joint
    repeating = 0.25 * (0.75 * A.joint + 0.25 * B.joint)
    np.testing.assert_allclose(both.repeating, repeating)
    np.testing.assert_allclose(both.joint, own + repeating)
    share = 0.75**2 / (0.75**2 + 0.25**2 * 2.0)
    np.testing.assert_allclose(both.dof, A.dof / (share**2 + (1.0 - share) ** 2))
    quality = both.quality
    assert (quality["num_periods"], quality["settling_periods"]) == (10, 2)
    assert quality["end_time"] == B.quality["end_time"]
    assert quality["more_periods"].tolist() == [0, 2]
    np.testing.assert_allclose(quality["force_steps"], 1.25)


def test_what_speaks_against_either_part_is_told_once():
    a = point(1.0, 6, 0.0, verdict=["force clipped", "good"])
    b = point(2.0, 2, 4.0, verdict=["force clipped; not settled", "good"])
    assert joined([a], [b])[0].quality["verdict"] == ["force clipped; not settled", "good"]


def test_a_part_that_has_not_settled_is_settling_of_the_other():
    a = point(1.0, 6, 0.0, settled=np.array([True, False]))
    (both,) = joined([a], [B])
    np.testing.assert_array_equal(both.joint, B.joint)
    assert (both.quality["num_periods"], both.quality["settling_periods"]) == (10, 8)


@pytest.mark.parametrize(
    "other",
    [
        point(2.0, 2, 6.0),  # five cycles after the end of A at 3.5 s; four may be missing
        replace(B, harmonic=[1, 5]),
        replace(B, amplitude=1.1),
        replace(B, frequency_hz=2.2),
        replace(B, sweep=True),
    ],
)
def test_other_levels_stay_apart(other):
    assert joined([A], [other]) == [A, other]
    assert len(joined([A], [point(2.0, 2, 5.4)])) == 1
