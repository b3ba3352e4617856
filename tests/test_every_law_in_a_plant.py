"""Every law in a driven plant is estimated from sweeps that another integrator simulates.

Each law is written out again, as a rate or as a function of the path, and integrated by the
Runge-Kutta method with fixed steps, from rest until the cycles no longer change.
"""

from collections.abc import Callable
from typing import NamedTuple

import control
import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.arrays import FloatArray
from dahl_ident.elements import Parameter
from tests.cold_records import iwan_elements
from tests.friction_tables import driven, relative_noise
from tests.recovery import assert_near
from tests.test_generic_friction import Jenkins, SlopeOfDahl

MASS, DAMPING, STIFFNESS = 0.3, 1.0, 8.0
F_MAX, SIGMA = 0.1, 30.0
STEPS, CYCLES = 250, 60  # errors of 1e-4, far below the noise
SETTLED = 1e-5
NOISE = 0.003
KNOWN = {"damping": DAMPING, "stiffness": STIFFNESS}

Law = Callable[[FloatArray, FloatArray], FloatArray]
"""(friction force, velocity) -> rate of the force."""


class Root(di.Friction):
    """A law that softens with the root of the force, whose derivative is infinite at 0 N."""

    parameters = di.Dahl.parameters[:2]

    def slope(self, force, direction, velocity, values):
        f_max, sigma = values
        return sigma * (1.0 - direction * np.sign(force) * np.sqrt(np.abs(force / f_max)))


def root(z, v):
    """Return the rate of the force of `Root`."""
    return SIGMA * (v - np.abs(v) * np.sign(z) * np.sqrt(np.abs(z) / F_MAX))


class Sliders(NamedTuple):
    """Springs in parallel, each with a displacement at which it slips."""

    stiffness: FloatArray
    slip: FloatArray

    def at_rest(self, n):
        """Return the springs' extensions of n plants."""
        return np.zeros((self.slip.size, n))

    def after(self, z, moved):
        """Return the extensions after a displacement."""
        return np.clip(z + moved, -self.slip[:, None], self.slip[:, None])

    def force(self, z):
        """Return the springs' force."""
        return np.asarray(self.stiffness @ z)


class Play(NamedTuple):
    """Linear Dahl friction behind a gap: its force, and the position in the gap."""

    half: float  # width of the gap

    def at_rest(self, n):
        """Return force and position of n plants."""
        return np.zeros((2, n))

    def after(self, z, moved):
        """Return both after a displacement: unloading, then the gap, then loading."""
        force, place = z
        s, left = np.sign(moved), np.abs(moved)
        back = F_MAX / SIGMA * np.log1p(np.maximum(-s * force, 0.0) / F_MAX)
        first = np.minimum(left, back)
        force = np.where(left < back, loaded(force, s, first), np.where(back > 0.0, 0.0, force))
        crossed = np.where(s * force > 0.0, 0.0, np.minimum(left - first, self.half - s * place))
        crossed = np.where(left < back, 0.0, crossed)
        return np.array([loaded(force, s, left - first - crossed), place + s * crossed])

    def force(self, z):
        """Return the friction force."""
        return np.asarray(z[0])


def loaded(force, side, path):
    """Return linear Dahl friction after a path in one direction."""
    return np.asarray(side * F_MAX - (side * F_MAX - force) * np.exp(-path * SIGMA / F_MAX))


def dahl(exponent=1.0, asymmetry=0.0):
    """Return the rate of the force of Dahl's law as a function."""

    def rate(force, v):
        side = np.sign(v)
        margin = 1.0 - side * force / (F_MAX * (1.0 + side * asymmetry))
        return np.asarray(SIGMA * np.sign(margin) * np.abs(margin) ** exponent * v)

    return rate


def bouc_wen(force, v):
    """Return the rate of the force of Bouc-Wen's law with exponent 1."""
    loading = force * v > 0.0
    return v * (SIGMA + np.where(loading, -300.0, 100.0) * np.abs(force))


def lugre(force, v):
    """Return the rate of the force with a limit that falls with the speed."""
    limit = F_MAX * (1.0 + 0.5 * np.exp(-((v / 0.05) ** 2)))
    return SIGMA * (v - np.abs(v) * force / limit)


class Case(NamedTuple):
    """A law to be fitted, the same law for the simulation, and its true parameters."""

    law: di.Element
    simulated: Law | Sliders | Play
    truth: dict[str, float]
    undetermined: tuple[str, ...] = ()  # by fundamentals
    free: tuple[str, ...] = ("damping", "stiffness")  # of the plant


def oscillator(mass, damping, stiffness):
    """The receptance of the plant without friction."""
    return control.tf([1.0], [mass, damping, stiffness])


def positive(start):
    """A free argument of a linear system."""
    return Parameter("", "", "", start, free=True, lower=0.0, transform="log")


BOTH = {"f_max": F_MAX, "sigma": SIGMA}
PAIR = Sliders(np.array([20.0, 10.0]), np.array([0.002, 0.006]))
CASES = {
    "linear Dahl": Case(di.Dahl(alpha=1.0), dahl(), BOTH),
    "Dahl, free exponent": Case(di.Dahl(alpha=None), dahl(0.7), {**BOTH, "alpha": 0.7}),
    "asymmetric Dahl": Case(
        di.Dahl(alpha=1.0, asymmetry=None), dahl(1.0, 0.3), BOTH, undetermined=("asymmetry",)
    ),
    "Bouc-Wen": Case(di.BoucWen(), bouc_wen, {"sigma": SIGMA, "q": 300.0, "p": 100.0}),
    "LuGre": Case(di.LuGre(), lugre, {**BOTH, "static_ratio": 1.5, "stribeck_speed": 0.05}),
    "Iwan": Case(
        di.Iwan(), Sliders(*iwan_elements(F_MAX, SIGMA, -0.3, 0.5)),
        {**BOTH, "chi": -0.3, "ratio": 0.5},
    ),
    "Maxwell slip": Case(
        di.MaxwellSlip([0.002, 0.006]), PAIR, {"stiffness_1": 20.0, "stiffness_2": 10.0}
    ),
    "power damper": Case(
        di.PowerDamper() + di.Dahl(F_MAX, SIGMA, 1.0), dahl(),
        {"coefficient": DAMPING, "exponent": 1.0}, free=("stiffness",),
    ),
    "Backlash": Case(di.Backlash(di.Dahl(alpha=1.0)), Play(0.001), {**BOTH, "gap": 0.002}),
    "user's law": Case(SlopeOfDahl(alpha=1.0), dahl(), BOTH),
    "user's law with a kink": Case(
        Jenkins(name="pad"), Sliders(np.array([SIGMA]), np.array([F_MAX / SIGMA])),
        {"pad_stiffness": SIGMA, "pad_slip": F_MAX / SIGMA},
    ),
    "user's law with a root": Case(Root(), root, BOTH),
    "linear system": Case(
        di.LinearSystem(control.tf([1.0], [MASS, DAMPING, STIFFNESS]), quantity="receptance")
        + di.Dahl(alpha=1.0),
        dahl(), BOTH, free=(),
    ),
    "linear system, free parameters": Case(
        di.LinearSystem(
            oscillator, quantity="receptance",
            parameters={"mass": MASS, "damping": positive(1.5), "stiffness": positive(5.0)},
        )
        + di.Dahl(alpha=1.0),
        dahl(), BOTH,
    ),
}  # fmt: skip


def settled(law, f, u):
    """Return the fundamentals of the displacement under u cos(2 pi f t)."""
    dt = 1.0 / f / STEPS
    x, v = np.zeros((2, f.size))
    path = law if isinstance(law, (Sliders, Play)) else None
    z = np.zeros((1, f.size)) if path is None else path.at_rest(f.size)
    last = np.full(f.size, np.inf, dtype=np.complex128)

    def rates(x, v, z, push, moved):
        if isinstance(law, (Sliders, Play)):
            force, change = law.force(law.after(z, moved)), np.zeros(z.shape)
        else:
            force, change = z[0], law(z[0], v)[None]
        return v, (push - force - DAMPING * v - STIFFNESS * x) / MASS, change

    for _ in range(CYCLES):
        X = np.zeros(f.size, dtype=np.complex128)
        for i in range(STEPS):
            X += 2.0 / STEPS * x * np.exp(-2j * np.pi * i / STEPS)
            push = [u * np.cos(2.0 * np.pi * (i + s) / STEPS) for s in (0.0, 0.5, 1.0)]
            a = rates(x, v, z, push[0], np.zeros(f.size))
            parts = [a]
            for share, p in ((0.5, push[1]), (0.5, push[1]), (1.0, push[2])):
                h = share * dt
                kx, kv, kz = parts[-1]
                parts.append(rates(x + h * kx, v + h * kv, z + h * kz, p, h * kx))
            dx, dv, dz = (
                dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
                for k1, k2, k3, k4 in zip(*parts, strict=True)
            )
            x, v = x + dx, v + dv
            z = z + dz if path is None else path.after(z, dx)
        if np.all(np.abs(X - last) < SETTLED * np.abs(X)):
            return X
        last = X
    raise AssertionError("the motion has not settled")


def table(case, levels, frequencies):
    """Return a sweep at several drives, from half the friction force to six times that force."""
    drives = F_MAX * np.geomspace(0.5, 6.0, levels)
    u, f = (
        g.ravel() for g in np.meshgrid(drives, np.geomspace(0.4, 2.6, frequencies), indexing="ij")
    )
    R = settled(case.simulated, f, u) / u * relative_noise(f.size, NOISE, 7)
    return driven(f, R, u, NOISE, level=u)


VARIANTS = ("user's law", "linear system", "Dahl, free exponent")  # of other cases


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in VARIANTS else n for n in CASES]
)
def test_a_law_in_a_driven_plant_is_estimated(name):
    case = CASES[name]
    size = (2, 4) if name == "Iwan" else (3, 4)  # the slowest law
    model = case.law
    if "linear system" not in name:
        model = model + di.Mass(MASS)
    for part, element in (("damping", di.Damper()), ("stiffness", di.Spring())):
        known = part in case.free and part not in {p.name for p in case.law.parameters}
        model = model + element if known else model
    fit = di.fit(table(case, *size), model)
    assert fit.trusted or case.undetermined, fit.verdict
    assert fit.identifiability.named(di.diagnostics.Verdict.NOT_IDENTIFIED) == [*case.undetermined]
    assert_near(fit, case.truth | {part: KNOWN[part] for part in case.free}, 3.0)
