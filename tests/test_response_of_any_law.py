"""The steady response in parallel with every law, against a bracketing root search."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from dahl_ident import Dahl, Damper, Element, Mass, Spring, response
from tests.test_generic_friction import BoucWen, Jenkins, SlopeOfDahl

LINEAR = Mass(0.3) + Damper(0.24) + Spring(0.3)
LAWS: dict[str, Element] = {
    "Dahl": Dahl(0.1, 30.0),
    "Dahl, alpha 1/2": Dahl(0.1, 30.0, 0.5),
    "elastoplastic": Jenkins(3.0, 0.02, name="joint"),
    "Dahl from its slope": SlopeOfDahl(0.1, 30.0, 0.5),
    "Bouc-Wen": BoucWen(30.0, 200.0, 100.0),
    "Bouc-Wen that never slips": BoucWen(30.0, 100.0, -150.0),
}


def all_amplitudes(plant: Element, frequency_hz: float, drive: float) -> list[float]:
    omega = 2.0 * np.pi * frequency_hz
    A = np.geomspace(1e-9, 1e3, 2000)
    excess = np.abs(A * plant.dynamic_stiffness(A, omega)) - drive
    crossings = np.flatnonzero(excess[1:] * excess[:-1] < 0.0)
    return [
        brentq(
            lambda a: abs(a * complex(plant.dynamic_stiffness(a, omega))) - drive,
            A[i], A[i + 1], rtol=1e-13, xtol=1e-300,
        )
        for i in crossings
    ]  # fmt: skip


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
@pytest.mark.parametrize("frequency_hz", [0.0, 1.5])
@pytest.mark.parametrize("drive", [0.01, 0.05, 0.5])
def test_response_is_what_a_root_search_finds(
    law: Element, frequency_hz: float, drive: float
) -> None:
    plant = law + LINEAR
    ours = response(plant, frequency_hz, drive, all_roots=True, steady="describing function")
    expected = all_amplitudes(plant, frequency_hz, drive)
    assert len(expected) == int(ours.number_of_solutions)
    np.testing.assert_allclose(np.ravel(ours.amplitude), expected, rtol=1e-8)


def test_no_element_that_depends_on_amplitude_is_taken_as_linear() -> None:
    plant = Jenkins(3.0, 0.004, name="joint") + Damper(0.05) + Spring(2.0)
    ours = float(np.ravel(response(plant, 0.5, 0.05, steady="describing function").amplitude)[0])
    (expected,) = all_amplitudes(plant, 0.5, 0.05)
    as_if_linear = 0.05 / abs(complex(plant.dynamic_stiffness(0.0, np.pi)))
    assert ours == pytest.approx(expected, rel=1e-8)
    assert abs(ours / as_if_linear - 1.0) > 0.5
