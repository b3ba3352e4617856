"""Automatic starts for records of any motion, by variable projection.

Given the nonlinear parameters of its laws, a model's force is linear in mass, damping, stiffness
and one scale for each law. So the nonlinear ones are scanned, and the linear ones solved for: from
the measured force if that is the output; if it is the motion, from the force balance with the
measured motion, differentiated within the drive's band.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from dahl_ident.arrays import SMALLEST, FloatArray
from dahl_ident.elements import Element, LinearSystem, Parameter
from dahl_ident.elements.parameter import Dimension
from dahl_ident.errors import FitError, ModelError, argument
from dahl_ident.problem.record_noise import in_band
from dahl_ident.problem.record_problem import RecordProblem

_LENGTHS = np.geomspace(1e-3, 10.0, 13)  # of the largest displacement
_SIGNED = np.geomspace(0.03, 30.0, 7)  # rates over the inverse of the largest displacement
_MOST_SAMPLES = 8192  # most samples of a record in the scan
_COMBINATIONS = 100  # most nodes of the grid: each takes nearly as long as a step of a search
_STARTS = 24  # most starts, as long as no motion is finite, such as with too stiff a contact
_LOADS = (0.0, 0.9, -0.9)  # of all springs at a first sample: none, or nearly slipping
_DECAY = 1e-3  # least amplitude in the spectrum of a free decay, over the largest
_DRIVE_BAND = 1e-5  # least power of the drive in its band, over the largest


def record_starts(problem: RecordProblem) -> Iterator[FloatArray]:
    """Yield starts, best first, as values of the problem, (P,).

    Values given to free parameters are kept.
    """
    with np.errstate(all="ignore"):  # laws far off may overflow; such combinations are left out
        starts = _Scan(problem).starts()
    return (started_at(problem, values) for values in starts)


def alternatives(problem: RecordProblem, values: FloatArray) -> Iterator[tuple[int, float]]:
    """Yield indices and other values of parameters in which the output is not linear.

    The values are those of the scan, in proportion to the law's size, and loads at first samples.
    """
    scan, index = _Scan(problem), 0
    for element in problem.model.elements:
        size = 1.0
        grids = zip(element.labels, element.parameters, scan.grids(element), strict=True)
        for label, parameter, grid in grids:
            if not parameter.free:
                continue
            scales = bool(label in element.scale_parameters and parameter.dimension[0])
            if len(grid) > 1:
                yield from ((index, value * size if scales else value) for value in grid)
            elif scales:
                size = float(values[index])
            index += 1
    low, high = problem.step_bounds(values, of_starts=True)
    for i in range(index, values.size):
        if np.isfinite(high[i] - low[i]):
            yield from ((i, 0.5 * (low[i] + high[i] + s * (high[i] - low[i]))) for s in _LOADS)


class _History(NamedTuple):
    """The fastest part of a record."""

    displacement: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    force: FloatArray
    output: FloatArray
    time: FloatArray


def _non_negative(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the non-negative solution of normal equations."""
    from scipy.optimize import nnls

    sizes, vectors = np.linalg.eigh(matrix)
    kept = sizes > 1e-10 * sizes[-1]
    root = np.sqrt(sizes[kept])
    rows = root[:, None] * vectors[:, kept].T
    return np.asarray(nnls(rows, (vectors[:, kept].T @ right) / root)[0])


def _differ(first: list[float], second: list[float]) -> bool:
    """Return whether a value differs from the other by a factor of about two."""
    a, b = np.array(first), np.array(second)
    return bool(np.max(np.abs(a - b) / (np.abs(a) + np.abs(b) + 1e-300)) > 0.3)


class _Scan:
    """The scan of a problem's nonlinear parameters, with the fastest part of each record."""

    def __init__(self, problem: RecordProblem) -> None:
        self.problem, self.elements = problem, problem.model.elements
        self.histories = [self._history(i) for i in range(len(problem.records))]
        positions = [h.displacement for h in self.histories]
        x = np.concatenate([x - x.mean() for x in positions])
        self.length = float(np.abs(x).max()) or 1.0
        rate = float(
            np.sqrt(np.mean([np.var(h.velocity) / np.var(h.displacement) for h in self.histories]))
        )
        self.time = 1.0 / rate if rate > 0.0 else 1.0
        self.force = max(float(np.std(h.force)) for h in self.histories)

    def _history(self, number: int) -> _History:
        problem, record = self.problem, self.problem.records[number]
        if problem.output == "force":
            x, v, a = problem.motions[number]
            if not v.size:
                v = np.gradient(x, record.time)
                a = np.gradient(v, record.time)
            force = problem.measured[number]
        else:
            x, v, a = in_band(record, problem.measured[number])
            force = record.force_samples
        n = min(x.size, _MOST_SAMPLES)
        energy = np.concatenate([[0.0], np.cumsum((v - v.mean()) ** 2)])
        start = int(np.argmax(energy[n:] - energy[:-n])) if n < x.size else 0
        part = slice(start, start + n)
        output = problem.measured[number]
        return _History(x[part], v[part], a[part], force[part], output[part], record.time[part])

    def starts(self) -> list[list[float]]:
        """Return the free values at the best starts that differ."""
        choices = [list(product(*self.grids(e))) for e in self.elements]
        while np.prod([float(len(c)) for c in choices]) > _COMBINATIONS:
            longest = int(np.argmax([len(c) for c in choices]))
            choices[longest] = choices[longest][::2]
        solutions: list[tuple[float, list[float]]] = []  # misfit and values
        forces: dict[tuple[int, int], list[FloatArray]] = {}
        for index in product(*(range(len(c)) for c in choices)):
            for e, i in enumerate(index):
                if (e, i) not in forces:
                    forces[e, i] = self._forces(self.elements[e], choices[e][i])
            node = [choices[e][i] for e, i in enumerate(index)]
            at_node = [forces[e, i] for e, i in enumerate(index)]
            if all(at_node):
                solutions += self._solve(node, at_node)
        if not solutions:
            values = [p.value if p.value is not None else 1.0 for p in self.problem.free]
            solutions = [(0.0, values)]
        chosen = list[list[float]]()
        for _, values in sorted(solutions, key=itemgetter(0)):
            if len(chosen) < _STARTS and all(_differ(values, other) for other in chosen):
                chosen.append(values)
        return chosen

    def grids(self, element: Element) -> list[list[float]]:
        """Return values of an element's parameters at which its force is to be computed.

        The first parameter that scales the force is 1. In units of it, the following parameters are
        lengths and times: with 1 N/m, a force is the length at which a spring exerts it.
        """
        grids: list[list[float]] = []
        unit_dimension: Dimension | None = None  # of the parameter that is 1
        for label, parameter in zip(element.labels, element.parameters, strict=True):
            fixed = [] if parameter.value is None else [float(parameter.value)]
            if label in element.linear_parameters:
                grids.append([1.0] if parameter.free else fixed)
                unit_dimension = parameter.dimension
            elif parameter.free and label in element.scale_parameters and unit_dimension is None:
                grids.append([1.0])
                unit_dimension = parameter.dimension
            elif fixed:
                grids.append(fixed)
            elif isinstance(element, LinearSystem):
                raise ModelError(
                    f"{parameter.name} is an argument of a linear system, and has no value to "
                    f"start from: give {argument('start')}, or a Parameter with a value"
                )
            elif parameter.scan:
                grids.append(list(parameter.scan))
            else:
                force, length, time = map(float, parameter.dimension)
                unit = self.length**length * self.time**time
                if force:
                    size = self.force**force
                    if unit_dimension is not None and unit_dimension[0]:
                        # the power of the unit parameter that has the dimension of a force
                        share = force / unit_dimension[0]
                        length, time = (
                            length - share * unit_dimension[1],
                            time - share * unit_dimension[2],
                        )
                        size = self.time**time
                    lengths = [size * (self.length * s) ** length for s in _LENGTHS]
                    grids.append(list(dict.fromkeys(lengths)))
                elif parameter.lower < 0.0:
                    positive = [unit * s for s in _SIGNED]
                    grids.append([*(-v for v in positive), 0.0, *positive])
                else:
                    grids.append([unit * s for s in _LENGTHS])
        return grids

    def _forces(self, element: Element, values: tuple[float, ...]) -> list[FloatArray]:
        """Return the force along each record; empty if a record has no motion at these values."""
        try:
            return [
                element.force_history(values, x, v, 0.0, acceleration=a, time=time)
                for x, v, a, *_, time in self.histories
            ]
        except FitError:
            return []

    def _solve(
        self, node: list[tuple[float, ...]], forces: list[list[FloatArray]]
    ) -> list[tuple[float, list[float]]]:
        """Return the misfit and the values with the best linear parameters; empty if impossible.

        They are not negative, so that a plant with these values has a finite motion.
        """
        scaled = [any(self._scales(e, p) for p in e.parameters) for e in self.elements]
        normal = np.zeros((sum(scaled) + 1, sum(scaled) + 1))
        for i, history in enumerate(self.histories):
            columns = [f[i] for f, s in zip(forces, scaled, strict=True) if s]
            known = sum(f[i] for f, s in zip(forces, scaled, strict=True) if not s)
            block = np.array([self._weighted(i, f) for f in (*columns, history.force - known)])
            normal += np.real(block.conj() @ block.T)
        if not np.isfinite(normal).all():
            return []
        size = np.sqrt(np.maximum(normal.diagonal()[:-1], 1e-300))
        matrix = normal[:-1, :-1] / np.outer(size, size)
        right = normal[:-1, -1] / size
        solution = _non_negative(matrix, right) if right.size else right
        values = self._values(node, scaled, solution / size)
        misfit = normal[-1, -1] - 2.0 * solution @ right + solution @ matrix @ solution
        return [] if values is None else [(float(misfit), values)]

    def _values(
        self, node: list[tuple[float, ...]], scaled: list[bool], solution: FloatArray
    ) -> list[float] | None:
        """Return the free values, scaled by the solution; None if one is impossible."""
        factors = iter(solution)
        values: list[float] = []
        for element, at_node, scales in zip(self.elements, node, scaled, strict=True):
            factor = float(next(factors)) if scales else 1.0
            rows = zip(element.labels, element.parameters, at_node, strict=True)
            for label, parameter, value in rows:
                if not parameter.free:
                    continue
                new = value
                if parameter.value is not None:
                    new = float(parameter.value)
                elif label in element.scale_parameters and parameter.dimension[0]:
                    new = value * factor
                if parameter.lower == 0.0 and new < SMALLEST:
                    return None
                values.append(float(np.clip(new, parameter.lower, parameter.upper)))
        return values

    @staticmethod
    def _scales(element: Element, parameter: Parameter) -> bool:
        """Return whether a parameter is free, without a value, and scales the element's force."""
        scaling = (*element.linear_parameters, *element.scale_parameters)
        unknown = bool(parameter.free) and parameter.value is None
        return unknown and element.label(parameter) in scaling

    def _weighted(self, number: int, force: FloatArray) -> FloatArray:
        """Return a force as weighted in residuals: detrended, or as motion within the band."""
        if self.problem.output == "force":
            t = np.linspace(-1.0, 1.0, force.size)
            level, slope = force.mean(), (force @ t) / (t @ t)
            return np.asarray(force - level - slope * t)
        window = np.hanning(force.size)
        spectrum = np.fft.rfft(window * (force - force.mean()))
        return np.asarray(spectrum * self._weight(number))

    def _weight(self, number: int) -> FloatArray:
        """Return a smooth gain, zero outside the band, from forces to the measured motion."""
        x, force = self.histories[number].output, self.histories[number].force
        window = np.hanning(x.size)
        X, F = (np.abs(np.fft.rfft(window * (w - w.mean()))) for w in (x, force))
        if not F.any():  # a free decay: the forces balance by themselves
            least = _DECAY * X.max() * self.length / (np.abs(x - x.mean()).max() or 1.0)
            return np.asarray(least < X, dtype=np.float64)
        smooth = max(3, x.size // 256)
        kernel = np.ones(smooth) / smooth
        X, F = (np.sqrt(np.convolve(s**2, kernel, "same")) for s in (X, F))
        return np.where(_DRIVE_BAND * np.max(F**2) < F**2, X / np.maximum(F, 1e-300), 0.0)


@np.errstate(all="ignore")  # laws far off may overflow
def started_at(problem: RecordProblem, values: list[float]) -> FloatArray:
    """Return all values of a problem, states and offsets included, from the model's free ones."""
    full = np.zeros(len(problem.parameters))
    full[: len(values)] = values
    for number, measured in enumerate(problem.measured):
        of_record = problem.record_values(full, number)
        if problem.output == "motion":
            x, v, _ = in_band(problem.records[number], measured)
            of_record[0], of_record[1] = x[0], v[0]
        _load_springs(problem, full, number)
        if problem.output == "force":
            total = problem.predict(full, number, derivatives=False).output
            of_record[-2] = float(np.mean(measured - total))
    return full


def _load_springs(problem: RecordProblem, full: FloatArray, number: int) -> None:
    """Set the initial loads of laws with several springs to match the record's first samples."""
    of_record, start = problem.record_values(full, number), 2 if problem.output == "motion" else 0

    def misfit() -> float:
        try:
            output = problem.predict(full, number, derivatives=False).output
        except FitError:
            return np.inf
        return float(np.var(problem.measured[number] - output))

    for element in problem.model.elements:
        stop = start + (len(element.starts) if element.has_memory else element.n_states)
        if element.has_memory and len(element.starts) > 1:
            tried = []
            for load in _LOADS:
                of_record[start:stop] = load
                tried.append(misfit())
            of_record[start:stop] = _LOADS[int(np.argmin(tried))]
        start = stop
