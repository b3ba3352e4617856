"""FrequencyResponse: validation, conversion, selection, tables, files, pictures."""

import copy
import pickle
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import control
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import dahl_ident as di
from dahl_ident.data import FrequencyResponse, read_frequency_response
from dahl_ident.errors import DataError, ValidationError
from dahl_ident.units import QUANTITIES

FIELDS = [f.name for f in fields(FrequencyResponse) if f.name not in ("quality", "provenance")]


def full_table(n=7, seed=3, motion="translation", **changes):
    """A table with everything in it, its errors correlated at random."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 3, 3)) * np.exp(rng.normal(size=(n, 3, 1)) - 5.0)
    joint = root @ root.swapaxes(1, 2)
    arguments: dict[str, Any] = {
        "frequency_hz": np.sort(rng.uniform(0.1, 90.0, n)),
        "response": rng.normal(size=n) + 1j * rng.uniform(0.1, 3.0, n),
        "amplitude": rng.uniform(1e-6, 1e-3, n),
        "drive": rng.uniform(0.1, 2.0, n),
        "covariance": joint[:, 1:, 1:],
        "dof": np.where(np.arange(n) % 2, 7.5, np.inf),
        "amplitude_std": np.sqrt(joint[:, 0, 0]),
        "amplitude_covariance": joint[:, 0, 1:],
        "level": [f"{k} N, #{k}" for k in range(n)],
        "run": [f"day {k // 3}" for k in range(n)],
        "controlled": ["force", "displacement"] * (n // 2) + ["force"] * (n % 2),
        "motion": motion,
        "drive_factor_uncertainty": 0.02,
        "quality": {
            "settled": np.arange(n) % 2 == 0,
            "remaining_bias": np.where(np.arange(n) == 2, np.nan, rng.normal(size=n)),
            "periods_needed": np.arange(n),
            "comment": [f"1.{k}0" for k in range(n)],
        },
        "provenance": {"file": "run.csv", "options": {"num_periods": 4}},
    }
    return FrequencyResponse(**{**arguments, **changes})


def assert_same(one, other):
    for name in FIELDS:
        a, b = getattr(one, name), getattr(other, name)
        if a is None:
            assert b is None, name
        else:
            np.testing.assert_array_equal(a, b, err_msg=name, strict=isinstance(a, np.ndarray))
    assert list(one.quality) == list(other.quality)
    for name, verdict in one.quality.items():
        np.testing.assert_array_equal(verdict, other.quality[name], err_msg=name, strict=True)


class TestValidation:
    def test_arrays_are_read_only_copies(self):
        amplitude = np.array([1e-3, 2e-3])
        data = FrequencyResponse([1.0, 2.0], [1j, 1j], amplitude=amplitude)
        amplitude[0] = 5.0
        assert data.amplitude[0] == 1e-3
        with pytest.raises(ValueError, match="read-only"):
            data.response[0] = 0.0
        with pytest.raises(AttributeError):
            data.drive = np.ones(2)  # type: ignore[misc]

    def test_defaults(self):
        data = FrequencyResponse([1.0, 2.0], [1j, 3.0], drive=[1.0, 1.0])
        assert data.controlled.tolist() == ["displacement", "displacement"]
        assert data.harmonic.tolist() == [1, 1]
        assert data.levels == []
        np.testing.assert_allclose(data.omega, [2 * np.pi, 4 * np.pi])
        np.testing.assert_allclose(data.phase, [np.pi / 2, 0.0])
        np.testing.assert_allclose(data.gain, [1.0, 3.0])
        assert len(data) == data.n == 2

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"amplitude": None, "drive": None}, "neither amplitude nor drive"),
            ({"frequency_hz": [1.0, -2.0]}, r"frequency_hz\[1\] is -2.0"),
            ({"frequency_hz": [[1.0, 2.0]]}, r"got shape \(1, 2\)"),
            ({"response": [1.0]}, r"response: expected shape \(2,\)"),
            ({"response": [1.0, np.nan]}, r"response.real\[1\] is nan"),
            ({"response": ["a", "b"]}, "expected complex numbers"),
            ({"amplitude": [1e-3, 0.0]}, r"amplitude\[1\] is 0.0"),
            ({"amplitude": [1e-3]}, "one entry for each point"),
            ({"dof": 3.0}, "without covariance"),
            ({"covariance": np.eye(2)[None] * [[[1.0]], [[-1.0]]]}, r"covariance\[1\]"),
            ({"covariance": [[[1.0, 2.0], [2.0, 1.0]]] * 2}, "positive semidefinite"),
            ({"covariance": [[[1.0, 0.1], [0.2, 1.0]]] * 2}, "symmetric"),
            ({"covariance": [np.eye(2)] * 2, "dof": [1.0, 0.0]}, r"dof\[1\] is 0.0"),
            ({"amplitude_std": [-1.0, 1.0]}, r"amplitude_std\[0\] is -1.0"),
            ({"amplitude_covariance": [[0.0, 0.0]] * 2}, "without amplitude_std"),
            ({"covariance": [np.eye(2)] * 2, "amplitude_std": [1.0, 1.0],
              "amplitude_covariance": [[0.0, 0.0], [1.5, 0.0]]}, r"covariance\[1\]"),
            ({"controlled": "speed"}, "controlled is 'speed'"),
            ({"harmonic": [1, 1.5]}, "whole numbers, got 1.5"),
            ({"harmonic": [1, 3], "quantity": "receptance"}, "harmonics of the force are rows of"),
            ({"harmonic": [1, 0]}, r"response\[1\] is .*harmonic 0 holds a mean"),
            ({"harmonic": [-1, 1]}, "numbers >= 0"),
            ({"quantity": "stiffness"}, "quantity is 'stiffness'; expected one of receptance"),
            ({"motion": "sideways"}, "translation, rotation"),
            ({"level": [1.0, np.inf]}, r"level\[1\] is inf"),
            ({"level": ["a"]}, "level: expected shape"),
            ({"quality": {"settled": [True]}}, "quality 'settled'"),
            ({"quality": {"settled": [1j, 2j]}}, "expected numbers or text"),
            ({"amplitude": None, "drive": [1.0, 1.0], "amplitude_std": [0.1, 0.1]},
             "amplitude_std is given without amplitude"),
            ({"drive_std": [0.1, 0.1]}, "drive_std is given without drive"),
            ({"harmonic": [0, 1], "response": [1.0, 1j], "covariance": [np.eye(2)] * 2},
             "imaginary part an error"),
        ],
    )  # fmt: skip
    def test_impossible_fields_are_refused(self, arguments, message):
        good = {"frequency_hz": [1.0, 2.0], "response": [1j, 2j], "amplitude": [1e-3, 2e-3]}
        with pytest.raises(ValidationError, match=message):
            FrequencyResponse(**{**good, **arguments})

    def test_survives_pickle_and_copy(self):
        data = full_table()
        assert_same(data, pickle.loads(pickle.dumps(data)))
        assert_same(data, copy.deepcopy(data))


class TestConversion:
    def test_definitions(self):
        """X/F and its kin from the phasors themselves (ISO 7626-1)."""
        f = np.array([0.7, 12.0])
        s = 2j * np.pi * f
        X, F = np.array([1e-3 * np.exp(0.3j), 2e-5 + 0j]), np.array([4.0 + 1j, 0.1j])
        expected = {
            "receptance": X / F,
            "mobility": s * X / F,
            "accelerance": s**2 * X / F,
            "dynamic_stiffness": F / X,
            "mechanical_impedance": F / (s * X),
            "apparent_mass": F / (s**2 * X),
        }
        for source in QUANTITIES:
            data = FrequencyResponse(f, expected[source], np.abs(X), quantity=source)
            for target in QUANTITIES:
                np.testing.assert_allclose(data.to(target).response, expected[target], rtol=1e-14)

    @pytest.mark.parametrize("target", QUANTITIES)
    @pytest.mark.parametrize("source", QUANTITIES)
    def test_covariance_travels(self, source, target):
        """Against the Jacobian by central differences of the phasor formula itself."""
        data = full_table(quantity=source, harmonic=1)
        covariance, amplitude_covariance = data.covariance, data.amplitude_covariance
        out = data.to(target)
        h = 1e-6 * data.gain
        J = np.empty((data.n, 2, 2))
        plain = replace(data, covariance=None, dof=None, amplitude_covariance=None)
        for k, step in enumerate((h, 1j * h)):
            ends = [replace(plain, response=data.response + by).to(target) for by in (step, -step)]
            slope = (ends[0].response - ends[1].response) / (2 * h)
            J[:, :, k] = np.stack([slope.real, slope.imag], -1)
        scale = np.abs(J).max() ** 2 * np.abs(covariance).max()
        expected = J @ covariance @ J.swapaxes(1, 2)
        np.testing.assert_allclose(out.covariance, expected, rtol=1e-6, atol=1e-9 * scale)
        cross = np.einsum("nij,nj->ni", J, amplitude_covariance)
        size = np.abs(cross).max()
        np.testing.assert_allclose(out.amplitude_covariance, cross, rtol=1e-6, atol=1e-9 * size)
        np.testing.assert_array_equal(out.amplitude_std, data.amplitude_std)

    def test_harmonics_stay_dynamic_stiffness(self):
        data = FrequencyResponse([1.0, 1.0], [1j, 0.1j], [1e-3, 1e-3], harmonic=[1, 3])
        with pytest.raises(ValidationError, match=r"harmonics 1, 3 cannot become mobility"):
            data.to("mobility")
        assert data.select(harmonic=1).to("mobility").n == 1
        assert data.to("dynamic_stiffness") is data

    def test_zero_has_no_inverse(self):
        data = FrequencyResponse([1.0, 2.0], [1j, 0.0], [1e-3, 1e-3])
        with pytest.raises(ValidationError, match=r"response\[1\] is 0"):
            data.to("receptance")
        assert data.to("apparent_mass").response[1] == 0.0


class TestSelection:
    def test_by_level_frequency_harmonic_and_rows(self):
        data = FrequencyResponse(
            [1.0, 2.0, 3.0, 3.0], [1j, 2j, 3j, 4j], [1e-3] * 4, level=[0.2, 0.5, 0.5, 0.2],
            harmonic=[1, 1, 1, 3], quality={"settled": [True, False, True, True]},
        )  # fmt: skip
        assert data.levels == [0.2, 0.5]
        assert data.select(level=0.5).response.tolist() == [2j, 3j]
        assert data.select(level=[0.2, 0.5], harmonic=1).n == 3
        assert data.select(frequency_hz=(2.0, 3.0)).n == 3
        settled = data.select(rows=data.quality["settled"])
        assert settled.response.tolist() == [1j, 3j, 4j]
        assert settled.quality["settled"].all()

    @pytest.mark.parametrize(
        ("conditions", "message"),
        [
            ({"level": "x"}, r"no level \['x'\]; there are 0.2, 0.5"),
            ({"frequency_hz": (7.0, 9.0)}, "none of the 2 points"),
            ({"harmonic": 5}, "none of the 2 points"),
            ({"rows": [0, 1]}, "True or False"),
        ],
    )
    def test_nothing_left_is_an_error(self, conditions, message):
        data = FrequencyResponse([1.0, 2.0], [1j, 2j], [1e-3] * 2, level=[0.2, 0.5])
        with pytest.raises(ValidationError, match=message):
            data.select(**conditions)

    def test_concatenate(self):
        one, other = full_table(4, 1), full_table(5, 2)
        both = FrequencyResponse.concatenate([one, other])
        assert both.n == 9
        assert_same(both.select(rows=np.arange(9) < 4), one)
        assert_same(both.select(rows=np.arange(9) >= 4), other)
        assert both.provenance == {"parts": [one.provenance, other.provenance]}

    @pytest.mark.parametrize("other", [
        full_table(harmonic=1, quantity="mobility"), full_table(dof=None), full_table(level=3.0),
        full_table(motion="rotation"),
    ])  # fmt: skip
    def test_concatenate_refuses_what_differs_and_nothing(self, other):
        with pytest.raises(ValidationError, match=r"parts\[1\] .* does not go with parts\[0\]"):
            FrequencyResponse.concatenate([full_table(), other])
        with pytest.raises(ValidationError, match="at least one table"):
            FrequencyResponse.concatenate([])

    def test_runs_are_text_and_can_be_selected(self):
        data = FrequencyResponse([1.0] * 3, [1j] * 3, [1e-3] * 3, run=[2, 2, 10.5])
        assert data.runs == ["2", "10.5"]
        assert data.select(run="2").n == 2
        assert "2 runs" in repr(data)
        with pytest.raises(ValidationError, match=r"no run \['3'\]; there are 2, 10.5"):
            data.select(run="3")
        bare = FrequencyResponse([1.0], [1j], [1e-3])
        with pytest.raises(ValidationError, match="there are none"):
            bare.select(run="a")
        with pytest.raises(ValidationError, match="no level"):
            bare.select(level=0.2)


@pytest.mark.filterwarnings("ignore::dahl_ident.errors.DataWarning")
@pytest.mark.versions
class TestTables:
    @pytest.mark.parametrize("motion", ["translation", "rotation"])
    @pytest.mark.parametrize("ending", [".csv", ".csv.gz", ".tsv", ".parquet", ".h5", ".hdf5"])
    def test_files_lose_nothing(self, tmp_path, ending, motion):
        data = full_table(motion=motion)
        path = data.save(tmp_path / f"levels{ending}")
        back = read_frequency_response(path)
        assert_same(data, back)
        assert back.provenance["origin"] == data.provenance
        assert back.provenance["file"] == str(path)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]

    @pytest.mark.parametrize("quantity", QUANTITIES)
    @pytest.mark.parametrize("motion", ["translation", "rotation"])
    def test_units_tell_the_quantity(self, tmp_path, quantity, motion):
        data = full_table(motion=motion).to(quantity)
        assert_same(data, read_frequency_response(data.save(tmp_path / "t.csv")))

    def test_harmonics_and_bare_tables(self, tmp_path):
        data = FrequencyResponse(
            [1.0, 1.0], [1j, 0.0], drive=[0.1, 0.1], harmonic=[1, 3], controlled="force"
        )
        assert_same(data, read_frequency_response(data.save(tmp_path / "t.csv")))

    @pytest.mark.parametrize("ending", [".csv", ".parquet", ".h5"])
    def test_mean_force_and_even_harmonics(self, tmp_path, ending):
        covariance = np.array([np.diag([4.0, 0.0]), np.eye(2), np.eye(2)])
        data = FrequencyResponse(
            [1.0] * 3, [-3.0, 50.0 + 9.0j, 1.0 - 2.0j], [1e-3] * 3, covariance=covariance,
            harmonic=[0, 1, 2], run=["1", "1", "02"],
        )  # fmt: skip
        assert_same(data, read_frequency_response(data.save(tmp_path / f"t{ending}")))
        polar = read_frequency_response(data.to_frame(polar=True))
        np.testing.assert_allclose(polar.response, data.response, rtol=1e-12)
        assert polar.response[0].imag == 0.0
        np.testing.assert_array_equal(polar.covariance[0], np.diag([4.0, 0.0]))

    @settings(max_examples=30)
    @given(
        arrays(np.float64, (3, 4), elements=st.floats(1e-90, 1e90)),
        st.lists(
            st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1),
            min_size=3,
            max_size=3,
        ),
    )
    def test_csv_loses_nothing(self, tmp_path_factory, numbers, labels):
        data = FrequencyResponse(
            numbers[:, 0], numbers[:, 1] + 1j * numbers[:, 2], numbers[:, 3], level=labels
        )
        path = data.save(tmp_path_factory.mktemp("t") / "t.csv")
        assert_same(data, read_frequency_response(path))

    def test_frame_keeps_provenance(self):
        data = full_table()
        assert read_frequency_response(data.to_frame()).provenance == data.provenance

    def test_polar_frame(self):
        data = full_table()
        frame = data.to_frame(polar=True)
        assert data.covariance is not None
        np.testing.assert_allclose(frame["gain [N/m]"], data.gain)
        np.testing.assert_allclose(frame["phase_deg"], np.degrees(data.phase))
        # ln R = ln gain + j phase, so the errors of both are those of dR/R
        a, b = data.response.real, data.response.imag
        J = np.linalg.inv(np.moveaxis(np.array([[a, -b], [b, a]]), -1, 0))
        expected = np.sqrt(np.diagonal(J @ data.covariance @ J.swapaxes(1, 2), axis1=1, axis2=2))
        np.testing.assert_allclose(frame["gain_std [N/m]"] / data.gain, expected[:, 0])
        np.testing.assert_allclose(np.radians(frame["phase_std_deg"]), expected[:, 1])

    def test_quality_must_not_hide_a_column(self):
        with pytest.raises(ValidationError, match="quality 'gain' is also the name"):
            full_table(quality={"gain": np.arange(7)}).to_frame()

    def test_unknown_ending_and_place(self, tmp_path):
        with pytest.raises(ValidationError, match=r"written as \.csv, .*got '.xlsx'"):
            full_table().save(tmp_path / "t.xlsx")
        with pytest.raises(DataError, match="cannot be written: No such file"):
            full_table().save(tmp_path / "absent" / "t.csv")

    def test_interrupted_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = full_table().save(tmp_path / "t.csv")
        before = path.read_bytes()

        def broken(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(Path, "replace", broken)
        with pytest.raises(KeyboardInterrupt):
            full_table(5).save(path, overwrite=True)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]

    def test_a_file_is_replaced_on_request_only(self, tmp_path):
        path = full_table().save(tmp_path / "t.csv")
        before = path.read_bytes()
        with pytest.raises(DataError, match=r"the file exists already.*overwrite=True"):
            full_table(5).save(path)
        assert path.read_bytes() == before
        assert full_table(5).save(path, overwrite=True).read_bytes() != before


@pytest.mark.versions
class TestControl:
    def test_one_system_a_level(self):
        data = FrequencyResponse(
            [2.0, 1.0, 1.0], [2j, 1j, 5.0], [1e-3] * 3, level=["a", "a", "b"], quantity="receptance"
        )
        systems = data.to_control()
        assert list(systems) == ["a", "b"]
        assert isinstance(systems["a"], control.FrequencyResponseData)
        np.testing.assert_allclose(systems["a"](2j * np.pi * 1.0), 1j)
        np.testing.assert_allclose(systems["a"](4j * np.pi), 2j)

    def test_without_levels(self):
        data = FrequencyResponse([1.0, 2.0], [1j, 2j], [1e-3] * 2)
        np.testing.assert_allclose(data.to_control()[None].omega, data.omega)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [({"harmonic": [1, 3]}, "no harmonics"), ({}, "1 Hz more than once")],
    )
    def test_what_is_no_transfer_function(self, arguments, message):
        data = FrequencyResponse([1.0, 1.0], [1j, 2j], [1e-3, 2e-3], **arguments)
        with pytest.raises(ValidationError, match=message):
            data.to_control()


class TestTelling:
    def test_repr_shows_levels_ranges_units(self):
        text = repr(full_table(motion="rotation", harmonic=[1, 3, 1, 3, 1, 3, 1]))
        facts = (
            "7 points of dynamic stiffness, rotation", "7 levels", "0 N, #0", "rad, zero to peak",
            "N m, zero to peak", "N m/rad", "force, displacement", "harmonics",
            "degrees of freedom", "settled", "run.csv",
        )  # fmt: skip
        assert [fact for fact in facts if fact not in text] == []

    def test_units(self):
        units = {"frequency_hz": "Hz", "amplitude": "rad", "drive": "N m"}
        turning = full_table(motion="rotation").to("mobility")
        assert turning.units == units | {"response": "rad/(N m s)"}

    def test_html_escapes(self):
        data = FrequencyResponse([1.0], [1j], [1e-3], level=["<b>"])
        assert "&lt;b&gt;" in data._repr_html_()
        assert "<b>" not in data._repr_html_()

    def test_one_of_a_kind_is_singular(self):
        one = FrequencyResponse([1.0], [1j], [1e-3], level=["a"])
        text = repr(one)
        assert "1 point of dynamic stiffness" in text
        assert "1 level " in text
        report = di.fit(one, di.Dahl(alpha=1.0), throw=False).fit_report()
        assert not re.search(r"\b1 (rows|points|levels|parameters|evaluations)\b", report)

    def test_many_levels_are_counted(self):
        data = FrequencyResponse(np.arange(1, 31), np.ones(30), np.ones(30), level=np.arange(30))
        assert "... (30 in all)" in repr(data)

    def test_picture_over_frequency_and_over_amplitude(self):
        levels = FrequencyResponse(
            [1.0, 2.0] * 2, [1j, 2j, 3j, 4j], drive=[0.1] * 4, level=["a", "a", "b", "b"]
        )
        top, bottom = levels.plot()
        assert bottom.get_xlabel() == "frequency [Hz]"
        assert len(top.get_lines()) == 2
        sweep = full_table(frequency_hz=np.ones(7), level=None, harmonic=[1, 1, 1, 1, 1, 3, 3],
                           controlled="displacement")  # fmt: skip
        axes = plt.figure().subplots(2)
        top, bottom = sweep.plot(ax=axes)
        assert top is axes[0]
        assert bottom.get_xlabel() == "displacement amplitude [m]"
        assert len(top.get_lines()[0].get_xdata()) == 5


def test_errors_of_the_drive_are_kept_in_files(tmp_path):
    response = np.array([1e-3 - 1e-4j, 2e-3 - 3e-4j])
    data = FrequencyResponse(
        [1.0, 2.0], response, drive=[0.5, 1.0], controlled="force", quantity="receptance",
        covariance=1e-8 * np.tile(np.eye(2), (2, 1, 1)), drive_std=[0.01, 0.02],
        drive_covariance=[[1e-7, 2e-8], [-1e-7, 0.0]],
    )  # fmt: skip
    read = read_frequency_response(data.save(tmp_path / "t.csv"))
    assert read.drive_std == pytest.approx([0.01, 0.02])
    assert read.drive_covariance == pytest.approx(data.drive_covariance)
    stiff = data.to("dynamic_stiffness")
    back = stiff.to("receptance")
    assert back.drive_covariance == pytest.approx(data.drive_covariance)
