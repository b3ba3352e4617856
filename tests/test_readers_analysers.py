"""Files of dynamic signal analysers, made here byte by byte from their manuals."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dahl_ident as di
from dahl_ident.data import inspect, read_frequency_response
from dahl_ident.errors import DataError, DataWarning, UnitError
from tests.reader_fuzz import uff_function, write_uff

FREQUENCY = np.geomspace(1.0, 100.0, 21)
FRICTION = di.Dahl(f_max=0.1, sigma=30.0, alpha=1.0)
LEVELS = (0.05, 0.2, 0.6)
REAL_PART = {"real": {"unit": "mm/N"}}


def receptance(force):
    """Of a driven plant, in m/N."""
    plant = FRICTION + di.Mass(0.01) + di.Damper(0.02)
    return di.response(plant, FREQUENCY, drive=force).displacement / force


def trace(values):
    """The ASCII file of an SR785: the number of points, then real and imaginary parts."""
    return f"{values.size}\r\n" + "".join(f"{v.real:.9e}, {v.imag:.9e}\r\n" for v in values)


class TestSr785:
    def read(self, path, **options):
        how = {"sweep": "1:100Hz log", "drive": "0.2 N", "columns": REAL_PART}
        return read_frequency_response(path, **{**how, **options})

    @pytest.mark.parametrize("separator", [", ", "\t", " "])
    def test_a_trace_that_looks_like_magnitude_and_phase_is_doubted(self, separator, tmp_path):
        path = tmp_path / "trace.asc"
        R = receptance(0.2)
        pairs = zip(np.abs(R).tolist(), np.degrees(np.angle(R)).tolist(), strict=True)
        rows = "".join(f"{a:.9g}{separator}{b:.9g}\n" for a, b in pairs)
        path.write_text(f"{R.size}\n{rows}")
        given: dict[str, Any] = {"sweep": "0.2:5Hz log", "drive": "0.2 N"}
        with pytest.warns(DataWarning, match="look like magnitude and phase"):
            read_frequency_response(path, columns={"real": {"unit": "m/N"}}, **given)
        columns = {
            "gain": {"column": "real", "unit": "m/N"}, "phase": {"column": "imag", "unit": "deg"}
        }  # fmt: skip
        data = read_frequency_response(path, columns=columns, **given)
        np.testing.assert_allclose(data.response, R, rtol=1e-7)

    def test_trace(self, tmp_path):
        path = tmp_path / "trace.asc"
        path.write_text(trace(1e3 * receptance(0.2)), newline="")
        data = self.read(path)
        assert data.quantity == "receptance"
        np.testing.assert_allclose(data.frequency_hz, FREQUENCY, rtol=1e-9)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-8)
        assert set(np.asarray(data.drive)) == {0.2}
        assert set(np.asarray(data.controlled)) == {"force"}
        linear = self.read(path, sweep="10:30Hz linear", frequency_hz=(15.5, 20.5))
        np.testing.assert_allclose(linear.frequency_hz, np.arange(16.0, 21.0))

    def test_auto_level_holds_the_response(self, tmp_path):
        path = tmp_path / "trace.asc"
        path.write_text(trace(1e3 * receptance(0.2)))
        data = self.read(path, drive=None, amplitude="5 um rms")
        assert set(np.asarray(data.controlled)) == {"displacement"}
        np.testing.assert_allclose(np.asarray(data.amplitude), 5e-6 * np.sqrt(2.0))

    def test_other_columns_and_a_column_map(self, tmp_path):
        values = 1e3 * receptance(0.2)
        path = tmp_path / "trace.asc"
        rows = np.column_stack([20 * np.log10(np.abs(values)), np.degrees(np.angle(values))])
        path.write_text("".join(f"{a:.9f}\t{b:.9f}\n" for a, b in rows))
        (tmp_path / "columns.toml").write_text(
            'sweep = "1:100Hz log"\ngain_db = "column 1 [mm/N]"\nphase = "column 2 [deg]"\n'
        )
        data = read_frequency_response(path, columns=tmp_path / "columns.toml", drive="0.2 N")
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-7)

    def test_what_is_missing_is_asked_for(self, tmp_path):
        path = tmp_path / "trace.asc"
        path.write_text(trace(1e3 * receptance(0.2)))
        with pytest.raises(DataError, match=r"give sweep=|sweep='1:100Hz log'"):
            self.read(path, sweep=None)
        with pytest.raises(UnitError, match="column 'real' has no unit"):
            self.read(path, columns=None)
        with pytest.raises(DataError, match="neither an amplitude nor a drive"):
            self.read(path, drive=None)
        for sweep in ("1 to 100 Hz", "1..100 Hz, log", "100:1Hz log", "0:9Hz log"):
            with pytest.raises(DataError, match="sweep is"):
                self.read(path, sweep=sweep)

    @pytest.mark.parametrize("by", [-1, 1])
    def test_rows_are_counted(self, by, tmp_path):
        text = trace(receptance(0.2)).splitlines()
        text = [*text, "1.0, 2.0"] if by > 0 else text[:-1]
        path = tmp_path / "trace.asc"
        path.write_text("\n".join(text) + "\n")
        with pytest.raises(DataError, match=f"first line says 21 points, and {21 + by} follow"):
            self.read(path)

    def test_one_file_for_each_level(self, run):
        for force in LEVELS:
            Path(f"pivot_{1000 * force:g}mN.asc").write_text(trace(1e3 * receptance(force)))
        Path("columns.toml").write_text('[real]\nunit = "mm/N"\n')
        done = run(
            "fit", "*.asc", "--columns", "columns.toml", "--sweep", "1:100Hz log",
            "--level-from-name", "([0-9]+)mN", "--drive", "{level} mN", "--mass", "0.01",
            "--damping", "free", "--noise", "relative", "--json",
        )  # fmt: skip
        told = json.loads(done.out)
        assert told["params"]["f_max"]["value"] == pytest.approx(0.1, rel=0.02)
        assert "runs differ" not in told["verdict"]


def unit(label):
    return struct.pack(">10sf8b", label.encode(), 1.0, *[0] * 8)


def sdf(
    results,
    units=("m", "N"),
    sensitivities=(200.0, 0.1),
    logarithmic=True,
    revision=2,
    overloaded=0,
    averages=40,
):
    """An SDF file of two channels, response over reference, all results on one axis.

    Sizes and places of the fields are those of the Standard Data Format Utilities User's Guide.
    """
    n, first, step = FREQUENCY.size, 1.0, float(FREQUENCY[1])
    measurement = struct.pack(
        ">hii2fi4hif60sf", 11, 140, -1, 50.0, 99.0, 2048, 0, 0, n - 1, 1, averages, 0.0, b"", 0.0
    ) + struct.pack(">3d3hd", 50.0, 99.0, 0.0, 9, 0, 0, 1.0)
    headers, numbers = b"", b""
    for k, (title, kind, values) in enumerate(results):
        is_complex = np.iscomplexobj(values)
        header = struct.pack(
            ">hii16s4h2f9hi2h", 12, 134, -1, title.encode(), 0, kind, n, n - 1, first, step,
            int(logarithmic), 4, 0, 3, 1, is_complex, 0, 0, 1, k, 1, 1,
        )  # fmt: skip
        header += unit("Hz") + struct.pack(">h", 0) + unit("")
        headers += header + struct.pack(">2d2h", first, step, 0, 1)
        numbers += np.asarray(values, ">c8" if is_complex else ">f4").tobytes()
    vectors = b"".join(struct.pack(">hii4h", 13, 18, -1, 1, 0, 48, -48) for _ in results)
    channels = b""
    for k in (1, 0):  # the reference first, as channel 1
        channels += struct.pack(
            ">hii30s12s12s2h5fh2f4h10s", 14, 192, -1, f"Chan {2 - k}".encode(), b"", b"", 0, 0,
            1.0, 0.0, 0.0, 1.0, 1.0, 0, 0.0, -20.0, 3, 1, 0, overloaded, b"V",
        )  # fmt: skip
        channels += unit(units[k]) + struct.pack(">2f", sensitivities[k], 1e6)
        channels += struct.pack(">3h5d", 0, 0, 0, 1.0, 0.0, 0.0, 0.0, 0.0)
    places = np.cumsum([66 + 140, len(headers), len(vectors), len(channels)]).tolist()
    head = struct.pack(
        ">hi5h8s6h7i", 10, 64, revision, 10, 2024, 211, 1015, b"A.01.11", len(results),
        len(results), 2, 0, 0, 0, *places[:3], -1, -1, -1, places[3],
    )  # fmt: skip
    block = struct.pack(">hi", 17, 6 + len(numbers)) + numbers
    assert len(measurement) == 140
    return b"B\0" + head + measurement + headers + vectors + channels + block


class TestSdf:
    def place(self, folder, content, name="TRACE.DAT"):
        (folder / name).write_bytes(content)
        return folder / name

    @pytest.mark.parametrize("name", ["TRACE.DAT", "trace.sdf", "trace"])
    def test_a_swept_sine(self, name, tmp_path):
        volts = receptance(0.2) * 200.0 / 0.1  # V/m of the response over V/N of the force
        path = self.place(tmp_path, sdf([("Freq Resp", 4, volts)]), name)
        data = read_frequency_response(path, drive="0.2 N")
        assert data.quantity == "receptance"
        np.testing.assert_allclose(data.frequency_hz, FREQUENCY, rtol=1e-12)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=2e-7)
        assert "Freq Resp" in str(inspect(path))

    def test_quantities_follow_from_the_units(self, tmp_path):
        content = sdf([("Freq Resp", 4, receptance(0.2))], ("g's", "lbf"), (1.0, 1.0))
        path = self.place(tmp_path, content)
        data = read_frequency_response(path, drive="0.2 N", passive=False)
        assert data.quantity == "accelerance"
        np.testing.assert_allclose(
            data.response, receptance(0.2) * 9.80665 / 4.4482216152605, rtol=2e-7
        )
        content = sdf([("Freq Resp", 4, receptance(0.2))], ("EU", "EU"), (1.0, 1.0))
        path = self.place(tmp_path, content)
        with pytest.raises(UnitError, match="V"):
            read_frequency_response(path, drive="0.2 N")
        named = read_frequency_response(
            path, drive="0.2 N", columns={"response": {"column": "Freq Resp", "unit": "mm/N"}}
        )
        np.testing.assert_allclose(named.response, 1e-3 * receptance(0.2), rtol=2e-7)

    def test_the_coherence_gives_the_standard_deviation(self, tmp_path):
        coherence = np.linspace(0.9, 0.999, FREQUENCY.size)
        content = sdf(
            [("Freq Resp", 4, receptance(0.2)), ("Coherence", 8, coherence)],
            sensitivities=(1.0, 1.0), averages=40,
        )  # fmt: skip
        data = read_frequency_response(self.place(tmp_path, content), drive="0.2 N")
        share = np.sqrt((1.0 - coherence) / (2.0 * 40 * coherence))
        expected = (share * np.abs(receptance(0.2))) ** 2
        covariance = np.asarray(data.covariance)
        np.testing.assert_allclose(covariance[:, 0, 0], expected, rtol=1e-4)
        np.testing.assert_allclose(covariance[:, 1, 1], expected, rtol=1e-4)

    def test_an_overload_is_told(self, tmp_path):
        path = self.place(tmp_path, sdf([("Freq Resp", 4, receptance(0.2))], overloaded=1))
        with pytest.warns(DataWarning, match=r"channel \d was overloaded"):
            read_frequency_response(path, drive="0.2 N")

    def test_damage(self, tmp_path):
        content = sdf([("Freq Resp", 4, receptance(0.2))])
        for changed in (content[:-4], content[:300], content[:70]):
            path = self.place(tmp_path, changed)
            with pytest.raises(DataError, match="the SDF file is damaged"):
                read_frequency_response(path, drive="0.2 N")
        rng = np.random.default_rng(4)
        for _ in range(300):
            noise = bytearray(content)
            for at in rng.integers(6, 760, 3).tolist():
                noise[at] = int(rng.integers(256))
            path = self.place(tmp_path, bytes(noise))
            try:
                inspect(path)
            except DataError:
                continue


class TestHeaders:
    """Exports of measuring programs: lines about the test above a table."""

    ROWS = tuple(zip(FREQUENCY.tolist(), (1e3 * receptance(0.2)).tolist(), strict=True))

    @pytest.mark.parametrize("content", [
        # a test bench's CSV with key and value lines
        "Project;pivot\nRun;12\nDate;2024-03-01 10:12:00\nExcitation level;0.2;N\nAverages;10\n\n"
        "Frequency [Hz];Real [mm/N];Imaginary [mm/N]\n{;}",
        # a header in comments, with a row of units
        "# Test.Lab export\n# Control level: 0.2 N\n# Point: tip:+Z\nFrequency,Real,Imag\n"
        "Hz,mm/N,mm/N\n{,}",
        # tabs and blanks around units, as scanning vibrometers write them
        "Source File Name:\tpivot.svd\nSignal:\tFRF Displacement / Force\nDrive amplitude:\t0.2 N\n"
        "\nFrequency\tReal\tImaginary\n[ Hz ]\t[ mm/N ]\t[ mm/N ]\n{\t}",
        # key=value lines and quoted names
        # the name of the response twice, its parts below the units
        "Project\tpivot\nDrive (N)\t0.2\n\nFrequency\tFRF tip:+Z/tip:+Z\tFRF tip:+Z/tip:+Z\n"
        "Hz\tmm/N\tmm/N\n\tReal\tImag\n{\t}",
        # unit of the level in brackets
        "Operator,me\nExcitation Level (mN),200\nFrequency (Hz),Real (mm/N),Imag (mm/N)\n{,}",
        '"Title=sweep up"\n"Drive Level=200 mN"\n"Frequency (Hz)","Real (mm/N)","Imag (mm/N)"\n{,}',
    ])  # fmt: skip
    def test_level_from_the_header(self, content, tmp_path):
        mark = content[-2]
        rows = "".join(f"{f!r}{mark}{v.real!r}{mark}{v.imag!r}\n" for f, v in self.ROWS)
        path = tmp_path / "export.txt"
        path.write_text(content[:-3] + rows)
        data = read_frequency_response(path)
        assert data.quantity == "receptance"
        np.testing.assert_allclose(np.asarray(data.drive), 0.2)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-12)
        assert any("as the file's header states" in n for n in (data.provenance or {})["notes"])
        other = read_frequency_response(path, drive="0.3 N")
        assert set(np.asarray(other.drive)) == {0.3}

    def test_an_amplitude_of_the_response_is_its_gain(self, tmp_path):
        text = "Frequency;Amplitude;Phase\nHz;mm/N;deg\n"
        for f, v in self.ROWS:
            text += f"{f!r};{abs(v)!r};{float(np.degrees(np.angle(v)))!r}\n"
        path = tmp_path / "export.csv"
        path.write_text(f"Control level;0,2;N\n{text}".replace(".", ","))
        data = read_frequency_response(path)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-12)
        assert set(np.asarray(data.drive)) == {0.2}

    def test_columns_can_be_counted(self, tmp_path):
        rows = "".join(f"{f!r},{v.real!r},{v.imag!r}\n" for f, v in self.ROWS)
        path = tmp_path / "export.csv"
        path.write_text(f"Frequency [Hz],FRF [mm/N],FRF [mm/N]\n{rows}")
        with pytest.raises(DataError, match="2 columns may be the response"):
            read_frequency_response(path, drive="0.2 N")
        columns = {"real": "column 2", "imag": "column 3"}
        data = read_frequency_response(path, drive="0.2 N", columns=columns)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-12)

    def test_a_held_response(self, tmp_path):
        rows = "".join(f"{f!r},{v.real!r},{v.imag!r}\n" for f, v in self.ROWS)
        path = tmp_path / "export.csv"
        path.write_text(
            "Source level: 0.2 N\nControl level: 5 um rms\nFrequency [Hz],Real [mm/N],"
            "Imag [mm/N]\n" + rows
        )
        data = read_frequency_response(path)
        assert data.drive is None
        assert set(np.asarray(data.controlled)) == {"displacement"}
        np.testing.assert_allclose(np.asarray(data.amplitude), 5e-6 * np.sqrt(2.0))

    @pytest.mark.parametrize("line", [
        "Trigger level: 0.2 N", "Level 3: 5 N", "Force sensor: 10 mV", "Drive level: 0.2",
        "Drive level: 0.2 N\nDrive level: 0.3 N", "Drive level: 2 V",
    ])  # fmt: skip
    def test_other_lines_state_none(self, line, tmp_path):
        rows = "".join(f"{f!r},{v.real!r},{v.imag!r}\n" for f, v in self.ROWS)
        path = tmp_path / "export.csv"
        path.write_text(f"{line}\nFrequency [Hz],Real [mm/N],Imag [mm/N]\n{rows}")
        with pytest.raises(DataError, match="neither an amplitude nor a drive"):
            read_frequency_response(path)

    def universal(self, path, force, **changes):
        """Write a receptance over uneven frequencies, its units as labels."""
        labels = {"ordinate_axis_units_lab": "m", "orddenom_axis_units_lab": "N"}
        function = uff_function(receptance(force), FREQUENCY, 4, 8, ref_node=1, **changes, **labels)
        return write_uff(path, function | {"abscissa_spacing": 0})

    def test_universal_files(self, tmp_path):
        paths = [
            self.universal(tmp_path / f"frf {i}.uff", force, id2=f"Excitation level {force} N")
            for i, force in enumerate(LEVELS)
        ]
        data = read_frequency_response(paths)
        assert data.run is None
        assert data.levels == ["0.05 N", "0.2 N", "0.6 N"]
        np.testing.assert_allclose(np.unique(np.asarray(data.drive)), LEVELS)

    @pytest.mark.parametrize("change", [
        lambda b: b.replace(b"\n", b"\r\n"), lambda b: b"\r\n" + b, lambda b: b"\xef\xbb\xbf" + b,
        lambda b: b.replace(b"    -1\n", b"-1\n"), lambda b: b.replace(b"    -1\n", b"    -1   \n"),
        lambda b: b.replace(b"e-", b"D-").replace(b"e+", b"D+"),
        lambda b: b"    -1\n  1858\n 1 2 3\nfree text\n    -1\n" + b,
    ])  # fmt: skip
    def test_universal_files_of_others(self, change, tmp_path):
        path = self.universal(tmp_path / "frf.unv", 0.2, id1="drive level 0.2 N")
        path.write_bytes(change(path.read_bytes()))
        data = read_frequency_response(path)
        np.testing.assert_allclose(data.response, receptance(0.2), rtol=1e-5)
        np.testing.assert_allclose(data.frequency_hz, FREQUENCY, rtol=1e-5)
