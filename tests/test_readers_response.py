"""Tables of response: every form they come in, doubts about them, many files into one."""

import math
import tomllib
import warnings

import numpy as np
import pandas as pd
import pytest

from dahl_ident.data import FrequencyResponse, inspect, read_frequency_response, read_record
from dahl_ident.errors import DataError, DataWarning, UnitError, ValidationError
from dahl_ident.synthetic import load_dataset

FREQUENCY = np.array([1.0, 2.0, 4.0])
OMEGA = 2 * np.pi * FREQUENCY
AMPLITUDE = np.array([1e-3, 2e-3, 4e-3])
STIFFNESS = np.array([3e3 + 4e3j, 1e3 + 2e3j, 5e2 + 1e2j])


def read(table, **options):
    """Read columns as a table, without its file."""
    return read_frequency_response(pd.DataFrame(table), **options)


BASE = {"frequency_hz": FREQUENCY, "amplitude [mm]": AMPLITUDE * 1e3}
RECTANGULAR = {**BASE, "real [N/m]": STIFFNESS.real, "imag [N/m]": STIFFNESS.imag}


class TestForms:
    @pytest.mark.parametrize(
        "columns",
        [
            {"real [N/m]": STIFFNESS.real, "imag [N/m]": STIFFNESS.imag},
            {"Re [kN/m]": STIFFNESS.real / 1e3, "Im": STIFFNESS.imag / 1e3},
            {"gain [N/mm]": abs(STIFFNESS) / 1e3, "phase_deg": np.angle(STIFFNESS, deg=True)},
            {"Magnitude (N/m)": abs(STIFFNESS), "Phase (rad)": np.angle(STIFFNESS)},
            {"gain_db [N/m]": 20 * np.log10(abs(STIFFNESS)),
             "phase_deg": np.angle(STIFFNESS, deg=True)},
            {"gain [dB re 1 kN/m]": 20 * np.log10(abs(STIFFNESS) / 1e3),
             "phase [deg]": np.angle(STIFFNESS, deg=True)},
            {"response [N/m]": STIFFNESS},
            {"frf [N/m]": [f"{z.real:.17g} {z.imag:+.17g}i" for z in STIFFNESS]},
        ],
    )  # fmt: skip
    def test_all_forms_agree(self, columns):
        data = read({**BASE, **columns})
        np.testing.assert_allclose(data.response, STIFFNESS, rtol=1e-13)
        np.testing.assert_allclose(data.amplitude, AMPLITUDE)
        assert (data.quantity, data.motion) == ("dynamic_stiffness", "translation")

    @pytest.mark.parametrize(
        ("unit", "power"), [("um", 0), ("um pk", 0), ("um/s", 1), ("um/s^2", 2)]
    )
    def test_amplitudes_of_any_motion(self, unit, power):
        columns = {**RECTANGULAR, f"amplitude [{unit}]": AMPLITUDE * OMEGA**power * 1e6}
        del columns["amplitude [mm]"]
        np.testing.assert_allclose(read(columns).amplitude, AMPLITUDE, rtol=1e-13)

    @pytest.mark.parametrize(
        ("header", "factor"), [("[N]", 1.0), ("[N rms]", math.sqrt(2)), ("[N pp]", 0.5)]
    )
    def test_markers(self, header, factor):
        force = AMPLITUDE * abs(STIFFNESS)
        data = read({**RECTANGULAR, f"drive {header}": force / factor})
        np.testing.assert_allclose(data.drive, force, rtol=1e-14)

    @pytest.mark.parametrize(
        ("header", "values"),
        [
            ("frequency [Hz]", FREQUENCY),
            ("frequency [rad/s]", OMEGA),
            ("frequency [rpm]", FREQUENCY * 60),
            ("freq [kHz]", FREQUENCY / 1e3),
        ],
    )
    def test_frequencies(self, header, values):
        columns = {**RECTANGULAR, header: values}
        del columns["frequency_hz"]
        np.testing.assert_allclose(read(columns).frequency_hz, FREQUENCY, rtol=1e-14)

    @pytest.mark.parametrize(
        ("unit", "quantity", "response"),
        [
            ("mm/N", "receptance", 1e3 / STIFFNESS),
            ("(m/s)/N", "mobility", 1j * OMEGA / STIFFNESS),
            ("g/N", "accelerance", -(OMEGA**2) / STIFFNESS / 9.80665),
            ("N s/m", "mechanical_impedance", STIFFNESS / (1j * OMEGA)),
            ("kg", "apparent_mass", -STIFFNESS / OMEGA**2),
        ],
    )
    def test_the_unit_tells_the_quantity(self, unit, quantity, response):
        data = read({**BASE, f"real [{unit}]": response.real, f"imag [{unit}]": response.imag})
        assert data.quantity == quantity
        np.testing.assert_allclose(data.to("dynamic_stiffness").response, STIFFNESS, rtol=1e-13)

    def test_rotation(self):
        data = read({
            "frequency_hz": FREQUENCY, "amplitude [deg]": np.degrees(AMPLITUDE),
            "real [lbf-in/deg]": STIFFNESS.real, "imag [lbf-in/deg]": STIFFNESS.imag,
        })  # fmt: skip
        assert data.motion == "rotation"
        factor = 0.45359237 * 9.80665 * 0.0254 * 180 / np.pi
        np.testing.assert_allclose(data.response, STIFFNESS * factor)
        assert data.unit == "N m/rad"

    def test_phase_with_amplitude_and_drive(self):
        """The phase is that of the quantity named, whatever motion the amplitude is."""
        columns = {
            "frequency_hz": FREQUENCY, "amplitude [m/s^2]": AMPLITUDE * OMEGA**2,
            "force [N]": AMPLITUDE * abs(STIFFNESS), "phase [rad]": -np.angle(STIFFNESS),
        }  # fmt: skip
        data = read(columns, columns={"quantity": "receptance"})
        np.testing.assert_allclose(data.response, 1.0 / STIFFNESS)
        with pytest.raises(DataError, match="say which quantity's it is"):
            read(columns)

    def test_one_amplitude_or_drive_for_all(self):
        response = {"real [N/m]": STIFFNESS.real, "imag [N/m]": STIFFNESS.imag}
        columns = {"frequency_hz": FREQUENCY, **response}
        data = read(columns, drive="200 mN pp")
        np.testing.assert_array_equal(data.drive, 0.1)
        assert data.amplitude is None
        assert data.controlled.tolist() == ["force"] * 3
        assert data.levels == ["200 mN pp"]
        data = read(columns, amplitude="2 mm/s rms")
        np.testing.assert_allclose(data.amplitude, 2e-3 * math.sqrt(2) / OMEGA)
        with pytest.raises(DataError, match=r"neither an amplitude nor a drive .* drive='0.2 N'"):
            read(columns)
        with pytest.raises(DataError, match="drive is '0 N'; expected a value > 0"):
            read(columns, drive="0 N")

    def test_drive_in_volts(self):
        columns = {**RECTANGULAR, "drive [mV]": AMPLITUDE * abs(STIFFNESS) / 12.5 * 1e3}
        mapped = {"drive_factor": "12.5 N/V", "drive_factor_uncertainty": 0.02}
        data = read(columns, columns=mapped)
        np.testing.assert_allclose(data.drive, AMPLITUDE * abs(STIFFNESS))
        assert data.provenance is not None
        assert data.drive_factor_uncertainty == 0.02
        assert "uncertain by 2 %" in repr(data)
        with pytest.raises(UnitError, match="the drive is a voltage; give the force for one"):
            read(columns)
        with pytest.raises(UnitError, match=r"drive_factor has the unit \[N/A\]; expected"):
            read(columns, columns={"drive_factor": "12.5 N/A"})

    def test_what_is_assumed_is_said(self):
        data = read(RECTANGULAR)
        assert data.provenance["notes"] == [
            "amplitude [mm] taken as zero to peak: the table does not say",
            "controlled: displacement, as the table does not say",
        ]
        assert "taken as zero to peak" in repr(data)
        silent = read({**RECTANGULAR, "amplitude [mm pk]": 1.0, "controlled": "force"}, columns={
            "amplitude": "amplitude [mm pk]"})  # fmt: skip
        assert "notes" not in silent.provenance

    def test_sign_of_the_phase(self):
        phase = -np.angle(STIFFNESS, deg=True)
        columns = {**BASE, "gain [N/m]": abs(STIFFNESS), "phase_deg": phase}
        data = read(columns, columns={"phase": {"sign": -1}})
        np.testing.assert_allclose(data.response, STIFFNESS)


def test_units_at_the_end_of_names(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "freq_Hz,drive_mN,receptance_re_m_per_N,receptance_im_m_per_N\n1,200,2e-3,-1e-3\n"
    )
    data = read_frequency_response(path)
    assert (data.quantity, data.response.tolist()) == ("receptance", [2e-3 - 1e-3j])
    np.testing.assert_allclose(data.drive, [0.2])
    path.write_text("time_s,displacement_um,force_N\n0,1,2\n0.5,2,3\n")
    record = read_record(path)
    np.testing.assert_allclose(record.displacement, [1e-6, 2e-6])


def test_columns_without_a_role_are_covariates(tmp_path):
    others = {"tension": [10, 20, 20], "gap": [1.0, np.nan, 2.0], "note": ["a", "b", "c"]}
    data = read({**RECTANGULAR, **others})
    assert list(data.quality) == ["tension"]  # of numbers, all of them finite
    np.testing.assert_array_equal(data.quality["tension"], [10, 20, 20], strict=True)
    assert "columns not used: gap, note" in repr(data)
    data.save(tmp_path / "saved.csv")
    again = read_frequency_response(tmp_path / "saved.csv")
    np.testing.assert_array_equal(again.quality["tension"], [10, 20, 20], strict=True)
    plain = read(RECTANGULAR)
    assert not FrequencyResponse.concatenate([data, plain]).quality


class TestErrors:
    def test_standard_deviations(self):
        n = len(STIFFNESS)
        data = read({**RECTANGULAR, "std": [1.0, 2.0, 3.0], "dof": [3.0, np.inf, 5.0]})
        np.testing.assert_allclose(
            data.covariance, np.eye(2) * np.array([1.0, 4.0, 9.0])[:, None, None]
        )
        np.testing.assert_array_equal(data.dof, [3.0, np.inf, 5.0])
        data = read({**RECTANGULAR, "real_std [kN/m]": [1.0] * n, "imag_std": [2.0] * n})
        np.testing.assert_allclose(data.covariance, [np.diag([1e6, 4.0])] * n)

    def test_polar_standard_deviations(self):
        """Against the sample covariance of drawn gains and phases."""
        rng = np.random.default_rng(5)
        data = read({
            **BASE, "gain [N/m]": abs(STIFFNESS), "phase_deg": np.angle(STIFFNESS, deg=True),
            "gain_std": 0.01 * abs(STIFFNESS), "phase_std_deg": [0.2, 0.5, 1.0],
            "amplitude_std [um]": [1.0, 2.0, 3.0],
        })  # fmt: skip
        np.testing.assert_allclose(data.amplitude_std, [1e-6, 2e-6, 3e-6])
        for k, phase_std in enumerate(np.radians([0.2, 0.5, 1.0])):
            gain, turn = 1 + 0.01 * rng.normal(size=200_000), phase_std * rng.normal(size=200_000)
            draws = STIFFNESS[k] * gain * np.exp(1j * turn)
            sample = np.cov(draws.real, draws.imag)
            limit = 0.02 * np.abs(sample).max()
            np.testing.assert_allclose(data.covariance[k], sample, rtol=0.02, atol=limit)

    def test_polar_table_reads_back(self):
        data = read({**RECTANGULAR, "std": [30.0, 20.0, 10.0]})
        again = read_frequency_response(data.to_frame(polar=True))
        np.testing.assert_allclose(again.response, data.response)
        np.testing.assert_allclose(again.covariance, data.covariance, atol=1e-9)

    @pytest.mark.parametrize(
        ("columns", "error", "message"),
        [
            ({"std": [1.0, -1.0, 1.0]}, DataError, "row 2, column 'std'.*a standard dev"),
            ({"std": 1.0, "real_std": 1.0, "imag_std": 1.0}, DataError, "both std and real_std"),
            ({"amplitude_std [N]": 1.0}, UnitError, r"unit \[N\]; expected .* of m"),
            ({"std": 1.0, "dof": [1.0, 0.0, 1.0]}, DataError, r"dof\[1\] is 0.0"),
            ({"dof": 3.0}, DataError, "dof is given without covariance"),
        ],
    )
    def test_bad_errors(self, columns, error, message):
        with pytest.raises(error, match=message):
            read({**RECTANGULAR, **columns})


class TestRefusal:
    @pytest.mark.parametrize(
        ("columns", "message"),
        [
            ({"frequency_hz": [1.0, 0.0, 2.0]}, r"row 2, column 'frequency_hz': found 0.0 .*a f"),
            ({"amplitude [mm]": [1.0, -2.0, 3.0]}, "row 2, column 'amplitude'.*a value > 0"),
            ({"drive [N]": [1.0, 2.0, 0.0]}, "row 3, column 'drive': found 0.0"),
            ({"real [N/m]": [1.0, np.nan, 1.0]}, "row 2, column 'real': the cell is empty or NaN"),
            ({"real [N/m]": [1.0, "x", 1.0]}, "row 2, column 'real': 'x' is not a number"),
            ({"real [N/m]": 0.0, "imag [N/m]": [1.0, 1.0, 0.0]}, "row 3: the response is 0"),
            ({"real [m]": STIFFNESS.real}, "2 columns may be the real"),
            ({"gain [N/m]": 1.0, "phase_deg": 1.0}, "both real and imag and gain and phase are"),
            ({"harmonic": [1, 2.5, 3]}, "row 2, column 'harmonic'.*a whole number >= 0"),
            ({"controlled": "speed"}, "row 1, column 'controlled': found speed"),
        ],
    )
    def test_bad_cells(self, columns, message):
        with pytest.raises(DataError, match=message):
            read({**RECTANGULAR, **columns})

    def test_negative_gain(self):
        with pytest.raises(DataError, match=r"row 3, column 'gain': found -1.0 .* a gain >= 0"):
            read({**BASE, "gain [N/m]": [1.0, 1.0, -1.0], "phase_deg": 10.0})

    @pytest.mark.parametrize(("role", "value"), [("amplitude", "5 um"), ("drive", "0.2 N")])
    def test_a_column_and_a_value_for_the_file(self, role, value):
        table = {**RECTANGULAR, "drive [N]": [1.0, 2.0, 3.0]}
        message = f"{role}='{value}' is given, and column '{role}' holds the {role} too"
        with pytest.raises(DataError, match=message):
            read(table, **{role: value})

    def test_no_response(self):
        with pytest.raises(DataError, match="no response; expected real and imag, gain") as error:
            read(BASE)
        assert all(name in str(error.value) for name in BASE)
        assert "(inspect proposes a column map)" in str(error.value)
        with pytest.raises(DataError, match="'response' holds no complex numbers"):
            read({**BASE, "response [N/m]": 1.0})

    def test_units(self):
        with pytest.raises(UnitError, match=r"imag in \[N s/m\] is mechanical_impedance"):
            read({**RECTANGULAR, "imag [N s/m]": 1.0}, columns={"imag": "imag [N s/m]",
                 "quantity": "dynamic_stiffness"})  # fmt: skip
        with pytest.raises(UnitError, match=r"'phase' has no unit; .*'phase \[deg\]'"):
            read({**BASE, "gain [N/m]": 1.0, "phase": 1.0})
        with pytest.raises(UnitError, match="amplitude is translation, real is rotation"):
            read({**BASE, "real [N m/rad]": 1.0, "imag [N m/rad]": 1.0})
        with pytest.raises(UnitError, match="does not say what 0 dB is"):
            read({**BASE, "gain [dB]": 1.0, "phase_deg": 1.0})

        with pytest.raises(UnitError, match="real is dynamic_stiffness, imag mechanical_impedance"):
            read({**BASE, "real [N/m]": 1.0, "imag [N s/m]": 1.0})

    def test_zero_hertz_can_be_left_out(self):
        columns = {**RECTANGULAR, "frequency_hz": [0.0, 1.0, 2.0], "real [N/m]": [np.nan, 1.0, 1.0]}
        with pytest.raises(DataError, match=r"a frequency > 0; frequency_hz=\(low, high\) keeps"):
            read(columns)

    def test_empty_frame(self):
        with pytest.raises(DataError, match="the table is empty"):
            read({})


class TestDoubts:
    def test_clean_tables_raise_no_doubt(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read({**RECTANGULAR, "drive [N]": AMPLITUDE * abs(STIFFNESS)})

    def test_radians_in_a_degree_column(self):
        with pytest.warns(DataWarning, match=r"no phase is above 2 pi; .*: row 1, row 2, row 3"):
            read({**BASE, "gain [N/m]": 1.0, "phase_deg": np.angle(STIFFNESS)})

    def test_degrees_in_a_radian_column(self):
        with pytest.warns(DataWarning, match=r"above 4 pi; are they degrees\?: row 1, row 2$"):
            read({**BASE, "gain [N/m]": 1.0, "phase [rad]": [53.13, 63.43, 11.31]}, passive=False)

    def test_rms_against_zero_to_peak(self):
        force = AMPLITUDE * abs(STIFFNESS) * [1.0, 1.0, 1 / math.sqrt(2)]
        with pytest.warns(DataWarning, match=r"\(rms against zero to peak\?\): row 3$"):
            read({**RECTANGULAR, "drive [N]": force})

    def test_single_rows_that_create_energy(self):
        with pytest.warns(DataWarning, match="the phase's sign creates energy: row 2$"):
            read({**RECTANGULAR, "imag [N/m]": STIFFNESS.imag * [1.0, -1.0, 1.0],
                  "amplitude [mm]": [1.0, 1.0, 1.0]})  # fmt: skip

    def test_a_table_that_creates_energy(self):
        wrong = {**RECTANGULAR, "imag [N/m]": -STIFFNESS.imag}
        with pytest.raises(DataError, match=r"creates energy: .* 10.4 times its standard error"):
            read(wrong)
        assert read(wrong, passive=False).n == 3

    def test_receptance_with_the_sign_of_a_stiffness(self):
        with pytest.raises(DataError, match="count the phase the other way round"):
            read({**BASE, "gain [m/N]": 1e-3, "phase_deg": [10.0, 20.0, 30.0]})

    def test_noise_is_no_created_energy(self):
        """Loss below the noise is negative half the time; three sigma refuses 1 in 740."""
        rng = np.random.default_rng(20)
        refused = 0
        for _ in range(100):
            imag = rng.normal(0.0, 1.0, 3)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", DataWarning)
                    read({**RECTANGULAR, "imag [N/m]": imag, "std": 1.0})
            except DataError:
                refused += 1
        assert refused <= 2  # a binomial of 100 and 0.00135 exceeds 2 once in 2,600 seeds

    def test_known_loss_below_zero_is_refused(self):
        with pytest.raises(DataError, match="creates energy"):
            read({**RECTANGULAR, "imag [N/m]": -4.0, "std": 1.0})
        with pytest.warns(DataWarning, match="creates energy"):
            # four standard errors from two degrees of freedom are not proof
            read({**RECTANGULAR, "imag [N/m]": [-9.0, 300.0, 300.0], "std": 1.0})

    def test_harmonics_may_have_any_sign(self):
        data = read({**RECTANGULAR, "imag [N/m]": [-1e3, 2e3, -1e3], "harmonic": [3, 1, 5]})
        assert data.harmonic.tolist() == [3, 1, 5]

    def test_many_rows_are_counted(self):
        n = 30
        columns = {"frequency_hz": np.arange(1.0, n + 1), "amplitude [m]": 1.0, "gain [N/m]": 1.0}
        with pytest.warns(DataWarning, match="row 10 and 20 more$"):
            read({**columns, "phase_deg": np.linspace(0.5, 1.5, n)})


def exported(folder, name, drive):
    """One file of an analyser: frequency and response, the level in the name alone."""
    R = drive / STIFFNESS
    columns = {"Frequency (Hz)": FREQUENCY, "Real (m/N)": R.real, "Imag (m/N)": R.imag}
    pd.DataFrame(columns).to_csv(folder / name, index=False)
    return folder / name


class TestSilentErrors:
    """What was once read without a word."""

    def table(self, gain, phase):
        n = len(gain)
        return pd.DataFrame({
            "frequency_hz": np.ones(n), "amplitude [m]": np.arange(1.0, n + 1.0),
            "gain [N/m]": gain, "phase_deg": phase,
        })  # fmt: skip

    @pytest.mark.parametrize(
        ("gain", "phase", "message"),
        [
            ([9, 8, 7, 6], [5.0, -8.0, 9.0, 12.0], "creates energy: row 2"),
            ([9, 8, 7], [5.0, 9.0, -8.0], "creates energy: row 3"),
            ([9, 8, 7, 6], [0.1, 0.2, 0.3, 0.4], "gain varies by 33 % at 1 Hz, .* in radians"),
            ([9, 8, 6], [0.1, 0.2, 0.3], "gain varies by 33 % at 1 Hz, .* in radians"),
        ],
    )
    def test_phases_that_cannot_be(self, gain, phase, message):
        with pytest.warns(DataWarning, match=message):
            read_frequency_response(self.table(gain, phase))

    @pytest.mark.parametrize("code", [-9999.0, 9999.0, 1e30, -32768.0])
    def test_marks_of_missing_values(self, code):
        table = self.table([9, 8, 7, 6, 5], [5.0, 8.0, 9.0, 12.0, 13.0])
        table.loc[2, "phase_deg"] = code
        with pytest.raises(DataError, match=r"row 3, column 'phase_deg': the cell is .*missing"):
            read_frequency_response(table)
        large = self.table([9999, 8000, 7000, 6000, 5000], [5.0, 8.0, 9.0, 12.0, 13.0])
        assert read_frequency_response(large).n == 5

    def test_masks(self):
        masked = np.ma.array([1e-3, 2e-3], mask=[False, True])
        with pytest.raises(ValidationError, match="amplitude: some values are masked"):
            FrequencyResponse([1.0, 1.0], [1j, 1j], masked)
        with pytest.raises(ValidationError, match="response: some values are masked"):
            FrequencyResponse([1.0, 1.0], np.ma.array([1j, 2j], mask=[True, False]), [1.0, 1.0])
        runs = np.ma.array(["a", "b"], mask=[True, False])
        with pytest.raises(ValidationError, match="run: some values are masked"):
            FrequencyResponse([1.0, 1.0], [1j, 1j], [1.0, 1.0], run=runs)

    @pytest.mark.parametrize(("unit", "expected"), [("m/V", 0.5), ("mm/V", 0.5e-3), ("V/m", 2.0)])
    def test_gain_for_a_drive(self, unit, expected):
        table = self.table([1.0, 1.0], [-25.0, -25.0] if unit != "V/m" else [25.0, 25.0])
        table = table.rename(columns={"gain [N/m]": f"gain [{unit}]"})
        data = read_frequency_response(table, drive_factor="2 N/V", drive_factor_uncertainty=0.01)
        np.testing.assert_allclose(data.gain, expected)
        assert data.drive_factor_uncertainty == 0.01
        assert data.quantity == ("dynamic_stiffness" if unit == "V/m" else "receptance")

    @pytest.mark.parametrize("text", ["{level[0]} N", "{level.__class__} N", "{0} N", "{level!r}"])
    def test_braces_hold_names_only(self, tmp_path, text):
        (tmp_path / "a1N.csv").write_text("frequency_hz,real [N/m],imag [N/m]\n1,1,1\n")
        with pytest.raises(DataError, match="cannot be filled from the file's name"):
            read_frequency_response(tmp_path / "a1N.csv", level_from_name="a(.)N", drive=text)


class TestManyFiles:
    def test_level_and_drive_from_the_name(self, tmp_path):
        paths = [exported(tmp_path, f"beam_{u}N_a.csv", u) for u in (0.2, 0.5, 1.5)]
        data = read_frequency_response(
            paths, level_from_name=r"_([\d.]+)N", drive="{level} N rms", controlled="force"
        )
        assert data.levels == [0.2, 0.5, 1.5]
        np.testing.assert_allclose(data.drive, np.repeat([0.2, 0.5, 1.5], 3) * math.sqrt(2))
        sources = data.provenance["parts"]
        assert [p["file"] for p in sources] == [str(p) for p in paths]
        assert sources[1]["options"] == {"controlled": "force", "drive": "0.5 N rms", "level": 0.5}

    def test_every_file_is_a_run(self, tmp_path):
        header = "frequency_hz,amplitude [m],real [N/m],imag [N/m]"
        for name in ("monday.csv", "tuesday.csv"):
            (tmp_path / name).write_text(f"{header}\n1,1,2,1\n")
        paths = [tmp_path / "monday.csv", tmp_path / "tuesday.csv"]
        assert read_frequency_response(paths[0]).run is None
        assert read_frequency_response(paths).runs == ["monday", "tuesday"]
        assert read_frequency_response(paths, run="bench").runs == ["bench"]
        days = read_frequency_response(
            paths, level_from_name=r"(?P<level>(?P<day>...))", run="day {day}"
        )
        assert days.runs == ["day mon", "day tue"]

    def test_a_level_in_a_file_of_its_own_is_no_run(self, tmp_path):
        header = "frequency_hz,drive [N],real [m/N],imag [m/N]"
        names = ("20mN", "50mN", "90mN")
        for name in names:
            force = float(name[:2]) / 1000
            rows = "\n".join(f"{f},{force * (1 + 0.01 * f)},{0.1 / f},-0.02" for f in (1, 2, 4))
            (tmp_path / f"{name}.csv").write_text(f"{header}\n{rows}\n")
        paths = [tmp_path / f"{name}.csv" for name in names]
        data = read_frequency_response(paths)
        assert data.run is None
        assert data.levels == list(names)
        by_name = read_frequency_response(paths, level_from_name="([0-9]+)mN")
        assert by_name.run is None
        assert by_name.levels == [20.0, 50.0, 90.0]
        for other in ("20mN again", "21mN"):  # so that one level is in two of the files
            text = paths[0].read_text().replace("0.02", f"0.0{other[:2]}")
            (tmp_path / f"{other}.csv").write_text(text)
            several = read_frequency_response([*paths, tmp_path / f"{other}.csv"])
            assert sorted(several.runs or ()) == sorted([*names, other])

    def test_one_amplitude_at_several_frequencies_is_no_run(self, tmp_path):
        header = "frequency_hz,amplitude [m],real [N/m],imag [N/m]"
        names = ("low 1Hz", "high 1Hz", "low 2Hz", "high 2Hz")
        for name, (hz, x) in zip(names, ((1, 1), (1, 3), (2, 1.02), (2, 2.9)), strict=True):
            (tmp_path / f"{name}.csv").write_text(f"{header}\n{hz},{x},2,1\n")
        paths = [tmp_path / f"{name}.csv" for name in names]
        data = read_frequency_response(paths)
        assert (data.run, data.levels) == (None, list(names))
        (tmp_path / "again.csv").write_text(f"{header}\n1.0002,1.05,2,1\n")
        assert len(read_frequency_response([*paths, tmp_path / "again.csv"]).runs or ()) == 5

    def test_the_run_is_found_by_name(self, tmp_path):
        path = tmp_path / "t.csv"
        path.write_text(
            "file,frequency_hz,amplitude [m],real [N/m],imag [N/m],day\na,1,1,2,1,1\nb,1,1,2,1,2\n"
        )
        assert read_frequency_response(path).runs == ["a", "b"]
        assert read_frequency_response(path, columns={"run": "day"}).runs == ["1", "2"]
        with pytest.raises(DataError, match="its own runs"):
            read_frequency_response(path, run="c")

    def test_named_groups(self, tmp_path):
        path = exported(tmp_path, "runB_5um.csv", 1.0)
        data = read_frequency_response(
            path, level_from_name=r"(?P<level>run.)_(?P<x>\w+)\.", amplitude="{x}"
        )
        assert data.levels == ["runB"]
        np.testing.assert_allclose(data.amplitude, 5e-6)

    def test_range(self, tmp_path):
        path = exported(tmp_path, "a.csv", 1.0)
        assert read_frequency_response(path, drive="1 N", frequency_hz=(1.5, 9.0)).n == 2
        with pytest.raises(DataError, match="no frequency lies from 7 to 9 Hz"):
            read_frequency_response(path, drive="1 N", frequency_hz=(7.0, 9.0))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"level_from_name": "_([0-9.]+)V", "drive": "1 N"}, "finds no group in the name"),
            ({"level_from_name": "_[0-9.]+N", "drive": "1 N"}, "put the level in round"),
            ({"level_from_name": "(", "drive": "1 N"}, "is not a regular expression"),
            ({"drive": 3}, "drive is 3; expected text"),
            ({"level": [], "drive": "1 N"}, r"level is \[\]; expected a text or a number"),
            ({"frequency_hz": [3], "drive": "1 N"}, r"frequency_hz is \[3\]; expected \(low, high"),
            ({"level_from_name": 3}, "level_from_name 3 is not a regular expression"),
            ({"drive": "{level} N"}, "level_from_name gives nothing"),
            ({"drive": "5 um"}, r"drive has the unit \[um\]"),
            ({"sheet": "x", "drive": "1 N"}, "the file is not a workbook"),
        ],
    )
    def test_refusal(self, tmp_path, options, message):
        path = exported(tmp_path, "beam_0.2N.csv", 0.2)
        with pytest.raises((DataError, UnitError, ValidationError), match=message):
            read_frequency_response([path], **options)

    def test_files_that_do_not_go_together(self, tmp_path):
        one = exported(tmp_path, "a.csv", 1.0)
        other = tmp_path / "b.csv"
        other.write_text("frequency_hz,real [N/m],imag [N/m]\n1,1,1\n")
        with pytest.raises(DataError, match=r"do not make one table: parts\[1\]"):
            read_frequency_response([one, other], drive="1 N")
        with pytest.raises(DataError, match="at least one path"):
            read_frequency_response([])


class TestInspect:
    def test_proposes_a_map_that_reads(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text(
            "f0 [Hz],Weg [um],Kraft [N],|H| [um/N],arg H [deg],n\n1,2,1,2,-30,7\n2,4,1,4,-60,7\n"
        )
        contents = inspect(path)
        assert [c.name for c in contents.channels] == ["f0", "Weg", "Kraft", "|H|", "arg H", "n"]
        assert contents.channels[1].range == "2 to 4"
        assert "# not used: n" in contents.column_map
        assert "Kraft" in repr(contents)
        assert "<td" in contents._repr_html_()

    def test_columns_with_names_of_their_own_are_nothing_else(self, tmp_path):
        path, columns = tmp_path / "ours.csv", tmp_path / "ours.toml"
        table = load_dataset("noisy")
        table.save(path)
        text = inspect(path).column_map
        assert "drive" not in text
        assert "# not used" not in text
        assert "# read by their names: covariance_real_real" in text
        columns.write_text(text)
        same = read_frequency_response(path, columns=columns)
        np.testing.assert_array_equal(same.covariance, table.covariance)

    def test_f_is_force_with_time_or_motion_and_frequency_else(self, tmp_path):
        path = tmp_path / "a.csv"
        for names, role in (("f,x_um,K", "frequency"), ("t,x,f", "force"), ("x,y,f", "force")):
            path.write_text(f"{names}\n1,100,29.9\n2,900,28.4\n")
            assert f'[{role}]\ncolumn = "f"' in inspect(path).column_map
        path.write_text("f,A,gain,phase\n1,100,29.9,3\n2,900,28.4,5\n")  # not an acceleration
        proposed = tomllib.loads(inspect(path).column_map)
        named = {role: entry["column"] for role, entry in proposed.items()}
        assert named == {"frequency": "f", "amplitude": "A", "gain": "gain", "phase": "phase"}

    def test_a_frequency_of_another_name_is_not_taken_as_one_hertz(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("Frequenz [Hz],amplitude [m],gain [N/m],phase [deg]\n5,1,1,10\n5,2,1,20\n")
        with pytest.raises(DataError, match="no column holds the frequency"):
            read_frequency_response(path)
        assert read_frequency_response(path, frequency=5).frequency_hz.tolist() == [5.0, 5.0]

    def test_missing_units_are_left_to_fill_in(self, tmp_path):
        path, columns = tmp_path / "a.csv", tmp_path / "lab.toml"
        path.write_text("frequency,drive [N],gain,phase_deg\n1,1,1,10\n2,1,1,20\n")
        blank = 'unit = ""  # the file does not say: fill in'
        text = inspect(path).column_map
        assert text.count(blank) == 2
        columns.write_text(text)
        with pytest.raises(UnitError, match="'frequency' has no unit"):
            read_frequency_response(path, columns=columns)
        text = text.replace(blank, 'unit = "Hz"', 1).replace(blank, 'unit = "N/m"', 1)
        columns.write_text(text)
        assert read_frequency_response(path, columns=columns).quantity == "dynamic_stiffness"

    def test_many_gaps_are_summarised(self, tmp_path):
        time = np.delete(np.arange(400) / 100.0, [*range(5, 400, 10), 206])
        rows = "".join(f"{t},{np.sin(t)},{np.cos(t)}\n" for t in time)
        path = tmp_path / "gaps.csv"
        path.write_text("time [s],x [m],F [N]\n" + rows)
        assert inspect(path).gaps == (
            "40 gaps, 0.81 s in all, median 0.02 s",
            "the longest 2.04 to 2.07 s, the first 0.04 to 0.06 s, the last 3.94 to 3.96 s",
        )

    def test_sampling_and_gaps(self, tmp_path):
        path = tmp_path / "run.csv"
        time = np.r_[0:50, 60:99] / 100.0
        pd.DataFrame({"time [s]": time, "x [mm]": 1.0, "F [N]": 1.0}).to_csv(path, index=False)
        contents = inspect(path)
        assert contents.sampling == "100 Hz, uneven, 89 samples in 0.98 s"
        assert contents.gaps == ("0.49 to 0.6 s",)
        assert '[force]\ncolumn = "F"\nunit = "N"' in contents.column_map
        path.write_text("Zeit,Weg\n[ s ],[ mm ]\n0,1\n0.5,2\n1,1\n")
        assert inspect(path).sampling == "2 Hz, even, 3 samples in 1 s"
        assert '[displacement]\ncolumn = "Weg"\nunit = "mm"' in inspect(path).column_map
        path.write_text("time [s],x [mm]\n1,1\n0,1\n")
        assert inspect(path).sampling == "time does not increase with every sample"
        path.write_text("x [mm],note,empty\n1,a,\n2,b,\n")
        contents = inspect(path)
        assert contents.sampling == ""
        ranges = ["1 to 2", "'a', 'b'", "nothing finite, 2 not finite"]
        assert [c.range for c in contents.channels] == ranges
