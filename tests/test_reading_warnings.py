"""What a reader warns of stays with the data: verdict and every form of report repeat it."""

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.errors import DataWarning

FRICTION = di.Dahl(f_max=0.1, sigma=30.0)
A = np.geomspace(5e-4, 2e-2, 8)
N = np.array([complex(FRICTION.describing_function(a)) for a in A])
N = N * np.exp(1e-3 * np.random.default_rng(0).standard_normal(A.size))


def table(folder, phase_deg, *, drive=None):
    """Write a table of one frequency."""
    drive = A * np.abs(N) if drive is None else drive
    lines = ["frequency_hz,amplitude [m],drive [N],gain [N/m],phase_deg"]
    lines += [
        f"1,{a!r},{f!r},{g!r},{p!r}"
        for a, f, g, p in np.column_stack([A, drive, np.abs(N), phase_deg]).tolist()
    ]
    path = folder / "table.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def radians(folder):
    return di.read_frequency_response(table(folder, 0.3 * np.angle(N)))


def one_sign(folder):
    phase = np.degrees(np.angle(N))
    phase[3] *= -1.0
    return di.read_frequency_response(table(folder, phase))


def rms_drive(folder):
    drive = A * np.abs(N) / np.sqrt(2.0)
    return di.read_frequency_response(table(folder, np.degrees(np.angle(N)), drive=drive))


def two_days(folder):
    path = table(folder, np.degrees(np.angle(N)))
    path.write_text(path.read_text() * 2)
    return di.read_frequency_response(path)


def record(folder, change):
    """Write a record of four levels."""
    t = np.arange(6000) / 100.0
    x = np.repeat([2e-2, 8e-3, 3e-3, 1e-3], 1500) * np.sin(2.0 * np.pi * t)
    force = FRICTION.force(x) + 1e-5 * np.random.default_rng(1).standard_normal(t.size)
    change(force)
    path = folder / "record.csv"
    table = np.column_stack([t, x, force])
    np.savetxt(path, table, delimiter=",", header="time [s],x [m],F [N]", comments="")
    return path


def stuck(folder):
    def change(force):
        for start in (720, 2220, 3720, 5220):
            force[start : start + 25] = force[start]

    return di.extract(record(folder, change), harmonics=[1])


def marks(folder):
    def change(force):
        force[[100, 101, 3000]] = -9999.0

    return di.extract(di.read_record(record(folder, change), missing="drop"), harmonics=[1])


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (radians, "are the phases in radians?"),
        (one_sign, "the phase's sign creates energy: line 5"),
        (rms_drive, "drive and amplitude do not agree with the response by more than 10 %"),
        (two_days, "the header is repeated in the file: read as 2 runs"),
        (stuck, "does a converter stick?"),
        (marks, "3 samples left out: column 'F' is -9999 in them, a mark of a missing value"),
    ],
)
def test_warnings_on_reading_reach_verdict_and_report(read, message, tmp_path):
    with pytest.warns(DataWarning) as said:
        data = read(tmp_path)
    assert sum(message in str(warning.message) for warning in said) == 1
    assert message in repr(data)
    fit = di.fit(data, di.Dahl(alpha=1.0), throw=False)
    assert message in fit.verdict
    assert message in fit.fit_report()
    assert message in di.FitResult.from_json(fit.to_json()).verdict


def test_warnings_on_reading_reach_every_report(tmp_path):
    message = "the phase's sign creates energy: line 5"
    with pytest.warns(DataWarning, match=message):
        one_sign(tmp_path).save(tmp_path / "saved.csv")
    with pytest.warns(DataWarning):
        data = di.read_frequency_response(tmp_path / "saved.csv")
    fit = di.fit(data, di.Dahl(alpha=1.0), throw=False)
    for name in ("report.html", "report.json", "report.md"):
        di.report(fit, tmp_path / name)
        assert message in (tmp_path / name).read_text().replace("&#39;", "'"), name


def test_a_fit_to_the_record_itself_repeats_them(tmp_path):
    def change(force):
        force[[100, 101, 3000]] = -9999.0

    path = record(tmp_path, change)
    with pytest.raises(di.errors.DataError, match=r"is -9999 \(3 such cells\)"):
        di.read_record(path)
    with pytest.warns(DataWarning, match="3 samples left out"):
        found = di.read_record(path, missing="drop")
    assert found.n == 5997
    verdict = di.fit(found, di.Dahl(alpha=1.0)).verdict
    assert "Warning on reading: " in verdict
    assert "3 samples left out: column 'F' is -9999 in them" in verdict
