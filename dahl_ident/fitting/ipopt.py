r"""Least squares by IPOPT: constraints between parameters, and noise in the drive as well.

The problem is that of :mod:`dahl_ident.fitting.search`, for any law and for exact steady motions.
Each step minimises the cost of linearised residuals, damped as by Levenberg and Marquardt, under
the constraints themselves, which IPOPT solves. All points after the first thus satisfy them.

**Constraints** are comparisons by name. A function takes a mapping of every parameter's name to its
casadi symbol, in SI units, and returns comparisons::

    lambda p: [
        p["f_max"] <= 1e-3 * p["sigma"],         # x_c of at most 1 mm
        p["pivot_sigma"] == p["seal_sigma"],
    ]

Fixed parameters are included as numbers. ``<`` means ``<=``. An equality reduces the number of free
parameters by one: the covariance is that of the estimate on the constraint. An inequality that
holds with equality acts as a bound; the covariance is that without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from dahl_ident.arrays import BoolArray, FloatArray
from dahl_ident.errors import FitError, ModelError, ValidationError, argument
from dahl_ident.fitting.convergence import optima
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import (
    ConstraintCost,
    Optimum,
    Status,
    agreed_scale,
    blanked,
    estimated_scale,
    information_of,
    inverse,
)
from dahl_ident.fitting.record_search import Tell
from dahl_ident.fitting.search import solve, starts_of
from dahl_ident.noise import squares_of
from dahl_ident.problem import Problem, Quadratic, TableProblem

if TYPE_CHECKING:
    import casadi as ca

_TOLERANCE = 1e-11  # gradient, in units of the noise, at which IPOPT ends
_ITERATIONS = 300  # IPOPT takes ten to thirty steps; one that needs more does not converge
_STEPS = 100  # most steps of a search, which takes one or two from an optimum
_SHORT = 1e-8  # length of a step, in standard errors, at which a search has converged
_STALLED = 1e-2  # the same where the cost does not fall, to the accuracy of predictions
_FIRST_DAMPING = 1e-9  # almost a Gauss-Newton step
_LEAST_DAMPING, _FIRM = 1e-6, 1e-3  # where the cost has not fallen; where it should have
_EASING = 0.1  # factor on the damping after a step that lowers the cost
# least rms residual over the largest change by a parameter, for the units of data without noise
_LEAST_RESIDUAL = 1e-4
_MOST_STARTS = 6  # of the global grid and the user
_SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
_INFEASIBLE = "Infeasible_Problem_Detected"
_SILENT: dict[str, Any] = {
    "print_time": False,
    "show_eval_warnings": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
}
_WORDS = {
    _INFEASIBLE: "it found no way to satisfy the constraints",
    "Maximum_Iterations_Exceeded": "it reached the maximum number of iterations",
    "Restoration_Failed": "it could not return to a point that satisfies the constraints",
    "Invalid_Number_Detected": "a constraint gave an invalid number",
    "Not_Enough_Degrees_Of_Freedom": "there are more equations than unknowns",
}

Constraints = Callable[[Mapping[str, "ca.SX"]], Iterable["ca.SX"]]
"""The user's function of constraints; see the docstring of this module."""
_EXAMPLE = "lambda p: [p['f_max'] <= 1e-3 * p['sigma']]"


@dataclass(frozen=True)
class Relations:
    """The user's constraints: texts, and lhs - rhs as a function of all parameters' values."""

    texts: tuple[str, ...]
    equal: tuple[bool, ...]
    differences: ca.Function | None

    @classmethod
    def of(cls, problem: Problem, constraints: Constraints | None) -> Relations:
        """Return the user's comparisons, and refuse anything else."""
        import casadi as ca

        if constraints is None:
            return cls((), (), None)
        symbols = _Symbols((p.name, ca.SX.sym(p.name)) for p in problem.all_parameters)
        free = ca.vertcat(*(symbols[name] for name in problem.names))
        texts, equal, differences = [], [], []
        for index, item in enumerate(_comparisons(constraints, symbols)):
            is_scalar = isinstance(item, ca.SX) and item.is_scalar()
            if not (is_scalar and any(map(item.is_op, (ca.OP_LE, ca.OP_LT, ca.OP_EQ)))):
                raise ValidationError(
                    f"constraints[{index}] is {item!r}; expected a comparison with <=, >= or == "
                    "such as p['f_max'] <= 1e-3 * p['sigma']"
                )
            difference = item.dep(0) - item.dep(1)
            if not ca.depends_on(difference, free):
                raise ValidationError(
                    f"constraints[{index}], {item}, holds no free parameter; free are "
                    f"{', '.join(problem.names)}"
                )
            texts.append(str(item).removeprefix("(").removesuffix(")"))
            equal.append(bool(item.is_op(ca.OP_EQ)))
            differences.append(difference)
        if not differences:
            return cls((), (), None)
        function = ca.Function("differences", list(symbols.values()), [ca.vertcat(*differences)])
        return cls(tuple(texts), tuple(equal), function)

    def at(self, problem: Problem, theta: ca.SX) -> ca.SX:
        """Return lhs - rhs as expressions of the search coordinates theta."""
        import casadi as ca

        if self.differences is None:
            return ca.SX(0, 1)
        values = []
        for parameter in problem.all_parameters:
            if parameter.name in problem.names:
                index = problem.names.index(parameter.name)
                values.append(problem.space.value(index, theta[index], ca))
            else:
                values.append(ca.SX(float(parameter.value or 0.0)))
        differences: ca.SX = self.differences.call(values)[0]
        return differences


class _Symbols(dict[str, "ca.SX"]):
    """Symbols by name; an unknown name is an error that lists the known ones."""

    def __missing__(self, name: str) -> ca.SX:
        raise ModelError(f"a constraint names {name!r}; the parameters are {', '.join(self)}")


def _comparisons(constraints: Constraints, symbols: _Symbols) -> list[Any]:
    import casadi as ca

    if not callable(constraints):
        raise ValidationError(f"constraints is {constraints!r}; expected a function: {_EXAMPLE}")
    try:
        relations = constraints(symbols)
    except RuntimeError as exc:  # casadi's, for the truth value that 0 <= x <= 1 asks for
        if "truth value" not in str(exc):
            raise
        raise ValidationError(
            "a constraint chains comparisons or joins them with 'and'; write each as one item, "
            "such as [p['sigma'] >= 1, p['sigma'] <= 2]"
        ) from None
    if isinstance(relations, ca.SX) or not isinstance(relations, Iterable):
        raise ValidationError(
            f"constraints returned {relations!r}; expected a list of comparisons: {_EXAMPLE}"
        )
    return list(relations)


def solve_ipopt(
    problem: Any,
    *,
    constraints: Constraints | None = None,
    start: Mapping[str, float] | None = None,
    loss: str = "linear",
    drive_std: ArrayLike | None = None,
    drive_covariance: ArrayLike | None = None,
    tell: Tell | None = None,
) -> Optimum:
    """Return the minimum of a problem's sum of squares under constraints.

    `constraints` takes a mapping of every parameter's name to its casadi symbol and returns
    comparisons with ``<=``, ``>=`` or ``==``. `start`, `loss` and `tell` are those of `solve`,
    which precedes. `drive_std` is the standard deviation, N, of the measured drive in
    force-controlled rows, () or (n,); `drive_covariance`, (n, 2), is its covariance with the real
    and the imaginary part of the response: the response is a quotient with the force, so they share
    the force's error.

    Where there are no constraints and the optimum lies at infinity, it is that of `solve`. The
    optimum's problem holds the noise of the drive.

    Examples
    --------
    >>> import numpy as np
    >>> from dahl_ident import Dahl
    >>> from dahl_ident.data import FrequencyResponse
    >>> A = np.geomspace(1e-4, 1e-2, 5)
    >>> N = Dahl(f_max=0.1, sigma=30.0).describing_function(A)
    >>> problem = TableProblem(FrequencyResponse(np.ones(5), N, A), Dahl())
    >>> tied = solve_ipopt(problem, constraints=lambda p: [p["sigma"] == 250 * p["f_max"]])
    >>> print(f"{tied.values[1] / tied.values[0]:.6f}")
    250.000000
    """
    plain = problem
    if drive_std is not None or drive_covariance is not None:
        problem = _with_drive_error(problem, loss, drive_std, drive_covariance)
    relations = Relations.of(problem, constraints)
    # without constraints, the start is that without errors of the drive, which is far quicker
    begin = solve(problem if relations.texts else plain, loss=loss, start=start, tell=tell)
    if begin.status.at_infinity and not relations.texts and problem is plain:
        return replace(begin, method="ipopt")
    # as changed by the search: the describing function without a steady motion, a record's delay
    problem = begin.problem if problem is plain else problem.with_steady(begin.problem.steady)
    adapts = not problem.scale_known and bool(loss != "linear" or problem.priors)
    search = _Descent(problem, relations, loss, begin.scale if adapts else 1.0)
    end = search.best(begin)
    if adapts and relations.texts:

        def again(scale: float) -> tuple[FloatArray, int]:
            nonlocal end
            search.scale = scale
            end = search.descend(end.theta)
            return end.theta, search.dof

        agreed_scale(problem, search.loss, again, search.scale)
    return search.optimum(end, begin)


@dataclass(frozen=True)
class _End:
    """The end of one run of IPOPT."""

    theta: FloatArray
    cost: float
    failure: str
    """Why IPOPT found no optimum, in words; empty if it found one."""
    slopes: FloatArray
    """Derivatives of the constraints' differences with respect to theta, (C, P)."""
    active: tuple[bool, ...]
    """Which inequalities hold with equality."""


class _Descent:
    """Runs of IPOPT on one problem with its constraints, loss and scale of the noise."""

    def __init__(self, problem: Problem, relations: Relations, loss: str, scale: float) -> None:
        self.problem, self.relations, self.scale = problem, relations, scale
        self.loss = loss_named(loss, problem.residuals_per_row)
        self.evaluations = 0

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residuals; every equality adds one."""
        problem = self.problem
        free = len(problem.names) - sum(self.relations.equal)
        return problem.n_nonzero + len(problem.priors) - free

    def at(self, theta: FloatArray) -> Quadratic:
        """Return half the sum of losses at theta, with its derivatives."""
        return self.problem.quadratic(theta, self.scale, self.loss)

    def best(self, begin: Optimum) -> _End:
        """Return the best end of runs from the least-squares optimum and other starts.

        The optimum is the only start, unless it is not finite or a constraint is active: the
        minimum on a constraint may be elsewhere.
        """
        ends = []
        if np.isfinite(self.at(begin.theta).cost):
            ends.append(self.descend(begin.theta))
            constrained = any(self.relations.equal) or any(ends[0].active)
            if begin.success and not ends[0].failure and not constrained:
                return ends[0]
        starts = np.clip(starts_of(self.problem, _MOST_STARTS), *self.problem.bounds())
        ends += [self.descend(theta) for theta in starts if np.isfinite(self.at(theta).cost)]
        if not ends:
            raise FitError("no start has a steady response in every row; give another start")
        if all(end.failure == _WORDS[_INFEASIBLE] for end in ends):
            raise FitError(
                f"no parameters satisfy the constraints {'; '.join(self.relations.texts)} within "
                "the bounds: relax one of them"
            )
        return min(ends, key=lambda e: (bool(e.failure), e.cost))

    def descend(self, start: FloatArray) -> _End:
        """Return the end of a search from `start`."""
        equal = np.array(self.relations.equal, dtype=np.bool_)
        solver, slopes_at = self._solver(start.size)
        theta, at, is_allowed = start, self.at(start), not equal.size
        damping, active, failure = _FIRST_DAMPING, np.zeros_like(equal), "it took too many steps"
        for _ in range(_STEPS):
            noise, unit = self._units(theta, at)
            hessian = at.hessian * np.outer(unit, unit) / noise + damping * np.eye(theta.size)
            size = np.linalg.norm(np.asarray(slopes_at(theta)) * unit, axis=1)
            size[~np.isfinite(size) | (size == 0.0)] = 1.0
            low, high = ((bound - theta) / unit for bound in self.problem.bounds())
            known = [theta, unit, at.gradient * unit / noise, hessian.ravel(), size]
            least = np.where(equal, 0.0, -np.inf)
            solution = solver(x0=0.0, p=np.hstack(known), lbx=low, ubx=high, lbg=least, ubg=0.0)
            status = str(solver.stats()["return_status"])
            if status not in _SOLVED:
                failure = _WORDS.get(status, status.replace("_", " ").lower())
                break
            step, *pairs = (np.asarray(solution[key]).ravel() for key in ("x", "g", "lam_g"))
            # distance or multiplier is zero, to a tolerance that differs between problems
            active = ~equal & (pairs[1] > -pairs[0])
            new, length = self.at(theta + unit * step), float(np.sqrt(step @ hessian @ step))
            self.evaluations += 1
            falls = bool(new.cost <= at.cost or (np.isfinite(new.cost) and not is_allowed))
            if falls:
                theta, at, is_allowed = theta + unit * step, new, True
            if length <= (_SHORT if falls or damping < _FIRM else _STALLED):
                failure = ""
                break
            damping = damping * _EASING if falls else max(damping, _LEAST_DAMPING) / _EASING
        slopes = np.asarray(slopes_at(theta))
        return _End(theta, float(at.cost), failure, slopes, tuple(active.tolist()))

    def _solver(self, P: int) -> tuple[ca.Function, ca.Function]:
        """Return IPOPT for one step in units, and the derivatives of the constraints."""
        import casadi as ca

        theta, unit, gradient, step = (ca.SX.sym(name, P) for name in ("theta", "u", "g", "step"))
        hessian, size = ca.SX.sym("hessian", P, P), ca.SX.sym("size", len(self.relations.texts))
        at_theta = self.relations.at(self.problem, theta)
        nlp = {
            "x": step,
            "p": ca.vertcat(theta, unit, gradient, ca.vec(hessian), size),
            "f": ca.dot(gradient, step) + 0.5 * ca.bilin(hessian, step, step),
            "g": self.relations.at(self.problem, theta + unit * step) / size,
        }
        options = {**_SILENT, "ipopt.tol": _TOLERANCE, "ipopt.max_iter": _ITERATIONS}
        slopes = ca.Function("slopes", [theta], [ca.jacobian(at_theta, theta)])
        return ca.nlpsol("ipopt", "ipopt", nlp, options), slopes

    def _units(self, theta: FloatArray, at: Quadratic) -> tuple[float, FloatArray]:
        """Return the variance of the noise, and steps that change the residuals by as much."""
        m = self.problem.n_residuals + len(self.problem.priors)
        slope = np.sqrt(np.maximum(np.diagonal(at.hessian), 0.0))
        slope = np.where((slope > 0.0) & np.isfinite(slope), slope, 1.0)
        largest = np.max(slope * np.where(self.problem.space.positive, 1.0, np.abs(theta)))
        noise = max(2.0 * float(at.cost), (_LEAST_RESIDUAL * float(largest)) ** 2) / m
        return noise, noise**0.5 / slope

    def optimum(self, end: _End, begin: Optimum) -> Optimum:
        """Return the optimum with status, message and covariance."""
        problem, relations = self.problem, self.relations
        minima = Minima(
            end.theta[None],
            np.array([end.cost]),
            self.at(end.theta).hessian[None],
            np.array([not end.failure]),
            np.array([begin.nfev + self.evaluations]),
        )
        result = optima(problem, minima, self.scale, self.loss, "ipopt")[0]
        if end.failure:
            return replace(result, message=f"{result.message} IPOPT says: {end.failure}.")
        return self._constrained(result, end, begin) if relations.texts else result

    def _constrained(self, result: Optimum, end: _End, begin: Optimum) -> Optimum:
        """Return `result` with status and covariance on the constraints, not reordered."""
        problem, relations, scale = self.problem, self.relations, self.scale
        if not problem.scale_known and self.loss is None and not problem.priors:
            scale = float(estimated_scale(problem, end.cost, self.dof))
        covariance, undetermined = _on_constraints(
            information_of(problem, end.theta, self.scale, self.loss, self.dof),
            end.slopes[np.array(relations.equal, dtype=np.bool_)],
        )
        active = [text for text, hit in zip(relations.texts, end.active, strict=True) if hit]
        status, message = result.status, result.message
        if undetermined.any():
            names = [n for n, lost in zip(problem.names, undetermined, strict=True) if lost]
            status = Status.SINGULAR
            message = f"{status.value} Involved: {', '.join(names)}."
        elif active:
            status = Status.AT_BOUND
            message = (
                f"Converged on the constraint {'; '.join(active)}: the sum of squares falls beyond "
                "it, so the interval is one-sided. Widen it, or hold it with equality."
            )
        elif status is Status.SINGULAR:
            status = Status.CONVERGED
            message = status.value
        return replace(
            result,
            theta=end.theta,
            values=problem.to_values(end.theta),
            covariance=covariance * (scale / self.scale) ** 2,
            scale=scale,
            dof=self.dof,
            status=status,
            message=message,
            constraint_cost=self._constraint_cost(end, begin),
        )

    def _constraint_cost(self, end: _End, begin: Optimum) -> ConstraintCost | None:
        """Return the rise of the cost due to the constraints; NaN if it cannot be judged.

        For a robust loss it is divided by E[psi^2]/E[psi'], as it then has the same distribution
        (P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed., 2009, chapter 7).
        """
        problem, loss = self.problem, self.loss
        relations = zip(self.relations.texts, self.relations.equal, end.active, strict=True)
        texts = tuple(text for text, equal, active in relations if equal or active)
        if not texts:
            return None
        rise, dof = float("nan"), np.inf if begin.scale_known else float(begin.dof)
        if begin.dof > 0 and not begin.is_exact:
            constrained, free = (
                float(problem.quadratic(theta, begin.scale, loss).cost)
                for theta in (end.theta, begin.theta)
            )
            rise = 2.0 * max(constrained - free, 0.0)
            if loss is not None:
                r = problem.residuals(begin.theta, begin.scale)[: problem.n_residuals]
                z = squares_of(r, problem.residuals_per_row)
                rise /= loss.inflation(z, begin.dof) * loss.mean_slope(z)
        return ConstraintCost(texts, rise, dof)


def _with_drive_error(
    problem: TableProblem, loss: str, std: ArrayLike | None, covariance: ArrayLike | None
) -> TableProblem:
    """Return the problem with checked errors of the drives in its data."""
    if std is None:
        if covariance is not None:
            raise ValidationError("drive_covariance is given without drive_std")
        return problem
    data = problem.data
    if data.drive is None or not (data.controlled == "force").any():
        raise ValidationError(
            "drive_std is given, but no row is force-controlled; an error of the displacement "
            "amplitude belongs into the data, as amplitude_std"
        )
    if problem.noise != "measured" or loss != "linear":
        raise ValidationError(
            f"drive_std is given with {problem.noise} noise and {loss} loss; how much it weighs "
            "in addition to the response's error is known only with "
            f"{argument('noise', 'measured')}, {argument('loss', 'linear')}"
        )
    columns: dict[str, Any] = {
        "drive_std": std if np.ndim(std) else np.full(data.n, std),
        "drive_covariance": covariance,
    }
    if covariance is not None and not np.ndim(covariance):
        columns["drive_covariance"] = np.full((data.n, 2), covariance)
    return problem.like(data=replace(data, **columns))


def _on_constraints(information: FloatArray, slopes: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariance where slopes @ dtheta = 0, and which parameters are undetermined."""
    if not len(slopes):
        return inverse(information)
    size = np.sqrt(np.diagonal(information))
    size = np.where(size > 0.0, size, 1.0)
    allowed = null_space(slopes / size) / size[:, None]
    inner, lost = inverse(allowed.T @ information @ allowed)
    undetermined = np.abs(allowed) @ lost.astype(np.float64) > 0.0
    covariance = allowed @ np.where(np.isinf(inner), 0.0, inner) @ allowed.T
    return blanked(covariance, undetermined), undetermined
