r"""Rows of data as casadi expressions: the residuals of a problem, written out for one row.

All rows of one kind (same harmonic, same controlled side) share one expression; what differs
from row to row enters as columns of numbers. A row has up to three unknowns of its own.

**Displacement-controlled rows** take the measured amplitude, so the response is explicit:
``F/X = Z(A, omega)``.

**Force-controlled rows** keep the displacement phasor ``X = A exp(j phi)`` as an unknown. It is
tied to the drive by the balance of forces, the complex form of Eqn. 53,

    Z(A, omega) X = u_0,

and the response is simply ``F/X = u_0/X``. Unknowns are ``ln(A/A_0)`` and ``phi - phi_0``, taken
from the phasor at the start, so that they are of order one in any units.

**Errors of the amplitude or of the drive** add one more unknown, the error e of its logarithm in
standard deviations s. It is drawn together with the response's error, so the row's residuals are

    e  and  V^-1/2 (R - R_model - c e),    V = C - c c',

c being the covariance of R with ln A (or ln u_0) over s. Their least squares over e is what
:mod:`dahl_ident.noise` computes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dahl_ident.arrays import ComplexArray, FloatArray
from dahl_ident.data.quantities import converted
from dahl_ident.data.rows import Rows
from dahl_ident.elements import Element
from dahl_ident.elements.casadi_dahl import Phasor
from dahl_ident.errors import FitError
from dahl_ident.fitting import losses
from dahl_ident.fitting.casadi_expansion import Expansion, is_short
from dahl_ident.noise import (
    Covariance,
    Measured,
    Noise,
    Relative,
    Student,
    Whitening,
    noise_for,
)
from dahl_ident.problem import Problem
from dahl_ident.sensors import measured_stiffness_factor

if TYPE_CHECKING:
    import casadi as ca

IntArray = NDArray[np.intp]

_LEAST_REST = 1e-10
"""Least share of det C that has to be the response's own."""


@dataclass(frozen=True)
class Target:
    """What is minimised: a problem, and how its residuals count.

    Attributes
    ----------
    problem : Problem
        One table.
    scale : float
        What the data's residuals are divided by.
    loss : str
        "linear" or a robust loss, see :mod:`dahl_ident.fitting.losses`.
    """

    problem: Problem
    scale: float = 1.0
    loss: str = "linear"


@dataclass(frozen=True)
class RowBlock:
    """Rows of one kind.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Which rows of the table.
    residuals : casadi.SX, shape (2,) or (3,)
        Over the scale; the third is the error of amplitude or drive.
    loss : casadi.SX
        What a row adds to the sum that is minimised.
    balance : casadi.SX, shape (0,) or (2,)
        Z X/u_0 - 1, to be zero.
    unknowns : casadi.SX, shape (k,)
        The row's own; zero at the start.
    columns : casadi.SX, shape (m,)
        Symbols for the row's numbers.
    numbers : ndarray, shape (m, n)
        Their values in every row.
    expansions : list of Expansion
        Describing functions whose coefficients are to be put in for their symbols.
    """

    rows: IntArray
    residuals: ca.SX
    loss: ca.SX
    balance: ca.SX
    unknowns: ca.SX
    columns: ca.SX
    numbers: FloatArray
    expansions: list[Expansion]


def parameter_values(problem: Problem, theta: ca.SX) -> dict[str, ca.SX]:
    """Return every parameter of model and sensors by name: expressions of theta, or numbers."""
    import casadi as ca

    place = {name: index for index, name in enumerate(problem.names)}
    values = {}
    for parameter in (*problem.model.parameters, *problem.sensors.parameters):
        if parameter.name not in place:
            assert parameter.value is not None
            values[parameter.name] = ca.SX(parameter.value)
        elif parameter.transform == "log":
            values[parameter.name] = ca.exp(theta[place[parameter.name]])
        else:
            values[parameter.name] = theta[place[parameter.name]]
    return values


def row_blocks(target: Target, theta: ca.SX, start: FloatArray) -> list[RowBlock]:
    """Return the rows of a table, kind by kind.

    Parameters
    ----------
    target : Target
        Problem, scale and loss.
    theta : casadi.SX, shape (P,)
        Search coordinates as expressions.
    start : ndarray, shape (P,)
        Search coordinates from which the displacement phasors of force-controlled rows are
        taken.

    Raises
    ------
    FitError
        If the plant has no steady amplitude at `start`, or an error leaves the response none of
        its own.
    """
    table = _Table(target, theta, start)
    kinds = np.stack([table.rows.harmonic, table.rows.forced, table.spread > 0.0], axis=1)
    return [
        table.block(np.flatnonzero((kinds == kind).all(axis=1)), int(kind[0]))
        for kind in np.unique(kinds, axis=0)
    ]


class _Columns:
    """What differs from row to row, with symbols to stand for it: numbers and expansions."""

    def __init__(self, rows: IntArray) -> None:
        self._rows = rows
        self._symbols: list[ca.SX] = []
        self._numbers: list[FloatArray] = []
        self.expansions: list[Expansion] = []

    def real(self, values: FloatArray) -> ca.SX:
        """Return the symbol of a column, or its number if that is the same in all rows.

        `values` are those of the whole table.
        """
        import casadi as ca

        column = values[self._rows]
        if (column == column[0]).all():
            return ca.SX(float(column[0]))
        self._symbols.append(ca.SX.sym(f"column{len(self._symbols)}"))
        self._numbers.append(column)
        return self._symbols[-1]

    def phasor(self, values: ComplexArray) -> Phasor:
        """Return the symbols of a complex column."""
        return Phasor(self.real(values.real), self.real(values.imag))

    def element(
        self,
        element: Element,
        values: Sequence[ca.SX],
        amplitude: ca.SX,
        omega: FloatArray,
        harmonic: int,
    ) -> Phasor:
        """Return F_k/X_1 of an element; `omega` is that of the whole table."""
        import casadi as ca

        linear = bool(values) and element.labels == element.linear_parameters
        if element.is_linear and (linear or not any(p.free for p in element.parameters)):
            one, numbers = np.ones(()), [np.asarray(p.value) for p in element.parameters]
            if not linear:
                fixed = element.stiffness(numbers, one, omega, harmonic)
                return self.phasor(np.broadcast_to(fixed, omega.shape))
            total = Phasor(ca.SX(0.0), ca.SX(0.0))
            for index, value in enumerate(values):
                unit = [np.asarray(float(i == index)) for i in range(len(values))]
                total = total + self.phasor(element.stiffness(unit, one, omega, harmonic)).scaled(
                    value
                )
            return total
        speed = ca.SX(0.0) if element.rate_independent else self.real(omega)
        if is_short(element, harmonic):
            return Phasor(*element.casadi_stiffness(values, amplitude, speed, harmonic))
        self.expansions.append(Expansion(element, values, amplitude, speed, harmonic))
        return self.expansions[-1].value

    def collected(self) -> tuple[ca.SX, FloatArray]:
        """Return all symbols and their numbers."""
        import casadi as ca

        numbers = np.array(self._numbers).reshape(len(self._numbers), self._rows.size)
        return ca.vertcat(*self._symbols), numbers


class _Table:
    """What all kinds of rows share."""

    def __init__(self, target: Target, theta: ca.SX, start: FloatArray) -> None:
        self.target, self.problem = target, target.problem
        self.values = parameter_values(self.problem, theta)
        self.rows = rows = Rows.of(self.problem.data)
        self.noise = noise_for(rows, self.problem.noise)
        unit = np.ones(rows.n, dtype=np.complex128)
        quantity = self.problem.data.quantity
        self.operator, slope = converted(unit, rows.omega, "dynamic_stiffness", quantity)
        self.is_stiffness = bool(slope[0] == self.operator[0])
        self.spread, self.shared, self.whitening = _split(self.noise, rows.n)
        self.start_phasor = self._displacement(start) if rows.forced.any() else None

    def block(self, rows: IntArray, harmonic: int) -> RowBlock:
        """Return the expressions of rows of one kind."""
        import casadi as ca

        columns, first = _Columns(rows), rows[0]
        error = ca.SX.sym("error", int(self.spread[first] > 0.0))
        stretch = ca.exp(-columns.real(self.spread) * error) if error.numel() else ca.SX(1.0)
        if self.rows.forced[first]:
            phasor = ca.SX.sym("phasor", 2)
            stiffness, balance = self._driven(columns, phasor, stretch)
        else:
            assert self.rows.amplitude is not None
            phasor = balance = ca.SX(0, 1)
            gain = self.values["displacement_gain"]
            amplitude = columns.real(self.rows.amplitude) * stretch / gain
            stiffness = self._stiffness(columns, amplitude, harmonic)
        predicted = self._response(columns, stiffness, harmonic)
        residuals = self._residuals(columns, predicted, harmonic, error) / self.target.scale
        loss = self._loss(columns, ca.sumsqr(residuals))
        symbols, numbers = columns.collected()
        unknowns = ca.vertcat(phasor, error)
        return RowBlock(
            rows, residuals, loss, balance, unknowns, symbols, numbers, columns.expansions
        )

    def _driven(self, columns: _Columns, phasor: ca.SX, stretch: ca.SX) -> tuple[Phasor, ca.SX]:
        """Return F/X = u_0/X and the balance Z X/u_0 - 1 for the unknown phasor X."""
        import casadi as ca

        assert self.start_phasor is not None
        assert self.rows.drive is not None
        amplitude = columns.real(np.abs(self.start_phasor)) * ca.exp(phasor[0])
        phase = columns.real(np.angle(self.start_phasor)) + phasor[1]
        drive = columns.real(self.rows.drive) * stretch / self.values["force_gain"]
        direction = Phasor(ca.cos(phase), ca.sin(phase))
        force = self._stiffness(columns, amplitude, 1) * direction.scaled(amplitude / drive)
        stiffness = Phasor(direction.real, -direction.imag).scaled(drive / amplitude)
        return stiffness, ca.vertcat(force.real - 1.0, force.imag)

    def _stiffness(self, columns: _Columns, amplitude: ca.SX, harmonic: int) -> Phasor:
        """Return Z_k(A, omega) of the model."""
        import casadi as ca

        total = Phasor(ca.SX(0.0), ca.SX(0.0))
        for element in self.problem.model.elements:
            values = [self.values[p.name] for p in element.parameters]
            total = total + columns.element(element, values, amplitude, self.rows.omega, harmonic)
        return total

    def _response(self, columns: _Columns, stiffness: Phasor, harmonic: int) -> Phasor:
        """Return the data's quantity as the sensors see it."""
        import casadi as ca

        force_gain, displacement_gain, delay = (
            self.values[p.name] for p in self.problem.sensors.parameters
        )
        angle = harmonic * columns.real(self.rows.omega) * delay
        sensors = Phasor(ca.cos(angle), ca.sin(angle)).scaled(force_gain / displacement_gain)
        operator = columns.phasor(self.operator)
        seen = stiffness * sensors
        return operator * seen if self.is_stiffness else operator / seen

    def _residuals(
        self, columns: _Columns, predicted: Phasor, harmonic: int, error: ca.SX
    ) -> ca.SX:
        """Return residuals of unit variance, or of the one unknown variance."""
        import casadi as ca

        measured = columns.phasor(self.rows.response)
        if isinstance(self.noise, Relative) and harmonic == 1:
            ratio = measured / predicted
            size = ratio.real * ratio.real + ratio.imag * ratio.imag
            return ca.vertcat(ca.log(size) / 2.0, ca.atan2(ratio.imag, ratio.real))
        rest = measured - predicted
        if isinstance(self.noise, Relative):
            assert self.noise.fundamental is not None
            rest = rest.scaled(1.0 / columns.real(self.noise.fundamental))
        if error.numel():
            rest = rest - columns.phasor(self.shared).scaled(error)
        if self.whitening is not None:
            a, b, c = (columns.real(part) for part in self.whitening)
            rest = Phasor(a * rest.real, b * rest.real + c * rest.imag)
        return ca.vertcat(rest.real, rest.imag, error)

    def _loss(self, columns: _Columns, squares: ca.SX) -> ca.SX:
        """Return rho of a row's sum of squares."""
        if self.target.loss != "linear":
            return _robust(self.target.loss, squares)
        if not isinstance(self.noise, Measured) or self.noise.tail is None:
            return squares
        return _student(self.noise.tail, columns, squares)

    def _displacement(self, start: FloatArray) -> ComplexArray:
        """Return the true displacement phasor X at `start`, 1 in rows that need none."""
        forced = self.rows.forced
        assert self.rows.drive is not None
        predicted = self.problem.predict(start)
        lost = forced & ~np.isfinite(predicted)
        if lost.any():
            row = int(np.argmax(lost))
            raise FitError(
                f"row {row}: the plant has no steady amplitude for drive "
                f"{self.rows.drive[row]:g} where the search starts; give another start"
            )
        numbers = dict(zip(self.problem.names, self.problem.to_values(start), strict=True))
        sensed = [np.asarray(numbers.get(p.name, p.value)) for p in self.problem.sensors.parameters]
        seen = predicted / self.operator if self.is_stiffness else self.operator / predicted
        stiffness = seen / measured_stiffness_factor(sensed, self.rows.omega, 1)
        return np.where(forced, self.rows.drive / sensed[0] / stiffness, 1.0)


def _student(tail: Student, columns: _Columns, squares: ca.SX) -> ca.SX:
    """Return rho(z) of rows whose covariance was estimated."""
    import casadi as ca

    size = columns.real(tail.dof - tail.parts)
    return size * ca.log1p(squares / columns.real(tail.dof))


def _robust(name: str, squares: ca.SX) -> ca.SX:
    """Return rho(z) of the losses in :mod:`dahl_ident.fitting.losses`."""
    import casadi as ca

    if name == "soft_l1":
        return 2.0 * squares / (ca.sqrt(1.0 + squares) + 1.0)
    if name == "student_t":
        return (losses.TAIL_DOF + 2.0) * ca.log1p(squares / losses.TAIL_DOF)
    is_near = squares <= losses.KNEE**2
    far = ca.if_else(is_near, losses.KNEE**2, squares)
    return ca.if_else(is_near, squares, 2.0 * losses.KNEE * ca.sqrt(far) - losses.KNEE**2)


def _split(noise: Noise, count: int) -> tuple[FloatArray, ComplexArray, Whitening | None]:
    """Return s, c and V^-1/2 of every row (see the head of this module)."""
    spread, shared = np.zeros(count), np.zeros(count, dtype=np.complex128)
    if not isinstance(noise, Measured):
        return spread, shared, None
    error = noise.amplitude
    if error is not None:
        concerned = error.variance > 0.0
        spread[concerned] = np.sqrt(error.variance[concerned])
        shared[concerned] = error.cross[concerned] / spread[concerned]
    rr, ri, ii = noise.covariance
    rest = Covariance(rr - shared.real**2, ri - shared.real * shared.imag, ii - shared.imag**2)
    tied = rest.rr * rest.ii - rest.ri**2 < _LEAST_REST * (rr * ii - ri**2)
    if tied.any():
        raise FitError(
            f"row {int(np.argmax(tied))}: the error of amplitude or drive accounts for all of the "
            "response's error in some direction, which would have to fit exactly; give the "
            "response an error of its own, or use method='lm'"
        )
    return spread, shared, Whitening.of(rest)
