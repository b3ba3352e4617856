r"""Least squares by IPOPT: constraints between parameters, and noise in the drive as well.

The problem is that of :mod:`dahl_ident.fitting.search`, for any law and for exact steady motions:
the cost and its exact gradient J' r are those of the problem's own residuals. The Hessian is the
difference of gradients: far from the optimum Gauss and Newton's leads IPOPT astray. From the
least-squares optimum it takes a few steps.

**Constraints** are comparisons by name. A function takes a mapping of every parameter's name to its
casadi symbol, in SI units, and returns comparisons::

    lambda p: [
        p["f_max"] <= 1e-3 * p["sigma"],         # x_c of at most 1 mm
        p["pivot_sigma"] == p["seal_sigma"],
    ]

Fixed parameters are there as well, as the numbers at which they are held. ``<`` means ``<=``.
casadi differentiates them twice. An equality takes away one degree of freedom: the
covariance is that of the estimate on the constraint. An inequality that holds with equality acts as
a bound does; the covariance is that without it.

**Coordinates.** Search coordinates relative to the start, each in the unit that changes the
residuals by their own size, so that nothing depends on physical units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space

from dahl_ident.arrays import FloatArray, finite_array, non_negative_array
from dahl_ident.errors import FitError, ModelError, ValidationError, argument
from dahl_ident.fitting.convergence import Ends, optima
from dahl_ident.fitting.levenberg_marquardt import Minima
from dahl_ident.fitting.losses import loss_named
from dahl_ident.fitting.optimum import (
    ConstraintCost,
    Optimum,
    Status,
    agreed_scale,
    estimated_scale,
    information_of,
    inverse,
)
from dahl_ident.fitting.record_search import Tell
from dahl_ident.fitting.search import solve, starts_of
from dahl_ident.problem import Problem, Quadratic, TableProblem

if TYPE_CHECKING:
    import casadi as ca

_TOLERANCE = 1e-11  # of the scaled gradient: well below the smallest step that a report shows
_ITERATIONS = 300  # a limit for searches that do not end
_LEAST_RESIDUAL = 1e-4  # of the largest change that a parameter's own size makes
_ACTIVE = 1e-6  # an inequality nearer to its limit than this holds there
_STEP = 1e-4  # of ln p, between gradients whose difference is the Hessian
_MOST_STARTS = 6  # the lowest minima of the global grid, and what the user gave
_WORDS = {
    "Maximum_Iterations_Exceeded": "it reached the maximum number of iterations",
    "Restoration_Failed": "it could not return to a point that satisfies the constraints",
    "Diverging_Iterates": "a parameter diverged",
    "Search_Direction_Becomes_Too_Small": "its steps became too small",
    "Invalid_Number_Detected": "the model or a constraint gave an invalid number",
    "Error_In_Step_Computation": "it could not compute a step",
    "Not_Enough_Degrees_Of_Freedom": "there are more equations than unknowns",
}


Constraints = Callable[[Mapping[str, "ca.SX"]], Iterable["ca.SX"]]
"""The user's function of constraints; see the head of this module."""


_EXAMPLE = "lambda p: [p['f_max'] <= 1e-3 * p['sigma']]"


@dataclass(frozen=True)
class Relations:
    """The user's constraints: text, and lhs - rhs of all parameters' values."""

    texts: tuple[str, ...]
    equal: tuple[bool, ...]
    differences: ca.Function | None

    @property
    def freedom_lost(self) -> int:
        """Number of equalities."""
        return sum(self.equal)

    @classmethod
    def of(cls, problem: Problem, constraints: Constraints | None) -> Relations:
        """Read the user's comparisons, or say what they are instead."""
        import casadi as ca

        if constraints is None:
            return cls((), (), None)
        symbols = _Symbols((p.name, ca.SX.sym(p.name)) for p in problem.every_parameter)
        free = ca.vertcat(*(symbols[name] for name in problem.names))
        texts, equal, differences = [], [], []
        for index, item in enumerate(_called(constraints, symbols)):
            relation = _is_comparison(item)
            if relation is None:
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
            equal.append(relation == ca.OP_EQ)
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
        for parameter in problem.every_parameter:
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


def _called(constraints: Constraints, symbols: _Symbols) -> list[Any]:
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


def _is_comparison(item: Any) -> int | None:
    """Return casadi's code of the comparison of two scalars that `item` is, else None."""
    import casadi as ca

    if not isinstance(item, ca.SX) or not item.is_scalar():
        return None
    return next((op for op in (ca.OP_LE, ca.OP_LT, ca.OP_EQ) if item.is_op(op)), None)


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
    # a start takes no noise of the drive, which takes many times as long; a cost does
    begin = solve(problem if relations.texts else plain, loss=loss, start=start, tell=tell)
    if begin.status.at_infinity and not relations.texts and problem is plain:
        return replace(begin, method="ipopt")
    # as the search ended: by a sine where no steady motion exists, freed of a record's delay
    problem = begin.problem if problem is plain else problem.with_steady(begin.problem.steady)
    adapts = not problem.scale_known and bool(loss != "linear" or problem.priors)
    target = Target(problem, begin.scale if adapts else 1.0, loss)
    end = _search(target, begin, relations)
    dof = problem.n_numbers + len(problem.priors) - len(problem.names) + relations.freedom_lost
    if adapts and relations.texts:

        def again(scale: float) -> tuple[FloatArray, int]:
            nonlocal target, end
            target = replace(target, scale=scale)
            end = _descend(target, end.theta, relations, end.evaluations)
            return end.theta, dof

        agreed_scale(problem, loss_named(loss, problem.parts), again, target.scale)
    return _ended(target, end, relations, begin)


@dataclass(frozen=True)
class Target:
    """The cost to minimise: a problem, the scale of its residuals, and their loss."""

    problem: Problem
    scale: float = 1.0
    loss: str = "linear"

    def at(self, theta: FloatArray) -> Quadratic:
        """Return the cost, half the sum of losses, with its derivatives; theta (P,) or (S, P)."""
        return self.problem.quadratic(theta, self.scale, loss_named(self.loss, self.problem.parts))


@dataclass(frozen=True)
class _Found:
    """Where IPOPT ended, in search coordinates."""

    theta: FloatArray
    cost: float
    return_status: str
    evaluations: int
    slopes: FloatArray
    """Derivatives of the relations' differences with respect to theta, (C, P)."""
    active: tuple[bool, ...]

    @property
    def failure(self) -> str:
        """Why IPOPT has no optimum, in words; nothing where it has one."""
        if self.return_status in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            return ""
        return _WORDS.get(self.return_status, self.return_status.replace("_", " ").lower())


def _search(target: Target, begin: Optimum, relations: Relations) -> _Found:
    """Return the best end of IPOPT's searches.

    The least-squares optimum is the one start, unless it is not finite or a constraint binds:
    the minimum on a constraint may lie elsewhere.
    """
    problem, ends = target.problem, []
    if np.isfinite(target.at(begin.theta).cost):
        ends.append(_descend(target, begin.theta, relations))
        held = relations.freedom_lost or any(ends[0].active)
        if begin.success and not ends[0].failure and not held:
            return ends[0]
    low, high = problem.bounds()
    ends += [
        _descend(target, theta, relations)
        for theta in np.clip(starts_of(problem)[:_MOST_STARTS], low, high)
        if np.isfinite(target.at(theta).cost)
    ]
    if not ends:
        raise FitError("no start has a steady response in every row; give another start")
    best = min(ends, key=lambda end: (bool(end.failure), end.cost))
    if not best.failure:  # again, in the units of the optimum
        ends.append(_descend(target, best.theta, relations))
        best = best if ends[-1].failure else ends[-1]
    return replace(best, evaluations=sum(end.evaluations for end in ends))


def _descend(
    target: Target, start: FloatArray, relations: Relations, evaluations: int = 0
) -> _Found:
    """Run IPOPT from `start`; `evaluations` were made before."""
    import casadi as ca

    problem = target.problem
    unit, weight, tolerance, step = _units(target, start)

    def value(xi: FloatArray) -> list[FloatArray]:
        at = target.at(start + unit * xi)
        return [2.0 * weight * at.cost, 2.0 * weight * unit * at.gradient]

    def hessian(xi: FloatArray) -> list[FloatArray]:
        at = target.at(start + unit * (xi + np.vstack([np.zeros(xi.size), np.diag(step)])))
        exact = (at.gradient[1:] - at.gradient[0]) / step[:, None] * unit
        curvature = (
            exact + exact.T
            if np.isfinite(exact).all()
            else 2.0 * at.hessian[0] * np.outer(unit, unit)
        )
        return [weight * curvature]

    xi = ca.SX.sym("xi", start.size)
    differences = relations.at(problem, ca.DM(start) + ca.DM(unit) * xi)
    slopes = ca.Function("slopes", [xi], [ca.jacobian(differences, xi)])
    size = np.linalg.norm(np.asarray(slopes(0.0)), axis=1)
    size[~np.isfinite(size) | (size == 0.0)] = 1.0
    differences = differences / ca.DM(size)
    multipliers = ca.SX.sym("lam_g", size.size)
    curvature, _ = ca.hessian(ca.dot(multipliers, differences), xi)
    related = ca.Function("related", [xi], [differences, ca.jacobian(differences, xi)])
    curved = ca.Function("curved", [xi, multipliers], [ca.densify(curvature)])
    x, p = ca.MX.sym("x", start.size), ca.MX.sym("p", 0)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", size.size)
    P = start.size
    computed = [_callback()(value, P, [(1, 1), (P, 1)]), _callback()(hessian, P, [(P, P)])]
    (f, gradient), (curvature,) = (function.call([x]) for function in computed)
    g, jacobian = related.call([x])
    curvature = ca.triu(lam_f * curvature + curved(x, lam_g))
    low, high = ((bound - start) / unit for bound in problem.bounds())
    bounded = not all(relations.equal) or bool(np.isfinite([low, high]).any())
    solver = ca.nlpsol(
        "ipopt",
        "ipopt",
        ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]),
        {
            "grad_f": ca.Function("grad_f", [x, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [x, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "hess_lag", [x, p, lam_f, lam_g], [curvature], ["x", "p", "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            ),
            "no_nlp_grad": True,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": tolerance,
            "ipopt.max_iter": _ITERATIONS,
            "ipopt.nlp_scaling_method": "none",
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.mu_init": 1e-3 if bounded else tolerance,
        },
    )  # fmt: skip
    least = np.where(relations.equal, 0.0, -np.inf)
    solution = solver(x0=0.0, lbx=low, ubx=high, lbg=least, ubg=0.0)
    stats = solver.stats()
    end, held = (np.asarray(solution[key]).ravel() for key in ("x", "g"))
    return _Found(
        theta=start + unit * end,
        cost=0.5 * float(solution["f"]) / weight,
        return_status=str(stats["return_status"]),
        evaluations=evaluations + int(stats["n_call_nlp_f"]),
        slopes=np.asarray(slopes(end)) / unit,
        active=tuple(
            not equal and bool(c > -_ACTIVE) for c, equal in zip(held, relations.equal, strict=True)
        ),
    )


def _units(target: Target, start: FloatArray) -> tuple[FloatArray, float, float, FloatArray]:
    """Return the units of IPOPT's coordinates xi and function f.

    The unit of each coordinate, the factor from the sum of losses to f, the tolerance of the
    gradient, and steps of xi for differences of the gradient.
    """
    problem, at = target.problem, target.at(start)
    m = problem.n_residuals + len(problem.priors)
    reach = np.sqrt(np.maximum(np.diagonal(at.hessian), 0.0) / m)  # rms change of the residuals
    reach = np.where((reach > 0.0) & np.isfinite(reach), reach, 1.0)
    logarithmic = problem.space.positive
    whole = np.max(reach * np.where(logarithmic, 1.0, np.abs(start)))
    residual = max(float(np.sqrt(2.0 * at.cost / m)), _LEAST_RESIDUAL * float(whole))
    unit = residual / reach
    rounding = float(problem.rounding) / target.scale / residual
    step = _STEP * np.where(logarithmic, 1.0, whole / reach) / unit
    return unit, 0.5 / (m * residual**2), max(_TOLERANCE, rounding), step


@cache
def _callback() -> Any:
    import casadi as ca

    class Computed(ca.Callback):
        """A casadi function of a vector that numpy computes."""

        def __init__(
            self,
            work: Callable[[FloatArray], list[FloatArray]],
            size: int,
            shapes: list[tuple[int, int]],
        ) -> None:
            ca.Callback.__init__(self)
            self._work, self._size, self._shapes = work, size, shapes
            self._last: tuple[bytes, list[Any]] = (b"", [])
            self.construct("computed", {})

        def get_n_out(self) -> int:
            return len(self._shapes)

        def get_sparsity_in(self, _: int) -> Any:
            return ca.Sparsity.dense(self._size)

        def get_sparsity_out(self, which: int) -> Any:
            return ca.Sparsity.dense(*self._shapes[which])

        def eval(self, arguments: Any) -> Any:
            at = np.asarray(arguments[0]).ravel()
            if self._last[0] != at.tobytes():
                self._last = at.tobytes(), [ca.DM(np.asarray(v)) for v in self._work(at)]
            return self._last[1]

    return Computed


def _with_drive_error(
    problem: TableProblem, loss: str, std: ArrayLike | None, covariance: ArrayLike | None
) -> TableProblem:
    """Return the problem with the errors of its drives in its data, checked."""
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
    spread = _for_rows(non_negative_array(std, "drive_std"), "drive_std", (data.n,))
    cross = None
    if covariance is not None:
        together = finite_array(covariance, "drive_covariance")
        cross = _for_rows(together, "drive_covariance", (data.n, 2))
    noisy = replace(data, drive_std=spread, drive_covariance=cross)
    return problem.like(data=noisy)


def _for_rows(value: FloatArray, name: str, shape: tuple[int, ...]) -> FloatArray:
    if value.shape not in ((), shape):
        raise ValidationError(f"{name} has shape {value.shape}; expected one number or {shape}")
    return np.broadcast_to(value, shape)


def _ended(target: Target, end: _Found, relations: Relations, begin: Optimum) -> Optimum:
    """Return the optimum with status, sentence and covariance."""
    problem, loss = target.problem, loss_named(target.loss, target.problem.parts)
    if end.return_status == "Infeasible_Problem_Detected":
        raise FitError(
            f"no parameters satisfy the constraints {'; '.join(relations.texts)} within the "
            "bounds; IPOPT found the least violation elsewhere: relax one of them"
        )
    words = end.failure
    minima = Minima(
        end.theta[None],
        np.array([end.cost]),
        target.at(end.theta).hessian[None],
        np.array([not words]),
        np.array([begin.nfev + end.evaluations]),
    )
    result = optima(problem, Ends(minima), target.scale, loss, "ipopt", minima.evaluations)[0]
    if words:
        return replace(result, message=f"{result.message} IPOPT says: {words}.")
    if not relations.texts:
        return result
    return _constrained(result, target, end, relations, begin)


def _constrained(
    result: Optimum, target: Target, end: _Found, relations: Relations, begin: Optimum
) -> Optimum:
    """Return `result` as found, not reordered, with the covariance on the constraints."""
    problem, loss = target.problem, loss_named(target.loss, target.problem.parts)
    dof = result.dof + relations.freedom_lost
    scale = target.scale
    if not problem.scale_known and loss is None and not problem.priors:
        scale = float(estimated_scale(problem, end.cost, dof))
    covariance, undetermined = _on_constraints(
        information_of(problem, end.theta, target.scale, loss, dof),
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
        covariance=covariance * (scale / target.scale) ** 2,
        scale=scale,
        dof=dof,
        status=status,
        message=message,
        constraint_cost=_constraint_cost(target, end, relations, begin),
    )


def _constraint_cost(
    target: Target, end: _Found, relations: Relations, begin: Optimum
) -> ConstraintCost | None:
    """Return the rise of the cost by the constraints over `begin`, least squares without them."""
    of_one_scale = target.problem.scale_known or not target.problem.priors
    if target.loss != "linear" or not of_one_scale or begin.is_exact or begin.dof <= 0:
        return None
    held = zip(relations.texts, relations.equal, end.active, strict=True)
    texts = tuple(text for text, equal, active in held if equal or active)
    if not texts:
        return None
    rise = 2.0 * max(end.cost - begin.cost, 0.0) / begin.scale**2
    return ConstraintCost(texts, rise, np.inf if begin.scale_known else float(begin.dof))


def _on_constraints(
    information: FloatArray, slopes: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the covariance where slopes @ dtheta = 0, and which parameters are undetermined."""
    if not len(slopes):
        return inverse(information)
    size = np.sqrt(np.diagonal(information))
    size = np.where(size > 0.0, size, 1.0)
    along = null_space(slopes / size) / size[:, None]
    inner, lost = inverse(along.T @ information @ along)
    undetermined = np.abs(along) @ lost.astype(np.float64) > 0.0
    covariance = along @ np.where(np.isinf(inner), 0.0, inner) @ along.T
    covariance[undetermined, :] = covariance[:, undetermined] = 0.0
    covariance[undetermined, undetermined] = np.inf
    return covariance, undetermined
