"""Parameters that could be exchanged without a difference are not called identified."""

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.diagnostics import Verdict

ROWS = 6  # of a harmonic; the loop of each is integrated in every step


class PullPush(di.Friction):
    """Linear Dahl with a limit for pulling and one for pushing: the mirrored law exchanges them."""

    parameters = tuple(
        di.Parameter(name, unit, name, lower=0.0, transform="log")
        for name, unit in (("pull", "N"), ("push", "N"), ("sigma", "N/m"))
    )

    def slope(self, force, direction, velocity, values):
        pull, push, sigma = values
        return sigma * (1.0 - direction * force / (pull * (direction > 0) + push * (direction < 0)))


def data(harmonics, pull, push):
    rng = np.random.default_rng(5)
    A = np.tile(np.geomspace(1e-3, 3e-2, ROWS), len(harmonics))
    k = np.repeat(harmonics, ROWS)
    law = PullPush(pull, push, 30.0)
    Z = np.array([law.dynamic_stiffness(a, harmonic=int(n)) for a, n in zip(A, k, strict=True)])
    size = np.abs(np.tile(Z[:ROWS], len(harmonics)))
    Z = Z + 0.005 * size * (rng.standard_normal(A.size) + 1j * rng.standard_normal(A.size))
    Z[k == 0] = Z[k == 0].real
    return di.FrequencyResponse(
        np.ones(A.size), Z, A, quantity="dynamic_stiffness", harmonic=k,
        covariance=np.tile((0.005 * size)[:, None, None] ** 2 * np.eye(2), (1, 1, 1)),
    )  # fmt: skip


def test_the_fundamental_leaves_the_order_open_and_the_verdict_says_so():
    fit = di.fit(data((1,), 0.06, 0.14), PullPush(), throw=False)
    found = fit.identifiability
    assert found.named(Verdict.NOT_IDENTIFIED) == ["pull", "push"]
    assert found.parameters["sigma"].verdict is Verdict.IDENTIFIED
    assert not fit.trusted
    assert "pull and push are exchangeable: these data are the same for either" in fit.verdict
    assert sorted(fit.optimum.values[:2]) == pytest.approx([0.06, 0.14], rel=0.05)
    assert not found.direction


def test_even_harmonics_decide_it():
    fit = di.fit(data((1, 2), 0.06, 0.14), PullPush(), throw=False)
    assert "exchangeable" not in fit.verdict
    assert fit.identifiability.complete
    assert fit.optimum.values[:2] == pytest.approx([0.06, 0.14], rel=0.05)


def test_parameters_of_other_kinds_are_not_exchanged():
    fit = di.fit(di.load_dataset("noisy"), di.Dahl())
    assert "exchangeable" not in fit.verdict
