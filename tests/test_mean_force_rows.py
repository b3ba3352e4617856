"""Rows of the mean force (k = 0) are real: their real part alone is weighed."""

import warnings

import numpy as np
import pytest
from scipy import optimize

import dahl_ident as di
from dahl_ident.noise import Student
from dahl_ident.problem import TableProblem

F_MAX, SIGMA, ASYMMETRY = 0.8, 400.0, 0.2
HARMONICS = (0, 1, 2, 3)
AMPLITUDES = np.geomspace(4e-4, 4e-2, 9)


def predicted(f_max, sigma, asymmetry):
    law = di.Dahl(f_max, sigma, asymmetry=asymmetry)
    return np.ravel([law.dynamic_stiffness(AMPLITUDES, harmonic=k) for k in HARMONICS])


def covariances():
    """Return a covariance for each row: one part for k = 0, correlated parts for the others."""
    std = np.tile(0.3 / AMPLITUDES**0.5 * 0.02, len(HARMONICS)) * SIGMA * 0.02
    C = np.array([[1.0, 0.4], [0.4, 0.7]]) * std[:, None, None] ** 2
    C[: AMPLITUDES.size, 1, :] = C[: AMPLITUDES.size, :, 1] = 0.0
    return C


def table(seed, dof=None):
    rng = np.random.default_rng(seed)
    C, n = covariances(), AMPLITUDES.size
    e = np.array([rng.multivariate_normal([0.0, 0.0], c) for c in C])
    Z = predicted(F_MAX, SIGMA, ASYMMETRY) + e @ np.array([1.0, 1.0j])
    return di.FrequencyResponse(
        np.full(4 * n, 2.0), Z, np.tile(AMPLITUDES, 4), harmonic=np.repeat(HARMONICS, n),
        covariance=C, dof=None if dof is None else np.full(4 * n, dof),
    )  # fmt: skip


def whitened(values, data):
    """Return residuals of unit variance: one number for k = 0, two for other rows."""
    rest, C, n = data.response - predicted(*values), covariances(), AMPLITUDES.size
    pairs = np.column_stack([rest.real, rest.imag])[n:]
    others = np.linalg.solve(np.linalg.cholesky(C[n:]), pairs[..., None])
    return np.concatenate([rest.real[:n] / np.sqrt(C[:n, 0, 0]), others.ravel()])


def test_the_fit_is_that_of_the_residuals_written_out():
    data = table(seed=1)
    mine = di.fit(data, di.Dahl(asymmetry=None))
    theirs = optimize.least_squares(
        whitened, [F_MAX, SIGMA, ASYMMETRY], args=(data,), x_scale=[1.0, 500.0, 0.3], xtol=1e-14
    )
    jacobian = np.asarray(theirs.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    optimum = mine.optimum
    assert optimum.cost == pytest.approx(theirs.cost, rel=1e-6)
    assert optimum.dof == 7 * AMPLITUDES.size - 3 == mine.ndata - 3
    assert optimum.values == pytest.approx(theirs.x, rel=1e-5)
    assert [optimum.stderr[name] for name in optimum.names] == pytest.approx(
        np.sqrt(np.diag(covariance)), rel=1e-3
    )


def test_chi_square_has_the_mean_of_its_degrees_of_freedom():
    values = np.array([F_MAX, SIGMA, ASYMMETRY])
    truth = np.array([np.log(F_MAX), np.log(SIGMA), ASYMMETRY])
    tables = [table(seed) for seed in range(40)]
    squares = [float(whitened(values, data) @ whitened(values, data)) for data in tables]
    models = [TableProblem(data, di.Dahl(asymmetry=None)) for data in tables]
    mine = [float(np.sum(p.residuals_and_jacobian(truth)[0] ** 2)) for p in models]
    assert mine == pytest.approx(squares, rel=1e-9)
    m = 7 * AMPLITUDES.size
    assert np.mean(mine) == pytest.approx(m, abs=4.0 * np.sqrt(2.0 * m / 40))


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("dof", [5.0, 8.0])
def test_the_score_of_an_estimated_covariance_varies_as_its_information_says(parts, dof):
    # y' S^-1 y with a covariance S of dof degrees of freedom, true covariance 1: variance of the
    # score and mean of the stated information are one number
    rng = np.random.default_rng(5)
    n = 200_000
    samples = rng.standard_normal((n, int(dof), parts))
    S = np.einsum("nki,nkj->nij", samples, samples) / dof
    y = np.linalg.solve(np.linalg.cholesky(S), rng.standard_normal((n, parts))[..., None])[..., 0]
    loss = Student(np.array(dof), float(parts))
    z = (y**2).sum(axis=1)
    _, slope, _ = loss(z)
    back = np.linalg.inv(np.linalg.cholesky(S))[:, :, 0]  # derivative of y by the first number
    score = slope * (back * y).sum(axis=1)
    a, b = loss.information(z)
    stated = a * (back**2).sum(axis=1) + b * (back * y).sum(axis=1) ** 2
    spread = np.sqrt(np.var(score**2) / n + np.var(stated) / n)
    assert np.mean(score**2) == pytest.approx(np.mean(stated), abs=4.0 * spread)
    assert 4.0 * spread < 0.05 * np.mean(stated)  # dof + 1.5 in place of dof + 1 moves it by 5 %


def test_pictures_and_the_printed_points_show_each_row_as_what_it_is(run, tmp_path):
    fit = di.fit(table(seed=4), di.Dahl(asymmetry=None))
    lines = {str(line.get_label()): line for line in fit.plot_residuals().lines}
    second = np.asarray(lines["imaginary part"].get_ydata(), dtype=float)
    assert np.isnan(second).tolist() == (fit.data.harmonic == 0).tolist()

    record = di.load_dataset("play_and_two_limits")
    record.save(tmp_path / "waveforms.csv")
    with pytest.warns(UserWarning, match="the force is asymmetric"):
        fundamental = di.extract(tmp_path / "waveforms.csv").select(harmonic=1)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        printed = run("extract", str(tmp_path / "waveforms.csv")).out
    assert all(f"{phase:.2f}" in printed for phase in np.degrees(fundamental.phase))
